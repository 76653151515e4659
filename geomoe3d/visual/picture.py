"""One picture of a registration: before, after, correspondences, residuals and the verdict.

Needs matplotlib, but neither a display nor pyplot: the figure is made and saved directly. This file lays the
panels out and draws the stages; `panels` draws the lower row. Cost: about two seconds, whatever the size of
the clouds.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np

from geomoe3d.geometry.se3 import transform_points
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray
from geomoe3d.visual.accuracy_facts import length
from geomoe3d.visual.drawing import (
    SOURCE_COLOR,
    STATUS_COLORS,
    STATUS_WORDS,
    TARGET_COLOR,
    Drawing,
    build_drawing,
)
from geomoe3d.visual.panels import draw_correspondences, draw_facts, draw_residuals
from geomoe3d.visual.paper import (
    INK,
    LABEL_BOX,
    SIDES,
    SOFT,
    bounds,
    draw_scale_bar,
    frame,
    save_figure,
    say,
    shorten,
    show,
)
from geomoe3d.visual.view import RegistrationView
from geomoe3d.visual.xray import xray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_POINTS = 60_000


def save_picture(view: RegistrationView, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Draw one registration, about 1600 x 1400 pixels.

    Args:
        view: what to show.
        path: the file to be written; its suffix chooses the format (.png, .pdf, .svg, .jpg, .jpeg, .webp).
        force: True replaces an existing file.

    Raises:
        FormatError: the suffix names no picture format.
        OutputError: the file exists and ``force`` is False, or it cannot be written.
    """
    save_figure(path, lambda vector: draw_picture(view, fineness=2.0 if vector else 1.0), force=force)


def draw_picture(view: RegistrationView, *, fineness: float = 1.0) -> Figure:
    """The figure that `save_picture` saves.

    Args:
        view: what to show.
        fineness: raster points per pixel in the cloud panels; 2 suits formats that can be zoomed.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16.0, 14.0), dpi=100, facecolor="white")
    drawing = build_drawing(view, max_points=MAX_POINTS)
    rows = figure.add_gridspec(
        3, 1, height_ratios=(1, 1, 1.05), left=0.02, right=0.98, top=0.895, bottom=0.04, hspace=0.16
    )
    _draw_header(figure, view)
    for row, (title, motion, note) in enumerate(_stages(view, drawing)):
        cells = rows[row].subgridspec(1, 3, wspace=0.03)
        panels = [figure.add_subplot(cells[column]) for column in range(3)]
        panels[0].set_title(title, loc="left", fontsize=13, fontweight="bold", color=INK, pad=8)
        panels[-1].set_title(note, loc="right", fontsize=10, color=SOFT, pad=8)
        if motion is None:
            draw_absent(panels, "no transform was found: there is nothing to show")
        else:
            draw_sides(figure, panels, drawing, motion, fineness, view.unit)
    below = rows[2].subgridspec(1, 3, wspace=0.13, width_ratios=(1.22, 0.83, 0.95))
    draw_correspondences(figure.add_subplot(below[0]), view, drawing, fineness)
    draw_residuals(figure.add_subplot(below[1]), view)
    draw_facts(figure.add_subplot(below[2]), view)
    return figure


def _stages(view: RegistrationView, drawing: Drawing) -> list[tuple[str, FloatArray | None, str]]:
    if drawing.apart is None:
        before = "both clouds as their files give them"
    else:
        before = f"centres {length(drawing.apart, view.unit or 'units', ',.6g')} apart in the files: drawn side by side"
    after = f"seen along the target's upright axes ({drawing.up_words})"
    if drawing.after is not None:
        after = f"dark: both clouds in one place  ·  {after}"
    return [("Before", drawing.before, before), ("After", drawing.after, after)]


def _draw_header(figure: Figure, view: RegistrationView) -> None:
    result = view.result
    color = STATUS_COLORS[result.status]
    figure.text(0.02, 0.972, "Registration", fontsize=20, fontweight="bold", color=INK, va="center")
    figure.text(
        0.168,
        0.972,
        f" {STATUS_WORDS[result.status]} ",
        fontsize=14,
        fontweight="bold",
        color="white",
        va="center",
        bbox={"boxstyle": "round,pad=0.35", "facecolor": color, "edgecolor": "none"},
    )
    confidence = f"confidence {result.confidence:.2f}" if np.isfinite(result.confidence) else "no confidence"
    figure.text(0.98, 0.972, confidence, fontsize=14, color=INK, va="center", ha="right")
    for x, color, role, name, num in (
        (0.02, SOURCE_COLOR, "source", result.source.name, len(view.source_points)),
        (0.5, TARGET_COLOR, "target", result.target.name, len(view.target_points)),
    ):
        figure.text(x, 0.938, "●", fontsize=15, color=color, va="center")
        figure.text(
            x + 0.016,
            0.938,
            f"{role}  {shorten(name, 44)}   ({counted(num, 'point')})",
            fontsize=12.5,
            color=INK,
            va="center",
            parse_math=False,
        )


def draw_sides(
    figure: Figure, panels: list[Axes], drawing: Drawing, motion: FloatArray, fineness: float, unit: str
) -> None:
    """The three sides of one stage, all at one scale."""
    source = transform_points(motion, drawing.source) @ drawing.axes.T
    target = drawing.target @ drawing.axes.T
    low, high = bounds(source, target)
    middle, extent = (low + high) / 2.0, np.maximum(high - low, 1e-9 * drawing.radius)
    panel = panels[0].get_window_extent()
    room = 0.94 * panel.width, 0.84 * panel.height
    pixel = max(  # its size in cloud units
        max(extent[right] / room[0], extent[up] / room[1]) for right, up in SIDES.values()
    )
    half = np.array([panel.width, panel.height]) * pixel / 2.0
    for axes, (title, (right, up)) in zip(panels, SIDES.items(), strict=True):
        frame(axes)
        center = middle[[right, up]] - (0.0, 0.09 * half[1])  # the scale bar stands below
        image = xray(
            source[:, [right, up]], target[:, [right, up]], center, half, pixel / fineness, drawing.spacing
        )
        show(axes, image, center, half)
        text = axes.text(0.015, 0.975, title, transform=axes.transAxes, va="top", fontsize=11, color=SOFT)
        text.set_bbox(LABEL_BOX)
        draw_scale_bar(axes, half, center, unit)


def draw_absent(panels: list[Axes], text: str) -> None:
    """Empty panels, with words in the middle one."""
    for axes in panels:
        frame(axes)
        axes.set_facecolor("#f4f5f7")
    say(panels[len(panels) // 2], text)
