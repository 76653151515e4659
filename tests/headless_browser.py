"""Pages in headless Chromium: a script is run in them, and what they say of themselves is read.

All pages with clouds to turn obey the hand alike: `turned_by_hand` tries it, `check_hand` says what is right.
"""

from __future__ import annotations

import html
import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest


def chromium() -> str:
    for name in ("chromium", "chromium-browser", "google-chrome", "chrome"):
        found = shutil.which(name)
        if found:
            return found
    message = "no Chromium found (chromium, chromium-browser, google-chrome): the page cannot be tried"
    if os.environ.get("CI", "").lower() == "true":
        pytest.fail(message)
    pytest.skip(message)


# Under virtual time a browser without a screen may call neither for frames nor for what is visible.
BEFORE = """<script>
window.requestAnimationFrame = (f) => setTimeout(() => f(performance.now()), 16);
window.IntersectionObserver = class {
  constructor(call) { this.call = call; }
  unobserve() {}
  observe(target) { setTimeout(() => this.call([{ target, isIntersecting: true }]), 10); }
};
</script>"""


def browse(
    tmp_path: Path,
    text: str,
    *,
    script: str = "",
    webgl: bool = True,
    wish: str = "",
    before: str = "",
    window: str = "760,560",
) -> dict[str, str]:
    """Open a page in headless Chromium, run a script in it and return the data attributes of its body.

    Args:
        wish: end of the page's address, with its # or ?.
        before: another script, run before those of the page.
    """
    path = tmp_path / "page.html"
    assert text.count("</head>") == 1 and text.count("</body>") == 1
    extra = f"<script>{script}</script></body>" if script else "</body>"
    first = BEFORE + (f"<script>{before}</script>" if before else "")
    text = text.replace("<title>", first + "<title>", 1).replace("</body>", extra)
    path.write_text(text, encoding="utf-8")
    graphics = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    done = subprocess.run(
        [
            chromium(),
            "--headless",
            "--no-sandbox",
            "--disable-quic",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            f"--user-data-dir={tmp_path / 'profile'}",
            f"--window-size={window}",
            "--virtual-time-budget=20000",
            *(graphics if webgl else ["--disable-gpu", "--disable-3d-apis"]),
            "--dump-dom",
            path.as_uri() + wish,
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    body = re.search(r"<body[^>]*>", done.stdout)
    assert body, f"Chromium gave no page: {done.stderr[-2000:]}"
    return {k: html.unescape(v) for k, v in re.findall(r'data-([\w-]+)="([^"]*)"', body.group(0))}


# What a hand does to a script's stage; for the start of scripts.
HAND = r"""
const settle = () => new Promise((done) => setTimeout(done, 100));
function handOn(stage) {
  stage.setPointerCapture = () => {};
  const send = (Kind, name, more) =>
    stage.dispatchEvent(new Kind(name, { bubbles: true, cancelable: true, ...more }));
  return {
    key: (key, more) => send(KeyboardEvent, "keydown", { key, ...more }),
    pointer: (kind, pointerId, clientX, clientY = 200) =>
      send(PointerEvent, "pointer" + kind, { pointerId, clientX, clientY, buttons: 1 }),
    wheel: (deltaY, more) => send(WheelEvent, "wheel", { deltaY, ...more }),
  };
}
"""
# Everything that a hand can do to the first stage of a page; after each step, the view it was drawn in.
TURN = r"""
(async () => {
  const stage = document.querySelector("#stage, .stage"), within = stage.closest(".card") || document;
  const { key, pointer, wheel } = handOn(stage), notice = document.getElementById("notice");
  const views = {}, last = {};
  const many = (times, step) => { for (let i = 0; i < times; i++) step(); };
  const side = (name) => within.querySelector(`[data-side="${name}"]`).click();
  for (const Kind of [CardRenderer, PlainRenderer]) {
    const draw = Kind.prototype.draw;
    Kind.prototype.draw = function (scene, ...size) {
      Object.assign(last, { canvas: this.canvas, view: Array.from(scene.view) });
      draw.call(this, scene, ...size);
    };
  }
  const note = async (name, step) => { step(); await settle(); views[name] = last.view; };
  const home = within.querySelector("[data-side]").dataset.side;
  await settle();
  await note("home", () => side(home));
  await note("wheel elsewhere", () => wheel(40));
  side(home);
  const drag = () => { pointer("down", 1, 100); pointer("move", 1, 150, 220); pointer("up", 1, 150); };
  await note("dragged", drag);
  await note("left", () => key("ArrowLeft"));
  await note("control", () => key("ArrowLeft", { ctrlKey: true }));
  await note("up", () => key("ArrowUp"));
  await note("moved", () => key("ArrowUp", { shiftKey: true }));
  for (const name of ["top", "front"]) await note(name, () => side(name));
  for (const digit of "1230") await note("digit " + digit, () => key(digit));
  await note("again", () => side(home));
  await note("nearer", () => key("+"));
  await note("nearest", () => key("="));
  await note("wheeled", () => wheel(40));
  await note("wheeled back", () => wheel(-40));
  await note("wheeled by lines", () => wheel(2, { deltaMode: 1 }));
  await note("pinched", () => { pointer("down", 1, 100); pointer("down", 2, 200); pointer("move", 2, 300); });
  await note("unpinched", () => { pointer("move", 2, 200); pointer("up", 1, 0); pointer("up", 2, 0); });
  await note("pitch's limit", () => many(30, () => key("ArrowDown")));
  await note("near limit", () => many(90, () => key("+")));
  await note("far limit", () => many(90, () => key("_")));
  const log = { views, renderer: document.body.dataset.renderer };
  if (log.renderer === "webgl2") {
    last.canvas.getContext("webgl2").getExtension("WEBGL_lose_context").loseContext();
    await settle();
    await note("after the loss", () => side("top"));
  }
  log.notice = notice && !notice.hidden ? notice.textContent : null;
  document.body.dataset.log = JSON.stringify(log);
})().catch((problem) => { document.body.dataset.error = "script: " + problem; });
"""
# A graphics card that answers everything and draws nothing.
NO_INK = """
WebGL2RenderingContext.prototype.readPixels = (x, y, width, height, format, type, pixels) => {
  for (let i = 0; i < pixels.length; i += 4) pixels.set([241, 242, 244, 255], i);
};
"""


def turned_by_hand(tmp_path: Path, text: str, *, webgl: bool) -> dict[str, Any]:
    """What becomes of a page's first stage under a hand: views (4, 4) by step, first renderer, notice."""
    seen = browse(tmp_path, text, script=HAND + TURN, webgl=webgl)
    assert "error" not in seen, seen["error"]
    log = json.loads(seen["log"])
    assert log["renderer"] == ("webgl2" if webgl else "canvas2d")
    assert seen["renderer"] == "canvas2d"  # the card was lost
    return {**log, "views": {name: np.reshape(view, (4, 4)).T for name, view in log["views"].items()}}


def check_hand(
    views: dict[str, np.ndarray],
    axes: list[list[float]],
    radius: float,
    *,
    pitch: float,
    per_pixel: float = 0.007,
    limits: tuple[float, float] = (0.02, 40.0),
    digits: bool = True,
    wheel_always: bool = True,
) -> None:
    """Assert what a hand does to every stage.

    Args:
        views: of `turned_by_hand`.
        axes, radius: as the page's data hold them.
        pitch: of the view that a page begins with.
        per_pixel: angle of a drag.
        limits: of the distance, in radii.
        digits: whether the keys 0 to 3 choose a side.
        wheel_always: whether the wheel zooms a stage that was not chosen before.
    """
    right, forward, up = np.array(axes)

    def angles(name: str) -> list[float]:
        across, above, back = views[name][:3, :3]
        return [np.arctan2(across @ forward, across @ right), np.arctan2(back @ up, above @ up)]

    def eye(name: str) -> np.ndarray:
        return -views[name][:3, :3].T @ views[name][:3, 3]

    def way(one: str, other: str) -> float:
        """From one eye to the other, positive when it goes back and forth along the line of sight only."""
        step = views[other][:3, :3] @ (eye(other) - eye(one))
        np.testing.assert_allclose(step[:2], 0.0, atol=1e-4 * radius)
        return float(step[2])

    def near(name: str, *expected: float) -> None:
        np.testing.assert_allclose(angles(name), expected, atol=1e-6)

    home = (-0.6, pitch)
    near("home", *home)
    if not wheel_always:
        np.testing.assert_array_equal(views["wheel elsewhere"], views["home"])
    else:
        assert way("home", "wheel elsewhere") > 0
    yaw, pitch = -0.6 - 50 * per_pixel, pitch + 20 * per_pixel
    near("dragged", yaw, pitch)
    near("left", yaw - 0.09, pitch)
    np.testing.assert_array_equal(views["control"], views["left"])  # is the browser's own
    near("up", yaw - 0.09, pitch + 0.09)
    near("moved", yaw - 0.09, pitch + 0.09)
    step = views["up"][:3, :3] @ (eye("moved") - eye("up"))
    assert step[1] > 0.001 * radius
    np.testing.assert_allclose(step[[0, 2]], 0.0, atol=1e-6 * radius)
    near("top", 0, np.pi / 2)
    near("front", 0, 0)
    for digit, side in zip("1230", ((0, np.pi / 2), (0, 0), (np.pi / 2, 0), home), strict=True):
        near(f"digit {digit}", *(side if digits else (0, 0)))
    np.testing.assert_allclose(views["again"], views["home"])  # also where it was moved and zoomed since
    first, second = way("again", "nearer"), way("nearer", "nearest")
    assert first < 0
    assert second == pytest.approx(0.87 * first, rel=1e-4)
    distance = first / -0.13 * 0.87**2
    assert way("nearest", "wheeled") == pytest.approx(distance * np.expm1(0.1), rel=1e-4)
    assert way("nearest", "wheeled back") == pytest.approx(0.0, abs=1e-6 * radius)
    distance *= np.exp(0.09)  # two lines are 36 pixels
    assert way("nearest", "wheeled by lines") == pytest.approx(distance * (1 - np.exp(-0.09)), rel=1e-4)
    pinched = views["pinched"][:3, :3] @ (eye("pinched") - eye("wheeled by lines"))
    assert pinched[2] == pytest.approx(-distance / 2, rel=1e-4)  # fingers twice as far apart
    assert pinched[0] < 0  # and the clouds go with them
    near("pitch's limit", -0.6, -np.pi / 2)
    assert way("near limit", "far limit") == pytest.approx((limits[1] - limits[0]) * radius, rel=1e-4)
    if "after the loss" in views:
        near("after the loss", 0, np.pi / 2)


def check_card_without_ink(tmp_path: Path, text: str) -> str | None:
    """Assert that a page notices when its graphics card draws nothing; returns what it says."""
    script = "setTimeout(() => { const found = document.getElementById('notice'); "
    script += "document.body.dataset.notice = found ? found.textContent : ''; }, 1000);"
    seen = browse(tmp_path, text, script=script, before=NO_INK)
    assert "error" not in seen, seen["error"]
    assert (seen["ready"], seen["renderer"]) == ("true", "canvas2d")
    assert float(seen["covered"]) > 0.02
    return seen["notice"]
