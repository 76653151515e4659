"""Pages in headless Chromium: a script is run in them, and what they say of themselves is read."""

from __future__ import annotations

import html
import os
import re
import shutil
import subprocess
from pathlib import Path

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
    window: str = "760,560",
) -> dict[str, str]:
    """Open a page in headless Chromium, run a script in it and return the data attributes of its body."""
    path = tmp_path / "page.html"
    assert text.count("</head>") == 1 and text.count("</body>") == 1
    extra = f"<script>{script}</script></body>" if script else "</body>"
    text = text.replace("<title>", BEFORE + "<title>", 1).replace("</body>", extra)
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
            path.as_uri() + ("#" + wish if wish else ""),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    body = re.search(r"<body[^>]*>", done.stdout)
    assert body, f"Chromium gave no page: {done.stderr[-2000:]}"
    return {k: html.unescape(v) for k, v in re.findall(r'data-([\w-]+)="([^"]*)"', body.group(0))}
