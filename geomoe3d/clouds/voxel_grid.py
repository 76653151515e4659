"""Points on a grid of voxels: which one each lies in, their means, and what is dropped on the way."""

from __future__ import annotations

import numpy as np

from geomoe3d.config import expert
from geomoe3d.errors import InputError
from geomoe3d.geometry.columns import bounds, extents, in_cache
from geomoe3d.geometry.draws import OFF_ROUND
from geomoe3d.runtime.threads import usable_threads
from geomoe3d.types import FloatArray, IntArray


def drop_duplicates(points: FloatArray) -> tuple[FloatArray, int]:
    """Points without exact repetitions, first ones kept in order, and how many were dropped."""
    # A 64-bit mix of the coordinates' bits sorts five times faster than rows do; two different points
    # share it with a chance of about 1e-6 at 5 million points.
    mixed = np.zeros(len(points), dtype=np.uint64)
    for rows in in_cache(len(points)):
        bits = (points[rows] + 0.0).view(np.uint64)  # + 0.0 makes -0.0 equal to 0.0
        for axis, factor in enumerate((0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9)):
            column = bits[:, axis] * np.uint64(factor)
            mixed[rows] ^= column ^ (column >> np.uint64(29))
            mixed[rows] *= np.uint64(0xBF58476D1CE4E5B9)
    ordered = np.sort(mixed)  # half the time of an order; most clouds have no duplicates
    if not (ordered[1:] == ordered[:-1]).any():
        return points, 0
    _, first = np.unique(mixed, return_index=True)
    return points[np.sort(first)], len(points) - len(first)


def voxel_keys(points: FloatArray, voxel_size: float, shift: float = 0.0) -> IntArray:
    """One integer per point that names its voxel on a grid with a corner ``shift`` voxels from the local
    origin. Raises InputError: the cloud spans more than 2^21 voxels along an axis."""
    limit = 2**21  # of a 64-bit voxel key, for each axis, at most
    first, last = (np.floor(corner / voxel_size - shift) for corner in bounds(points))
    if (last - first).max() >= limit:
        extent = float(extents(points).max())
        raise InputError(
            f"voxel size {voxel_size:.4g} is too small for a cloud of extent {extent:.4g}: more than "
            f"{limit} voxels along one axis; use at least {extent / limit:.3g} or remove stray points"
        )
    # No more bits than needed: small keys are sorted in fewer steps.
    widths = [int(cells).bit_length() for cells in last - first]
    keys: IntArray = np.zeros(len(points), dtype=np.int64)
    for rows in in_cache(len(points)):
        for column, lowest, bits in zip(points[rows].T, first, widths, strict=True):
            cells = np.floor(column / voxel_size - shift)
            cells -= lowest
            keys[rows] <<= bits
            keys[rows] |= cells.astype(np.int64)
    return keys


def sorted_rows(keys: IntArray) -> IntArray:
    """Rows of keys (N,), none negative, in rising order, equal ones in theirs; by 16 bits at a time, which numpy counts
    in place of comparing: a third of the time."""
    order = np.argsort(keys.astype(np.uint16), kind="stable")
    for shift in range(16, int(keys.max()).bit_length(), 16):
        order = order[np.argsort((keys[order] >> shift).astype(np.uint16), kind="stable")]
    return order


def num_different(keys: IntArray) -> int:
    """How many different keys there are."""
    largest = int(keys.max())
    if largest >= 2**26:  # bytes spent on counting voxels by a flag each
        return len(np.unique(keys))
    seen = np.zeros(largest + 1, dtype=np.bool_)
    seen[keys] = True
    return int(np.count_nonzero(seen))


def voxel_means(points: FloatArray, voxel_size: float) -> FloatArray:
    """Mean point of every occupied voxel, (n, 3), ordered by voxel.

    In the last twentieth of a voxel before a wall the weight of a point falls from 1 to next to nothing. So one that
    rounding or noise puts on the other side changes next to nothing. For the same reason a voxel that holds less
    than a hundredth of a point is left out where a fuller one's mean lies within its edge, and the grid has
    its corner at no round number: floors lie at zero, and points of a fused volume on its own grid.
    """
    from scipy.spatial import cKDTree

    weights, numbers = by_voxel(points, voxel_size)
    sums = np.bincount(numbers, weights)
    held = np.flatnonzero(sums)
    columns = [np.bincount(numbers, column * weights)[held] for column in points.T]
    sums = sums[held]
    means: FloatArray = np.stack(columns, axis=1) / sums[:, None]
    kept = sums >= expert().preparation.least_held
    thin = np.flatnonzero(~kept)
    if not kept.any():
        return means
    if len(thin):
        tree = cKDTree(means[kept], balanced_tree=False, compact_nodes=False)
        kept[thin] = np.isinf(tree.query(means[thin], distance_upper_bound=voxel_size)[0])
    return means[kept]


def by_voxel(points: FloatArray, voxel_size: float) -> tuple[FloatArray, IntArray]:
    """Weights in a voxel, see `voxel_means`, never zero, and numbers of the voxels, rising with their keys; some may be
    left out."""
    known = expert().preparation
    weights: FloatArray = np.empty(len(points))
    for rows in in_cache(len(points)):
        inside = weights[rows]
        inside[:] = 0.5
        for column in points[rows].T:
            place = column / voxel_size - OFF_ROUND
            place -= np.floor(place) + 0.5
            np.minimum(inside, 0.5 - np.abs(place, out=place), out=inside)
        inside /= known.ramp
        np.clip(inside, known.at_wall, 1, out=inside)
    keys = voxel_keys(points, voxel_size, OFF_ROUND)
    if keys.max() < len(keys):
        return weights, keys
    order = sorted_rows(keys)
    numbers = np.empty_like(keys)
    numbers[order] = np.cumsum(np.diff(keys[order], prepend=keys[order[0]]) > 0)
    return weights, numbers


def drop_isolated(points: FloatArray, radius: float) -> FloatArray:
    """Points that have at least two others within ``radius``: fewer fix no plane."""
    import small_gicp

    while len(points) >= 3:
        tree = small_gicp.KdTree(small_gicp.PointCloud(points), num_threads=1)
        _, squared = tree.batch_knn_search(points, 3, num_threads=usable_threads())
        close = squared[:, 2] <= radius**2
        if close.all():
            return points
        points = points[close]  # whoever leaned on the dropped ones may now be isolated too
    return points[:0]
