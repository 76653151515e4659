"""One sheet of paper on a registration for a customer: scans, transform, accuracy, pictures, versions.

An A4 page as PDF, drawn by matplotlib without a display, from the panels of the picture. About two seconds.
"""

from __future__ import annotations

import os
import textwrap
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray
from geomoe3d.visual.accuracy_facts import accuracy_facts, length
from geomoe3d.visual.drawing import (
    SOURCE_COLOR,
    STATUS_COLORS,
    STATUS_WORDS,
    TARGET_COLOR,
    Drawing,
    build_drawing,
    distance_to_target,
)
from geomoe3d.visual.page import distance_limit, distance_reach
from geomoe3d.visual.paper import FAINT, INK, SOFT, number, plain_axes, save_figure, shorten
from geomoe3d.visual.picture import MAX_POINTS, draw_absent, draw_sides
from geomoe3d.visual.view import RegistrationView

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class _Layout:
    """Where text stands on the sheet, in shares of its width and height."""

    left: float = 0.08
    right: float = 0.92
    line: float = 0.0165
    characters: int = 100  # of a line of text
    reasons: int = 8  # lines
    dpi: int = 150


_AT = _Layout()


def save_sheet(view: RegistrationView, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write the sheet as PDF; the same registration gives the same bytes.

    Args:
        view: what to show.
        path: .pdf.
        force: replace an existing file.

    Raises:
        FormatError: another suffix.
        OutputError: the file exists and ``force`` is False, or it cannot be written.
    """
    save_figure(path, lambda vector: draw_sheet(view), formats=(".pdf",), force=force, Title=_title(view))


def draw_sheet(view: RegistrationView) -> Figure:
    """The figure that `save_sheet` saves."""
    from matplotlib.figure import Figure

    result = view.result
    figure = Figure(figsize=(8.27, 11.69), dpi=_AT.dpi, facecolor="white")  # A4, inches
    drawing = build_drawing(view, max_points=MAX_POINTS)
    figure.text(
        _AT.left, 0.955, "Registration of two scans", fontsize=17, fontweight="bold", color=INK, va="center"
    )
    figure.text(
        _AT.right,
        0.955,
        f" {STATUS_WORDS[result.status]}, confidence {number(result.confidence, '.2f')} ",
        fontsize=11,
        fontweight="bold",
        color="white",
        va="center",
        ha="right",
        bbox={"boxstyle": "round,pad=0.35", "facecolor": STATUS_COLORS[result.status], "edgecolor": "none"},
    )
    y = _lines(figure, 0.925, _scans(view))
    reasons = [line for reason in result.reasons for line in textwrap.wrap(f"• {reason}", _AT.characters)]
    more = ["… more in the result file"] if len(reasons) > _AT.reasons else []
    for line in [*reasons[: _AT.reasons - len(more)], *more]:
        y = _paragraph(figure, y, line)
    panel = 0.15
    for title, motion in (("Before", drawing.before), ("After", drawing.after)):
        y -= 0.012
        rows = figure.add_gridspec(
            1, 3, left=_AT.left, right=_AT.right, top=y - 0.014, bottom=y - panel, wspace=0.04
        )
        panels = [figure.add_subplot(rows[column]) for column in range(3)]
        panels[0].set_title(title, loc="left", fontsize=10, fontweight="bold", color=INK, pad=4)
        if motion is None:
            draw_absent(panels, "no transform was found")
        else:
            draw_sides(figure, panels, drawing, motion, 2.0, view.unit)
        y -= panel
    y = _heading(figure, y - 0.02, "Transform")
    if view.has_transform:
        s, times = ("", "") if result.scale == 1.0 else ("s", f"{result.scale:.6g} ")
        said = f"p_target = {times}R p_source + t, in the files' own coordinates; rows of [{s}R t]:"
        y = _paragraph(figure, y, said)
        for row in result.T_target_source[:3]:
            cells = [*(f"{value: .9f}" for value in row[:3]), f"{row[3]: .6f}"]
            figure.text(
                _AT.left + 0.02, y, "   ".join(cells), family="monospace", fontsize=8.5, color=INK, va="top"
            )
            y -= _AT.line
    else:
        y = _paragraph(figure, y, "No transform was found; the reasons above say why.")
    y = _heading(figure, y - 0.012, "Accuracy")
    y = _lines(figure, y, _measured(view))
    bottom = 0.09
    if y - bottom > 0.1 and drawing.after is not None:
        box = (_AT.left + 0.04, bottom + 0.03, _AT.right - _AT.left - 0.04, min(y - bottom - 0.06, 0.16))
        _draw_distances(figure.add_axes(box), view, drawing, drawing.after)
    versions = ", ".join(f"{name} {version}" for name, version in result.versions.items())
    foot = f"Made with {versions or 'geomoe3d'}; seed {result.seed}."
    figure.text(_AT.left, 0.03, textwrap.fill(foot, 125), fontsize=7, color=SOFT, va="bottom")
    return figure


def _draw_distances(axes: Axes, view: RegistrationView, drawing: Drawing, motion: FloatArray) -> None:
    """Histogram of how far the moved source points lie from the nearest target point."""
    reach = distance_reach(view, drawing)
    distances = distance_to_target(view, drawing, motion, reach)
    limit = distance_limit(distances, reach)
    near = distances[distances < limit]
    axes.hist(near, bins=np.linspace(0.0, limit, 51).tolist(), color=SOURCE_COLOR)
    axes.set_xlim(0.0, limit)
    share = len(near) / max(len(distances), 1)
    axes.set_title("Distances after alignment", loc="left", fontsize=9, fontweight="bold", color=INK)
    axes.set_xlabel(
        f"distance of a source point to the nearest target point ({view.unit or 'unit of the files'}); "
        f"{100 * share:.0f} % of the source points have one within {length(limit, view.unit, '.3g')}",
        fontsize=7.5,
        color=SOFT,
    )
    axes.set_ylabel("source points drawn", fontsize=7.5, color=SOFT)
    plain_axes(axes, 7.5)


def _title(view: RegistrationView) -> str:
    return f"{view.result.source.name} on {view.result.target.name}"


def _scans(view: RegistrationView) -> list[tuple[str, str, str]]:
    """Name, text and colour of each scan."""
    result = view.result
    return [
        (
            role,
            f"{shorten(cloud.name, 60)}: {counted(cloud.num_input, 'point')}, {cloud.num_points:,} used on the grid",
            color,
        )
        for role, cloud, color in (
            ("source", result.source, SOURCE_COLOR),
            ("target", result.target, TARGET_COLOR),
        )
    ]


def _measured(view: RegistrationView) -> list[tuple[str, str, str]]:
    result = view.result
    facts = accuracy_facts(result, view.unit)
    if result.num_correspondences:
        agree = f"{result.num_inliers:,} of {counted(result.num_correspondences, 'correspondence')} within "
        facts.append(("inliers", agree + length(result.inlier_threshold, view.unit, ".4g")))
    if np.isfinite(result.voxel_size):
        facts.append(("grid", f"voxels of {length(result.voxel_size, view.unit, '.4g')}"))
    return [(name, text, SOFT) for name, text in facts]


def _heading(figure: Figure, y: float, text: str) -> float:
    from matplotlib.lines import Line2D

    figure.add_artist(Line2D([_AT.left, _AT.right], [y + 0.006, y + 0.006], color=FAINT, linewidth=0.8))
    figure.text(_AT.left, y, text, fontsize=10, fontweight="bold", color=INK, va="top")
    return y - 1.25 * _AT.line


def _paragraph(figure: Figure, y: float, text: str) -> float:
    lines = textwrap.wrap(text, _AT.characters)
    for line in lines:
        figure.text(_AT.left, y, line, fontsize=8.5, color=INK, va="top", parse_math=False)
        y -= _AT.line
    return y


def _lines(figure: Figure, y: float, rows: list[tuple[str, str, str]]) -> float:
    """Rows of a name in its colour and a text."""
    for name, text, color in rows:
        figure.text(_AT.left, y, name, fontsize=8.5, color=color, va="top", fontweight="bold")
        for line in textwrap.wrap(text, _AT.characters - 14):
            figure.text(_AT.left + 0.11, y, line, fontsize=8.5, color=INK, va="top", parse_math=False)
            y -= _AT.line
    return y
