"""Folded parts of GeoMoE that see only the M sub-fields, and how norms are folded into weights.

Used by `geomoe3d.networks.folded`; everything here works on one pair under B motions, (B, C, M) or (B, C, N).
"""

from __future__ import annotations

import torch
from torch import Tensor

from geomoe3d.networks.blocks import GraphAttention, TwoLayer
from geomoe3d.networks.layers import BiPathRectifier, ChannelPath, FeedForward
from geomoe3d.networks.moe import DenseFeedForward, FMoE, expert_weights
from geomoe3d.networks.norms import BatchNorm, ContextNorm


def affine(module: torch.nn.Conv1d) -> tuple[Tensor, Tensor]:
    """Weight (out, in) and bias (out, 1) of a 1x1 convolution."""
    assert module.bias is not None
    return module.weight.detach()[:, :, 0].clone(), module.bias.detach()[:, None].clone()


def scale_shift(norm: BatchNorm) -> tuple[Tensor, Tensor]:
    """A batch norm in evaluation as x * scale + shift, each (C, 1)."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    scale = norm.weight.detach() * torch.rsqrt(norm.running_var + norm.eps)
    return scale[:, None].clone(), (norm.bias.detach() - norm.running_mean * scale)[:, None].clone()


def two_layer(module: TwoLayer) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Two weights and biases, the norm between them folded into the first."""
    weight, bias = affine(module.linear1)
    scale, shift = scale_shift(module.norm)
    return (weight * scale, bias * scale + shift, *affine(module.linear2))


def product(weight: Tensor, x: Tensor, bias: Tensor | None = None) -> Tensor:
    """weight (O, C) times every x (B, C, N), plus bias (O, 1)."""
    weight = weight.expand(len(x), -1, -1)
    return torch.bmm(weight, x) if bias is None else torch.baddbmm(bias, weight, x)


def scale_relu(x: Tensor, norm: tuple[Tensor, Tensor]) -> Tensor:
    """ReLU of a batch norm."""
    return torch.addcmul(norm[1], x, norm[0]).relu_()


def norm_relu(x: Tensor, norm: tuple[Tensor, Tensor]) -> Tensor:
    """ReLU of batch norm of context norm over the last axis, in place on a centred copy."""
    centred = x - x.mean(dim=-1, keepdim=True)
    variance = torch.linalg.vecdot(centred, centred)[..., None] / x.shape[-1]
    scale = norm[0] * torch.rsqrt(variance + ContextNorm.eps)
    return centred.mul_(scale).add_(norm[1]).relu_()


class FoldedAmong:
    """Sub-fields attend to each other."""

    def __init__(self, block: GraphAttention) -> None:
        self.heads = block.num_heads
        width = block.query.in_channels
        key, key_bias = affine(block.key)
        value, value_bias = affine(block.value)
        query, query_bias = affine(block.query)
        scale = (width // self.heads) ** -0.5
        self.all = torch.cat([query * scale, key, value])
        self.all_bias = torch.cat([query_bias * scale, key_bias, torch.zeros_like(value_bias)])
        self.update = FoldedUpdate(block, value_bias)

    def __call__(self, z: Tensor) -> Tensor:
        """Sub-fields (B, C, M) to the same shape."""
        num, _, num_fields = z.shape
        parts = product(self.all, z, self.all_bias).view(num, 3, self.heads, -1, num_fields)
        q, k, v = (part.reshape(num * self.heads, -1, num_fields) for part in parts.unbind(1))
        attention = torch.bmm(q.transpose(1, 2), k).softmax(dim=2)
        return self.update(z, torch.bmm(v, attention.transpose(1, 2)).view(z.shape))


class FoldedUpdate:
    """a + TwoLayer(concat[a, message(heads)]) with the message folded into the first layer.

    Args:
        block: whose message and update these are.
        value_bias: left out of the heads; attention sums to one, so it is a constant of the message.
    """

    def __init__(self, block: GraphAttention, value_bias: Tensor) -> None:
        first, first_bias, self.second, self.second_bias = two_layer(block.update)
        message, message_bias = affine(block.message)
        width = message.shape[0]
        self.own = first[:, :width].contiguous()
        self.heads = first[:, width:] @ message
        self.bias = first_bias + first[:, width:] @ (message_bias + message @ value_bias)

    def __call__(self, a: Tensor, heads: Tensor) -> Tensor:
        """Both (B, C, M) to the updated a."""
        hidden = product(self.own, a, self.bias).add_(product(self.heads, heads)).relu_()
        return product(self.second, hidden, self.second_bias).add_(a)


class FoldedRectifier:
    """Both paths, their fusion and the experts."""

    def __init__(self, module: BiPathRectifier) -> None:
        self.gain: list[tuple[Tensor, Tensor]] = []
        self.sigmoid = False
        if module.channel is not None:
            self.sigmoid = module.channel.channelwise
            self.gain = _gain(module.channel)
        self.spatial = None if module.spatial is None else FoldedAmong(module.spatial)
        self.fuse = None if module.fuse is None else two_layer(module.fuse)
        self.experts = FoldedExperts(module.experts)

    def __call__(self, z: Tensor) -> tuple[Tensor, Tensor | None]:
        """Sub-fields (B, C, M) rectified, and the main expert (B, M) of each."""
        paths = []
        if self.gain:
            (a, a_bias), (b, b_bias) = self.gain
            gain = product(b, product(a, z.mean(dim=2, keepdim=True), a_bias).relu_(), b_bias)
            paths.append(z * (gain.sigmoid() if self.sigmoid else gain))
        if self.spatial is not None:
            paths.append(self.spatial(z))
        if self.fuse is not None:
            a, a_bias, b, b_bias = self.fuse
            z = product(b, product(a, torch.cat(paths, dim=1), a_bias).relu_(), b_bias)
        return self.experts(z)


class FoldedExperts:
    """F-MoE, its dense stand-in or nothing, with the residual."""

    def __init__(self, module: FeedForward) -> None:
        self.residual = module.residual
        body = module.body
        self.moe = body if isinstance(body, FMoE) else None
        self.dense = (*affine(body.up), *affine(body.down)) if isinstance(body, DenseFeedForward) else None
        if self.moe is not None:
            moe = self.moe
            self.router = two_layer(moe.router)
            self.num, self.width, inner = moe.up_weight.shape
            self.up = moe.up_weight.detach().reshape(-1, inner).clone()
            self.up_bias = moe.up_bias.detach().reshape(-1, 1).clone()
            # Hidden units and, for the biases, the expert weights themselves go down in one product.
            down = moe.down_weight.detach().transpose(0, 1).reshape(inner, -1)
            self.down = torch.cat([down, moe.down_bias.detach().t()], dim=1).contiguous()

    def __call__(self, z: Tensor) -> tuple[Tensor, Tensor | None]:
        """The sub-fields (B, C, M) after their experts, and the main expert (B, M) of each."""
        if self.dense is not None:
            a, a_bias, b, b_bias = self.dense
            change = product(b, product(a, z, a_bias).relu_(), b_bias)
            return (change.add_(z) if self.residual else change), None
        if self.moe is None:
            return z, None
        a, a_bias, b, b_bias = self.router
        logits = product(b, product(a, z, a_bias).relu_(), b_bias)
        weights = expert_weights(logits, self.moe.top_k, self.moe.router_order)
        hidden = product(self.up, z, self.up_bias).relu_().view(len(z), self.num, self.width, -1)
        hidden = hidden.mul_(weights[:, :, None]).view(len(z), self.num * self.width, -1)
        change = product(self.down, torch.cat([hidden, weights], dim=1))
        return (change.add_(z) if self.residual else change), weights.argmax(dim=1)


def _gain(module: ChannelPath) -> list[tuple[Tensor, Tensor]]:
    if isinstance(module.gain, TwoLayer):
        a, a_bias, b, b_bias = two_layer(module.gain)
        return [(a, a_bias), (b, b_bias)]
    return [affine(part) for part in module.gain.modules() if isinstance(part, torch.nn.Conv1d)]
