"""The window: what its keys switch, and a clear word where there is no display."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from registration_views import nasty_view, room_view, without_transform

from geomoe3d.errors import OutputError
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.visual.drawing import build_drawing
from geomoe3d.visual.window import WindowContent, show_window


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="displays are found by environment on Linux only"
)
def test_window_without_display_says_so(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(OutputError, match=r"no display.*\.html"):
        show_window(room_view())
    monkeypatch.setenv("WAYLAND_DISPLAY", "no-such-socket")
    with pytest.raises(OutputError, match="nothing answers at WAYLAND_DISPLAY=no-such-socket"):
        show_window(room_view())


def test_window_content_switches():
    pytest.importorskip("open3d", exc_type=ImportError)
    view = nasty_view()
    scene = build_drawing(view, max_points=1000)
    content = WindowContent(replace(view, groups=None), scene)

    def source():
        return np.asarray(content.source.points)

    def colors():
        return np.asarray(content.source.colors)

    assert len(content.geometries()) == 3
    np.testing.assert_allclose(source(), transform_points(scene.after, scene.source))
    lengths = np.linalg.norm(np.diff(np.asarray(content.lines.points).reshape(2, -1, 3), axis=0)[0], axis=1)
    assert lengths.max() <= view.result.inlier_threshold  # only agreeing ones, and they are in place
    assert len(np.unique(colors(), axis=0)) == 1
    content.switch_stage()
    np.testing.assert_allclose(source(), transform_points(scene.before, scene.source))
    content.switch_alternative()
    np.testing.assert_allclose(source(), transform_points(scene.alternative, scene.source))
    content.switch_alternative()
    np.testing.assert_allclose(source(), transform_points(scene.after, scene.source))
    content.switch_colors()
    np.testing.assert_allclose(colors(), view.source_colors[scene.source_rows])
    content.switch_lines()
    pairs = np.asarray(content.lines.lines)
    assert len(pairs) and (pairs[:, 0] == pairs[:, 1]).all()
    lost = without_transform(replace(view, groups=None, correspondences=np.zeros((0, 6))))
    content = WindowContent(lost, build_drawing(lost, max_points=1000))
    content.switch_stage()
    content.switch_alternative()
    assert len(content.geometries()) == 2
    np.testing.assert_allclose(source(), transform_points(scene.before, scene.source))
