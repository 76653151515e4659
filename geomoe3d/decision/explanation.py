"""A result with what led to it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from geomoe3d.result import RegistrationResult
from geomoe3d.types import BoolArray, Correspondences, FilterOutput, FloatArray, Hypothesis, PointCloud


@dataclass(frozen=True)
class Explanation:
    """A result with what led to it, for pictures and for curious users.

    Attributes:
        result: the answer.
        source, target: the clouds as loaded, full resolution, local coordinates.
        correspondences: what was given to the estimator, local coordinates; empty where it never came to it.
        weighed: what the filter said of them, in the same order; of a network that scores, what it said under
            the answer, all zero where there was none.
        inliers: (K,) True where a correspondence agrees with the answer.
        hypotheses: all that were considered, best first, local coordinates, before refinement.
    """

    result: RegistrationResult
    source: PointCloud
    target: PointCloud
    correspondences: Correspondences = field(default_factory=lambda: Correspondences(np.zeros((0, 6))))
    weighed: FilterOutput = field(default_factory=lambda: FilterOutput(np.zeros(0)))
    inliers: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    hypotheses: tuple[Hypothesis, ...] = ()

    @property
    def weights(self) -> FloatArray:
        """(K,) the filter's weights."""
        return self.weighed.weights
