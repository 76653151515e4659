"""How firmly the surfaces that two clouds share hold the transform between them.

Place: decide. The point-to-plane information of the fit, from which looseness, observability and standard deviations
follow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomoe3d.config import expert
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.geometry.se3 import cross_matrix, transform_points
from geomoe3d.types import FloatArray, PreparedCloud

_LOOSEST = 1000.0  # stands for infinity, of which means and files could make nothing


@dataclass(frozen=True)
class Information:
    """How firmly the overlapping surfaces hold the motion.

    Attributes:
        matrix: (6, 6) sum of J^T J / variance, J = [(x - c) x n, n] per matched point: order [rotation
            (rad), translation], target axes, about ``center``; 1 / cloud unit^2 where it applies.
        center: (3,) centroid c of the matched points, target local coordinates.
        observability: smallest eigenvalue of the same sum per point with lengths divided by the root mean
            square radius; 1/3 would be held equally from all sides, 0 means that the source can slide.
        num_matched: matched points.
        looseness: standard deviation of where the motion puts the source's sensor, in voxels, if the gaps
            between the surfaces were independent from point to point; where no place is known or guessed, of
            the most loosely held twentieth of its points. They are not independent, so it tells a loose fit
            from a firm one and is no error bar. Of the source alone, so exchanging the scans may change it.
            At most 1000, which is also what stands for fewer than 6 points.
        sensors_known: whether both sensors' places are known or guessed, so that free space could be asked.
        sensors_apart: distance of the two sensors under the motion, in voxels, see `_sensors_apart`; infinite where
            nothing is known of them.
    """

    matrix: FloatArray
    center: FloatArray
    observability: float
    num_matched: int
    looseness: float = _LOOSEST
    sensors_known: bool = False
    sensors_apart: float = np.inf

    @property
    def least_observability(self) -> float:
        """What the observability must reach: more where the motion lays sensor on sensor."""
        limits = expert().confidence
        coincide = self.sensors_apart < limits.coinciding_sensors
        return limits.least_observability_coinciding if coincide else limits.least_observability


def measure_information(
    T_target_source: FloatArray, source: PreparedCloud, target: PreparedCloud, threshold: float
) -> Information:
    """Point-to-plane information of a motion over source points within ``threshold`` of the target.

    Returns NaN matrices, observability 0 and looseness 1000 for fewer than 6 matched points.
    """
    known = source.viewpoint is not None and target.viewpoint is not None
    moved = transform_points(T_target_source, source.points)
    distance, nearest = target.tree.query(moved, distance_upper_bound=threshold)
    distance, nearest = np.asarray(distance), np.asarray(nearest)
    hit = np.isfinite(distance)
    if hit.sum() < 6:
        return Information(np.full((6, 6), np.nan), np.full(3, np.nan), 0.0, int(hit.sum()), _LOOSEST, known)
    points, normals = moved[hit], target.normals[nearest[hit]]
    gaps = np.einsum("ij,ij->i", points - target.points[nearest[hit]], normals)
    center = points.mean(0)
    J = np.hstack([np.cross(points - center, normals), normals])
    # Points on one voxel grid cannot be trusted below a part of its edge.
    variance = max(float(np.mean(gaps**2)), (expert().confidence.least_gap * source.voxel_size) ** 2)
    radius = float(np.sqrt(np.mean(np.sum((points - center) ** 2, axis=1))))
    scaled = J / np.array([radius] * 3 + [1.0] * 3)
    smallest = float(np.linalg.eigvalsh(scaled.T @ scaled / len(points))[0])
    matrix = J.T @ J / variance
    places = source.points[drawn_rows(source.points, source.voxel_size, expert().confidence.asked_points)]
    if source.viewpoint is not None:
        places = source.viewpoint[None]
    deviations = deviations_at(matrix, center, transform_points(T_target_source, places)) / source.voxel_size
    looseness = float(np.quantile(np.minimum(deviations, _LOOSEST), 0.95))
    apart = _sensors_apart(T_target_source, source, target)
    return Information(matrix, center, max(smallest, 0.0), int(hit.sum()), looseness, known, apart)


def _sensors_apart(T_target_source: FloatArray, source: PreparedCloud, target: PreparedCloud) -> float:
    """Distance in voxels of the sensors under a motion, or, if less, of the files' origins where both lie amid their
    clouds: a spinning sensor stood there, though the cloud may look as if it had been moved there."""
    if not (source.scanned and target.scanned):
        return np.inf
    origins = [-cloud.origin for cloud in (source, target)]
    places = [(source.viewpoint, target.viewpoint)]
    if all(
        ((cloud.points.min(0) <= at) & (at <= cloud.points.max(0))).all()
        for cloud, at in zip((source, target), origins, strict=True)
    ):
        places.append((origins[0], origins[1]))
    gaps = [
        distance_under(T_target_source, one, other)
        for one, other in places
        if one is not None and other is not None
    ]
    return min(gaps, default=np.inf) / source.voxel_size


def distance_under(T_target_source: FloatArray, source: FloatArray, target: FloatArray) -> float:
    """Distance of a place (3,) of the source, moved, and one of the target."""
    return float(np.linalg.norm(transform_points(T_target_source, source[None])[0] - target))


def deviations_at(matrix: FloatArray, center: FloatArray, points: FloatArray) -> FloatArray:
    """Standard deviations (n,) of where a motion puts points (n, 3), by its information about ``center``.

    inf where the matrix holds nothing at all.
    """
    turning, shifting = np.trace(matrix[:3, :3]), np.trace(matrix[3:, 3:])
    if not shifting > 0:
        return np.full(len(points), np.inf)
    # With lengths over the radius of what is shared, what is next to nothing does not depend on the unit.
    scale = np.array([max(np.sqrt(turning / shifting), 1e-12)] * 3 + [1.0] * 3)
    scaled = matrix / np.outer(scale, scale)
    # Never singular: what nothing holds may be anywhere.
    covariance = np.linalg.inv(scaled + 1e-12 * np.trace(scaled) * np.eye(6))
    # p + w x (p - c) + v
    J = np.array([np.hstack([-cross_matrix(point - center), np.eye(3)]) for point in points]) / scale
    variance = np.einsum("nij,jk,nik->n", J, covariance, J)
    deviations: FloatArray = np.sqrt(np.maximum(variance, 0.0))
    return deviations
