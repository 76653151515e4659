"""A GeoMoE that sees correspondences under given motions: how sure of each, and which rows are inliers.

As a filter it lets consensus propose motions, has the keypoints draw them closer, judges them, and weighs the
correspondences under the motion that it likes best. Registration asks it about the motions that the clouds
like best. Cost at N = 1000 on one core: about 10 ms, and 5 ms per motion; motions are judged side by side on
more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import torch

from geomoe3d.clouds.keypoints import KeypointSurfaces
from geomoe3d.config import EstimatorConfig
from geomoe3d.errors import CheckpointError
from geomoe3d.estimators.consensus import ConsensusEstimator
from geomoe3d.estimators.keypoint_alignment import KeypointAligner
from geomoe3d.estimators.proposals import propose
from geomoe3d.filters.network import Insight, finite_part, run_several
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.folded import FoldedGeoMoE, FoldedOutput
from geomoe3d.networks.geomoe import GeoMoE
from geomoe3d.networks.inputs import MIN_CORRESPONDENCES, MotionInputs
from geomoe3d.networks.one_thread import helper_keeps_to_one_torch_thread, single_torch_thread
from geomoe3d.networks.pretrained import WeightCard, load_pretrained
from geomoe3d.runtime.threads import each, single_blas_thread
from geomoe3d.types import Correspondences, FilterOutput, FloatArray, Hypothesis, IntArray

MOST_MOTIONS = 6
"""Motions that the filter judges of those that consensus proposes."""
MOST_ROWS = 1000
"""Correspondences that a motion is judged on; mutual ones first where there are more."""
FIRST_MOTIONS = 2
"""Motions that are judged before the filter asks itself whether it has seen enough."""
CONVINCED = 3.0
"""Verdict from which on the filter looks at no further motions."""
_NUM_SEEDS, _NUM_REFINED = 500, 60  # of consensus: motions to be drawn closer need not be proposed so well
_PARTS = 2  # of a lot, side by side; for any number of threads: last bits depend on how many share a batch


class Judged:
    """What the network says under one motion.

    Attributes:
        verdict: logit that the motion is right.
        output: weights of the N correspondences under it, made when asked for.
    """

    def __init__(self, verdict: float, make: Callable[[], FilterOutput]) -> None:
        self.verdict = verdict
        self._make = make

    @cached_property
    def output(self) -> FilterOutput:
        """See the class."""
        return self._make()


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
            CheckpointError: see `geomoe3d.networks.pretrained.load_pretrained`.
        """
        model, card = load_pretrained(name_or_path)
        return cls(model, card, device)

    @single_blas_thread()
    @single_torch_thread()
    def about(
        self,
        correspondences: Correspondences,
        *,
        voxel_size: float,
        surfaces: KeypointSurfaces | None = None,
    ) -> PairJudge:
        """The judge of one pair's motions.

        Args:
            correspondences: N rows in local coordinates; free space is asked where ``viewpoints`` are given.
            voxel_size: the grid the points came from.
            surfaces: of the finite ones, see `MotionInputs`, where somebody has them already.
        """
        seen, part = finite_part(correspondences)
        inputs = None
        if len(seen) >= MIN_CORRESPONDENCES:
            views = part.viewpoints or (None, None)
            inputs = MotionInputs(part.points, views, voxel_size, self.config, surfaces)
        return PairJudge(self._network, self.config, self.device, inputs, seen, len(correspondences))

    @single_blas_thread()
    def __call__(self, correspondences: Correspondences, *, voxel_size: float, seed: int = 0) -> FilterOutput:
        """Weigh correspondences under the best motion; see `Filter`.

        Returns:
            Weights, and as ``hypotheses`` what consensus proposed: those looked at, of the first
            `MOST_MOTIONS`, drawn closer by the keypoints as far as ``num_aligned`` of the configuration says,
            in the order of their verdicts; then the others. Where no motion is proposed all weights are 0.
        """
        seen, part = finite_part(correspondences)
        blind = Insight.blind(len(correspondences), self.config.num_layers).output(self.config)
        if len(seen) < MIN_CORRESPONDENCES:
            return blind
        threshold = self._proposing.inlier_threshold * voxel_size
        few = likeliest_rows(part, MOST_ROWS, seed)
        surfaces = None
        if few is part and self._proposing.inlier_threshold == self.config.compatibility_threshold:
            surfaces = KeypointSurfaces.of(part.points, part.viewpoints or (None, None), threshold)
        num_aligned = self._proposing.num_aligned if part.normals is None else 0
        estimate = ConsensusEstimator(num_hypotheses=self._proposing.num_hypotheses)
        if num_aligned:
            estimate = replace(estimate, num_seeds=_NUM_SEEDS, num_refined=_NUM_REFINED)
        found = propose(
            estimate,
            part,
            np.ones(len(part)),
            self._proposing.model_copy(update={"num_aligned": 0}),  # only those looked at, below
            inlier_threshold=threshold,
            seed=seed,
            surfaces=surfaces,
        )
        if not found:
            return blind
        aligner = KeypointAligner(part.points, threshold, surfaces)
        ask = self.about(few, voxel_size=voxel_size, surfaces=surfaces)
        first: list[Hypothesis] = []
        judged: list[Judged] = []
        for lot in (found[:FIRST_MOTIONS], found[FIRST_MOTIONS:MOST_MOTIONS]):
            if lot and all(j.verdict < CONVINCED for j in judged):
                count = max(num_aligned - len(first), 0)
                lot = aligner.hypotheses(lot[:count]) + lot[count:]
                judged += ask(np.array([h.T_target_source for h in lot]))
                first += lot
        order = np.argsort([-j.verdict for j in judged], kind="stable")
        ranked = [replace(first[k], verdict=judged[k].verdict) for k in order]
        output: FilterOutput = judged[order[0]].output
        if few is not correspondences:  # judged on some rows, weighed on all
            best = ranked[0].T_target_source[None]
            everything = self.about(correspondences, voxel_size=voxel_size, surfaces=surfaces)
            output = everything(best)[0].output
        return replace(output, hypotheses=(*ranked, *found[len(judged) :]))


class PairJudge:
    """What the network says of motions of one pair's correspondences; see `MotionJudge.about`."""

    def __init__(
        self,
        network: FoldedGeoMoE,
        config: NetworkConfig,
        device: torch.device,
        inputs: MotionInputs | None,
        seen: IntArray,
        num_rows: int,
    ) -> None:
        self._network, self._config, self._device = network, config, device
        self._inputs, self._seen, self._num_rows = inputs, seen, num_rows

    @single_blas_thread()
    @single_torch_thread()
    def __call__(self, motions: FloatArray) -> list[Judged]:
        """Judge motions, several at a time where there are threads.

        Args:
            motions: (K, 4, 4) p_target = R p_source + t, local coordinates.

        Returns:
            One per motion, in order; none where fewer than 3 rows are finite.
        """
        if self._inputs is None or len(motions) == 0:
            return []
        parts = np.array_split(motions, min(_PARTS, len(motions)))
        return [judged for part in each(self._judge, parts) for judged in part]

    def _judge(self, motions: FloatArray) -> list[Judged]:
        helper_keeps_to_one_torch_thread()
        assert self._inputs is not None
        outputs = run_several(self._network, self._inputs.under(motions), self._device)
        return [
            Judged(float(out.verdict), partial(self._output, out))
            for out in outputs
            if out.verdict is not None
        ]

    def _output(self, out: FoldedOutput) -> FilterOutput:
        insight = Insight.blind(self._num_rows, self._config.num_layers)
        insight.fill(self._seen, out)
        return insight.output(self._config)


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
