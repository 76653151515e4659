"""What was decided of a scan at one place of a map."""

from __future__ import annotations

from dataclasses import dataclass, replace

from geomoe3d.clouds.pair import Pair
from geomoe3d.decision.accuracy import measure_accuracy
from geomoe3d.decision.answer import Decision
from geomoe3d.decision.scale import Scale, measure_scale
from geomoe3d.decision.shared_surface import SharedSurface
from geomoe3d.runtime.threads import beside
from geomoe3d.types import Accuracy


@dataclass(frozen=True, eq=False)
class Found:
    """What was decided at one place.

    Attributes:
        pair: the scan, and the map around the place.
        decision: of the ordinary line there.
        sure: whether it was ok beside all rivals, before the scale was measured: more looks cannot help then.
        stood: whether it was ok before it had rivals elsewhere.
        measures: the scale and the accuracy of its answer, where somebody measured them.
    """

    pair: Pair
    decision: Decision
    sure: bool = False
    stood: bool = False
    measures: tuple[Scale | None, Accuracy | None] | None = None

    @property
    def score(self) -> float:
        """Of the answer; none is worth nothing."""
        return 0.0 if self.decision.answer is None else self.decision.answer.score

    @property
    def confidence(self) -> float:
        """Of the decision."""
        return self.decision.judgement.confidence

    def measured(self) -> Found:
        """The same with its measures."""
        if self.measures is not None or self.decision.answer is None:
            return self
        T, shared = self.decision.T_target_source, SharedSurface(*self.pair.clouds)
        measures = beside(
            lambda: measure_scale(T, shared),
            lambda: measure_accuracy(T, shared, self.pair.matched, self.pair.inlier_threshold),
        )
        return replace(self, measures=measures)
