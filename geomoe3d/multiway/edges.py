"""An edge of the graph of scans: one registered pair, with what it measures and how much it is worth.

Poses are T_group_scan in local coordinates (each scan's file coordinates minus its float64 origin), so that
georeferenced scans lose nothing. Differences between motions are measured where they matter: as the root mean
square distance by which they move the points of the source scan.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from geomoe3d.batch.store import Outcome
from geomoe3d.clouds.transform_files import has_transform
from geomoe3d.config import expert
from geomoe3d.decision.information import deviations_at
from geomoe3d.geometry.se3 import cross_matrix, inverse, rotation_angle_deg, shift_frames, transform_points
from geomoe3d.types import FloatArray


@dataclass(frozen=True)
class Shape:
    """Where the points of a scan lie, in its local frame: enough to tell how far a motion moves them.

    Attributes:
        center: (3,) mean.
        spread: (3, 3) covariance.
        origin: (3,) file coordinate = local + origin.
        sensor: (3,) where the sensor stood, or the centre where that is not known.
    """

    center: FloatArray
    spread: FloatArray
    origin: FloatArray
    sensor: FloatArray

    @classmethod
    def of(cls, points: FloatArray, origin: FloatArray, sensor: FloatArray | None = None) -> Shape:
        """From the voxel points of a scan (N, 3), N >= 1, and its sensor (3,), local coordinates."""
        center = points.mean(0)
        spread = np.atleast_2d(np.cov(points.T, bias=True))
        return cls(center, spread, origin, center if sensor is None else sensor)


@dataclass(frozen=True)
class Edge:
    """A registered pair of scans, by number.

    Attributes:
        source, target: numbers of the scans.
        T_target_source: (4, 4) in local coordinates.
        confidence: of the registration.
        information: (6, 6) about the target's local origin, order [rotation, translation], for the left
            perturbation; scaled so that its translation part counts matched points.
        looseness: standard deviation of the source's sensor in the target, cloud units, if the gaps between
            the surfaces were independent from point to point; they are not, see `GroupingRules`.
        expected: log-odds by what is known beforehand, as that the scans were taken one after the other.
        of_maps: whether local maps about the scans were registered, not the scans alone.
        given: whether it was not registered, but is of poses that the caller gave.
        evidence: log-odds that triangles of edges add, see `geomoe3d.multiway.cycles`.
    """

    source: int
    target: int
    T_target_source: FloatArray
    confidence: float
    information: FloatArray
    looseness: float = 0.0
    evidence: float = 0.0
    expected: float = 0.0
    of_maps: bool = False
    given: bool = False

    @property
    def prior(self) -> float:
        """Log-odds of the confidence among pairs of which most share nothing, at most 7: none is certain."""
        odds = np.clip(self.confidence, 1e-9, 1 - 1e-9)
        known = expert().many_groups
        return float(min(np.log(odds / (1 - odds)) - known.unrelated + self.expected, known.most_log_odds))

    @property
    def worth(self) -> float:
        """Log-odds that the edge is right, by its confidence and by the triangles that it is part of."""
        return self.prior + self.evidence


def edge_of(
    outcome: Outcome, source: int, target: int, shapes: Sequence[Shape] | Mapping[int, Shape]
) -> Edge | None:
    """The edge of a finished pair, or None where it holds no motion."""
    result = outcome.result
    if result is None or not has_transform(result) or not np.isfinite(result.information_matrix).all():
        return None
    origin = shapes[target].origin
    T = shift_frames(result.T_target_source, -shapes[source].origin, -origin)
    matched = max(result.overlap * result.source.num_points, 1.0)
    center = result.information_center - origin
    information = _about_origin(result.information_matrix, center)
    sensor = transform_points(T, shapes[source].sensor[None])
    looseness = float(deviations_at(result.information_matrix, center, sensor)[0])
    information *= matched / max(float(np.trace(result.information_matrix[3:, 3:])), 1e-12)
    # A surface that lets the source slide must not make the graph singular.
    floor = expert().many_groups.least_observability * matched
    radius_squared = max(float(np.trace(shapes[source].spread)), 1e-12)
    information += floor * np.diag([radius_squared] * 3 + [1.0] * 3)
    most = expert().many_groups.most_ambiguous if result.status == "ambiguous" else 1.0
    return Edge(source, target, T, min(result.confidence, most), information, looseness)


def differences(
    motions: FloatArray, others: FloatArray, shapes: Sequence[Shape]
) -> tuple[FloatArray, FloatArray]:
    """How far motions (K, 4, 4) and others of the same K scans are apart.

    Returns:
        (K,) root mean square distance between the images of the scan's points, cloud units, and (K,) angle
        between the rotations, degrees.
    """
    D = motions - others
    shift = np.einsum("kij,kj->ki", D[:, :3, :3], np.stack([s.center for s in shapes])) + D[:, :3, 3]
    spreads = np.stack([s.spread for s in shapes])
    squares = (shift**2).sum(1) + np.einsum("kij,kjl,kil->k", D[:, :3, :3], spreads, D[:, :3, :3])
    cosine = (np.einsum("kij,kij->k", motions[:, :3, :3], others[:, :3, :3]) - 1) / 2
    return np.sqrt(np.maximum(squares, 0.0)), np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def displacement(T_a: FloatArray, T_b: FloatArray, shape: Shape) -> float:
    """Root mean square distance between the images of a scan under two motions, cloud units."""
    D = T_a - T_b
    at_center = D[:3, :3] @ shape.center + D[:3, 3]
    return float(np.sqrt(at_center @ at_center + np.trace(D[:3, :3] @ shape.spread @ D[:3, :3].T)))


def agrees(T_a: FloatArray, T_b: FloatArray, shape: Shape, tolerance: float, max_turn_deg: float) -> bool:
    """Whether two motions of one scan are the same: in where they put its points, and in how they turn it.

    The turn counts by itself, since a small overlap lets a scan turn about what it shares.
    """
    if displacement(T_a, T_b, shape) >= tolerance:
        return False
    return rotation_angle_deg(T_a[:3, :3].T @ T_b[:3, :3]) < max_turn_deg


def expected_error(edge: Edge, poses: dict[int, FloatArray], shape: Shape, correlation: float) -> float:
    """By how much an edge may have the source's sensor in a wrong place, cloud units.

    Two things tell: how far it differs from the poses, which other pairs have made too, and how loosely its
    own surfaces hold the sensor, which stands at the end of a lever from what the two scans share.

    Args:
        edge: the registered pair.
        poses: T_group_scan of both its scans.
        shape: of the source.
        correlation: by what the looseness is multiplied, see `GroupingRules`.
    """
    predicted = predicted_motion(edge.source, edge.target, poses)
    apart = transform_points(predicted - edge.T_target_source, shape.sensor[None])[0]
    return float(np.hypot(np.linalg.norm(apart), correlation * edge.looseness))


def predicted_motion(source: int, target: int, poses: dict[int, FloatArray]) -> FloatArray:
    """T_target_source (4, 4) by the poses T_group_scan."""
    T: FloatArray = inverse(poses[target]) @ poses[source]
    return T


def source_information(edge: Edge) -> FloatArray:
    """(6, 6) information about a small motion [rotation, translation] on the right of the edge's transform.

    Pose graphs weigh there: g2o, GTSAM, and Open3D 0.20, though it builds its matrices from the target's
    points. A small motion x on the right of T equals Ad(T) x on its left.
    """
    R, t = edge.T_target_source[:3, :3], edge.T_target_source[:3, 3]
    adjoint = np.zeros((6, 6))
    adjoint[:3, :3] = adjoint[3:, 3:] = R
    adjoint[3:, :3] = cross_matrix(t) @ R
    moved: FloatArray = adjoint.T @ edge.information @ adjoint
    return moved


def _about_origin(information: FloatArray, center: FloatArray) -> FloatArray:
    """Information about ``center`` as information about the origin of the same frame.

    p + w x (p - c) + v = p + w x p + (v - w x c), so the perturbation about c is v = v_0 - c x w.
    """
    A = np.eye(6)
    A[3:, :3] = -cross_matrix(center)
    moved: FloatArray = A.T @ information @ A
    return moved
