"""Passes over arrays (N, 3) column by column, some rows at a time.

numpy reduces such an array along its long axis, or along its short one, 20 to 70 times slower than it
reduces three columns one after the other; on millions of points that is what a registration waits for. The
results are the same to the bit. What takes several passes is done for so many rows that they stay in the processor's
cache.
"""

from __future__ import annotations

import numpy as np

from geomoe3d.types import BoolArray, Float32Array, FloatArray


def in_cache(count: int) -> list[slice]:
    """Slices of so many rows that together are all of ``count``."""
    return [slice(start, min(start + 2**15, count)) for start in range(0, count, 2**15)]


def bounds(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest corner, (3,) each, of points (N, 3), N >= 1."""
    parts = [points[rows].T for rows in in_cache(len(points))]
    low = np.min([[column.min() for column in part] for part in parts], axis=0)
    return low, np.max([[column.max() for column in part] for part in parts], axis=0)


def extents(points: FloatArray) -> FloatArray:
    """Edges (3,) of the box around points (N, 3), N >= 1."""
    low, high = bounds(points)
    edges: FloatArray = high - low
    return edges


def finite_rows(points: FloatArray) -> BoolArray:
    """(N,) which rows of points (N, 3) hold finite numbers alone."""
    finite: BoolArray = np.isfinite(points[:, 0])
    for column in points.T[1:]:
        finite &= np.isfinite(column)
    return finite


def crossed(a: FloatArray, b: FloatArray) -> FloatArray:
    """(N, 3) cross products of the rows of two arrays (N, 3)."""
    (x, y, z), (u, v, w) = a.T, b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


def exponential(x: Float32Array) -> Float32Array:
    """exp of float32, in place; of what lies below -80 that of -80, 2e-35, which changes no sum with a larger number.

    Below 1e-38 float32 keeps fewer digits, and the processor takes some hundred times as long for such a number, here
    and wherever it is used.
    """
    np.maximum(x, np.float32(-80), out=x)
    np.exp(x, out=x)
    return x
