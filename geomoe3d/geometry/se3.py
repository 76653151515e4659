"""Rigid motions as 4x4 matrices: T_b_a maps p_a to p_b = R p_a + t."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomoe3d.errors import InputError
from geomoe3d.runtime.words import shape_in_words
from geomoe3d.types import FloatArray

_WANTED = "a transform must be 4 rows of 4 finite numbers"


def make_transform(R: NDArray[np.floating[Any]], t: NDArray[np.floating[Any]]) -> FloatArray:
    """(..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def transform_points(T: FloatArray, points: FloatArray) -> FloatArray:
    """R p + t for points (N, 3) and one transform (4, 4); float64."""
    moved: FloatArray = points @ T[:3, :3].T + T[:3, 3]
    return moved


def inverse(T: FloatArray, scale: float = 1.0) -> FloatArray:
    """Inverse of a rigid motion (4, 4), using R^-1 = R^T, or of a similarity with the given scale."""
    R = T[:3, :3] / scale
    return make_transform(R.T / scale, -R.T @ T[:3, 3] / scale)


def scale_of(T: FloatArray) -> float:
    """The scale of a similarity (4, 4); exactly 1 where it is within 1e-9 of it, as of a rigid motion."""
    scale = float(np.cbrt(np.linalg.det(T[:3, :3])))
    return 1.0 if abs(scale - 1.0) < 1e-9 else scale


def residuals(T: FloatArray, source: FloatArray, target: FloatArray) -> FloatArray:
    """|R p + t - q| of paired points (N, 3) and (N, 3), (N,)."""
    distances: FloatArray = np.linalg.norm(transform_points(T, source) - target, axis=1)
    return distances


def cross_matrix(v: FloatArray) -> FloatArray:
    """(3, 3) so that cross_matrix(v) @ x is the cross product of v and x."""
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def rotation_angle_deg(R: FloatArray) -> float:
    """Angle of a rotation (3, 3) in degrees, in [0, 180]; accurate near 0 as well as near 180."""
    cosine = (np.trace(R) - 1.0) / 2.0
    sine = np.linalg.norm(R - R.T) / np.sqrt(8.0)
    return float(np.degrees(np.arctan2(sine, cosine)))


def rotation_error_deg(T_estimate: FloatArray, T_truth: FloatArray) -> float:
    """Angle between the rotations of two motions in degrees (PointDSC's RE, without its clamp)."""
    return rotation_angle_deg(T_estimate[:3, :3].T @ T_truth[:3, :3])


def translation_error(T_estimate: FloatArray, T_truth: FloatArray) -> float:
    """|t_estimate - t_truth| in cloud units (PointDSC's TE)."""
    return float(np.linalg.norm(T_estimate[:3, 3] - T_truth[:3, 3]))


def motions_apart(T_a: FloatArray, T_b: FloatArray, place: FloatArray) -> tuple[float, float]:
    """Distance between the two images of a place (3,), and the angle between the two rotations, degrees."""
    a, b = transform_points(T_a, place[None]), transform_points(T_b, place[None])
    return float(np.linalg.norm(b - a)), rotation_angle_deg(T_a[:3, :3].T @ T_b[:3, :3])


def project_to_so3(R: FloatArray) -> FloatArray:
    """The rotation nearest to a 3x3 matrix in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(R)
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    rotation: FloatArray = U @ D @ Vt
    return rotation


def shift_frames(T_local: FloatArray, source_origin: FloatArray, target_origin: FloatArray) -> FloatArray:
    """A motion between local frames, expressed between the file frames (file = local + origin)."""
    T: FloatArray = T_local.copy()
    T[:3, 3] = T_local[:3, 3] + target_origin - T_local[:3, :3] @ source_origin
    return T


def is_rotation(R: FloatArray, tolerance: float) -> bool:
    """Whether R (3, 3) does not mirror and R^T R is within ``tolerance`` of the identity, entry by entry."""
    return _off_rotation(R) <= tolerance and bool(np.linalg.det(R) > 0)


def is_motion(T: FloatArray, tolerance: float) -> bool:
    """Whether T is (4, 4), finite, its last row 0 0 0 1 within 1e-6, and `is_rotation` of its linear part."""
    return (
        T.shape == (4, 4)
        and bool(np.isfinite(T).all())
        and bool(np.abs(T[3] - (0.0, 0.0, 0.0, 1.0)).max() <= 1e-6)
        and is_rotation(T[:3, :3], tolerance)
    )


def _off_rotation(R: FloatArray) -> float:
    return float(np.abs(R.T @ R - np.eye(3)).max())


def _not_rigid(R: FloatArray, tolerance: float) -> str:
    """Why R (3, 3) is no rotation, and what to do, as the end of a sentence."""
    det = float(np.linalg.det(R))
    mirrors = "; it also mirrors" if det < 0 else ""
    scale = float(np.cbrt(abs(det)))
    if scale > 0 and _off_rotation(R / scale) <= tolerance and abs(scale - 1) > tolerance / 2:
        return (
            f"it holds a scale of {scale:.6g}{mirrors}; divide the first three numbers of its first three rows by "
            f"{scale:.6g} if all data are in one unit, else bring them to one unit first"
        )
    if _off_rotation(R) <= tolerance:
        return "it mirrors (its determinant is -1); bring both clouds to right-handed axes first"
    lengths = ", ".join(f"{length:.4g}" for length in np.linalg.norm(R, axis=0))
    return (
        "the first three columns of its first three rows must have the length 1 and stand at right angles; their "
        f"lengths are {lengths}, and lengths and angles are off by up to {_off_rotation(R):.3g} (at most "
        f"{tolerance}){mirrors}"
    )


@np.errstate(over="ignore", invalid="ignore")  # what comes of huge numbers is refused
def check_motion(T: ArrayLike) -> FloatArray:
    """A user's matrix as a rigid motion (4, 4), its rotation projected onto SO(3). Raises InputError: another
    shape, non-finite numbers, a last row other than 0 0 0 1, or a linear part that is no rotation: R^T R
    differs from the identity by more than 0.01, or it mirrors."""
    try:
        matrix = np.array(T, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{_WANTED}, found something that is no table of numbers") from None
    if matrix.shape != (4, 4):
        raise InputError(f"{_WANTED}, found {shape_in_words(matrix.shape)}")
    if not np.isfinite(matrix).all():
        raise InputError(f"{_WANTED}, found NaN or infinities in it")
    R = matrix[:3, :3]
    tolerance = 0.01  # published poses are up to 5e-4 off
    if not is_rotation(R, tolerance):
        raise InputError(f"the matrix is no rigid transform: {_not_rigid(R, tolerance)}")
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise InputError(f"the last row of a transform must be 0 0 0 1, found {matrix[3].tolist()}")
    return make_transform(project_to_so3(R), matrix[:3, 3])
