"""How wide the voxels of two clouds are: from their extents and densities, unless the user says."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomoe3d.clouds.voxel_grid import by_voxel, drop_duplicates, num_different, voxel_keys, voxel_means
from geomoe3d.config import expert
from geomoe3d.geometry.columns import extents, in_cache
from geomoe3d.geometry.draws import OFF_ROUND, mixed
from geomoe3d.runtime.threads import each
from geomoe3d.types import FloatArray, PointCloud


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
    if source is target:
        (size,) = _own_sizes(source, (num_points,))
        return size, size
    (first,), (second,) = each(lambda cloud: _own_sizes(cloud, (num_points,)), (source, target))
    return first, second


def voxel_sizes_of(cloud: PointCloud, *num_points: int) -> tuple[float, ...]:
    """`choose_voxel_size` of one cloud for several numbers of points; what they have in common is measured once."""
    return tuple(round_size(size) for size in _own_sizes(cloud, num_points))


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
    for cloud in (source,) if source is target else (source, target):
        if len(cloud) <= max_points:  # no point is in two voxels
            continue
        while (occupied := num_different(voxel_keys(cloud.points, voxel_size, OFF_ROUND))) > max_points:
            # Surfaces fill voxels like 1 / size^2; a little more than that ends the search soon.
            voxel_size *= expert().preparation.coarsening * float(np.sqrt(occupied / max_points))
    return voxel_size


def scale_mismatch(source: PointCloud, target: PointCloud) -> str | None:
    """A sentence where two extents differ so much that the units must differ, else None.

    A factor of 50 is far beyond partial overlap of two scans, and far below millimetres against metres.
    """
    extents = each(robust_extent, (source.points, target.points))
    small, large = sorted(extents)
    most = expert().preparation.most_extent_ratio
    if small <= 0 or large / small < most:
        return None
    return (
        f"the extents differ by a factor of {large / small:.0f} ('{source.name}' {extents[0]:.4g}, "
        f"'{target.name}' {extents[1]:.4g}; at most {most} is taken): one is probably in "
        "millimetres and the other in metres; bring both to one unit, a rigid transform cannot change scale"
    )


def _own_sizes(cloud: PointCloud, counts: Sequence[int]) -> list[float]:
    """What a cloud would get by itself for each number of points."""
    least = 2.0 * typical_spacing(cloud.points)

    def of(num_points: int) -> float:
        size = _size_for_count(cloud.points, num_points)
        # Where foliage fills space, a grid for surfaces shows next to nothing of it.
        return max(size / 2 if size > least and _fills_space(cloud.points, size) else size, least)

    return each(of, counts)


def _size_for_count(points: FloatArray, num_points: int) -> float:
    """The voxel size at which the points occupy ``num_points`` voxels, from a seeded-by-order sample.

    Counted on grids whose edges are powers of sqrt(2), whatever the cloud, and read off between two of them: a
    search that stops when it is close enough would end elsewhere when one point moves to another voxel. For the same
    reason a voxel that holds next to nothing counts in part.
    """
    # Rows written several times fill no more voxels than one.
    sample, _ = drop_duplicates(points[:: max(1, len(points) // expert().preparation.extent_sample)])
    extent = robust_extent(points)
    # A small cloud cannot fill the voxels asked for; half its points is what a grid can still even out.
    goal = min(num_points, max(len(sample) // 2, 1))

    def count(step: int) -> float:
        weights, numbers = by_voxel(sample, 2.0 ** (step / 2))
        return float(np.minimum(np.bincount(numbers, weights) / expert().preparation.full, 1).sum())

    coarsest = int(np.ceil(2 * np.log2(extent)))
    step = min(round(2 * np.log2(extent / np.sqrt(goal))), coarsest)
    fine, coarse = count(step), count(step + 1)
    while coarse > goal and step < coarsest:
        step, fine, coarse = step + 1, coarse, count(step + 2)
    while fine < goal:
        # Places written several times, but for rounding, fill no more voxels however small: then half the places.
        if 2.0 ** (step / 2) < extent / expert().preparation.finest:
            return _size_for_count(points, max(int(fine) // 2, 1))
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
    """Distance from a point to its nearest other place, mean of the middle half, cloud units; 0 of a single place.

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
    places, _ = drop_duplicates(points)
    if len(places) < 2:
        return 0.0
    tree = small_gicp.KdTree(small_gicp.PointCloud(places), num_threads=1)
    nearest = np.sqrt(np.sort(tree.batch_knn_search(queries, 2)[1][:, 1]))
    quarter = len(nearest) // 4
    return float(nearest[quarter : len(nearest) - quarter].mean())
