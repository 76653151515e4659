"""A window of Open3D in which the clouds can be turned; needs a display and blocks until it is closed.

For machines without a display there are `picture` and `page`. Cost: the thinned clouds, at most 200,000
points each, and Open3D's own start of about a second.
"""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.errors import DependencyError, OutputError
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.types import FloatArray
from geomoe3d.visual.drawing import (
    GROUP_COLORS,
    KEPT_COLOR,
    REJECTED_COLOR,
    SOURCE_COLOR,
    STATUS_WORDS,
    TARGET_COLOR,
    Drawing,
    build_drawing,
    choose_rows,
    rgb,
)
from geomoe3d.visual.view import RegistrationView


def show_window(view: RegistrationView) -> None:
    """Show one registration and return when the window is closed.

    Keys: space switches between before and after, A to the alternative, L shows or hides the correspondences,
    C switches between the clouds' own colours and one colour each; the rest as in Open3D (H prints it).

    Args:
        view: what to show.

    Raises:
        OutputError: there is no display, or the window cannot be opened.
        DependencyError: Open3D cannot be imported.
    """
    check_display()
    try:
        import open3d as o3d
    except (ImportError, OSError) as error:
        raise DependencyError(
            f"the window needs Open3D, which cannot be imported ({error}); "
            "'geomoe3d doctor' says what is missing"
        ) from error

    drawing = build_drawing(view, max_points=200_000)
    shown = WindowContent(view, drawing)
    window = o3d.visualization.VisualizerWithKeyCallback()
    result = view.result
    title = (
        f"{result.source.name} (orange) on {result.target.name} (blue): {STATUS_WORDS[result.status]}"
        " - space: before/after, A: alternative, L: lines, C: colours"
    )
    if not window.create_window(title, 1280, 860):
        raise OutputError("cannot open a window on this display; write a picture or a page instead")
    try:
        for geometry in shown.geometries():
            window.add_geometry(geometry)

        def on(change: Any) -> Any:
            def callback(window: Any) -> bool:
                change()
                for geometry in shown.geometries():
                    window.update_geometry(geometry)
                return True

            return callback

        for key, change in (
            (" ", shown.switch_stage),
            ("A", shown.switch_alternative),
            ("L", shown.switch_lines),
            ("C", shown.switch_colors),
        ):
            window.register_key_callback(ord(key), on(change))
        right, forward, up = drawing.axes
        control = window.get_view_control()
        control.set_lookat(np.zeros(3))
        control.set_front(0.45 * right - 0.75 * forward + 0.5 * up)
        control.set_up(up)
        control.set_zoom(0.7)
        window.run()
    finally:
        window.destroy_window()


class WindowContent:
    """The Open3D geometries of a view, and what the keys do to them. Opens nothing."""

    def __init__(self, view: RegistrationView, drawing: Drawing) -> None:
        import open3d as o3d

        self._vectors = o3d.utility.Vector3dVector
        self._drawing = drawing
        self.motion = drawing.before if drawing.after is None else drawing.after
        self.lines_shown = True
        self.own_colors = False
        self._own = [
            None if colors is None else colors[rows]
            for colors, rows in (
                (view.source_colors, drawing.source_rows),
                (view.target_colors, drawing.target_rows),
            )
        ]
        self.source = o3d.geometry.PointCloud()
        self.target = o3d.geometry.PointCloud()
        self.target.points = self._vectors(drawing.target)
        self.lines = o3d.geometry.LineSet()
        rows, colors = _chosen_lines(view)
        self._starts = view.correspondences[rows, :3] - drawing.source_center
        self._ends = view.correspondences[rows, 3:] - drawing.target_center
        self._line_colors = colors
        pairs = np.arange(2 * len(rows)).reshape(2, -1).T
        self._pairs = o3d.utility.Vector2iVector(np.ascontiguousarray(pairs, dtype=np.int32))
        # Hidden lines have length zero: Open3D warns of a set without lines at every frame.
        self._no_pairs = o3d.utility.Vector2iVector(np.zeros((len(rows), 2), dtype=np.int32))
        self._refresh()

    def geometries(self) -> list[Any]:
        """The source cloud, the target cloud and the lines, as they are to be shown now; no empty ones."""
        candidates = ((self.source, len(self._drawing.source)), (self.target, len(self._drawing.target)))
        return [cloud for cloud, num in candidates if num] + ([self.lines] if len(self._starts) else [])

    def switch_stage(self) -> None:
        """From before to after, from anything else to before."""
        if self._drawing.after is not None:
            self.motion = self._drawing.after if self.motion is self._drawing.before else self._drawing.before
        self._refresh()

    def switch_alternative(self) -> None:
        """To the alternative and back to the answer; nothing where there is no alternative."""
        if self._drawing.after is not None and self._drawing.alternative is not None:
            at_alternative = self.motion is self._drawing.alternative
            self.motion = self._drawing.after if at_alternative else self._drawing.alternative
        self._refresh()

    def switch_lines(self) -> None:
        """Show or hide the correspondences."""
        self.lines_shown = not self.lines_shown
        self._refresh()

    def switch_colors(self) -> None:
        """Between the clouds' own colours, where they have any, and one colour each."""
        self.own_colors = not self.own_colors
        self._refresh()

    def _refresh(self) -> None:
        self.source.points = self._vectors(transform_points(self.motion, self._drawing.source))
        for cloud, own, plain in (
            (self.source, self._own[0], SOURCE_COLOR),
            (self.target, self._own[1], TARGET_COLOR),
        ):
            if self.own_colors and own is not None:
                cloud.colors = self._vectors(own)
            else:
                cloud.paint_uniform_color(rgb(plain))
        starts = transform_points(self.motion, self._starts)
        self.lines.points = self._vectors(np.concatenate([starts, self._ends]))
        self.lines.lines = self._pairs if self.lines_shown else self._no_pairs
        self.lines.colors = self._vectors(self._line_colors)


def check_display() -> None:
    """Say in words that there is no display, where Open3D would hang on an invisible window. Raises
    OutputError: on Linux, neither X11 nor Wayland answers."""
    if not sys.platform.startswith("linux"):
        return
    instead = "write a picture (.png) or a page (.html) instead"
    x11, wayland = os.environ.get("DISPLAY"), os.environ.get("WAYLAND_DISPLAY")
    if not x11 and not wayland:
        raise OutputError(
            f"cannot open a window: there is no display (DISPLAY and WAYLAND_DISPLAY are not set); {instead}"
        )
    if wayland and Path(os.environ.get("XDG_RUNTIME_DIR", "/"), wayland).exists():
        return
    if x11:
        try:
            library = ctypes.CDLL("libX11.so.6")
        except OSError:
            return  # Open3D itself will say that it is missing
        library.XOpenDisplay.restype = ctypes.c_void_p
        library.XCloseDisplay.argtypes = [ctypes.c_void_p]
        display = library.XOpenDisplay(None)
        if display:
            library.XCloseDisplay(display)
            return
    name = f"DISPLAY={x11}" if x11 else f"WAYLAND_DISPLAY={wayland}"
    raise OutputError(f"cannot open a window: nothing answers at {name}; {instead}")


def _chosen_lines(view: RegistrationView) -> tuple[Any, FloatArray]:
    """Rows of the correspondences that are drawn, and the colour of each."""
    if view.groups is not None:
        palette = np.array([rgb(color) for color in GROUP_COLORS])
        colors = palette[view.groups % len(palette)]
        mask = np.ones(len(view.correspondences), dtype=bool)
    else:
        kept = view.kept()
        colors = np.where(kept[:, None], rgb(KEPT_COLOR), rgb(REJECTED_COLOR))
        mask = kept if kept.any() else ~kept
    mask = mask & np.isfinite(view.correspondences).all(axis=1)
    rows = choose_rows(mask, 1_000, view.result.seed)
    return rows, colors[rows]
