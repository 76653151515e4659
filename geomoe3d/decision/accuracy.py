"""How closely two clouds lie on each other under an answer, and how far off that may be.

Place: decide, after the scale. Gaps between surfaces are not independent from point to point: what a camera or a
robot has laid together is bent, and a bend is common to all points of a place. A residual variance divided by
thousands of points would promise far too much. So, as far as the shared surfaces are seen to be bent, one residual
counts as one observation of the whole, and the bend itself adds what it moves. The weights are fitted on generated
pairs (scripts/measure_accuracy.py). About 5 ms, whatever the size of the clouds.
"""

from __future__ import annotations

import numpy as np

from geomoe3d.config import expert
from geomoe3d.decision.shared_surface import (
    Contact,
    SharedSurface,
    distortion_of,
    robust_weights,
    solved,
)
from geomoe3d.geometry.columns import crossed
from geomoe3d.geometry.se3 import cross_matrix, residuals, transform_points
from geomoe3d.types import Accuracy, Correspondences, FloatArray


def measure_accuracy(
    T_target_source: FloatArray,
    shared: SharedSurface,
    matched: Correspondences,
    threshold: float,
) -> Accuracy | None:
    """The figures of an answer; see `Accuracy`.

    Args:
        T_target_source: (4, 4) the answer, local coordinates.
        shared: of both clouds.
        matched: the correspondences, of which those that agree make the inlier RMSE.
        threshold: of an inlier, cloud units.

    Returns:
        None where too few points lie on each other and face alike.
    """
    contact = shared.contact(T_target_source, threshold)
    if len(contact.gaps) < expert().accuracy.least_points:
        return None
    distances = np.abs(contact.gaps)
    agreeing = residuals(T_target_source, matched.source, matched.target)
    agreeing = agreeing[agreeing < threshold]
    places = np.vstack([transform_points(T_target_source, shared.source.points), shared.target.points])
    center = contact.points.mean(0)
    farthest = places[np.argmax(np.sum((places - center) ** 2, axis=1))]
    radius, covariance = covariance_of(contact, center, shared.source.voxel_size)
    J = np.hstack([-cross_matrix((farthest - center) / radius), np.eye(3)])
    variances = np.trace(covariance[3:, 3:]), np.trace(J @ covariance @ J.T), np.trace(covariance[:3, :3])
    at_center, at_farthest, turned = np.sqrt(variances)
    return Accuracy(
        inlier_rmse=float(np.sqrt(np.mean(agreeing**2))) if len(agreeing) else float("nan"),
        overlap_source=contact.shares[0],
        overlap_target=contact.shares[1],
        distance_mean=float(distances.mean()),
        distance_median=float(np.median(distances)),
        distance_std=float(distances.std()),
        distance_p95=float(np.quantile(distances, 0.95)),
        sigma_center=float(at_center),
        sigma_farthest=float(at_farthest),
        sigma_rotation_deg=float(np.degrees(turned / radius)),
    )


def covariance_of(contact: Contact, center: FloatArray, voxel_size: float) -> tuple[float, FloatArray]:
    """Root mean square radius of what is shared, and the covariance (6, 6) of [rotation x radius, translation]."""
    known = expert().accuracy
    per_residual = np.repeat([known.residual_turn, known.residual_shift], 3)
    per_bend = np.repeat([known.bend_turn, known.bend_shift], 3) / np.sqrt(3)
    offsets = contact.points - center
    radius = max(float(np.sqrt(np.mean(np.sum(offsets**2, axis=1)))), 1e-9 * voxel_size)
    X, normals, gaps = offsets / radius, contact.normals, contact.gaps
    weights = robust_weights(gaps, voxel_size)
    _, inverse, variance = solved(np.hstack([crossed(X, normals), normals]), gaps, weights)
    strain = distortion_of(X, normals, gaps, weights, radius)
    bent = (strain / (strain + known.small_strain)) ** 2
    of_one = variance * float(weights.sum()) * inverse
    common = bent**2 * of_one * np.outer(per_residual, per_residual)
    return radius, common + np.diag((per_bend * strain * radius) ** 2)
