"""What an estimator is: weighted correspondences in, candidate transforms out; and the checks they share.

Place: propose, between outlier rejection and score.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from geomoe3d.errors import InputError
from geomoe3d.parts import Part, Registry
from geomoe3d.types import FloatArray, Hypothesis

if TYPE_CHECKING:
    from typing_extensions import Self

    from geomoe3d.estimators.surroundings import Surroundings


class Estimator(Part):
    """Anything that turns weighted correspondences into hypotheses.

    Attributes:
        uses_surroundings: whether it is to be given what surrounds the correspondences: normals at the points
            and what the sensors saw.
    """

    uses_surroundings: ClassVar[bool] = False

    def with_less_effort(self) -> Self:
        """The same where every proposal is drawn closer by others before it is scored; here itself."""
        return self

    def with_least_effort(self) -> Self:
        """The same where only whether there is anything at all is asked; here itself."""
        return self

    @abstractmethod
    def __call__(
        self,
        correspondences: ArrayLike,
        weights: ArrayLike | None = None,
        *,
        inlier_threshold: float,
        seed: int = 0,
        surroundings: Surroundings | None = None,
    ) -> list[Hypothesis]:
        """Estimate rigid transforms p_target = R p_source + t.

        Args:
            correspondences: (N, 6) rows [source xyz, target xyz], one unit of length; extents up to
                about 1e5 inlier thresholds (distances are formed in float32).
            weights: (N,) non-negative, or None for all ones.
            inlier_threshold: largest residual of an inlier, same unit.
            seed: decides every random choice.
            surroundings: of the same rows, for those that use them; else None.

        Returns:
            Distinct hypotheses, best first; empty where the correspondences do not determine a motion
            (fewer than 3, collinear, coincident). Never a stand-in identity.

        Raises:
            InputError: wrong shapes, non-finite numbers, negative weights, a threshold <= 0.
        """


estimator: Registry[Estimator] = Registry("estimator", "geomoe3d.estimators", lambda: Estimator)
"""Decorator by which an estimator joins, and the choice by name."""


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
