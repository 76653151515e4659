"""A picture of matches: kept ones as motion vectors coloured by sub-field or expert, rejected ones in grey."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomoe3d.errors import FormatError
from geomoe3d.runtime.files import write_atomically
from geomoe3d.runtime.words import counted
from geomoe3d.types import BoolArray, FloatArray, IntArray

SUFFIXES = (".png", ".jpg", ".jpeg", ".pdf", ".svg")


def save_matches(
    path: str | Path,
    images: tuple[NDArray[Any], NDArray[Any]],
    pixels: FloatArray,
    kept: BoolArray,
    *,
    sub_field: IntArray | None = None,
    expert: IntArray | None = None,
    title: str = "",
    force: bool = False,
) -> None:
    """Draw two images with at most 400 kept matches between them, and below the motion vectors in the first.

    Args:
        path: .png, .jpg, .pdf or .svg.
        images: grey, (height, width).
        pixels: (N, 4).
        kept: (N,) which are inliers.
        sub_field, expert: (N,) colours of the motion vectors, one panel each; None draws them in one colour.
        title: above.
        force: replace an existing file.

    Raises:
        FormatError: another suffix.
        OutputError: the file exists and ``force`` is False, or cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    if Path(path).suffix.lower() not in SUFFIXES:
        raise FormatError(
            f"cannot write a picture as '{Path(path).suffix}' ('{path}'); use .png, .jpg, .pdf or .svg"
        )
    height = max(image.shape[0] for image in images)
    both = np.full((height, images[0].shape[1] + images[1].shape[1]), 255, np.uint8)
    both[: images[0].shape[0], : images[0].shape[1]] = images[0]
    both[: images[1].shape[0], images[0].shape[1] :] = images[1]
    fields = {"sub-field": sub_field, "expert": expert}
    shown = {name: values for name, values in fields.items() if values is not None} or {
        "": np.zeros(len(pixels), int)
    }
    figure = Figure(figsize=(14, 7 + 7 * height / both.shape[1]), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, len(shown))
    axes = figure.add_subplot(grid[0, :])
    axes.imshow(both, cmap="gray", vmin=0, vmax=255)
    axes.set_title(title or f"{kept.sum():,} of {counted(len(kept), 'match', 'matches')} kept")
    rng = np.random.default_rng(0)
    for rows, color, width in (
        (np.flatnonzero(~kept), "#d1495b", 0.3),
        (np.flatnonzero(kept), "#2e9e5b", 0.6),
    ):
        some = rng.permutation(rows)[:400]
        lines = pixels[some].reshape(-1, 2, 2) + np.array([[0, 0], [images[0].shape[1], 0]])
        axes.add_collection(LineCollection(list(lines), colors=color, linewidths=width, alpha=0.7))
    axes.set_axis_off()
    for column, (name, values) in enumerate(shown.items()):
        axes = figure.add_subplot(grid[1, column])
        axes.imshow(images[0], cmap="gray", vmin=0, vmax=255, alpha=0.5)
        axes.add_collection(
            LineCollection(list(pixels[~kept].reshape(-1, 2, 2)), colors="#999999", linewidths=0.3)
        )
        drawn = LineCollection(list(pixels[kept].reshape(-1, 2, 2)), cmap="turbo", linewidths=1.0)
        drawn.set_array(values[kept])
        axes.add_collection(drawn)
        axes.set_title(f"motion vectors by {name}" if name else "motion vectors")
        axes.set_xlim(0, images[0].shape[1])
        axes.set_ylim(images[0].shape[0], 0)
        axes.set_axis_off()
    kind = Path(path).suffix[1:].lower()
    write_atomically(
        Path(path), lambda temporary: figure.savefig(temporary, format=kind, dpi=100), force=force
    )
