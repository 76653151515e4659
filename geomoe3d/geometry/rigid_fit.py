"""Least-squares rigid motions for many weighted point sets at once, in numpy.

The estimators of the classical path call these thousands of times per registration and must work where
torch is absent; the differentiable twin for training is `geomoe3d.geometry.kabsch`. Cost: O(total number
of points) plus one 3x3 singular value decomposition per set.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomoe3d.types import FloatArray

Floats = NDArray[np.floating[Any]]


def fit_rigid(source: Floats, target: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Weighted Kabsch: the R, t minimising sum_i w_i |R p_i + t - q_i|^2 for every set of a batch.

    Args:
        source: (..., N, 3) points p.
        target: (..., N, 3) points q.
        weights: (..., N) non-negative, any scale.

    Returns:
        R (..., 3, 3) with determinant +1 and t (..., 3), in the dtype of ``source``. Where the points do
        not determine a rotation (coincident, collinear, all weights zero) it is one of the minimisers:
        check the sets, not the matrix.

    Source: Kabsch 1976; the sign of the smallest direction is chosen so that det R = +1 (Umeyama 1991).
    """
    w = weights / np.maximum(weights.sum(-1, keepdims=True), np.finfo(weights.dtype).tiny)
    source_mean = np.einsum("...n,...nd->...d", w, source)
    target_mean = np.einsum("...n,...nd->...d", w, target)
    weighted = (source - source_mean[..., None, :]) * w[..., None]
    # einsum sums in one order for any number of threads; a matrix product does not.
    H = np.einsum("...ni,...nj->...ij", weighted, target - target_mean[..., None, :])
    return _motion(H, source_mean, target_mean)


def products(source: Floats, target: Floats) -> FloatArray:
    """(N, 17) of correspondences p, q: p q^T (9), p, q, |p|^2 + |q|^2 and 1.

    Squared residuals under any motion, and the moments of any weighting, are one matrix product with these.

    Args:
        source: (N, 3) points p, near their centroid (what is far from it cancels badly).
        target: (N, 3) points q, likewise.
    """
    p, q = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    both = (p[:, :, None] * q[:, None, :]).reshape(len(p), 9)
    squares = (p * p).sum(1) + (q * q).sum(1)
    return np.column_stack([both, p, q, squares, np.ones(len(p))])


def fit_rigid_shared(rows: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """`fit_rigid` for K weightings of the same N correspondences.

    Args:
        rows: (N, 17) their `products`.
        weights: (K, N) non-negative.

    Returns:
        R (K, 3, 3), t (K, 3) as in `fit_rigid`. Last bits are the same for any number of threads where BLAS keeps to
        one.
    """
    sums = weights @ rows
    moments = sums / np.maximum(sums[:, 16:], np.finfo(np.float64).tiny)
    source_mean, target_mean = moments[:, 9:12], moments[:, 12:15]
    H = moments[:, :9].reshape(-1, 3, 3) - source_mean[:, :, None] * target_mean[:, None, :]
    R, t = _motion(H, source_mean, target_mean)
    return R.astype(np.float64, copy=False), t.astype(np.float64, copy=False)


def squared_residuals_shared(R: Floats, t: Floats, rows: FloatArray) -> FloatArray:
    """|R_k p_n + t_k - q_n|^2 for K motions and N correspondences, given their `products` (N, 17): (K, N).

    Of points within 1e4 of their centroid they err by some 1e-8.
    """
    factors = np.empty((len(R), rows.shape[1]))
    np.multiply(R.transpose(0, 2, 1).reshape(-1, 9), -2, out=factors[:, :9])
    np.multiply(np.einsum("kij,ki->kj", R, t), 2, out=factors[:, 9:12])
    np.multiply(t, -2, out=factors[:, 12:15])
    factors[:, 15], factors[:, 16] = 1, np.einsum("ki,ki->k", t, t)
    found: FloatArray = factors @ rows.T
    return np.maximum(found, 0, out=found)


def _motion(H: Floats, source_mean: Floats, target_mean: Floats) -> tuple[Floats, Floats]:
    U, _, Vt = np.linalg.svd(H.astype(np.float64))
    sign = np.sign(_determinants(U) * _determinants(Vt))
    V = np.swapaxes(Vt, -1, -2).copy()
    V[..., :, 2] *= sign[..., None]
    R = (V @ np.swapaxes(U, -1, -2)).astype(H.dtype)
    t = target_mean - np.einsum("...ij,...j->...i", R, source_mean)
    return R, t


def _determinants(matrices: FloatArray) -> FloatArray:
    """(...) of (..., 3, 3) orthogonal matrices: 1 or -1 but for rounding; by numpy's it takes seven times as long."""
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(matrices, (-2, -1), (0, 1))
    found: FloatArray = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    return found


def squared_residuals(R: Floats, t: Floats, source: Floats, target: Floats) -> Floats:
    """|R_k p_n + t_k - q_n|^2 for K motions and N correspondences: (K, N)."""
    moved = (R.reshape(-1, 3) @ source.T).reshape(len(R), 3, -1)
    moved += t[:, :, None]
    moved -= target.T[None]
    moved *= moved
    result: Floats = moved.sum(1)
    return result


def spread(points: Floats, weights: Floats) -> FloatArray:
    """Second largest standard deviation of points (N, 3) weighted (..., N): zero where they are collinear.

    Three directions of scatter decide a rigid fit: with the second at zero the rotation about the line is
    free. Returns (...) float64, 0 for no points or zero weights.
    """
    w = np.asarray(weights, dtype=np.float64)
    w = w / np.maximum(w.sum(-1, keepdims=True), np.finfo(w.dtype).tiny)
    centred = points - np.einsum("...n,nd->...d", w, points)[..., None, :]
    covariance = np.einsum("...ni,...nj->...ij", centred * w[..., None], centred)
    return np.sqrt(np.maximum(np.linalg.eigvalsh(covariance.astype(np.float64))[..., 1], 0.0))


def spread_shared(points: FloatArray, weights: Floats) -> FloatArray:
    """`spread` for K weightings (K, N) of the same N points, near their centroid, by moments: (K,).

    A third of the time for many weightings; a spread below 1e-7 of the extent is lost in rounding.
    """
    w = np.asarray(weights, dtype=np.float64)
    w = w / np.maximum(w.sum(1, keepdims=True), np.finfo(w.dtype).tiny)
    products = (points[:, :, None] * points[:, None, :]).reshape(len(points), 9)
    moments = np.einsum("kn,nd->kd", w, np.hstack([points, products]))
    mean = moments[:, :3]
    covariance = moments[:, 3:].reshape(-1, 3, 3) - mean[:, :, None] * mean[:, None, :]
    return np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[:, 1], 0.0))
