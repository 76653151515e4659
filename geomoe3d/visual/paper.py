"""What all panels of the picture share: inks, empty frames, rasters, scale bars, short texts."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geomoe3d.clouds.transform_files import check_suffix
from geomoe3d.runtime.files import write_atomically
from geomoe3d.types import FloatArray
from geomoe3d.visual.drawing import nice_length

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = (".png", ".pdf", ".svg", ".jpg", ".jpeg", ".webp")
INK = "#1d2129"
SOFT = "#646b78"
FAINT = "#d9dce2"
LABEL_BOX = {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
SIDES = {  # title: rows of the upright axes that run right and up in the panel
    "top": (0, 1),
    "front": (0, 2),
    "side": (1, 2),
}


def save_figure(
    path: str | os.PathLike[str],
    draw: Callable[[bool], Figure],
    *,
    formats: tuple[str, ...] = FORMATS,
    force: bool = False,
    **said: str,
) -> None:
    """Write a figure, the same bytes each time, in the format that the suffix of ``path`` names.

    Args:
        path: the file to be written.
        draw: makes the figure; told whether the format is one of lines (.pdf, .svg) rather than of pixels.
        formats: suffixes that are taken.
        force: True replaces an existing file.
        said: what else a PDF says of itself, as Title.

    Raises:
        FormatError: the suffix is none of ``formats``.
        OutputError: the file exists and ``force`` is False, or it cannot be written.
    """
    suffix = check_suffix(path, formats)
    # A date in the file would give other bytes tomorrow.
    metadata = {".pdf": {"CreationDate": None, **said}, ".svg": {"Date": None}}.get(suffix)

    def write(temporary: Path) -> None:
        figure = draw(suffix in (".pdf", ".svg"))
        with warnings.catch_warnings():  # a file name in a script the font lacks shows as boxes: enough
            warnings.filterwarnings("ignore", message="Glyph .* missing from")
            figure.savefig(temporary, format=suffix[1:], dpi="figure", metadata=metadata)

    write_atomically(path, write, force=force)


def frame(axes: Axes) -> None:
    """A faint frame without ticks."""
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color(FAINT)


def say(axes: Axes, text: str) -> None:
    """One sentence in the middle of an empty panel."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", fontsize=11, color=SOFT)


def show(axes: Axes, image: FloatArray, center: FloatArray, half: FloatArray) -> None:
    """A raster of `xray` in the coordinates of its points: ``center`` and ``half`` as there."""
    low, high = center - half, center + half
    axes.imshow(image, extent=(low[0], high[0], low[1], high[1]), interpolation="antialiased", aspect="equal")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])


def draw_scale_bar(axes: Axes, half: FloatArray, center: FloatArray, unit: str) -> None:
    """A round length in the lower left corner of a panel shown by `show`, with the name of its unit if known."""
    length = nice_length(0.4 * float(half[0]))
    x, y = center[0] - 0.96 * half[0], center[1] - 0.92 * half[1]
    axes.plot([x, x + length], [y, y], color=INK, linewidth=2.5, solid_capstyle="butt")
    text = axes.text(
        x, y + 0.03 * half[1], f"{length:g} {unit or 'units'}", fontsize=9, color=INK, va="bottom"
    )
    text.set_bbox(LABEL_BOX)


def bounds(source: FloatArray, target: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners of the box around both clouds but for stray points; a unit box for no points at all."""
    boxes = [np.percentile(points, [0.2, 99.8], axis=0) for points in (source, target) if len(points)]
    if not boxes:
        return -np.ones(3), np.ones(3)
    return np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)


def number(value: float, form: str) -> str:
    """The number in the given format, or a word where there is none."""
    return format(value, form) if np.isfinite(value) else "unknown"


def shorten(text: str, most: int) -> str:
    """The text on one line, its middle left out where it is longer than ``most`` characters."""
    text = " ".join(text.split())
    if len(text) <= most:
        return text
    tail = most // 2
    return text[: most - tail - 1] + "…" + text[-tail:]


def plain_axes(axes: Axes, size: float) -> None:
    """Ticks in small soft print, lines at the left and below alone."""
    axes.tick_params(labelsize=size, colors=SOFT)
    for name, spine in axes.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_color(FAINT)
