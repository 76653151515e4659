"""Weighted least squares over the correspondences, with the weights that the network gives under a hypothesis."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from geomoe3d.clouds.pair import Pair
from geomoe3d.estimators.weighted_svd import WeightedSvdEstimator
from geomoe3d.geometry.se3 import residuals
from geomoe3d.refinement.base import PairRefiner, Refiner, refiner
from geomoe3d.scoring.network import opinion_of
from geomoe3d.types import FloatArray, Hypothesis


@refiner("svd")
class WeightedSvdRefiner(Refiner):
    """One weighted Kabsch fit per hypothesis; without a network the inliers weigh alike.

    Where the weights do not determine a transform, nothing is left of the hypothesis: it speaks for them alone.
    """

    needs_clouds: ClassVar[bool] = False

    @classmethod
    def from_config(cls, config: object) -> WeightedSvdRefiner:
        """There is nothing to configure."""
        return cls()

    def about(self, pair: Pair) -> PairRefiner:
        """See `geomoe3d.refinement.base.Refiner`."""
        matched, fit = pair.matched, WeightedSvdEstimator()

        def refine(hypothesis: Hypothesis) -> tuple[FloatArray | None, str | None]:
            opinion = opinion_of(hypothesis)
            output = None if opinion is None else opinion.output
            if output is None:
                gaps = residuals(hypothesis.T_target_source, matched.source, matched.target)
                weights = np.where(gaps < pair.inlier_threshold, 1.0, 0.0)
            else:
                weights = output.weights
            found = fit(matched.points, weights, inlier_threshold=pair.inlier_threshold)
            return (found[0].T_target_source, None) if found else (None, "the weights fix no transform")

        return refine
