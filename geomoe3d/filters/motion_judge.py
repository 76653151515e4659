"""A GeoMoE that sees correspondences under given motions: how sure of each, and which rows are inliers.

As a filter it lets consensus propose motions, judges them, and weighs the correspondences under the motion
that it likes best. Registration asks it about the motions that the clouds like best. Cost at N =
1000 on one core: about 10 ms, and 3 ms per motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from geomoe3d.config import EstimatorConfig
from geomoe3d.errors import CheckpointError
from geomoe3d.estimators.consensus import ConsensusEstimator
from geomoe3d.estimators.proposals import propose
from geomoe3d.filters.base import FilterOutput
from geomoe3d.filters.folded import FoldedGeoMoE
from geomoe3d.filters.geomoe import GeoMoE
from geomoe3d.filters.geomoe_filter import Insight, finite_rows, run
from geomoe3d.filters.inputs import MIN_CORRESPONDENCES, motion_inputs
from geomoe3d.filters.one_thread import single_torch_thread
from geomoe3d.filters.pretrained import WeightCard, load_pretrained
from geomoe3d.threads import single_blas_thread
from geomoe3d.types import Correspondences, FloatArray

MOST_MOTIONS = 20
"""Motions that the filter judges of those that consensus proposes."""
MOST_ROWS = 1000
"""Correspondences that a motion is judged on; mutual ones first where there are more."""


@dataclass(frozen=True)
class Judged:
    """What the network says under one motion.

    Attributes:
        verdict: logit that the motion is right.
        output: weights of the N correspondences under it.
    """

    verdict: float
    output: FilterOutput


class MotionJudge:
    """A network that judges motions, and the filter made of it.

    Args:
        model: trained with the channels ``aligned``; its weights are copied.
        card: what it is, or None.
        device: where it runs.
        estimator: what proposes motions to the filter; None takes the defaults.

    Raises:
        CheckpointError: a network that judges no motions.
    """

    def __init__(
        self,
        model: GeoMoE,
        card: WeightCard | None = None,
        device: str | torch.device = "cpu",
        estimator: EstimatorConfig | None = None,
    ) -> None:
        if not model.config.judges_motions:
            raise CheckpointError("this network judges no motions; GeoMoEFilter runs it, not MotionJudge")
        self.config = model.config
        self.card = card
        self.device = torch.device(device)
        self._network = FoldedGeoMoE(model.to(self.device).eval())
        self._proposing = estimator or EstimatorConfig()

    @classmethod
    def from_pretrained(cls, name_or_path: str | Path, device: str | torch.device = "cpu") -> MotionJudge:
        """Load a .safetensors file with its card, or weights that ship with the package.

        Raises:
            CheckpointError: see `geomoe3d.filters.pretrained.load_pretrained`.
        """
        model, card = load_pretrained(name_or_path)
        return cls(model, card, device)

    @single_blas_thread()
    @single_torch_thread()
    def judge(
        self, correspondences: Correspondences, motions: FloatArray, *, voxel_size: float
    ) -> list[Judged]:
        """What the network says under each motion.

        Args:
            correspondences: N rows in local coordinates; free space is asked where ``viewpoints`` are given.
            motions: (K, 4, 4) p_target = R p_source + t, same coordinates.
            voxel_size: the grid the points came from.

        Returns:
            One per motion, in order; none where fewer than 3 rows are finite.
        """
        seen, part = finite_rows(correspondences)
        if len(seen) < MIN_CORRESPONDENCES or len(motions) == 0:
            return []
        views = part.viewpoints or (None, None)
        found = []
        for inputs in motion_inputs(part.points, motions, views, voxel_size, self.config):
            out = run(self._network, inputs, self.device)
            assert out.verdict is not None
            insight = Insight.blind(len(correspondences), self.config.num_layers)
            insight.fill(seen, out)
            found.append(Judged(float(out.verdict), insight.output(self.config)))
        return found

    @single_blas_thread()
    @single_torch_thread()
    def __call__(self, correspondences: Correspondences, *, voxel_size: float, seed: int = 0) -> FilterOutput:
        """Weigh correspondences under the best motion; see `Filter`.

        Returns:
            Weights, and as ``hypotheses`` what consensus proposed: the first `MOST_MOTIONS` in the order of
            their verdicts, then the others. Where no motion is proposed all weights are 0.
        """
        seen, part = finite_rows(correspondences)
        blind = Insight.blind(len(correspondences), self.config.num_layers).output(self.config)
        if len(seen) < MIN_CORRESPONDENCES:
            return blind
        found = propose(
            ConsensusEstimator(num_hypotheses=self._proposing.num_hypotheses),
            part,
            np.ones(len(part)),
            self._proposing,
            inlier_threshold=self._proposing.inlier_threshold * voxel_size,
            seed=seed,
        )
        if not found:
            return blind
        few = likeliest_rows(part, MOST_ROWS, seed)
        first = found[:MOST_MOTIONS]
        motions = np.array([h.T_target_source for h in first])
        judged = self.judge(few, motions, voxel_size=voxel_size)
        order = np.argsort([-j.verdict for j in judged], kind="stable")
        ranked = [replace(first[k], verdict=judged[k].verdict) for k in order]
        output: FilterOutput = judged[order[0]].output
        if few is not correspondences:  # judged on some rows, weighed on all
            output = self.judge(correspondences, motions[order[:1]], voxel_size=voxel_size)[0].output
        return replace(output, hypotheses=(*ranked, *found[MOST_MOTIONS:]))


def likeliest_rows(correspondences: Correspondences, limit: int, seed: int) -> Correspondences:
    """At most ``limit`` correspondences in their order: mutual ones first, a seeded choice among equals.

    The same object where there are no more.
    """
    if len(correspondences) <= limit:
        return correspondences
    chosen = np.random.default_rng(seed).permutation(len(correspondences))
    if correspondences.mutual is not None:
        chosen = chosen[np.argsort(~correspondences.mutual[chosen], kind="stable")]
    return correspondences.take(np.sort(chosen[:limit]))
