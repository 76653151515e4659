"""The layers of GeoMoE, one class per idea of the paper, on fields (B, D, N).

Motion initialisation, Local Orthogonal Context, Prior-Guided Decomposition, Bi-Path Rectifier,
reconstruction and inlier predictor. All are linear in N; the rectifier does not depend on N at all.

Source: GeoMoE (Le et al., arXiv 2508.00592). Where its text and its released code differ, `NetworkConfig`
has a switch and the docstring says which is which.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.blocks import GraphAttention, PointCN, SubFieldPool, TwoLayer
from geomoe3d.networks.config import FIXED
from geomoe3d.networks.moe import DenseFeedForward, FMoE, Routing
from geomoe3d.networks.norms import BatchNorm, Pointwise, norm_relu_linear


def weights_from_logits(logits: Tensor) -> Tensor:
    """w = relu(tanh(logit)) in [0, 1): zero for a rejected correspondence."""
    return F.relu(torch.tanh(logits))


def motion(coordinates: Tensor, form: str) -> Tensor:
    """[p, q - p] for ``difference``, [p, q] otherwise; (..., 2d) to the same shape."""
    if form != "difference":
        return coordinates
    source, target = coordinates.chunk(2, dim=-1)
    return torch.cat([source, target - source], dim=-1)


class MotionInitialisation(nn.Module):
    """Correspondences to the initial motion field: a 1x1 embedding and one PointCN block.

    Source: the paper's motion initialisation ("convolution and ContextNorm"); the block follows the code.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.motion_form = config.motion_form
        self.embedding = Pointwise(config.input_width, config.width)
        self.block = PointCN(config.width, leading_norm=config.embedding_norm)

    def forward(self, coordinates: Tensor, channels: Tensor | None, mask: Tensor | None) -> Tensor:
        """Coordinates (B, N, 2d) and extra channels (B, N, C) to the field (B, D, N)."""
        inputs = [] if self.motion_form == "none" else [motion(coordinates, self.motion_form)]
        if channels is not None:
            inputs.append(channels)
        field: Tensor = self.block(self.embedding(torch.cat(inputs, dim=2).transpose(1, 2)), mask)
        return field


class LocalOrthogonalContext(nn.Module):
    """LOC: differences to the K neighbours, mixed over channels, then over neighbours, then collapsed.

    Source: the paper's Local Orthogonal Context; the final residual stands in the code only.
    """

    def __init__(self, width: int, num_neighbors: int, context_width: int, residual: bool) -> None:
        super().__init__()
        self.residual = residual
        self.reduce = Pointwise(width, context_width)
        self.mix_channels = TwoLayer(context_width, context_width, context_width)
        self.mix_neighbors = TwoLayer(num_neighbors, num_neighbors, num_neighbors)
        self.collapse = TwoLayer(num_neighbors, num_neighbors, 1)
        self.restore = Pointwise(context_width, width)

    def forward(self, field: Tensor, neighbors: Tensor, mask: Tensor | None) -> Tensor:
        """Field (B, D, N) and neighbour indices (B, K, N) to the field in context, (B, D, N)."""
        size, num_neighbors, num = neighbors.shape
        f = self.reduce(field)
        width = f.shape[1]
        # Gathered from (B, d', N) itself: an operand expanded to N x N would be allocated in the backward.
        index = neighbors.reshape(size, 1, -1).expand(-1, width, -1)
        h = (f[:, :, None] - f.gather(2, index).unflatten(2, (num_neighbors, num))).flatten(2)
        h = h + self.mix_channels(h, None if mask is None else mask.repeat(1, 1, num_neighbors))
        g = h.unflatten(2, (num_neighbors, num)).transpose(1, 2).flatten(2)
        wide_mask = None if mask is None else mask.repeat(1, 1, width)
        g = g + self.mix_neighbors(g, wide_mask)
        context: Tensor = self.restore(self.collapse(g, wide_mask).reshape(size, width, num))
        return torch.add(field, context) if self.residual else context


class PriorGuidedDecomposition(nn.Module):
    """PPGD: pool the field into sub-fields, send them through F-MoE, let them gather from likely inliers.

    Source: the paper's Probabilistic Prior-Guided Decomposition. Prior ``mask`` (the released code): keys
    with a previous logit <= 0 get no attention; ``soft`` (the text): keys and values from w * F.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.prior = config.prior
        self.pool = SubFieldPool(config.width, config.num_sub_fields)
        self.experts = FeedForward(config)
        self.gather = GraphAttention(config.width, config.num_heads)

    def forward(
        self, field: Tensor, logits: Tensor | None, mask: Tensor | None
    ) -> tuple[Tensor, Routing | None]:
        """Field (B, D, N) and the previous logits (B, N), None in the first layer, to (B, D, M)."""
        z, _ = self.pool(field, mask)
        z, routing = self.experts(z)
        kept = None
        if logits is not None and self.prior == "mask":
            kept = (logits > 0)[:, None]
        elif logits is not None and self.prior == "soft":
            field = field * weights_from_logits(logits.detach())[:, None].to(field.dtype)
        return self.gather(z, field, b_mask=mask, b_kept=kept)[0], routing


class BiPathRectifier(nn.Module):
    """MBPR: sub-fields along a spatial and a channel path, fused, then sent to the experts.

    Source: the paper's MoE-enhanced Bi-Path Rectifier. A path that is switched off is left out of the
    fusion, which with one path is a map of that path alone.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        width = config.width
        self.channel = None if config.channel_path == "none" else ChannelPath(width, config.channel_path)
        self.spatial = GraphAttention(width, config.num_heads) if config.spatial_path else None
        num_paths = (self.channel is not None) + (self.spatial is not None)
        self.fuse = TwoLayer(num_paths * width, num_paths * width, width) if num_paths else None
        self.experts = FeedForward(config)

    def forward(self, z: Tensor) -> tuple[Tensor, Routing | None]:
        """Sub-fields (B, D, M) to rectified sub-fields of the same shape."""
        paths = [] if self.channel is None else [self.channel(z)]
        if self.spatial is not None:
            paths.append(self.spatial(z, z)[0])
        if self.fuse is not None:
            z = self.fuse(torch.cat(paths, dim=1))
        result: tuple[Tensor, Routing | None] = self.experts(z)
        return result


class ChannelPath(nn.Module):
    """Gain from the mean sub-field: one plain scalar per pair (released), or a sigmoid per channel."""

    def __init__(self, width: int, form: str) -> None:
        super().__init__()
        self.channelwise = form == "channelwise"
        if self.channelwise:  # no batch statistics: there is one vector per pair
            self.gain: nn.Module = nn.Sequential(
                Pointwise(width, width), nn.ReLU(), Pointwise(width, width), nn.Sigmoid()
            )
        else:
            self.gain = TwoLayer(width, width, 1)

    def forward(self, z: Tensor) -> Tensor:
        """(B, D, M) to the same shape."""
        return z * self.gain(z.mean(dim=2, keepdim=True))  # type: ignore[no-any-return]


class FeedForward(nn.Module):
    """F-MoE, its dense stand-in or nothing, with the identity residual of the released code."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.residual = config.feed_forward_residual
        self.body: nn.Module | None = None
        if config.feed_forward == "moe":
            self.body = FMoE(
                config.width,
                config.num_experts,
                config.top_k,
                config.expert_width,
                config.router_order,
                config.load_balance,
            )
        elif config.feed_forward == "dense":
            self.body = DenseFeedForward(config.width, config.top_k * config.expert_width)

    def forward(self, z: Tensor) -> tuple[Tensor, Routing | None]:
        """(B, D, M) to the same shape, and the routing if there is one."""
        if self.body is None:
            return z, None
        change, routing = self.body(z)
        return z + change if self.residual else change, routing


class InlierPredictor(nn.Module):
    """BatchNorm, ReLU, 1x1 to one logit per correspondence."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = BatchNorm(width)
        self.linear = Pointwise(width, 1)

    def forward(self, field: Tensor, mask: Tensor | None) -> Tensor:
        """(B, D, N) to logits (B, N), at least float32, 0 at padding."""
        logits = norm_relu_linear(field, self.norm, self.linear, mask)[:, 0]
        logits = logits.to(torch.promote_types(logits.dtype, torch.float32))
        return logits if mask is None else logits.masked_fill(~mask[:, 0], 0.0)


class GeoMoELayer(nn.Module):
    """Local context, decomposition, rectification, reconstruction, verdict."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.context = (
            LocalOrthogonalContext(
                config.width, config.num_neighbors, config.context_width, config.context_residual
            )
            if config.local_context
            else None
        )
        self.decompose = PriorGuidedDecomposition(config)
        self.rectify = BiPathRectifier(config)
        self.reconstruct = GraphAttention(config.width, config.num_heads)
        self.predict = InlierPredictor(config.width)

    def forward(
        self, field: Tensor, logits: Tensor | None, neighbors: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor, tuple[Routing | None, Routing | None]]:
        """Field (B, D, N) to the next field, its logits (B, N), the attention and the routing."""
        if self.context is not None:
            field = self.context(field, neighbors, mask)
        z, routing1 = self.decompose(field, logits, mask)
        z, routing2 = self.rectify(z)
        field, attention = self.reconstruct(field, z, a_mask=mask)
        return field, self.predict(field, mask), attention, (routing1, routing2)


class MotionVerdict(nn.Module):
    """Whether the motion that a field was seen under is right: one logit per field.

    From the channels' means over all correspondences, which the norms inside the network take out of the
    field; the same over those that the motion brings together; and the field itself, pooled evenly and by
    attention.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.attend = Pointwise(config.width, 1)
        self.norm = BatchNorm(3 * config.input_width + 1 + 2 * config.width)
        self.hidden = Pointwise(3 * config.input_width + 1 + 2 * config.width, FIXED.verdict_width)
        self.out = Pointwise(FIXED.verdict_width, 1)

    def forward(self, channels: Tensor, field: Tensor, together: Tensor, mask: Tensor | None) -> Tensor:
        """Verdicts of a batch.

        Args:
            channels: (B, N, C) what the network was given.
            field: (B, D, N) of the last layer.
            together: (B, N) in [0, 1], how far the motion brings each correspondence together.
            mask: (B, 1, N) or None.

        Returns:
            (B,) logits, at least float32.
        """
        x = channels.transpose(1, 2).to(torch.promote_types(field.dtype, torch.float32))
        field = field.to(x.dtype)
        scores = self.attend(field)
        real = x.new_ones(()).expand(len(x), 1, x.shape[2]) if mask is None else mask.to(x.dtype)
        if mask is not None:
            scores = scores.masked_fill(~mask, -torch.inf)
        count = real.sum(2)
        means = (x * real).sum(2) / count
        gate = together[:, None] * real
        total = gate.sum(2)
        kept = (x * gate).sum(2) / (total + 1e-3)
        pooled = torch.cat(
            [
                means,
                (means.clamp(min=0) + FIXED.least_mean).log(),
                kept,
                (total + 0.1).log(),
                (field * real).sum(2) / count,
                (field * scores.softmax(dim=2)).sum(2),
            ],
            dim=1,
        )
        hidden = F.relu(self.hidden(self.norm(pooled[:, :, None])))
        verdict: Tensor = self.out(hidden)[:, 0, 0]
        return verdict
