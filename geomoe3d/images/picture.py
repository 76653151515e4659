"""A picture of matches: kept ones as motion vectors coloured by sub-field or expert, rejected ones in grey."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geomoe3d.runtime.words import counted
from geomoe3d.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEPT, REJECTED, FAINT = "#2e9e5b", "#d1495b", "#999999"


def draw_matches(
    images: tuple[NDArray[Any], NDArray[Any]],
    pixels: FloatArray,
    kept: BoolArray,
    *,
    sub_field: IntArray | None = None,
    expert: IntArray | None = None,
) -> Figure:
    """Two images with at most 400 kept and 400 rejected matches between them, and below motion vectors in the first.

    Args:
        images: grey, (height, width).
        pixels: (N, 4).
        kept: (N,) which are inliers.
        sub_field, expert: (N,) colours of the motion vectors, one panel each; None draws them in one colour.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.figure import Figure

    named = {"motion vectors by sub-field": sub_field, "motion vectors by expert": expert}
    colours = {title: values for title, values in named.items() if values is not None}
    (height, width), other = images[0].shape, images[1].shape
    both = np.full((max(height, other[0]), width + other[1]), 255, np.uint8)
    both[:height, :width] = images[0]
    both[: other[0], width:] = images[1]
    colours = colours or {"motion vectors": np.zeros(len(pixels), int)}
    figure = Figure(figsize=(14, 7 + 7 * both.shape[0] / both.shape[1]), layout="constrained")
    grid = figure.add_gridspec(2, len(colours))
    axes = figure.add_subplot(grid[0, :])
    axes.imshow(both, cmap="gray", vmin=0, vmax=255)
    axes.set_title(f"{kept.sum():,} of {counted(len(kept), 'match', 'matches')} kept")
    axes.set_axis_off()
    lines = pixels.reshape(-1, 2, 2)
    rng = np.random.default_rng(0)
    for rows, color, thickness in ((~kept, REJECTED, 0.3), (kept, KEPT, 0.6)):
        some = lines[rng.permutation(np.flatnonzero(rows))[:400]] + [[0, 0], [width, 0]]
        axes.add_collection(LineCollection(list(some), colors=color, linewidths=thickness, alpha=0.7))
    for column, (title, values) in enumerate(colours.items()):
        axes = figure.add_subplot(grid[1, column])
        axes.imshow(images[0], cmap="gray", vmin=0, vmax=255, alpha=0.5)
        axes.add_collection(LineCollection(list(lines[~kept]), colors=FAINT, linewidths=0.3))
        vectors = LineCollection(list(lines[kept]), cmap="turbo", linewidths=1.0)
        vectors.set_array(values[kept])
        axes.add_collection(vectors)
        axes.set(title=title, xlim=(0, width), ylim=(height, 0))
        axes.set_axis_off()
    return figure
