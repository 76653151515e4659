"""Seeded draws that follow the places of points, not their order.

A draw by row becomes wholly another one where a single point more or less shifts all rows behind it. Here every
cell of a lattice has a rank by a hash of its coordinates and the seed, and the points of the lowest ranks are
drawn: a point that comes, goes or moves to another cell changes at most one of them. O(N log N).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geomoe3d.types import BoolArray, FloatArray, IntArray

_STEP, _FIRST, _SECOND = (np.uint64(n) for n in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))
OFF_ROUND = 0.618034
"""Where a lattice has its corner, in cells: coordinates are often round numbers, and none of these is a wall."""
Ranks = NDArray[np.uint64]


def mixed(values: Ranks) -> Ranks:
    """64-bit numbers (N,) scattered so that close ones lie apart: the finisher of SplitMix64.

    Source: Steele, Lea and Flood, Fast Splittable Pseudorandom Number Generators, OOPSLA 2014.
    """
    values = (values ^ (values >> np.uint64(30))) * _FIRST
    values = (values ^ (values >> np.uint64(27))) * _SECOND
    found: Ranks = values ^ (values >> np.uint64(31))
    return found


def cell_ranks(points: FloatArray, cell: float, seed: int) -> Ranks:
    """(N,) random numbers, equal for points (N, k) in one cell of a lattice with a corner at `OFF_ROUND` cells."""
    ranks: Ranks = mixed(np.full(len(points), seed % 2**64, dtype=np.uint64) + _STEP)
    for column in points.T:
        # Numbers beyond 64 bits are no cells of a cloud; they wrap round, as a rank may.
        cells = np.floor(column / cell - OFF_ROUND).astype(np.int64).view(np.uint64)
        ranks = mixed(ranks + _STEP + cells)
    return ranks


def drawn_rows(
    points: FloatArray, cell: float, limit: int, seed: int = 0, *, first: BoolArray | None = None
) -> IntArray:
    """At most ``limit`` rows of points (N, k), rising: all, or those of the lowest ranks.

    Args:
        points: k coordinates each; of correspondences (N, 6) both ends.
        cell: edge of the lattice; points that share a cell are drawn together, in their order.
        limit: how many at most.
        seed: decides the ranks; take another one for a draw that is to be independent.
        first: (N,) rows that go before all others, or None.
    """
    if len(points) <= limit:
        return np.arange(len(points))
    ranks = cell_ranks(points, cell, seed)
    order = np.argsort(ranks, kind="stable")
    if first is not None:
        order = order[np.argsort(~first[order], kind="stable")]
    rows: IntArray = np.sort(order[:limit])
    return rows
