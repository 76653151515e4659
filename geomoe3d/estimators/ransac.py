"""RANSAC on correspondences: Open3D's, behind the form all estimators share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from geomoe3d.config import EstimatorConfig, expert
from geomoe3d.estimators.base import Estimator, check_correspondences, estimator
from geomoe3d.geometry.rigid_fit import fit_rigid, spread, squared_residuals
from geomoe3d.geometry.se3 import make_transform
from geomoe3d.runtime.open3d_core import open3d_core
from geomoe3d.types import FloatArray, Hypothesis

if TYPE_CHECKING:
    from typing_extensions import Self

    from geomoe3d.estimators.surroundings import Surroundings


@estimator("ransac")
@dataclass(frozen=True)
class RansacEstimator(Estimator):
    """Open3D's RANSAC with the edge-length and distance checkers.

    Attributes:
        iterations: upper bound on the number of samples.
        confidence: stops earlier once an all-inlier sample was drawn with this probability.
        edge_length_similarity: a sample is skipped when two of its edges differ by more than this factor.
    """

    iterations: int = 50_000
    confidence: float = 0.999
    edge_length_similarity: float = 0.9

    @classmethod
    def from_config(cls, config: EstimatorConfig) -> Self:
        """With as many samples as configured."""
        return cls(iterations=config.ransac_iterations, confidence=config.ransac_confidence)

    def __call__(
        self,
        correspondences: ArrayLike,
        weights: ArrayLike | None = None,
        *,
        inlier_threshold: float,
        seed: int = 0,
        surroundings: Surroundings | None = None,
    ) -> list[Hypothesis]:
        """See `Estimator`. Weights only select: correspondences of weight zero are left out.

        Open3D answers a search without any inlier with the identity; that is no answer and gives [].
        """
        rows, w = check_correspondences(correspondences, weights, inlier_threshold)
        rows = rows[w > 0]
        if len(rows) < 3 or min(
            spread(rows[:, :3], np.ones(len(rows))), spread(rows[:, 3:], np.ones(len(rows)))
        ) < (1e-6 * inlier_threshold):
            return []
        o3d = open3d_core()

        registration = o3d.pipelines.registration
        o3d.utility.random.seed(seed)
        clouds = [
            o3d.geometry.PointCloud(o3d.utility.Vector3dVector(rows[:, s])) for s in (slice(3), slice(3, 6))
        ]
        pairs = o3d.utility.Vector2iVector(np.repeat(np.arange(len(rows), dtype=np.int32)[:, None], 2, 1))
        answer = registration.registration_ransac_based_on_correspondence(
            clouds[0],
            clouds[1],
            pairs,
            inlier_threshold,
            registration.TransformationEstimationPointToPoint(False),
            3,
            [
                registration.CorrespondenceCheckerBasedOnEdgeLength(self.edge_length_similarity),
                registration.CorrespondenceCheckerBasedOnDistance(inlier_threshold),
            ],
            registration.RANSACConvergenceCriteria(self.iterations, self.confidence),
        )
        T = _settle(np.array(answer.transformation, dtype=np.float64), rows, inlier_threshold)
        r2 = squared_residuals(T[None, :3, :3], T[None, :3, 3], rows[:, :3], rows[:, 3:])[0]
        num_inliers = int((r2 < inlier_threshold**2).sum())
        # Inliers on a line leave the turn about it free: that is no answer either.
        thinnest = min(spread(half, (r2 < inlier_threshold**2) * 1.0) for half in (rows[:, :3], rows[:, 3:]))
        firm = expert().consensus.least_spread * inlier_threshold
        if len(answer.correspondence_set) < 3 or num_inliers < 3 or thinnest < firm:
            return []
        score = float(np.maximum(1 - r2 / inlier_threshold**2, 0).sum())
        return [Hypothesis(T, score, num_inliers)]


def _settle(T: FloatArray, rows: FloatArray, inlier_threshold: float) -> FloatArray:
    """Least squares on the inliers until they stay the same.

    Where many rows are inliers the library stops early, and which of its threads' good samples it returns
    depends on their race; from any of them this ends at the same fit.
    """
    before = np.zeros(len(rows), dtype=np.bool_)
    for _ in range(expert().ransac.most_refits):
        r2 = squared_residuals(T[None, :3, :3], T[None, :3, 3], rows[:, :3], rows[:, 3:])[0]
        inlier = r2 < inlier_threshold**2
        if inlier.sum() < 3 or (inlier == before).all():
            break
        R, t = fit_rigid(rows[inlier, :3], rows[inlier, 3:], np.ones(int(inlier.sum())))
        T, before = make_transform(R, t), inlier
    return T
