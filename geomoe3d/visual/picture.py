"""One picture of a registration: before, after, correspondences, residuals and the verdict.

Needs matplotlib, but neither a display nor pyplot: the figure is made and saved directly. The clouds are
drawn like an X-ray: each cloud's ink adds up along the line of sight, so that a wall seen edge-on is a dark
line, a wall that is doubled by a wrong transform is two, and a ceiling hides nothing; where both clouds
lie on each other their colours mix to a dark one. Cost: about two seconds, whatever the size of the clouds.
"""

from __future__ import annotations

import os
import textwrap
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geomoe3d.errors import FormatError
from geomoe3d.files import write_atomically
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.types import BoolArray, FloatArray
from geomoe3d.visual.scene import (
    GROUP_COLORS,
    KEPT_COLOR,
    REJECTED_COLOR,
    SOURCE_COLOR,
    STATUS_COLORS,
    STATUS_WORDS,
    TARGET_COLOR,
    Scene,
    build_scene,
    choose_rows,
    nice_length,
)
from geomoe3d.visual.view import RegistrationView

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = (".png", ".pdf", ".svg", ".jpg", ".jpeg", ".webp")
MAX_POINTS = 60_000
MAX_LINES = 300
SIZE_INCHES = (16.0, 14.0)
DPI = 100

INK = "#1d2129"
SOFT = "#646b78"
FAINT = "#d9dce2"
_LABEL_BOX = {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
SIDES = {  # title: rows of the upright axes that run right and up in the panel
    "top": (0, 1),
    "front": (0, 2),
    "side": (1, 2),
}


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
    suffix = Path(path).suffix.lower()
    if suffix not in FORMATS:
        raise FormatError(f"cannot write a picture as '{suffix}' ('{path}'); use one of {', '.join(FORMATS)}")

    def write(temporary: Path) -> None:
        vector = suffix in (".pdf", ".svg")
        figure = draw_picture(view, fineness=2.0 if vector else 1.0)
        # A date in the file would make the same registration give other bytes tomorrow.
        metadata = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}.get(suffix)
        with warnings.catch_warnings():  # a file name in a script the font lacks shows as boxes: enough
            warnings.filterwarnings("ignore", message="Glyph .* missing from")
            figure.savefig(temporary, format=suffix[1:], dpi=DPI, metadata=metadata)

    write_atomically(path, write, force=force)


def draw_picture(view: RegistrationView, *, fineness: float = 1.0) -> Figure:
    """The figure that `save_picture` saves.

    Args:
        view: what to show.
        fineness: raster points per pixel in the cloud panels; 2 suits formats that can be zoomed.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE_INCHES, dpi=DPI, facecolor="white")
    scene = build_scene(view, max_points=MAX_POINTS)
    rows = figure.add_gridspec(
        3, 1, height_ratios=(1, 1, 1.05), left=0.02, right=0.98, top=0.895, bottom=0.04, hspace=0.16
    )
    _draw_header(figure, view)
    for row, (title, motion, note) in enumerate(_stages(view, scene)):
        cells = rows[row].subgridspec(1, 3, wspace=0.03)
        panels = [figure.add_subplot(cells[column]) for column in range(3)]
        panels[0].set_title(title, loc="left", fontsize=13, fontweight="bold", color=INK, pad=8)
        panels[-1].set_title(note, loc="right", fontsize=10, color=SOFT, pad=8)
        if motion is None:
            _draw_absent(panels, "no transform was found: there is nothing to show")
        else:
            _draw_sides(figure, panels, scene, motion, fineness)
    below = rows[2].subgridspec(1, 3, wspace=0.13, width_ratios=(1.22, 0.83, 0.95))
    _draw_correspondences(figure, figure.add_subplot(below[0]), view, scene, fineness)
    _draw_residuals(figure.add_subplot(below[1]), view)
    _draw_facts(figure.add_subplot(below[2]), view)
    return figure


def _stages(view: RegistrationView, scene: Scene) -> list[tuple[str, FloatArray | None, str]]:
    if scene.apart is None:
        before = "both clouds as their files give them"
    else:
        before = f"centres {scene.apart:,.6g} units apart in the files: drawn side by side"
    after = f"seen along the target's upright axes ({scene.up_words})"
    if scene.after is not None:
        after = f"dark: both clouds in one place  ·  {after}"
    return [("Before", scene.before, before), ("After", scene.after, after)]


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
            f"{role}  {_shorten(name, 44)}   ({num:,} points)",
            fontsize=12.5,
            color=INK,
            va="center",
            parse_math=False,
        )


def _draw_sides(
    figure: Figure, panels: list[Axes], scene: Scene, motion: FloatArray, fineness: float
) -> None:
    """The three sides of one stage, all at one scale."""
    source = transform_points(motion, scene.source) @ scene.axes.T
    target = scene.target @ scene.axes.T
    low, high = _bounds(source, target)
    middle, extent = (low + high) / 2.0, np.maximum(high - low, 1e-9 * scene.radius)
    panel = panels[0].get_window_extent()
    room = 0.94 * panel.width, 0.84 * panel.height
    unit = max(  # cloud units per pixel
        max(extent[right] / room[0], extent[up] / room[1]) for right, up in SIDES.values()
    )
    half = np.array([panel.width, panel.height]) * unit / 2.0
    for axes, (title, (right, up)) in zip(panels, SIDES.items(), strict=True):
        _frame(axes)
        center = middle[[right, up]] - (0.0, 0.09 * half[1])  # the scale bar stands below
        image = xray(
            source[:, [right, up]], target[:, [right, up]], center, half, unit / fineness, scene.spacing
        )
        _show(axes, image, center, half)
        text = axes.text(0.015, 0.975, title, transform=axes.transAxes, va="top", fontsize=11, color=SOFT)
        text.set_bbox(_LABEL_BOX)
        _draw_scale_bar(axes, half, center)


def xray(
    source: FloatArray, target: FloatArray, center: FloatArray, half: FloatArray, unit: float, spacing: float
) -> FloatArray:
    """Both clouds projected onto a plane, as ink on white paper.

    Args:
        source, target: (N, 2) and (M, 2) right and up coordinates.
        center: (2,) middle of the picture.
        half: (2,) half its width and height.
        unit: cloud units per raster point.
        spacing: distance between neighbouring points; ink is spread to close the gaps.

    Returns:
        (rows, columns, 3) colours in [0, 1], first row at the top. White where no point falls.
    """
    columns, rows = np.maximum(np.round(2.0 * half / unit).astype(int), 1)
    paper = np.ones((rows, columns, 3))
    for points, color in ((source, SOURCE_COLOR), (target, TARGET_COLOR)):
        position = (points - (center - half)) / unit - 0.5
        ink = _ink(position, rows, columns, float(np.clip(0.7 * spacing / unit, 0.6, 2.5)))
        paper *= 1.0 - ink[:, :, None] * (1.0 - _rgb(color))
    return paper[::-1]


def _ink(position: FloatArray, rows: int, columns: int, blur: float) -> FloatArray:
    """(rows, columns) in [0, 1): points spread over their four nearest raster points, blurred, saturating."""
    from scipy.ndimage import gaussian_filter

    density = np.zeros(rows * columns)
    corner = np.floor(position).astype(np.int64)
    rest = position - corner
    for right in (0, 1):
        for up in (0, 1):
            x, y = corner[:, 0] + right, corner[:, 1] + up
            share = np.abs(1 - right - rest[:, 0]) * np.abs(1 - up - rest[:, 1])
            inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
            density += np.bincount(
                y[inside] * columns + x[inside], weights=share[inside], minlength=rows * columns
            )
    smooth = np.asarray(gaussian_filter(density.reshape(rows, columns), blur))
    inked = smooth[smooth > 0.02 * smooth.max(initial=0.0)]
    if not len(inked):
        return smooth
    # A typical surface seen face-on takes 45 % of the ink; one seen edge-on, many times as dense, all of it.
    ink = 1.0 - np.exp(-0.6 * smooth / np.median(inked))
    return np.asarray(np.round(48.0 * ink) / 48.0)  # finer steps cannot be seen and double the file


def _draw_correspondences(
    figure: Figure, axes: Axes, view: RegistrationView, scene: Scene, fineness: float
) -> None:
    """Source beside target, turned by the answer, with a line from each source to its target point."""
    _frame(axes)
    axes.set_title("Correspondences", loc="left", fontsize=13, fontweight="bold", color=INK, pad=8)
    if len(view.correspondences) and scene.after is not None:
        note = "source laid beside target: right ones run level"
        axes.set_title(note, loc="right", fontsize=10, color=SOFT, pad=8)
    motion = scene.before if scene.after is None else scene.after
    source = transform_points(motion, scene.source) @ scene.axes.T
    target = scene.target @ scene.axes.T
    low, high = _bounds(source, target)
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
        scene.spacing,
    )
    _show(axes, 0.45 + 0.55 * image, center, half)
    if not len(view.correspondences):
        _say(axes, "no correspondences were given")
        return
    start = transform_points(motion, view.correspondences[:, :3] - scene.source_center) @ scene.axes.T - shift
    end = (view.correspondences[:, 3:] - scene.target_center) @ scene.axes.T
    from matplotlib.collections import LineCollection

    kinds = _classes(view)
    for label, color, mask, strength in kinds:
        rows = choose_rows(mask, MAX_LINES // len(kinds), view.result.seed)
        total = int(mask.sum())
        drawn = f"{total:,}" if len(rows) == total else f"{total:,}, {len(rows)} drawn"
        lines = np.stack([start[rows][:, [right, up]], end[rows][:, [right, up]]], axis=1)
        axes.add_collection(LineCollection(list(lines), colors=color, linewidths=0.8, alpha=strength))
        axes.plot([], [], color=color, linewidth=2.5, label=f"{_shorten(label, 30)} ({drawn})")
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


def _draw_residuals(axes: Axes, view: RegistrationView) -> None:
    """Histogram of |R p + t - q| over the correspondences, logarithmic, with the inlier threshold."""
    axes.set_title("Residuals after alignment", loc="left", fontsize=13, fontweight="bold", color=INK, pad=8)
    residuals = view.residuals()
    finite = np.isfinite(residuals)
    if not finite.any():
        _frame(axes)
        _say(axes, "no transform was found" if len(residuals) else "no correspondences were given")
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
        f" inlier threshold {threshold:.3g}  \n {inside:,} of {len(residuals):,} below  ",
        transform=axes.get_xaxis_transform(),
        va="top",
        ha="right" if threshold > np.sqrt(low * high) else "left",
        fontsize=9.5,
        color=INK,
        bbox=_LABEL_BOX,
    )
    axes.set_xlabel(
        "distance of the moved source point to its target point (cloud units)", fontsize=9.5, color=SOFT
    )
    axes.set_ylabel("correspondences", fontsize=9.5, color=SOFT)
    axes.tick_params(labelsize=9, colors=SOFT)
    for name, spine in axes.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_color(FAINT)


def _draw_facts(axes: Axes, view: RegistrationView) -> None:
    """The verdict in words and numbers."""
    result = view.result
    axes.set_axis_off()
    axes.set_title("Verdict", loc="left", fontsize=13, fontweight="bold", color=INK, pad=8)
    facts = [
        ("status", STATUS_WORDS[result.status]),
        ("confidence", _number(result.confidence, ".2f")),
        ("overlap of source", _number(result.overlap, ".0%")),
        ("inliers", f"{result.num_inliers:,} of {result.num_correspondences:,} correspondences"),
        ("inlier threshold", f"{result.inlier_threshold:.4g}"),
        ("voxel size", f"{result.voxel_size:.4g}"),
    ]
    if result.seconds:
        facts.append(("seconds", f"{result.seconds.get('total', sum(result.seconds.values())):.2f}"))
    if result.alternative is not None:
        other = result.alternative
        facts.append(
            (
                "alternative",
                f"{other.rotation_difference_deg:.1f}° and {other.translation_difference:.3g} away,\n"
                f"score {other.relative_score:.2f} of the answer's",
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
    room = int((y + 0.05) / 0.049)
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


def _draw_absent(panels: list[Axes], text: str) -> None:
    for axes in panels:
        _frame(axes)
        axes.set_facecolor("#f4f5f7")
    _say(panels[len(panels) // 2], text)


def _say(axes: Axes, text: str) -> None:
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", fontsize=11, color=SOFT)


def _frame(axes: Axes) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color(FAINT)


def _show(axes: Axes, image: FloatArray, center: FloatArray, half: FloatArray) -> None:
    low, high = center - half, center + half
    axes.imshow(image, extent=(low[0], high[0], low[1], high[1]), interpolation="antialiased", aspect="equal")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])


def _draw_scale_bar(axes: Axes, half: FloatArray, center: FloatArray) -> None:
    length = nice_length(0.4 * float(half[0]))
    x, y = center[0] - 0.96 * half[0], center[1] - 0.92 * half[1]
    axes.plot([x, x + length], [y, y], color=INK, linewidth=2.5, solid_capstyle="butt")
    text = axes.text(x, y + 0.03 * half[1], f"{length:g} (cloud units)", fontsize=9, color=INK, va="bottom")
    text.set_bbox(_LABEL_BOX)


def _bounds(source: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners of the box around both clouds but for stray points; a unit box for no points at all."""
    boxes = [np.percentile(points, [0.2, 99.8], axis=0) for points in (source, target) if len(points)]
    if not boxes:
        return -np.ones(3), np.ones(3)
    return np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)


def _rgb(color: str) -> FloatArray:
    return np.array([int(color[i : i + 2], 16) / 255.0 for i in (1, 3, 5)])


def _number(value: float, form: str) -> str:
    return format(value, form) if np.isfinite(value) else "unknown"


def _shorten(text: str, most: int) -> str:
    """The text on one line, its middle left out where it is longer than ``most`` characters."""
    text = " ".join(text.split())
    if len(text) <= most:
        return text
    tail = most // 2
    return text[: most - tail - 1] + "…" + text[-tail:]
