"""The page: self-contained, escaped, holding the clouds and the answer, and usable in a browser."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from headless_browser import HAND, browse, check_card_without_ink, check_hand, turned_by_hand
from registration_views import NASTY, UTM, make_result, nasty_view, room_view, without_transform
from scipy.spatial.transform import Rotation, Slerp

from geomoe3d.geometry.se3 import make_transform, rotation_angle_deg, transform_points
from geomoe3d.types import Alternative
from geomoe3d.visual.drawing import build_drawing, distance_to_target
from geomoe3d.visual.page import distance_limit, render_page, save_page
from geomoe3d.visual.view import RegistrationView

# ---------------------------------------------------------------- the page as a file


class Page(HTMLParser):
    """Elements, their attributes and the text in them, as a browser would split them."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[tuple[str, str]] = []
        self.open: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag not in ("meta", "input", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, f"</{tag}> does not close what is open"

    def handle_data(self, data):
        self.texts.append((self.open[-1] if self.open else "", data))

    def rows(self) -> list[tuple[str, str]]:
        """Headed rows of the tables."""
        cells = [text for tag, text in self.texts if tag in ("th", "td")]
        heads = [k for k, (tag, _) in enumerate(t for t in self.texts if t[0] in ("th", "td")) if tag == "th"]
        return [(cells[k], cells[k + 1]) for k in heads]

    def data(self) -> dict:
        return json.loads(max((text for tag, text in self.texts if tag == "script"), key=len))


def decode(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype=kind)


def test_page_keeps_user_text_as_text_and_asks_no_network():
    text = render_page(nasty_view())
    page = Page(text)
    assert page.open == []
    tags = [tag for tag, _ in page.elements]
    assert tags.count("script") == 4
    assert "img" not in tags and "i" in tags  # the only <i> is the page's own colour scale
    joined = "".join(data for tag, data in page.texts if tag not in ("script", "style"))
    for words in (
        NASTY,
        '"><img src=x onerror=alert(1)>',
        "<i>reason</i> & </script><script>alert(1)</script>",
    ):
        assert words in joined
    assert page.data()["lines"]["classes"][0]["label"] == "</script><script>alert(2)</script>"
    for tag, attributes in page.elements:
        assert not {"src", "href", "action", "srcset", "data"} & set(attributes), (tag, attributes)
        assert not any(name.startswith("on") for name in attributes)
    policy = next(a["content"] for t, a in page.elements if t == "meta" and "http-equiv" in a)
    assert policy.startswith("default-src 'none'")
    for word in (
        "http://",
        "https://",
        "@import",
        "url(",
        "fetch(",
        "XMLHttpRequest",
        "innerHTML",
        "{{title}}",
    ):
        assert word not in text
    labels = {a["id"] for _, a in page.elements if "id" in a}
    assert len(labels) == sum("id" in a for _, a in page.elements)  # ids are unique


def test_the_colour_scale_ends_where_the_data_do():
    rng = np.random.default_rng(0)
    fit, rim = (
        np.abs(rng.normal(0, 0.01, 9000)),
        rng.uniform(0, 0.4, 1000),
    )  # what lies on it, and beside its end
    limit = distance_limit(np.concatenate([fit, rim, [np.inf]]), 0.4)
    assert 0.03 < limit < 0.06
    assert distance_limit(np.full(3, np.inf), 0.4) == distance_limit(np.zeros(3), 0.4) == 0.4


def test_page_data_are_the_clouds_and_the_answer():
    view = nasty_view()
    data = Page(render_page(view)).data()
    scene = build_drawing(view, max_points=50_000)
    source = decode(data["source"]["points"], "<f4").reshape(-1, 3)
    assert len(source) == len(view.source_points)
    after = np.array(data["motions"]["answer"]).reshape(4, 4)
    there = transform_points(after, source.astype(float)) + scene.target_center
    np.testing.assert_allclose(there, view.result.apply(view.source_points), atol=1e-5)
    target = decode(data["target"]["points"], "<f4").reshape(-1, 3) + scene.target_center
    np.testing.assert_allclose(target, view.target_points, atol=1e-5)
    colors = decode(data["source"]["colors"], "u1").reshape(-1, 3)
    np.testing.assert_allclose(colors / 255.0, view.source_colors, atol=0.5 / 255 + 1e-9)
    assert data["target"]["colors"] is None
    for name, T in (
        ("answer", view.result.T_target_source),
        ("alternative", view.result.alternative.T_target_source),
    ):
        copied = np.array([[float(v) for v in line.split()] for line in data["matrices"][name].splitlines()])
        np.testing.assert_array_equal(copied, T)  # every bit
    reach, limit = data["distanceReach"], data["distanceLimit"]
    assert reach == 2 * view.result.inlier_threshold
    assert 0 < limit <= reach
    for name, motion in (("answer", scene.after), ("alternative", scene.alternative)):
        distance = distance_to_target(view, scene, motion, reach)
        levels = decode(data["distances"][name], "u1")
        np.testing.assert_allclose(
            levels, np.where(distance < reach, np.minimum(254 * distance / limit, 254), 255), atol=0.501
        )
        assert len(np.unique(levels)) > 50
    lines = decode(data["lines"]["vertices"], "<f4").reshape(-1, 2, 3)
    assert [(kind["total"], kind["drawn"]) for kind in data["lines"]["classes"]] == [(150, 150), (150, 150)]
    moved = transform_points(after, lines[:, 0].astype(float))
    length = np.linalg.norm(moved - lines[:, 1], axis=1)
    np.testing.assert_allclose(np.sort(length), np.sort(view.residuals()), atol=1e-4)


def test_page_is_small_and_repeatable(tmp_path):
    rng = np.random.default_rng(0)
    num = 100_000
    points = rng.random((num, 3)) * [30, 20, 3]
    matches = points[rng.integers(0, num, 20_000)]
    view = RegistrationView(
        points,
        points + UTM,
        make_result(make_transform(np.eye(3), UTM), alternative=Alternative(np.eye(4), 0.5, 0.0, 9.0)),
        np.hstack([matches, matches + UTM + rng.normal(0, 0.1, matches.shape)]),
        source_colors=rng.random((num, 3)),
        target_colors=rng.random((num, 3)),
    )
    save_page(view, tmp_path / "a.html")
    assert (tmp_path / "a.html").stat().st_size < 3_000_000
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert re.search(r"Drawn: 4\d,\d\d\d of 100,000 source points", text)
    assert render_page(room_view()) == render_page(room_view())


# ---------------------------------------------------------------- the page in a browser


# Uses the page as a person would and notes what it says it drew after each step.
USE = r"""
(async () => {
  const body = document.body, byId = (id) => document.getElementById(id), log = {};
  const { key } = handOn(byId("stage"));
  const note = async (name) => { await settle(); log[name] = { ...body.dataset }; };
  const slide = (id, value) => { byId(id).value = value; byId(id).dispatchEvent(new Event("input")); };
  await note("start");
  for (const at of [0, 0.25, 0.5, 1]) { slide("progress", at); await note("at" + at); }
  key("ArrowLeft"); await note("turned");
  key("ArrowUp", { shiftKey: true }); await note("moved");
  key("+"); await note("zoomed");
  key("1"); await note("top");
  byId("show-source").click(); await note("hidden");
  byId("show-source").click();
  byId("classes").querySelector("input").click(); await note("lines");
  document.querySelector('[name="color"][value="distance"]').click();
  log.bars = byId("histogram").querySelectorAll("i").length; log.near = byId("beyond").textContent;
  document.querySelector('[name="motion"][value="alternative"]').click();
  await note("alternative");
  key(" "); await note("playing"); key(" ");
  const clipboard = { writeText: async (text) => { log.copied = text; } };
  Object.defineProperty(navigator, "clipboard", { value: clipboard });
  document.querySelector('[data-copy="answer"]').click(); await settle();
  log.wronglyMade = document.querySelectorAll("b:not(.names b), img").length;
  body.dataset.log = JSON.stringify(log);
})().catch((problem) => { document.body.dataset.error = "script: " + problem; });
"""


def model(entry: dict[str, str]) -> np.ndarray:
    return np.array([float(v) for v in entry["model"].split()]).reshape(4, 4).T


def camera(entry: dict[str, str]) -> np.ndarray:
    return np.array([float(v) for v in entry["camera"].split()])


@pytest.mark.parametrize("webgl", [True, False], ids=["webgl2", "canvas2d"])
def test_page_in_a_browser(tmp_path, webgl):
    view = nasty_view()
    seen = browse(tmp_path, render_page(view), script=HAND + USE, webgl=webgl)
    assert "error" not in seen, seen["error"]
    assert seen["ready"] == "true"
    assert seen["renderer"] == ("webgl2" if webgl else "canvas2d")
    log = json.loads(seen["log"])
    num = len(view.source_points) + len(view.target_points)
    assert log["start"]["drawnPoints"] == str(num)
    assert log["start"]["drawnLines"] == "300"
    assert 0.03 < float(log["start"]["covered"]) < 0.9
    assert log["hidden"]["drawnPoints"] == str(len(view.target_points))
    assert log["lines"]["drawnLines"] == "150"
    assert log["wronglyMade"] == 0
    np.testing.assert_array_equal(
        np.array(log["copied"].split(), dtype=float).reshape(4, 4), view.result.T_target_source
    )

    # The slider moves the source rigidly: spherical interpolation, about the source's own middle.
    scene = build_drawing(view, max_points=50_000)
    path = Slerp([0, 1], Rotation.from_matrix([scene.before[:3, :3], scene.after[:3, :3]]))
    for at in (0, 0.25, 0.5, 1):
        expected = make_transform(
            path(at).as_matrix(), (1 - at) * scene.before[:3, 3] + at * scene.after[:3, 3]
        )
        np.testing.assert_allclose(model(log[f"at{at}"]), expected, atol=1e-9)
    np.testing.assert_allclose(model(log["alternative"]), scene.alternative, atol=1e-9)
    assert rotation_angle_deg(model(log["playing"])[:3, :3].T @ scene.alternative[:3, :3]) > 0.5

    yaw, pitch, distance = range(3)
    start, turned, moved = camera(log["at1"]), camera(log["turned"]), camera(log["moved"])
    assert turned[yaw] != start[yaw] and np.array_equal(turned[1:], start[1:])
    assert np.array_equal(moved[:3], turned[:3]) and not np.array_equal(moved[3:], turned[3:])
    assert log["bars"] == 51 and "have a target point within" in log["near"]
    assert camera(log["zoomed"])[distance] == pytest.approx(0.87 * moved[distance], rel=1e-4)
    top = camera(log["top"])
    assert top[pitch] == pytest.approx(np.pi / 2, rel=1e-5)


PHONE = """
(async () => {
  const stage = document.getElementById("stage");
  await settle();
  for (const side of ["home", "top", "front", "side"]) {
    document.querySelector(`[data-side="${side}"]`).click();
    await settle();
    document.body.dataset["at" + side] = document.body.dataset.camera;
  }
  document.body.dataset.size = stage.clientWidth + " " + stage.clientHeight;
})();
"""


@pytest.mark.parametrize("window", ["390,844", "1280,800", "500,300"])
def test_nothing_is_cut_off_on_a_phone_or_elsewhere(tmp_path, window):
    view = nasty_view()
    text = render_page(view)
    seen = browse(tmp_path, text, script=HAND + PHONE, webgl=False, window=window)
    assert "error" not in seen, seen["error"]
    width, height = (float(v) for v in seen["size"].split())
    scene, data = build_drawing(view, max_points=50_000), Page(text).data()
    points = np.concatenate([scene.target, transform_points(scene.after, scene.source)])
    right, forward, up = np.array(data["axes"])
    for side in ("home", "top", "front", "side"):
        yaw, pitch, distance, *center = (float(v) for v in seen[f"at{side}"].split())
        level = np.cos(yaw) * forward - np.sin(yaw) * right
        across = np.cos(yaw) * right + np.sin(yaw) * forward
        above, look = np.sin(pitch) * level + np.cos(pitch) * up, np.cos(pitch) * level - np.sin(pitch) * up
        at = points - center
        depth = (distance + at @ look) * np.tan(np.radians(20))
        shown = np.abs(np.stack([at @ across / (depth * width / height), at @ above / depth]))
        assert np.mean(shown.max(axis=0) > 1) < 0.005, side
        assert shown.max(axis=1).max() > 0.5, side  # and it fills the stage


def test_lengths_have_the_name_of_their_unit():
    view = nasty_view()
    assert "0.05" in dict(Page(render_page(view)).rows())["voxel size"]
    rows = dict(Page(render_page(replace(view, unit="mm"))).rows())
    assert rows["voxel size"] == "0.05 mm" and rows["inlier threshold"].endswith(" mm")


def test_the_alternative_is_shown_where_it_matters(tmp_path):
    view = nasty_view()
    other = view.result.alternative
    for status, score, shown in (("ok", 0.1, False), ("ok", 0.5, True), ("ambiguous", 0.1, True)):
        result = replace(view.result, status=status, alternative=replace(other, relative_score=score))
        text = render_page(replace(view, result=result))
        assert ("Alternative" in text) == shown
        assert (Page(text).data()["motions"]["alternative"] is not None) == shown


@pytest.mark.parametrize("webgl", [True, False], ids=["webgl2", "canvas2d"])
def test_page_obeys_the_hand(tmp_path, webgl):
    text = render_page(nasty_view())
    log, data = turned_by_hand(tmp_path, text, webgl=webgl), Page(text).data()
    check_hand(log["views"], data["axes"], data["radius"], pitch=0.5)
    why = "the graphics card was lost" if webgl else "no WebGL 2"
    assert log["notice"] == f"Drawn without a graphics card ({why}): slower, otherwise the same."


def test_page_draws_without_a_card_that_draws_nothing(tmp_path):
    said = check_card_without_ink(tmp_path, render_page(nasty_view()))
    assert said == "Drawn without a graphics card (it drew nothing): slower, otherwise the same."


def test_page_without_transform_shows_only_before(tmp_path):
    view = without_transform(room_view())
    text = render_page(view)
    assert "No transform was found" in text
    assert "data-copy" not in "".join(str(attributes) for _, attributes in Page(text).elements)
    script = "document.body.dataset.locked = document.getElementById('progress').disabled"
    seen = browse(tmp_path, text, script=script, wish="#at=1&renderer=canvas2d&color=distance")
    assert "error" not in seen
    assert seen["locked"] == "true"
    assert seen["drawn-points"] == str(len(view.source_points) + len(view.target_points))
    scene = build_drawing(view, max_points=50_000)
    np.testing.assert_allclose(model(seen), scene.before, atol=1e-9)
