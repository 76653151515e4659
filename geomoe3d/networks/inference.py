"""What the last layer of a trained GeoMoE did with the correspondences of one pair; numpy alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.folded import FoldedOutput
from geomoe3d.types import Correspondences, FilterOutput, FloatArray, IntArray


@dataclass(frozen=True)
class Insight:
    """What the last layer did with N correspondences; -1 where it did not see one.

    Attributes:
        sub_field: (N,) the sub-field from which each correspondence is mostly rebuilt.
        expert: (N,) the expert with the largest weight for that sub-field, all -1 without experts.
        logits_per_layer: (L, N) verdicts of all layers, NaN where not seen.
    """

    sub_field: IntArray
    expert: IntArray
    logits_per_layer: FloatArray

    @classmethod
    def blind(cls, num: int, num_layers: int) -> Insight:
        """Nothing seen of N correspondences."""
        return cls(np.full(num, -1), np.full(num, -1), np.full((num_layers, num), np.nan))

    def fill(self, seen: IntArray, out: FoldedOutput) -> None:
        """Write what the network said of the rows ``seen``."""
        self.logits_per_layer[:, seen] = out.logits
        self.sub_field[seen] = out.sub_field
        if out.expert is not None:
            self.expert[seen] = out.expert[out.sub_field]

    def output(self, config: NetworkConfig) -> FilterOutput:
        """Weights relu(tanh(logit)), 0 where not seen; ``groups`` is the expert of each one's sub-field."""
        logits = np.nan_to_num(self.logits_per_layer[-1], nan=-np.inf)
        experts = config.num_experts if config.feed_forward == "moe" else 0
        return FilterOutput(
            weights=np.maximum(np.tanh(logits), 0.0),
            logits=logits,
            groups=np.where(self.expert < 0, experts, self.expert) if experts else None,
            group_names=(*(f"expert {i + 1}" for i in range(experts)), "not seen") if experts else (),
        )


def finite_part(correspondences: Correspondences) -> tuple[IntArray, Correspondences]:
    """The rows without NaN or infinity, and the correspondences of these rows."""
    seen = np.flatnonzero(np.isfinite(correspondences.points).all(axis=1))
    return seen, correspondences if len(seen) == len(correspondences) else correspondences.take(seen)
