"""The lower row of the picture: correspondences, residuals, the verdict in words."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

import numpy as np

from geomoe3d.geometry.se3 import transform_points
from geomoe3d.runtime.words import counted, of_the_score
from geomoe3d.types import BoolArray
from geomoe3d.visual.accuracy_facts import accuracy_facts, length
from geomoe3d.visual.drawing import (
    GROUP_COLORS,
    KEPT_COLOR,
    REJECTED_COLOR,
    STATUS_COLORS,
    STATUS_WORDS,
    Drawing,
    choose_rows,
)
from geomoe3d.visual.paper import (
    INK,
    LABEL_BOX,
    SIDES,
    SOFT,
    bounds,
    frame,
    number,
    plain_axes,
    say,
    shorten,
    show,
)
from geomoe3d.visual.view import RegistrationView
from geomoe3d.visual.xray import xray

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_correspondences(axes: Axes, view: RegistrationView, drawing: Drawing, fineness: float) -> None:
    """Source beside target, turned by the answer, with a line from each source to its target point.

    ``fineness`` is raster points per pixel.
    """
    frame(axes)
    axes.set_title("Correspondences", loc="left", fontsize=13, fontweight="bold", color=INK, pad=8)
    if len(view.correspondences) and drawing.after is not None:
        note = "source drawn beside target: correct ones are level"
        axes.set_title(note, loc="right", fontsize=10, color=SOFT, pad=8)
    motion = drawing.before if drawing.after is None else drawing.after
    source = transform_points(motion, drawing.source) @ drawing.axes.T
    target = drawing.target @ drawing.axes.T
    low, high = bounds(source, target)
    extent = high - low
    panel = axes.get_window_extent()
    right, up = max(SIDES.values(), key=lambda side: extent[side[0]] * extent[side[1]])
    shift = np.zeros(3)
    shift[right] = 1.06 * extent[right] + 1e-9
    left = low[[right, up]] - shift[[right, up]]
    size = high[[right, up]] - left
    unit = float(max(size[0] / panel.width, size[1] / panel.height / 0.86, 1e-12)) * 1.03
    half = np.array([panel.width, panel.height]) * unit / 2.0
    center = left + size / 2.0 - np.array([0.0, 0.07 * 2.0 * half[1]])  # room for the legend below
    image = xray(
        (source - shift)[:, [right, up]],
        target[:, [right, up]],
        center,
        half,
        unit / fineness,
        drawing.spacing,
    )
    show(axes, 0.45 + 0.55 * image, center, half)
    if not len(view.correspondences):
        say(axes, "no correspondences were given")
        return
    start = (
        transform_points(motion, view.correspondences[:, :3] - drawing.source_center) @ drawing.axes.T - shift
    )
    end = (view.correspondences[:, 3:] - drawing.target_center) @ drawing.axes.T
    from matplotlib.collections import LineCollection

    kinds = _classes(view)
    for label, color, mask, strength in kinds:
        rows = choose_rows(mask, 300 // len(kinds), view.result.seed)
        total = int(mask.sum())
        drawn = f"{total:,}" if len(rows) == total else f"{total:,}, {len(rows)} drawn"
        lines = np.stack([start[rows][:, [right, up]], end[rows][:, [right, up]]], axis=1)
        axes.add_collection(LineCollection(list(lines), colors=color, linewidths=0.8, alpha=strength))
        axes.plot([], [], color=color, linewidth=2.5, label=f"{shorten(label, 30)} ({drawn})")
    legend = axes.legend(
        loc="lower left",
        fontsize=9.5,
        frameon=False,
        labelcolor=INK,
        ncols=2,
        columnspacing=1.4,
        handlelength=1.4,
    )
    for text in legend.get_texts():
        text.set_parse_math(False)


def _classes(view: RegistrationView) -> list[tuple[str, str, BoolArray, float]]:
    """Label, colour, (K,) mask and opacity of each kind of correspondence, the last drawn on top."""
    if view.groups is not None:
        return [
            (view.group_label(int(g)), GROUP_COLORS[int(g) % len(GROUP_COLORS)], view.groups == g, 0.6)
            for g in np.unique(view.groups)
        ]
    kept = view.kept()
    yes, no = view.kept_words
    if view.weights is None and not view.has_transform:
        return [(no, REJECTED_COLOR, ~kept, 0.55)]
    return [(no, REJECTED_COLOR, ~kept, 0.55), (yes, KEPT_COLOR, kept, 0.75)]


def draw_residuals(axes: Axes, view: RegistrationView) -> None:
    """Histogram of |R p + t - q| over the correspondences, logarithmic, with the inlier threshold."""
    axes.set_title("Residuals after alignment", loc="left", fontsize=13, fontweight="bold", color=INK, pad=8)
    residuals = view.residuals()
    finite = np.isfinite(residuals)
    if not finite.any():
        frame(axes)
        say(axes, "no transform was found" if len(residuals) else "no correspondences were given")
        return
    threshold = view.result.inlier_threshold
    largest = float(residuals[finite].max())
    if not (np.isfinite(threshold) and threshold > 0):
        threshold = largest or 1.0
    low = threshold / 100.0  # smaller ones join the first bar
    high = max(largest, threshold) * 1.1
    bins = np.geomspace(low, high, 45)
    classes = [kind for kind in _classes(view) if (kind[2] & finite).any()]
    axes.hist(
        [np.clip(residuals[mask & finite], low, high) for _, _, mask, _ in classes],
        bins=bins.tolist(),
        stacked=True,
        color=[color for _, color, _, _ in classes],
    )
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.margins(y=0.18)
    axes.axvline(threshold, color=INK, linewidth=1.4, linestyle=(0, (4, 3)))
    inside = int((residuals[finite] <= threshold).sum())
    axes.text(
        threshold,
        0.985,
        f" inlier threshold {length(threshold, view.unit, '.3g')}  \n {inside:,} of {len(residuals):,} below  ",
        transform=axes.get_xaxis_transform(),
        va="top",
        ha="right" if threshold > np.sqrt(low * high) else "left",
        fontsize=9.5,
        color=INK,
        bbox=LABEL_BOX,
    )
    axes.set_xlabel(
        f"distance of the moved source point to its target point ({view.unit or 'unit of the files'})",
        fontsize=9.5,
        color=SOFT,
    )
    axes.set_ylabel("correspondences", fontsize=9.5, color=SOFT)
    plain_axes(axes, 9)


def draw_facts(axes: Axes, view: RegistrationView) -> None:
    """The verdict in words and numbers."""
    result = view.result
    axes.set_axis_off()
    axes.set_title("Verdict", loc="left", fontsize=13, fontweight="bold", color=INK, pad=8)
    facts = [
        ("status", STATUS_WORDS[result.status]),
        ("confidence", number(result.confidence, ".2f")),
        *((name, textwrap.fill(text.split(" (")[0], 38)) for name, text in accuracy_facts(result, view.unit)),
        ("inliers", f"{result.num_inliers:,} of {counted(result.num_correspondences, 'correspondence')}"),
        ("voxel size", length(result.voxel_size, view.unit, ".4g")),
    ]
    if result.seconds:
        facts.append(("seconds", f"{result.seconds.get('total', sum(result.seconds.values())):.2f}"))
    other = view.rival
    if other is not None:
        away = length(other.translation_difference, view.unit, ".3g")
        facts.append(
            (
                "alternative",
                f"{other.rotation_difference_deg:.1f}° and {away} away,\n{of_the_score(other.relative_score)}",
            )
        )
    y = 0.95
    for name, value in facts:
        axes.text(0.0, y, name, color=SOFT, fontsize=10.5, transform=axes.transAxes)
        for line in value.split("\n"):
            text = axes.text(0.36, y, line, color=INK, fontsize=10.5, transform=axes.transAxes)
            y -= 0.066
        if name == "status":
            text.set(color=STATUS_COLORS[result.status], fontweight="bold")
    lines: list[str] = []
    for reason in result.reasons:
        lines += textwrap.wrap(reason, 56, initial_indent="• ", subsequent_indent="   ")
    room = max(int((y + 0.05) / 0.049), 1)
    if len(lines) > room:
        lines = [*lines[: max(room - 1, 0)], "… more in the result file"]
    axes.text(
        0.0,
        y + 0.03,
        "\n".join(lines),
        transform=axes.transAxes,
        va="top",
        fontsize=10,
        color=INK,
        linespacing=1.3,
        parse_math=False,
    )
