"""A trained GeoMoE as a filter of the pipeline: correspondences in, one weight each out.

Weights are loaded once and folded for inference; calls share nothing and draw nothing at random. Rows with
a NaN or infinite coordinate get weight 0. Cost: linear in N, about 30 ms at N = 1000 on two idle cores
beside the inputs that the network asks for.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from geomoe3d.filters.base import FilterOutput
from geomoe3d.filters.folded import FoldedGeoMoE
from geomoe3d.filters.geomoe import GeoMoE
from geomoe3d.filters.inputs import MIN_CORRESPONDENCES, pair_input
from geomoe3d.filters.layers import weights_from_logits
from geomoe3d.filters.pretrained import WeightCard, load_pretrained
from geomoe3d.types import Correspondences, FloatArray, IntArray


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
    """

    def __init__(
        self, model: GeoMoE, card: WeightCard | None = None, device: str | torch.device = "cpu"
    ) -> None:
        self.config = model.config
        self.card = card
        self.device = torch.device(device)
        self._network = FoldedGeoMoE(model.to(self.device).eval())

    @classmethod
    def from_pretrained(cls, name_or_path: str | Path, device: str | torch.device = "cpu") -> GeoMoEFilter:
        """Load a .safetensors file with its card, or weights that ship with the package.

        Raises:
            CheckpointError: see `geomoe3d.filters.pretrained.load_pretrained`.
        """
        model, card = load_pretrained(name_or_path)
        return cls(model, card, device)

    def __call__(self, correspondences: Correspondences, *, voxel_size: float, seed: int = 0) -> FilterOutput:
        """Weigh correspondences; see `Filter`. ``groups`` is the expert of each one's sub-field.

        Returns:
            Weights relu(tanh(logit)): 0 where the logit is negative. With fewer than 3 finite rows there
            is nothing to go by: all weights 0.

        Raises:
            InputError: the network was trained with a channel that these correspondences lack.
        """
        insight = self.look(correspondences, voxel_size=voxel_size)
        logits = insight.logits_per_layer[-1]
        weights = weights_from_logits(torch.from_numpy(np.nan_to_num(logits, nan=-np.inf))).numpy()
        experts = self.config.num_experts if self.config.feed_forward == "moe" else 0
        return FilterOutput(
            weights=weights,
            logits=np.nan_to_num(logits, nan=-np.inf),
            groups=np.where(insight.expert < 0, experts, insight.expert) if experts else None,
            group_names=(*(f"expert {i + 1}" for i in range(experts)), "not seen") if experts else (),
        )

    def look(self, correspondences: Correspondences, *, voxel_size: float) -> Insight:
        """Verdicts of all layers, sub-fields and experts, for drawing."""
        num = len(correspondences)
        result = Insight(np.full(num, -1), np.full(num, -1), np.full((self.config.num_layers, num), np.nan))
        seen = np.flatnonzero(np.isfinite(correspondences.points).all(axis=1))
        if len(seen) < MIN_CORRESPONDENCES:
            return result
        part = correspondences if len(seen) == num else correspondences.take(seen)
        wanted = set(self.config.extra_channels)
        given: dict[str, NDArray[Any] | None] = {
            name: getattr(part, name) for name in ("feature_distance", "ratio", "mutual") if name in wanted
        }
        inputs = pair_input(part.points, voxel_size, self.config, **given)
        channels = None if inputs.channels is None else inputs.channels.to(self.device)
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


def geomoe_filter(weights: str | Path | None = None) -> GeoMoEFilter:
    """The filter named ``geomoe``.

    Args:
        weights: name or path; None: the weights that ship with the package.

    Raises:
        CheckpointError: not found or not fitting; None and none ship with this version.
    """
    return GeoMoEFilter.from_pretrained(DEFAULT_WEIGHTS if weights is None else weights)


DEFAULT_WEIGHTS = "geomoe3d"
