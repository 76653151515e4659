"""F-MoE: each sub-field is sent to its best experts, small bottleneck networks.

All experts run on all sub-fields in two matrix products and the unchosen ones get weight zero: with 48
sub-fields that is cheaper than dispatching, and it needs no capacity limit. Cost does not grow with N.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from geomoe3d.networks.blocks import TwoLayer
from geomoe3d.networks.norms import Pointwise


class Routing(NamedTuple):
    """What a router decided.

    Attributes:
        weights: (B, T, M) weight of each of T experts for each of M sub-fields, zero where not chosen.
        balance: scalar load-balance loss.
        usage: (T,) mean weight of each expert, detached.
        entropy: scalar mean entropy of the full router distribution over log T: 1 undecided, 0 certain.
    """

    weights: Tensor
    balance: Tensor
    usage: Tensor
    entropy: Tensor


class FMoE(nn.Module):
    """Mixture of T bottleneck experts (width -> expert_width -> width) with a top-k router.

    Source: the paper's F-MoE. The router is dense as in the released code; "sparse" is only its top-k.
    """

    def __init__(
        self,
        width: int,
        num_experts: int,
        top_k: int,
        expert_width: int,
        router_order: Literal["top_k_softmax", "softmax_top_k"],
        load_balance: Literal["normalised", "paper"],
    ) -> None:
        super().__init__()
        self.top_k = top_k
        self.router_order = router_order
        self.load_balance = load_balance
        self.router = TwoLayer(width, width, num_experts)
        self.up_weight = nn.Parameter(_uniform((num_experts, expert_width, width), width))
        self.up_bias = nn.Parameter(_uniform((num_experts, expert_width), width))
        self.down_weight = nn.Parameter(_uniform((num_experts, width, expert_width), expert_width))
        self.down_bias = nn.Parameter(_uniform((num_experts, width), expert_width))

    def forward(self, z: Tensor) -> tuple[Tensor, Routing]:
        """Sub-fields (B, C, M) to the weighted sum of their experts' outputs, same shape."""
        routing = self.route(z)
        num_experts, expert_width, width = self.up_weight.shape
        hidden = self.up_weight.reshape(-1, width) @ z + self.up_bias.reshape(-1, 1)
        hidden = F.relu(hidden).reshape(len(z), num_experts, expert_width, -1) * routing.weights[:, :, None]
        down = self.down_weight.transpose(0, 1).reshape(width, -1)
        return down @ hidden.flatten(1, 2) + self.down_bias.t() @ routing.weights, routing

    def route(self, z: Tensor) -> Routing:
        """Experts for the sub-fields (B, C, M); with ``top_k_softmax`` the weights of each sum to one."""
        logits = self.router(z)
        logits = logits.to(torch.promote_types(logits.dtype, torch.float32))
        weights = expert_weights(logits, self.top_k, self.router_order)
        usage = weights.mean(dim=(0, 2))
        num_experts = len(usage)
        factor = num_experts if self.load_balance == "normalised" else 1 / num_experts
        log_probability = logits.detach().log_softmax(dim=1)
        entropy = -(log_probability.exp() * log_probability).sum(1).mean() / max(math.log(num_experts), 1e-9)
        return Routing(weights, factor * usage.square().sum(), usage.detach(), entropy)


def expert_weights(logits: Tensor, top_k: int, router_order: str) -> Tensor:
    """Router logits (..., T, M) to the weights of the chosen experts, zero elsewhere."""
    if router_order == "top_k_softmax":
        best, chosen = logits.topk(top_k, dim=-2)
        kept = best.softmax(dim=-2)
    else:
        kept, chosen = logits.softmax(dim=-2).topk(top_k, dim=-2)
    return torch.zeros_like(logits).scatter(-2, chosen, kept)


class DenseFeedForward(nn.Module):
    """What replaces F-MoE in the ablation: one bottleneck as wide as the experts active at a time."""

    def __init__(self, width: int, hidden_width: int) -> None:
        super().__init__()
        self.up = Pointwise(width, hidden_width)
        self.down = Pointwise(hidden_width, width)

    def forward(self, z: Tensor) -> tuple[Tensor, None]:
        """(B, C, M) to the same shape; no routing."""
        return self.down(F.relu(self.up(z))), None


def _uniform(shape: tuple[int, ...], fan_in: int) -> Tensor:
    return torch.empty(shape).uniform_(-(fan_in**-0.5), fan_in**-0.5)
