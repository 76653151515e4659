"""A trained GeoMoE as a filter of the pipeline: correspondences in, one weight each out.

Weights are loaded once and folded for inference; calls share nothing and draw nothing at random. Rows with
a NaN or infinite coordinate get weight 0. Cost: linear in N, about 30 ms at N = 1000 on two idle cores
beside the inputs that the network asks for. A network that judges motions is run by `MotionJudge`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from geomoe3d.config import EstimatorConfig
from geomoe3d.errors import CheckpointError
from geomoe3d.filters.base import Filter
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.folded import FoldedGeoMoE, FoldedOutput
from geomoe3d.networks.geomoe import GeoMoE
from geomoe3d.networks.inputs import MIN_CORRESPONDENCES, PairInput, pair_input
from geomoe3d.networks.layers import weights_from_logits
from geomoe3d.networks.pretrained import WeightCard, load_pretrained
from geomoe3d.networks.weight_files import DEFAULT_WEIGHTS
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
        self.logits_per_layer[:, seen] = out.logits.cpu().numpy()
        if out.sub_field is not None:
            sub_field = out.sub_field.cpu().numpy()
            self.sub_field[seen] = sub_field
            if out.expert is not None:
                self.expert[seen] = out.expert.cpu().numpy()[sub_field]

    def output(self, config: NetworkConfig) -> FilterOutput:
        """Weights relu(tanh(logit)), 0 where not seen; ``groups`` is the expert of each one's sub-field."""
        logits = np.nan_to_num(self.logits_per_layer[-1], nan=-np.inf)
        experts = config.num_experts if config.feed_forward == "moe" else 0
        return FilterOutput(
            weights=weights_from_logits(torch.from_numpy(logits)).numpy(),
            logits=logits,
            groups=np.where(self.expert < 0, experts, self.expert) if experts else None,
            group_names=(*(f"expert {i + 1}" for i in range(experts)), "not seen") if experts else (),
        )


class GeoMoEFilter:
    """A network as `geomoe3d.filters.base.Filter`.

    Args:
        model: trained, not one that judges motions; its weights are copied.
        card: what it is, or None.
        device: where it runs.

    Raises:
        CheckpointError: a network that judges motions.
    """

    def __init__(
        self, model: GeoMoE, card: WeightCard | None = None, device: str | torch.device = "cpu"
    ) -> None:
        if model.config.judges_motions:
            raise CheckpointError("this network judges motions; MotionJudge runs it, not GeoMoEFilter")
        self.config = model.config
        self.card = card
        self.device = torch.device(device)
        self._network = FoldedGeoMoE(model.to(self.device).eval())

    def __call__(self, correspondences: Correspondences, *, voxel_size: float, seed: int = 0) -> FilterOutput:
        """Weigh correspondences; see `Filter`.

        Returns:
            See `Insight.output`. With fewer than 3 finite rows there is nothing to go by: all weights 0.

        Raises:
            InputError: the network was trained with a channel that these correspondences lack.
        """
        return self.look(correspondences, voxel_size=voxel_size).output(self.config)

    def look(self, correspondences: Correspondences, *, voxel_size: float) -> Insight:
        """Verdicts of all layers, sub-fields and experts, for drawing."""
        result = Insight.blind(len(correspondences), self.config.num_layers)
        seen, part = finite_part(correspondences)
        if len(seen) < MIN_CORRESPONDENCES:
            return result
        wanted = set(self.config.extra_channels)
        given: dict[str, NDArray[Any] | None] = {
            name: getattr(part, name) for name in ("feature_distance", "ratio", "mutual") if name in wanted
        }
        inputs = pair_input(part.points, voxel_size, self.config, **given)
        result.fill(seen, run(self._network, inputs, self.device))
        return result


def finite_part(correspondences: Correspondences) -> tuple[IntArray, Correspondences]:
    """The rows without NaN or infinity, and the correspondences of these rows."""
    seen = np.flatnonzero(np.isfinite(correspondences.points).all(axis=1))
    return seen, correspondences if len(seen) == len(correspondences) else correspondences.take(seen)


def run(network: FoldedGeoMoE, inputs: PairInput, device: torch.device) -> FoldedOutput:
    """One pass with insight."""
    return run_several(network, [inputs], device)[0]


def run_several(network: FoldedGeoMoE, inputs: list[PairInput], device: torch.device) -> list[FoldedOutput]:
    """One pass with insight, one pair under several motions: inputs that differ in their channels only."""
    given = [one.channels for one in inputs if one.channels is not None]
    channels = torch.stack(given).to(device) if given else None
    first = inputs[0]
    return network.under_motions(
        first.coordinates.to(device), channels, first.neighbors.to(device), insight=True
    )


def geomoe_filter(weights: str | Path | None = None, estimator: EstimatorConfig | None = None) -> Filter:
    """The filter named ``geomoe``: a `MotionJudge` or a `GeoMoEFilter`, as the weights ask for.

    Args:
        weights: name or path; None: the weights that ship with the package.
        estimator: what proposes motions to a network that judges some; None takes the defaults.

    Raises:
        CheckpointError: not found or not fitting; None and none ship with this version.
    """
    from geomoe3d.filters.motion_judge import MotionJudge

    model, card = load_pretrained(DEFAULT_WEIGHTS if weights is None else weights)
    if model.config.judges_motions:
        return MotionJudge(model, card, estimator=estimator)
    return GeoMoEFilter(model, card)
