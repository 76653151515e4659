"""Transforms fitted to correspondences and judged by them: what consensus does with what it has proposed.

R (K, 3, 3) and t (K, 3) are about the centroids of both halves, in inlier thresholds; ``known`` (N, 17) are the
`geomoe3d.geometry.rigid_fit.products` of the correspondences.
"""

from __future__ import annotations

import numpy as np

from geomoe3d.config import expert
from geomoe3d.estimators.surroundings import Surroundings
from geomoe3d.geometry.columns import exponential
from geomoe3d.geometry.rigid_fit import fit_rigid_shared, spread_shared, squared_residuals_shared
from geomoe3d.geometry.se3 import make_transform
from geomoe3d.types import Float32Array, FloatArray, Hypothesis

_SCORED_AT_ONCE = 64_000


def score(
    R: FloatArray,
    t: FloatArray,
    known: FloatArray,
    vote: Float32Array,
    surroundings: Surroundings | None = None,
) -> FloatArray:
    """Sum of vote x exp(-r^2 / (2 s^2)) over all correspondences for each motion, (K,).

    Residuals r and s, `expert.consensus.score_sigma`, in inlier thresholds; with surroundings each term is weighed by
    how well the normals meet.
    """
    scores = np.empty(len(R))
    step = max(1, _SCORED_AT_ONCE // max(len(known), 1))
    for start in range(0, len(R), step):
        part = slice(start, start + step)
        kernel = squared_residuals_shared(R[part], t[part], known).astype(np.float32)
        kernel *= np.float32(-0.5 / expert().consensus.score_sigma ** 2)
        exponential(kernel)
        if surroundings is not None:
            kernel *= surroundings.matched(R[part])
        scores[part] = kernel @ vote
    return scores


def refit(
    R: FloatArray, t: FloatArray, known: FloatArray, vote: Float32Array
) -> tuple[FloatArray, FloatArray]:
    """One reweighted fit per motion on residuals under the threshold, weights vote / (1 + r^2).

    A motion left with fewer than three inliers stays as it is.
    """
    r2 = squared_residuals_shared(R, t, known)
    weights = vote * (r2 < 1)
    enough = np.count_nonzero(weights, axis=1) >= 3
    r2 += 1
    R_new, t_new = fit_rigid_shared(known, weights / r2)
    return np.where(enough[:, None, None], R_new, R), np.where(enough[:, None], t_new, t)


def finished(
    R: FloatArray,
    t: FloatArray,
    scores: FloatArray,
    unit: FloatArray,
    known: FloatArray,
    centre: FloatArray,
    vote: Float32Array,
    inlier_threshold: float,
) -> list[Hypothesis]:
    """A last fit on the inliers of each motion, in order; those without enough are left out.

    R (K, 3, 3), t (K, 3), unit (N, 6) in inlier thresholds about ``centre``; known (N, 17) the products of unit.
    """
    r2 = squared_residuals_shared(R, t, known)
    weights = vote * (r2 < 1) / (1 + r2)
    # A thin set leaves the turn about its line to the noise.
    thinnest = np.minimum(spread_shared(unit[:, :3], weights), spread_shared(unit[:, 3:], weights))
    firm = ((weights > 0).sum(1) >= 3) & (thinnest >= expert().consensus.least_spread)
    if not firm.any():
        return []
    R, t = fit_rigid_shared(known, weights[firm])
    counts = (squared_residuals_shared(R, t, known) < 1).sum(1)
    shift = about_origin(R, t * inlier_threshold, centre)
    return [
        Hypothesis(make_transform(*motion), float(score_value), int(count))
        for *motion, score_value, count in zip(R, shift, scores[firm], counts, strict=True)
    ]


def about_origin(R: FloatArray, t: FloatArray, centre: FloatArray) -> FloatArray:
    """t (K, 3) of motions about ``centre`` (6,), the means of both halves, as they are about the origin."""
    found: FloatArray = t + centre[3:] - np.einsum("kij,j->ki", R, centre[:3])
    return found
