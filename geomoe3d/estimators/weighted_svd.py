"""Weighted SVD: one closed-form fit to all correspondences, as good as the weights are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from geomoe3d.estimators.base import Estimator, check_correspondences, estimator
from geomoe3d.geometry.rigid_fit import fit_rigid, spread, squared_residuals
from geomoe3d.geometry.se3 import make_transform
from geomoe3d.types import Hypothesis

if TYPE_CHECKING:
    from typing_extensions import Self

    from geomoe3d.estimators.surroundings import Surroundings


@estimator("svd")
@dataclass(frozen=True)
class WeightedSvdEstimator(Estimator):
    """Weighted Kabsch over all correspondences.

    This is the numpy form; `geomoe3d.geometry.kabsch.weighted_kabsch` is the batched differentiable twin.
    """

    @classmethod
    def from_config(cls, config: object) -> Self:
        """There is nothing to configure."""
        return cls()

    def __call__(
        self,
        correspondences: ArrayLike,
        weights: ArrayLike | None = None,
        *,
        inlier_threshold: float,
        seed: int = 0,
        surroundings: Surroundings | None = None,
    ) -> list[Hypothesis]:
        """See `Estimator`. Returns one hypothesis or none; ``seed`` and ``surroundings`` are not used."""
        rows, w = check_correspondences(correspondences, weights, inlier_threshold)
        source, target = rows[:, :3], rows[:, 3:]
        if (w > 0).sum() < 3 or min(spread(source, w), spread(target, w)) < 1e-6 * inlier_threshold:
            return []
        R, t = fit_rigid(source, target, w)
        r2 = squared_residuals(R[None], t[None], source, target)[0]
        score = float((w * np.maximum(1 - r2 / inlier_threshold**2, 0)).sum())
        num_inliers = int((r2 < inlier_threshold**2).sum())
        return [Hypothesis(make_transform(R, t), score, num_inliers)]
