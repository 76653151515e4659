"""A GeoMoE network small enough to be tried often, and input for it."""

from __future__ import annotations

import torch

from geomoe3d.config import build_config
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.geomoe import GeoMoE

TINY = NetworkConfig(num_layers=2, width=16, num_sub_fields=6, num_heads=2, expert_width=4)


def tiny(**changes: object) -> GeoMoE:
    torch.manual_seed(0)
    return GeoMoE(build_config(NetworkConfig, {**TINY.model_dump(), **changes}))


def sample(size: int, num: int, seed: int = 0, dim: int = 6) -> torch.Tensor:
    return torch.randn(size, num, dim, generator=torch.Generator().manual_seed(seed))


def settle(model: GeoMoE) -> GeoMoE:
    """Give the batch norms statistics of their own, so that evaluation is no trivial case."""
    model.train()
    for seed in range(3):
        model(sample(4, 60, seed, model.config.correspondence_dim))
    return model.eval()
