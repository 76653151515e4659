"""A result with what led to it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from geomoe3d.clouds.inputs import Inputs, mark_of
from geomoe3d.geometry.se3 import motions_apart
from geomoe3d.result import RegistrationResult
from geomoe3d.types import BoolArray, Correspondences, FilterOutput, FloatArray, Hypothesis, PointCloud

if TYPE_CHECKING:
    from geomoe3d.visual.view import RegistrationView


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

    def exchanged(self) -> Explanation:
        """The same with the roles of source and target exchanged."""
        result, source = self.result.inverse(), self.target
        other = result.alternative
        if other is not None:
            center = source.origin + [column.mean() for column in source.points.T]
            shift, _ = motions_apart(result.T_target_source, other.T_target_source, center)
            result = replace(result, alternative=replace(other, translation_difference=shift))
        return replace(
            self,
            result=result,
            source=source,
            target=self.source,
            correspondences=self.correspondences.exchanged(),
            hypotheses=tuple(h.exchanged() for h in self.hypotheses),
        )

    def view(self, unit: str = "") -> RegistrationView:
        """What the displays take: clouds, answer and correspondences in file coordinates, and their unit's name."""
        from geomoe3d.visual.view import RegistrationView

        made = self._inputs(None, None)
        found = made.correspondences, made.weights, made.groups, made.group_names
        return RegistrationView.of(self.result, (self.source, self.target), *found, unit)

    def remembering(self, source: Any, target: Any) -> Explanation:
        """With a result that knows what it was made of: the data as the caller gave them."""
        return replace(self, result=self.result._with_inputs(self._inputs(source, target)))

    def _inputs(self, source: Any, target: Any) -> Inputs:
        matched, weighed, used = self.correspondences, self.weighed, self.result.config
        filtered = used["filter"]["name"] != "none" or "network" in used["scoring"]["scorers"]
        return Inputs(
            source,
            target,
            (mark_of(self.source), mark_of(self.target)),
            np.column_stack([matched.source + self.source.origin, matched.target + self.target.origin]),
            weighed.weights if filtered else None,
            weighed.groups,
            weighed.group_names,
        )
