"""Parameters and multiply-accumulates of a network, counted the paper's way and in full.

The paper's figures count multiply-accumulates of 1x1 convolutions and linear maps, 4 per element of a
BatchNorm and 2 per element of a ContextNorm, in evaluation mode; products inside attention and pooling are
left out there. One forward pass is run.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from geomoe3d.networks.build import Network
from geomoe3d.networks.layers import ChannelPath
from geomoe3d.networks.moe import FMoE
from geomoe3d.networks.norms import BatchNorm, ContextNorm, Pointwise


class Cost(NamedTuple):
    """Multiply-accumulates of one forward pass.

    Attributes:
        layers: convolutions, linear maps and norms: what the paper prints.
        products: all matrix products, those inside attention and pooling with them, without norms.
    """

    layers: int
    products: int


def num_parameters(model: nn.Module) -> int:
    """Trainable parameters."""
    return sum(p.numel() for p in model.parameters() if p.requires_grad)


def count_cost(model: Network, num_correspondences: int) -> Cost:
    """Cost of weighing one pair with so many correspondences."""
    totals = {"maps": 0, "norms": 0}

    def hook(module: nn.Module, inputs: tuple[Any, ...], output: Any) -> None:
        first: Tensor = inputs[0] if inputs else output
        if isinstance(module, Pointwise):
            totals["maps"] += output.numel() * module.in_channels
        elif isinstance(module, FMoE):
            totals["maps"] += first.shape[0] * first.shape[2] * 2 * module.up_weight.numel()
        elif isinstance(module, BatchNorm):
            totals["norms"] += 4 * first.numel()
        elif isinstance(module, ContextNorm):
            totals["norms"] += 2 * first.numel()
        elif isinstance(module, ChannelPath):
            # The mean over M sub-fields: M additions and a division per channel.
            totals["norms"] += first.shape[0] * first.shape[1] * (first.shape[2] + 1)

    handles = [module.register_forward_hook(hook) for module in model.modules()]
    was_training = model.training
    trainable = [p for p in model.parameters() if p.requires_grad]
    for parameter in trainable:  # the counter of products asks every tensor for its gradient
        parameter.requires_grad_(False)
    config = model.config
    generator = torch.Generator().manual_seed(0)

    def random(width: int) -> Tensor:
        return torch.randn(1, num_correspondences, width, generator=generator)

    neighbors = torch.arange(num_correspondences)[None, :, None].expand(-1, -1, config.num_neighbors)
    channels = random(config.num_extra_channels) if config.extra_channels else None
    try:
        with torch.no_grad(), FlopCounterMode(display=False) as products:
            model.eval()(random(config.correspondence_dim), channels, neighbors)
    finally:
        model.train(was_training)
        for parameter in trainable:
            parameter.requires_grad_(True)
        for handle in handles:
            handle.remove()
    return Cost(totals["maps"] + totals["norms"], products.get_total_flops() // 2)
