"""A trained GeoMoE as a filter of the pipeline: correspondences in, one weight each out.

Weights are loaded once and folded for inference; calls share nothing and draw nothing at random. Rows with
a NaN or infinite coordinate get weight 0. Cost: linear in N, about 30 ms at N = 1000 on two idle cores
beside the inputs that the network asks for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from geomoe3d.config import EstimatorConfig
from geomoe3d.estimators.consensus import ConsensusEstimator
from geomoe3d.estimators.proposals import propose
from geomoe3d.filters.base import FilterOutput
from geomoe3d.filters.folded import FoldedGeoMoE
from geomoe3d.filters.geomoe import GeoMoE
from geomoe3d.filters.inputs import MIN_CORRESPONDENCES, motion_inputs, pair_input
from geomoe3d.filters.layers import weights_from_logits
from geomoe3d.filters.pretrained import WeightCard, load_pretrained
from geomoe3d.types import Correspondences, FloatArray, Hypothesis, IntArray

MOST_MOTIONS = 16
MOST_ROWS = 1000


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


class GeoMoEFilter:
    """A network as `geomoe3d.filters.base.Filter`.

    Args:
        model: trained; its weights are copied.
        card: what it is, or None.
        device: where it runs.
        estimator: what proposes motions to a network that judges some; None takes the defaults.
    """

    def __init__(
        self,
        model: GeoMoE,
        card: WeightCard | None = None,
        device: str | torch.device = "cpu",
        estimator: EstimatorConfig | None = None,
    ) -> None:
        self.config = model.config
        self.card = card
        self.device = torch.device(device)
        self._network = FoldedGeoMoE(model.to(self.device).eval())
        self._proposing = estimator or EstimatorConfig()

    @classmethod
    def from_pretrained(
        cls,
        name_or_path: str | Path,
        device: str | torch.device = "cpu",
        estimator: EstimatorConfig | None = None,
    ) -> GeoMoEFilter:
        """Load a .safetensors file with its card, or weights that ship with the package.

        Raises:
            CheckpointError: see `geomoe3d.filters.pretrained.load_pretrained`.
        """
        model, card = load_pretrained(name_or_path)
        return cls(model, card, device, estimator)

    def __call__(self, correspondences: Correspondences, *, voxel_size: float, seed: int = 0) -> FilterOutput:
        """Weigh correspondences; see `Filter`. ``groups`` is the expert of each one's sub-field.

        Returns:
            Weights relu(tanh(logit)): 0 where the logit is negative. With fewer than 3 finite rows there
            is nothing to go by: all weights 0.

        Raises:
            InputError: the network was trained with a channel that these correspondences lack.
        """
        hypotheses: tuple[Hypothesis, ...] = ()
        if self.config.judges_motions:
            hypotheses = tuple(self.judge(correspondences, voxel_size=voxel_size, seed=seed))
        insight = self.look(correspondences, voxel_size=voxel_size, hypotheses=hypotheses)
        logits = insight.logits_per_layer[-1]
        weights = weights_from_logits(torch.from_numpy(np.nan_to_num(logits, nan=-np.inf))).numpy()
        experts = self.config.num_experts if self.config.feed_forward == "moe" else 0
        return FilterOutput(
            weights=weights,
            logits=np.nan_to_num(logits, nan=-np.inf),
            groups=np.where(insight.expert < 0, experts, insight.expert) if experts else None,
            group_names=(*(f"expert {i + 1}" for i in range(experts)), "not seen") if experts else (),
            hypotheses=hypotheses,
        )

    @torch.inference_mode()
    def judge(
        self, correspondences: Correspondences, *, voxel_size: float, seed: int = 0
    ) -> list[Hypothesis]:
        """The motions that consensus proposes, those that the network likes best first.

        At most ``MOST_MOTIONS`` are judged, on at most ``MOST_ROWS`` of the correspondences, mutual ones
        first; the others follow in their order.
        """
        seen = correspondences.take(np.flatnonzero(np.isfinite(correspondences.points).all(axis=1)))
        if len(seen) < MIN_CORRESPONDENCES:
            return []
        found = propose(
            ConsensusEstimator(num_hypotheses=self._proposing.num_hypotheses),
            seen,
            np.ones(len(seen)),
            self._proposing,
            inlier_threshold=self.config.compatibility_threshold * voxel_size,
            seed=seed,
        )
        if not found:
            return []
        few = found[:MOST_MOTIONS]
        if len(seen) > MOST_ROWS:
            first = np.arange(len(seen)) if seen.mutual is None else np.argsort(~seen.mutual, kind="stable")
            seen = seen.take(np.sort(first[:MOST_ROWS]))
        motions = np.array([h.T_target_source for h in few])
        views = seen.viewpoints or (None, None)
        verdicts = [
            self._network(
                one.coordinates.to(self.device), _on(one.channels, self.device), one.neighbors.to(self.device)
            ).verdict
            for one in motion_inputs(seen.points, motions, views, voxel_size, self.config)
        ]
        judged = [replace(h, verdict=float(v)) for h, v in zip(few, verdicts, strict=True) if v is not None]
        return sorted(judged, key=lambda h: -(h.verdict or 0.0)) + found[MOST_MOTIONS:]

    def look(
        self,
        correspondences: Correspondences,
        *,
        voxel_size: float,
        hypotheses: Sequence[Hypothesis] = (),
    ) -> Insight:
        """Verdicts of all layers, sub-fields and experts, for drawing.

        A network that judges motions looks at the correspondences under the first of ``hypotheses``, and
        sees nothing without any.
        """
        num = len(correspondences)
        result = Insight(np.full(num, -1), np.full(num, -1), np.full((self.config.num_layers, num), np.nan))
        seen = np.flatnonzero(np.isfinite(correspondences.points).all(axis=1))
        if len(seen) < MIN_CORRESPONDENCES:
            return result
        part = correspondences if len(seen) == num else correspondences.take(seen)
        if self.config.judges_motions:
            if not hypotheses:
                return result
            motions = hypotheses[0].T_target_source[None]
            views = part.viewpoints or (None, None)
            inputs = motion_inputs(part.points, motions, views, voxel_size, self.config)[0]
        else:
            wanted = set(self.config.extra_channels)
            given: dict[str, NDArray[Any] | None] = {
                name: getattr(part, name)
                for name in ("feature_distance", "ratio", "mutual")
                if name in wanted
            }
            inputs = pair_input(part.points, voxel_size, self.config, **given)
        channels = _on(inputs.channels, self.device)
        out = self._network(
            inputs.coordinates.to(self.device), channels, inputs.neighbors.to(self.device), insight=True
        )
        result.logits_per_layer[:, seen] = out.logits.cpu().numpy()
        if out.sub_field is not None:
            sub_field = out.sub_field.cpu().numpy()
            result.sub_field[seen] = sub_field
            if out.expert is not None:
                result.expert[seen] = out.expert.cpu().numpy()[sub_field]
        return result


def _on(channels: Tensor | None, device: torch.device) -> Tensor | None:
    return None if channels is None else channels.to(device)


def geomoe_filter(
    weights: str | Path | None = None, estimator: EstimatorConfig | None = None
) -> GeoMoEFilter:
    """The filter named ``geomoe``.

    Args:
        weights: name or path; None: the weights that ship with the package.
        estimator: as in `GeoMoEFilter`.

    Raises:
        CheckpointError: not found or not fitting; None and none ship with this version.
    """
    return GeoMoEFilter.from_pretrained(DEFAULT_WEIGHTS if weights is None else weights, estimator=estimator)


DEFAULT_WEIGHTS = "geomoe3d"
