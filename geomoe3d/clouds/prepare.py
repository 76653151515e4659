"""From a loaded cloud to voxel points with oriented normals.

Place: prepare, between load and describe. One representative per occupied voxel (the mean of its points,
which also averages sensor noise) bounds everything after it: O(N log N) time for N points in, and memory
of a few arrays of N numbers, so millions of points in are fine.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from geomoe3d.clouds.viewpoint import guess_viewpoint
from geomoe3d.config import PreparationConfig, expert
from geomoe3d.errors import EmptyCloudError, InputError
from geomoe3d.geometry.columns import bounds, extents, in_cache
from geomoe3d.geometry.draws import OFF_ROUND, mixed
from geomoe3d.runtime.open3d_core import open3d_core
from geomoe3d.runtime.threads import each, usable_threads
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray, IntArray, PointCloud, PreparedCloud

_MIN_POINTS = 3


def prepare(
    cloud: PointCloud,
    voxel_size: float,
    config: PreparationConfig,
    *,
    viewpoint: FloatArray | None = None,
    seed: int = 0,
) -> PreparedCloud:
    """Thin a cloud to its voxel grid and give every point a normal turned to the sensor.

    Args:
        cloud: finite points in local coordinates.
        voxel_size: edge of the grid, cloud units.
        config: neighbourhoods in voxels.
        viewpoint: (3,) local position of the sensor; None guesses it. Where no guess is plausible, or none
            is wanted (``config.viewpoint`` centroid), normals turn to the cloud's centroid.
        seed: decides the guess.

    Returns:
        A cloud without features; see `PreparedCloud` for what was dropped and counted.

    Raises:
        InputError: a voxel so small that the grid's indices overflow.
        EmptyCloudError: fewer than 3 voxel points remain.
    """
    points, num_duplicates = drop_duplicates(cloud.points)
    voxels = voxel_means(points, voxel_size)
    num_voxels = len(voxels)
    radius = config.normal_radius * voxel_size
    voxels = drop_isolated(voxels, radius)
    if len(voxels) < _MIN_POINTS:
        raise EmptyCloudError(
            f"'{cloud.name}': {len(voxels)} of {counted(len(cloud), 'point')} remain on a {voxel_size:.4g} grid "
            f"({num_duplicates} duplicates, {num_voxels - len(voxels)} isolated), at least {_MIN_POINTS} are "
            f"needed; give a denser scan or a voxel size that fits it"
        )
    normals = estimate_normals(voxels, radius, config.normal_neighbors)
    if viewpoint is None and config.viewpoint != "centroid":
        viewpoint = guess_viewpoint(voxels, normals, voxel_size, seed=seed)
    towards = voxels.mean(0) if viewpoint is None else viewpoint
    return PreparedCloud(
        points=voxels,
        normals=orient_normals(voxels, normals, towards),
        features=None,
        voxel_size=voxel_size,
        viewpoint=viewpoint,
        origin=cloud.origin,
        name=cloud.name,
        num_input=len(cloud) + cloud.num_non_finite,
        num_non_finite=cloud.num_non_finite,
        num_duplicates=num_duplicates,
        num_isolated=num_voxels - len(voxels),
    )


def choose_voxel_size(source: PointCloud, target: PointCloud, num_points: int) -> float:
    """A voxel size for two clouds from their extent and density, cloud units.

    It is the size at which the larger cloud occupies about ``num_points`` voxels, half of it where its points fill
    space as foliage does, but about twice the typical spacing of the sparser cloud at least, below which a grid no
    longer evens out density; see `round_size`.

    Both clouds must have passed `check_cloud`.
    """

    return round_size(max(own_voxel_sizes(source, target, num_points)))


def round_size(size: float) -> float:
    """The nearest number of the series E24 (1, 1.1, 1.2, 1.3, 1.5, ... times a power of ten): steps so wide that
    clouds that differ by rounding get one voxel size."""
    power = 10.0 ** np.floor(np.log10(size))
    e24 = (10, 11, 12, 13, 15, 16, 18, 20, 22, 24, 27, 30, 33, 36, 39, 43, 47, 51, 56, 62, 68, 75, 82, 91)
    series = np.array([*e24, 100]) / 10
    nearest = series[np.abs(np.log(series * (power / size))).argmin()]
    return float(f"{nearest * power:.2g}")


def own_voxel_sizes(source: PointCloud, target: PointCloud, num_points: int) -> tuple[float, float]:
    """The voxel size that each of two clouds would get by itself, see `choose_voxel_size`; not rounded."""

    def of(cloud: PointCloud) -> float:
        size, least = _size_for_count(cloud.points, num_points), 2.0 * typical_spacing(cloud.points)
        # Where foliage fills space, a grid for surfaces shows next to nothing of it.
        return max(size / 2 if size > least and _fills_space(cloud.points, size) else size, least)

    if source is target:
        return (size := of(source)), size
    first, second = each(of, (source, target))
    return first, second


def check_cloud(cloud: PointCloud) -> None:
    """Refuse a cloud that cannot fix a rigid motion whatever the other one is. Raises EmptyCloudError: fewer
    than 3 points, or all points equal."""
    if len(cloud) < _MIN_POINTS:
        held = f"'{cloud.name}' holds {counted(len(cloud), 'point')}"
        raise EmptyCloudError(f"{held}; a rigid transform needs at least {_MIN_POINTS}")
    if not extents(cloud.points).any():
        raise EmptyCloudError(
            f"'{cloud.name}': all {len(cloud)} points are equal to {cloud.file_points[0].tolist()}; "
            "they fix no rotation"
        )


def robust_extent(points: FloatArray) -> float:
    """Diagonal of the box that holds the central 98 % along each axis: stray points do not count."""
    known = expert().preparation
    sample = points[:: max(1, len(points) // known.extent_sample)]
    low, high = np.percentile(sample, [known.outside_extent, 100 - known.outside_extent], axis=0)
    extent = float(np.linalg.norm(high - low))
    return extent if extent > 0 else float(np.linalg.norm(extents(points)))


def bounded_voxel_size(source: PointCloud, target: PointCloud, voxel_size: float, max_points: int) -> float:
    """The given size, or the next larger at which neither cloud occupies more than ``max_points`` voxels.
    Raises InputError: a voxel so small that the grid's indices overflow."""
    for cloud in (source, target):
        while (occupied := _num_different(voxel_keys(cloud.points, voxel_size, OFF_ROUND))) > max_points:
            # Surfaces fill voxels like 1 / size^2; a little more than that ends the search soon.
            voxel_size *= expert().preparation.coarsening * float(np.sqrt(occupied / max_points))
    return voxel_size


def scale_mismatch(source: PointCloud, target: PointCloud) -> str | None:
    """A sentence where two extents differ so much that the units must differ, else None.

    A factor of 50 is far beyond partial overlap of two scans, and far below millimetres against metres.
    """
    extents = [robust_extent(cloud.points) for cloud in (source, target)]
    small, large = sorted(extents)
    most = expert().preparation.most_extent_ratio
    if small <= 0 or large / small < most:
        return None
    return (
        f"the extents differ by a factor of {large / small:.0f} ('{source.name}' {extents[0]:.4g}, "
        f"'{target.name}' {extents[1]:.4g}; at most {most} is taken): one is probably in "
        "millimetres and the other in metres; bring both to one unit, a rigid transform cannot change scale"
    )


def _size_for_count(points: FloatArray, num_points: int) -> float:
    """The voxel size at which the points occupy ``num_points`` voxels, from a seeded-by-order sample.

    Counted on grids whose edges are powers of sqrt(2), whatever the cloud, and read off between two of them: a
    search that stops when it is close enough would end elsewhere when one point moves to another voxel. For the same
    reason a voxel that holds next to nothing counts in part.
    """
    sample = points[:: max(1, len(points) // expert().preparation.extent_sample)]
    extent = robust_extent(points)
    # A small cloud cannot fill the voxels asked for; half its points is what a grid can still even out.
    goal = min(num_points, max(len(sample) // 2, 1))

    def count(step: int) -> float:
        weights, numbers = _by_voxel(sample, 2.0 ** (step / 2))
        return float(np.minimum(np.bincount(numbers, weights) / expert().preparation.full, 1).sum())

    coarsest = int(np.ceil(2 * np.log2(extent)))
    step = min(round(2 * np.log2(extent / np.sqrt(goal))), coarsest)
    fine, coarse = count(step), count(step + 1)
    while coarse > goal and step < coarsest:
        step, fine, coarse = step + 1, coarse, count(step + 2)
    while fine < goal:
        step, fine, coarse = step - 1, count(step - 1), fine
    share = np.log(fine / goal) / np.log(fine / coarse) if fine > coarse else 1.0
    return float(min(2.0 ** ((step + share) / 2), extent))


def _fills_space(points: FloatArray, voxel_size: float) -> bool:
    """Whether points lie as in foliage, not as on surfaces; 3 ms for most clouds.

    Of 51 recorded pairs and 72 indoor fragments the variation is at most 0.13, of two pairs of airborne tiles and
    one of forest 0.17 to 0.19.
    """
    means = voxel_means(points[:: max(1, len(points) // expert().scatter.sample)], voxel_size)
    rounds = zip(expert().scatter.asked, expert().scatter.variations, strict=True)
    return all(_surface_variation(means, voxel_size, asked) > most for asked, most in rounds)


def _surface_variation(points: FloatArray, voxel_size: float, count: int) -> float:
    """Share of the variance of what surrounds a point that is along its normal, median of so many points: 0 for planes,
    1/3 for what fills space. 0 where too few have neighbours.

    Source: Pauly et al., IEEE Visualization 2002.
    """
    places = (points - points.mean(0)) / voxel_size
    asked = places[:: max(1, len(places) // count)]
    squared = (asked**2).sum(1)[:, None] + (places**2).sum(1) - 2 * asked @ places.T
    near = (squared < expert().scatter.radius ** 2).astype(np.float64)
    held = near.sum(1)
    near = near[held >= expert().scatter.least] / held[held >= expert().scatter.least, None]
    if len(near) < expert().scatter.least:
        return 0.0
    products = np.einsum("ni,nj->nij", places, places).reshape(-1, 9)
    means = near @ places
    covariance = (near @ products).reshape(-1, 3, 3) - np.einsum("ni,nj->nij", means, means)
    along = np.linalg.eigvalsh(covariance)
    return float(np.median(along[:, 0] / np.maximum(along.sum(1), 1e-12)))


def typical_spacing(points: FloatArray) -> float:
    """Distance from a point to its nearest other, mean of the middle half, cloud units; 0 where most points coincide.

    Estimated on about 2,000 points inside the central part of the cloud that holds about 8,000. (A median would
    jump where the distances form clusters, as those of points on a grid do.)
    """
    import small_gicp

    # All points of a part keep their density; a thinned cloud would look sparser than it is.
    known = expert().preparation
    middle = np.median(points[:: max(1, len(points) // known.middle_sample)], axis=0)
    away: FloatArray = np.zeros(len(points))
    for rows in in_cache(len(points)):
        for column, at in zip(points[rows].T, middle, strict=True):
            np.maximum(away[rows], np.abs(column - at), out=away[rows])
    sample = known.spacing_sample
    if len(points) > sample:
        away_limit = np.partition(away, sample)[sample]
        central = np.flatnonzero(away <= away_limit)
        asked = mixed(central.astype(np.uint64)) % np.uint64(sample // known.spacing_asked) == 0
        points, queries = points[central], points[central[asked]]
    else:
        queries = points[:: max(1, len(points) // known.spacing_asked)]
    tree = small_gicp.KdTree(small_gicp.PointCloud(points), num_threads=1)
    nearest = np.sqrt(np.sort(tree.batch_knn_search(queries, 2)[1][:, 1]))
    quarter = len(nearest) // 4
    return float(nearest[quarter : len(nearest) - quarter].mean())


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


def _num_different(keys: IntArray) -> int:
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

    weights, numbers = _by_voxel(points, voxel_size)
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


def _by_voxel(points: FloatArray, voxel_size: float) -> tuple[FloatArray, IntArray]:
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


def estimate_normals(points: FloatArray, radius: float, neighbors: int) -> FloatArray:
    """Unit normals (n, 3) of local planes, sign arbitrary, by Open3D."""
    o3d = open3d_core()

    # The tensor API takes three fifths of the legacy one's time, and gives the same to the last few bits.
    cloud: Any = o3d.t.geometry.PointCloud(o3d.core.Tensor.from_numpy(np.ascontiguousarray(points)))
    cloud.estimate_normals(min(neighbors, len(points)), radius)
    return np.array(cloud.point.normals.numpy(), dtype=np.float64)


def orient_normals(points: FloatArray, normals: FloatArray, towards: FloatArray) -> FloatArray:
    """Normals flipped where they point away from ``towards`` (3,)."""
    away = np.einsum("ij,ij->i", normals, towards - points) < 0
    return np.where(away[:, None], -normals, normals)
