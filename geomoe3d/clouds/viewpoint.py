"""Where the sensor stood: believed, or guessed from what it can have seen.

Normals have no sign of their own, FPFH needs one, and only the sensor's side of a surface gives it the same
sign in two scans. Place: prepare. Believing costs nothing; guessing takes about 0.1 s per cloud.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from geomoe3d.clouds.voxel_grid import voxel_keys
from geomoe3d.config import expert
from geomoe3d.errors import ConfigError, InputError
from geomoe3d.geometry.columns import bounds
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.types import BoolArray, FloatArray, IntArray, PointCloud, PreparedCloud

Sensors = tuple[ArrayLike | Literal["none"] | None, ArrayLike | Literal["none"] | None]
"""Where the sensors of source and target stood, as far as the user says; see `with_sensors`."""


def find_viewpoints(
    source: PointCloud, target: PointCloud, rule: str
) -> tuple[FloatArray | None, FloatArray | None]:
    """Local positions (3,) of the two sensors, or None for both where either is not known.

    Rule ``auto`` believes that a sensor stood at the file's origin when that lies within one extent of the
    cloud, as it does for depth cameras and single laser scans, and never for georeferenced data, nor where
    the cloud was plainly moved there: its mean, the middle of its box or its lowest corner lies at the
    origin, and points do not thin out away from it as the rays of a spinning sensor do. Where it does not,
    the place is believed that the file itself gives (the pose of its one scan, or VIEWPOINT), within the same
    limit. A place that the user gave is believed as it is. ``origin`` always; ``guess`` and ``centroid``
    never. Normals of the two clouds must be turned by the same rule, hence both or none.
    """
    if rule in ("guess", "centroid"):
        return None, None
    if rule == "origin":
        return -source.origin, -target.origin
    first, second = _believed(source), _believed(target)
    return (None, None) if first is None or second is None else (first, second)


def known_viewpoints(
    source: PointCloud, target: PointCloud, rule: str
) -> tuple[FloatArray, FloatArray] | None:
    """`find_viewpoints` as one value: both places, or None."""
    first, second = find_viewpoints(source, target, rule)
    return None if first is None or second is None else (first, second)


def with_sensors(
    clouds: tuple[PointCloud, PointCloud], sensors: Sensors, rule: str
) -> tuple[PointCloud, PointCloud]:
    """Source and target, of whose sensors the user knows something; each of ``sensors``, ``rule`` and the errors
    (InputError, ConfigError) are as of `with_sensor`."""
    source, target = (
        with_sensor(cloud, sensor, rule, whose)
        for cloud, sensor, whose in zip(clouds, sensors, ("source", "target"), strict=True)
    )
    return source, target


def with_sensor(
    cloud: PointCloud, sensor: ArrayLike | Literal["none"] | None, rule: str, whose: str = "scan"
) -> PointCloud:
    """A cloud of whose sensor the user knows something.

    Args:
        cloud: as loaded.
        sensor: (3,) where it stood, file coordinates; ``none`` where no one sensor saw the cloud, as a merged one, a
            mesh or a whole object; None leaves it to the evidence.
        rule: that of the configuration, which must then be ``auto``.
        whose: what to call the cloud in messages.

    Raises:
        InputError: a place that is none.
        ConfigError: another rule.
    """
    if sensor is None:
        return cloud
    if rule != "auto":
        raise ConfigError(
            f"a sensor's place is given, but preparation.viewpoint is '{rule}', which decides it too; leave one of the "
            "two out"
        )
    if isinstance(sensor, str):
        if sensor != "none":
            raise InputError(
                f"the sensor of the {whose} is '{sensor}'; give X,Y,Z in the file's coordinates, or none"
            )
        return replace(cloud, sensor=None, sensor_given=True)
    place = np.asarray(sensor, dtype=np.float64)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise InputError(f"the sensor of the {whose} must be three finite numbers X,Y,Z, found {sensor!r}")
    limit = expert().loading.most_coordinate
    if np.abs(place).max() > limit:
        raise InputError(
            f"the sensor of the {whose} is at {place.tolist()}, beyond the limit of {limit:g}; give X,Y,Z in the "
            "file's coordinates"
        )
    return replace(cloud, sensor=place, sensor_given=True)


def check_both_known(clouds: tuple[PointCloud, PointCloud]) -> None:
    """Refuse the place of one sensor, given by the user, where that of the other cloud is not known. Raises
    InputError: normals of both must be turned by one rule, so that place would be of no use."""
    for one, other in (clouds, clouds[::-1]):
        if one.sensor_given and one.sensor is not None and _believed(other) is None:
            raise InputError(
                f"the place of one sensor is given, that of '{one.name}', but that of '{other.name}' is not known, and "
                "one alone is of no use; give it too, or leave both out"
            )


def seen_by_none(clouds: tuple[PointCloud, PointCloud]) -> bool:
    """Whether the user says of either cloud that no one sensor saw it: normals are then turned to the centroids."""
    return any(cloud.sensor_given and cloud.sensor is None for cloud in clouds)


def believed_viewpoints(
    correspondences: FloatArray, origins: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray] | None:
    """Rule ``auto`` for bare correspondences (N, 6) in local coordinates: the origins, or None.

    Args:
        correspondences: N >= 1 rows [source, target].
        origins: (3,) shifts that were removed from the two halves.
    """
    source, target = (PointCloud(correspondences[:, 3 * k : 3 * k + 3], origins[k]) for k in range(2))
    return known_viewpoints(source, target, "auto")


def _believed(cloud: PointCloud) -> FloatArray | None:
    """The local place (3,) of a cloud's sensor by the rule ``auto``, or None."""
    if cloud.sensor_given:
        return None if cloud.sensor is None else cloud.sensor - cloud.origin
    if _sensor_may_be_at_origin(cloud):
        return -cloud.origin
    if cloud.sensor is None:
        return None
    place: FloatArray = cloud.sensor - cloud.origin
    return place if may_have_seen(cloud.points, place) else None


def may_have_seen(points: FloatArray, place: FloatArray) -> bool:
    """Whether a sensor at a place (3,) that a file names may have seen the points (n, 3), n > 0, of the same frame: one
    farther off than their extent is a georeference."""
    return _is_near(place, *bounds(points))


def _is_near(place: FloatArray, low: FloatArray, high: FloatArray) -> bool:
    """Whether a place lies within one extent of a box."""
    away = np.linalg.norm(np.maximum(np.maximum(low - place, place - high), 0))
    return bool(away <= np.linalg.norm(high - low))


def _sensor_may_be_at_origin(cloud: PointCloud) -> bool:
    low, high = (corner + cloud.origin for corner in bounds(cloud.points))
    extent = float(np.linalg.norm(high - low))
    if not _is_near(np.zeros(3), low, high):
        return False
    mean = cloud.points.mean(axis=0) + cloud.origin
    known = expert().viewpoint
    middle = (low + high) / 2
    away = (
        [float(np.linalg.norm(place)) / extent for place in (mean, middle, low)] if extent > 0 else [0.0] * 3
    )
    limits = (known.moved_mean, known.moved_middle, known.moved_corner)
    if all(far >= least for far, least in zip(away, limits, strict=True)):
        return True
    return min(away) >= known.moved_exactly and _thinning(cloud) <= known.most_thinning


def _thinning(cloud: PointCloud) -> float:
    """Rank correlation between how many points fill a cell and how far it lies from the file's origin, in [-1, 1].

    Rays from one place spread, so around a sensor it is well below zero, and the mean of what a sensor saw all around
    lies near it by nature. Clouds that were thinned to a grid, sampled or merged have about none.
    Source: Spearman, 1904.
    """
    known = expert().viewpoint
    points = cloud.points
    cell = float(np.linalg.norm(np.subtract(*bounds(points)))) / known.thinning_cells
    if len(points) > known.thinning_points:  # by place: far finer cells than those that are counted
        points = points[drawn_rows(points, cell / 1000, known.thinning_points)]
    _, first, count = np.unique(voxel_keys(points, cell), return_index=True, return_counts=True)
    if len(count) < 3:
        return 0.0
    full, far = _ranks(count), _ranks(np.linalg.norm(points[first] + cloud.origin, axis=1))
    spread = float(np.linalg.norm(full) * np.linalg.norm(far))
    return float(full @ far) / spread if spread > 0 else 0.0


def _ranks(values: FloatArray | IntArray) -> FloatArray:
    """Ranks of values (n,) from the middle one; equal ones share the mean of theirs."""
    _, which, count = np.unique(values, return_inverse=True, return_counts=True)
    ranks = np.cumsum(count) - (count - 1) / 2.0
    found: FloatArray = ranks[which] - (len(values) + 1) / 2.0
    return found


def sign_breaks(cloud: PreparedCloud) -> float:
    """Share of neighbours on one smooth surface whose normals are turned to opposite sides, in [0, 1]."""
    known = expert().viewpoint
    distance, near = cloud.tree.query(cloud.points, k=known.sign_neighbors + 1)
    rows = np.repeat(np.arange(len(cloud.points)), known.sign_neighbors)
    others = np.asarray(near)[:, 1:].ravel()
    close = np.asarray(distance)[:, 1:].ravel() < known.sign_reach * cloud.voxel_size
    cosine = np.einsum("ij,ij->i", cloud.normals[rows[close]], cloud.normals[others[close]])
    smooth = np.abs(cosine) > known.smooth_cosine
    return float((cosine[smooth] < 0).mean()) if smooth.any() else 0.0


def guess_viewpoint(
    points: FloatArray, normals: FloatArray, voxel_size: float, *, seed: int = 0
) -> FloatArray | None:
    """The place from which nearly all of a cloud can have been seen, (3,) in its frame, or None.

    A sensor sees no point through another, and hardly any at a grazing angle. Random places around the
    cloud are scored by both, and the best are improved by a random search. On depth-camera fragments the
    guess lies one to two metres off, yet turns some 96 % of the normals as the true place does (the
    centroid: 76 %). A cloud that was seen from all sides mostly has no such place.

    Args:
        points: (N, 3), at least one.
        normals: (N, 3) unit, of any sign.
        voxel_size: edge of the grid; points four of it farther than another in the same direction count as hidden.
        seed: decides places and points looked at.
    """
    known = expert().viewpoint
    margin, rng = known.margin * voxel_size, np.random.default_rng(seed)
    chosen = drawn_rows(points, voxel_size, known.num_points, seed)
    points, normals = points[chosen], normals[chosen]
    low, high = bounds(points)
    half = (high - low) / 2
    step = known.first_step * float(np.linalg.norm(half))
    places = (low + high) / 2 + rng.uniform(-1, 1, (known.num_candidates, 3)) * (known.reach * half + step)
    scores = np.array([_plausibility(place, points, normals, margin) for place in places])
    order = np.argsort(-scores, kind="stable")[: known.num_kept]
    best, best_scores = places[order], scores[order]
    for _ in range(known.rounds):
        for k in range(len(best)):
            for trial in best[k] + rng.normal(0, step, (known.trials, 3)):
                score = _plausibility(trial, points, normals, margin)
                if score > best_scores[k]:
                    best[k], best_scores[k] = trial, score
        step /= known.narrowing
    found: FloatArray = best[best_scores.argmax()]
    directions, distance, _ = _view(found, points, normals)
    visible = _not_hidden(directions, distance, margin).mean()
    return found if visible >= known.least_visible else None


def _plausibility(place: FloatArray, points: FloatArray, normals: FloatArray, margin: float) -> float:
    """Share of points not hidden, plus mean |cosine| of incidence, minus the share at a grazing angle."""
    directions, distance, cosine = _view(place, points, normals)
    visible = _not_hidden(directions, distance, margin)
    return float(visible.mean() + cosine.mean() - (cosine < expert().viewpoint.grazing_cosine).mean())


def _view(
    place: FloatArray, points: FloatArray, normals: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Unit directions (N, 3), distances (N,) and |cosine| of incidence (N,) of points from a place."""
    rays = points - place
    distance = np.maximum(np.sqrt(np.einsum("ij,ij->i", rays, rays)), 1e-12)
    directions = rays / distance[:, None]
    return directions, distance, np.abs(np.einsum("ij,ij->i", directions, normals))


def _not_hidden(directions: FloatArray, distance: FloatArray, margin: float) -> BoolArray:
    """True where no point in the same pixel of a cube map around the place is nearer by ``margin``."""
    size = round(90 / expert().viewpoint.pixel_deg)
    axis = np.abs(directions).argmax(1)
    rows = np.arange(len(directions))
    major = directions[rows, axis]
    others = np.array([[1, 2], [0, 2], [0, 1]])[axis]
    plane = np.take_along_axis(directions, others, 1) / np.abs(major)[:, None]
    cell = np.minimum(((plane + 1) / 2 * size).astype(np.int64), size - 1)
    pixel = ((2 * axis + (major > 0)) * size + cell[:, 0]) * size + cell[:, 1]
    nearest = np.full(6 * size * size, np.inf)
    np.minimum.at(nearest, pixel, distance)
    visible: BoolArray = distance < nearest[pixel] + margin
    return visible
