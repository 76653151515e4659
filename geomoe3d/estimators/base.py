"""The one form of an estimator, the checks they share, and the choice by name."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from geomoe3d.config import EstimatorConfig
from geomoe3d.errors import ConfigError, InputError
from geomoe3d.types import FloatArray, Hypothesis


class Estimator(Protocol):
    """Anything that turns weighted correspondences into hypotheses.

    One that can use normals at the points and what the sensors saw offers moreover ``with_surroundings``: it
    takes `geomoe3d.estimators.surroundings.Surroundings` of the same rows and returns such an estimator.
    """

    def __call__(
        self,
        correspondences: ArrayLike,
        weights: ArrayLike | None = None,
        *,
        inlier_threshold: float,
        seed: int = 0,
    ) -> list[Hypothesis]:
        """Estimate rigid motions p_target = R p_source + t.

        Args:
            correspondences: (N, 6) rows [source xyz, target xyz], one unit of length; extents up to
                about 1e5 inlier thresholds (distances are formed in float32).
            weights: (N,) non-negative, or None for all ones.
            inlier_threshold: largest residual of an inlier, same unit.
            seed: decides every random choice.

        Returns:
            Distinct hypotheses, best first; empty where the correspondences do not determine a motion
            (fewer than 3, collinear, coincident). Never a stand-in identity.

        Raises:
            InputError: wrong shapes, non-finite numbers, negative weights, a threshold <= 0.
        """
        ...


def check_correspondences(
    correspondences: ArrayLike, weights: ArrayLike | None, inlier_threshold: float
) -> tuple[FloatArray, FloatArray]:
    """Validated (N, 6) float64 and (N,) weights; see `Estimator` for the rules."""
    rows = np.asarray(correspondences, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 6:
        raise InputError(
            f"correspondences must have shape (N, 6), rows [source xyz, target xyz]; found {rows.shape}"
        )
    if not np.isfinite(rows).all():
        bad = int(np.flatnonzero(~np.isfinite(rows).all(1))[0])
        raise InputError(f"correspondence {bad} holds a NaN or infinite number: {rows[bad]}; drop such rows")
    w = np.ones(len(rows)) if weights is None else np.asarray(weights, dtype=np.float64)
    if w.shape != (len(rows),):
        raise InputError(f"weights must have shape ({len(rows)},) like the correspondences, found {w.shape}")
    if not np.isfinite(w).all() or (w < 0).any():
        raise InputError("weights must be finite and not negative")
    if not (np.isfinite(inlier_threshold) and inlier_threshold > 0):
        raise InputError(f"inlier_threshold must be a positive length, found {inlier_threshold}")
    return rows, w


def make_estimator(config: EstimatorConfig) -> Estimator:
    """The estimator that a configuration names."""
    if config.name == "consensus":
        from geomoe3d.estimators.consensus import ConsensusEstimator

        return ConsensusEstimator(num_hypotheses=config.num_hypotheses)
    if config.name == "ransac":
        from geomoe3d.estimators.ransac import RansacEstimator

        return RansacEstimator(iterations=config.ransac_iterations, confidence=config.ransac_confidence)
    if config.name == "svd":
        from geomoe3d.estimators.weighted_svd import WeightedSvdEstimator

        return WeightedSvdEstimator()
    raise ConfigError(f"unknown estimator '{config.name}'; known: consensus, ransac, svd")
