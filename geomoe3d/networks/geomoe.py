"""GeoMoE: motion fields modelled by divide and conquer, with experts for their sub-fields.

The network weighs correspondences. Each layer refines every correspondence by its neighbours (local
context), decomposes the field of N motions into M sub-fields guided by the previous layer's verdict,
rectifies the sub-fields along two paths and by experts, rebuilds the field from them and gives each
correspondence a logit: positive means inlier. Weights are not shared between layers. Time and memory are
linear in N beyond the search for neighbours.

Source: GeoMoE (Le et al., arXiv 2508.00592), carried from image points to points in space; names follow
the paper, and where its text and released code differ `NetworkConfig` has a switch.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from geomoe3d.networks.aligned import CHANNELS, PRIOR_KERNEL
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.layers import GeoMoELayer, MotionInitialisation, MotionVerdict, motion
from geomoe3d.networks.moe import Routing
from geomoe3d.networks.neighbors import nearest_neighbors
from geomoe3d.networks.norms import frozen_statistics


@dataclass(frozen=True)
class LayerInsight:
    """What one layer did, for drawing and logging; all detached.

    Attributes:
        sub_field: (B, N) int64, the sub-field from which each correspondence is mostly rebuilt.
        shares: (B, N, M) how much of each correspondence is rebuilt from each sub-field, mean over heads.
        expert: (B, M) int64, the expert with the largest weight in the second F-MoE, or None without one.
        usage: (2, T) mean weight of each expert in the two F-MoEs, or None.
        entropy: (2,) router entropy over log T, or None.
    """

    sub_field: Tensor
    shares: Tensor
    expert: Tensor | None
    usage: Tensor | None
    entropy: Tensor | None


@dataclass(frozen=True)
class GeoMoEOutput:
    """What the network returns.

    Attributes:
        logits: (L, B, N) of every layer, in order; those of the last are the answer; 0 at padding.
        balance: scalar load-balance loss, mean over F-MoEs and layers; 0 without experts.
        usage: (L, 2, T) expert usage, or None.
        entropy: (L, 2) router entropy, or None.
        kept_fraction: (L,) share of correspondences with a positive logit.
        insights: one per layer if asked for, else empty.
        verdict: (B,) logit that the motion of each field is right, or None for a network that is given none.
        similarity: (B, N, N) in [0, 1], how alike the features of two rows are, from PointDSC; else None.
    """

    logits: Tensor
    balance: Tensor
    usage: Tensor | None
    entropy: Tensor | None
    kept_fraction: Tensor
    insights: tuple[LayerInsight, ...] = ()
    verdict: Tensor | None = None
    similarity: Tensor | None = None


class GeoMoE(nn.Module):
    """The whole network: correspondences in, one logit each per layer out.

    Equivariant to the order of the correspondences. What coordinates it must be given, and what makes it
    independent of units and of the clouds' origins, is in `geomoe3d.networks.inputs`.
    """

    def __init__(self, config: NetworkConfig | None = None) -> None:
        super().__init__()
        self.config = config or NetworkConfig()
        self.initialise = MotionInitialisation(self.config)
        self.layers = nn.ModuleList(GeoMoELayer(self.config) for _ in range(self.config.num_layers))
        self.verdict = MotionVerdict(self.config) if self.config.judges_motions else None
        self.checkpoint_activations = False

    def forward(
        self,
        coordinates: Tensor,
        channels: Tensor | None = None,
        neighbors: Tensor | None = None,
        mask: Tensor | None = None,
        *,
        insight: bool = False,
    ) -> GeoMoEOutput:
        """Weigh a batch of pairs.

        Args:
            coordinates: (B, N, 2d) float, centred and in network units; anything finite at padding.
            channels: (B, N, C) float extra channels as the configuration names them, or None.
            neighbors: (B, N, K) int64 indices within each pair, the row itself first; None: they are
                sought here by ``knn_space`` (which cannot be compatibility then).
            mask: (B, N) bool, False at padding, or None where nothing is padded. Every pair needs at
                least one real correspondence.
            insight: also return which sub-field and expert each correspondence belongs to.
        """
        if neighbors is None:
            neighbors = find_neighbors(coordinates, self.config, mask)
        neighbors = neighbors.transpose(1, 2).contiguous()
        wide_mask = None if mask is None else mask[:, None]
        field = self.initialise(coordinates, channels, wide_mask)
        together = None if self.verdict is None else together_under_motion(channels)
        logits: Tensor | None = None if together is None else together - PRIOR_KERNEL
        verdicts, routings, insights = [], [], []
        for layer in self.layers:
            if self.checkpoint_activations and self.training:
                step = checkpoint(
                    layer,
                    field,
                    logits,
                    neighbors,
                    wide_mask,
                    use_reentrant=False,
                    context_fn=lambda: (nullcontext(), frozen_statistics()),
                )
            else:
                step = layer(field, logits, neighbors, wide_mask)
            field, logits, attention, routing = step
            verdicts.append(logits)
            routings.append(routing)
            if insight:
                insights.append(_insight(attention, routing))
        verdict = None
        if self.verdict is not None:
            verdict = self.verdict(channels, field, together, wide_mask)
        return replace(_collect(torch.stack(verdicts), routings, mask, tuple(insights)), verdict=verdict)


def together_under_motion(channels: Tensor | None) -> Tensor:
    """The channel ``residual`` of (B, N, C) aligned channels: (B, N), 1 where a motion fits exactly."""
    assert channels is not None
    return channels[..., CHANNELS.index("residual")]


def find_neighbors(coordinates: Tensor, config: NetworkConfig, mask: Tensor | None = None) -> Tensor:
    """Neighbours (B, N, K) by distance in the configured space; padding neighbours only itself. Raises
    ValueError: the configuration asks for neighbours by compatibility, which coordinates do not give."""
    if config.knn_space == "compatibility":
        raise ValueError("neighbours by compatibility come with the input (geomoe3d.networks.inputs)")
    values = coordinates
    if config.knn_space == "motion":
        values = motion(coordinates, "difference")
    elif config.knn_space == "source":
        values = coordinates[..., : coordinates.shape[-1] // 2]
    size, num, _ = coordinates.shape
    if mask is None:
        return torch.stack([nearest_neighbors(v, config.num_neighbors) for v in values])
    index = torch.arange(num, device=values.device)[:, None].expand(num, config.num_neighbors)
    result = index.repeat(size, 1, 1)
    for i in range(size):
        real = mask[i].nonzero()[:, 0]
        result[i, real] = real[nearest_neighbors(values[i, real], config.num_neighbors)]
    return result


def _insight(attention: Tensor, routing: tuple[Routing | None, Routing | None]) -> LayerInsight:
    shares = attention.detach().mean(dim=1)
    sub_field = shares.argmax(dim=-1)
    if routing[0] is None or routing[1] is None:
        return LayerInsight(sub_field, shares, None, None, None)
    usage, entropy = (torch.stack([getattr(r, name) for r in routing]) for name in ("usage", "entropy"))
    return LayerInsight(sub_field, shares, routing[1].weights.detach().argmax(dim=1), usage, entropy)


def _collect(
    logits: Tensor,
    routings: list[tuple[Routing | None, Routing | None]],
    mask: Tensor | None,
    insights: tuple[LayerInsight, ...],
) -> GeoMoEOutput:
    positive = (logits.detach() > 0).float()
    kept = positive.mean(dim=(1, 2)) if mask is None else positive.sum(dim=(1, 2)) / mask.sum()
    flat = [r for pair in routings for r in pair if r is not None]
    if not flat:
        return GeoMoEOutput(logits, logits.new_zeros(()), None, None, kept, insights)
    balance = torch.stack([r.balance for r in flat]).mean()
    usage = torch.stack([r.usage for r in flat]).reshape(len(logits), 2, -1)
    entropy = torch.stack([r.entropy for r in flat]).reshape(len(logits), 2)
    return GeoMoEOutput(logits, balance, usage, entropy, kept, insights)
