"""A GeoMoE network and baselines small enough to be tried often, and input for them."""

from __future__ import annotations

from typing import TypeVar

import torch

from geomoe3d.config import build_config
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.build import Network, build_network
from geomoe3d.networks.geomoe import GeoMoE

SMALL: dict[str, dict[str, object]] = {
    "pointcn": {"num_layers": 3, "width": 16},
    "oanet": {"width": 16, "num_sub_fields": 6},
    "umatch": {"num_layers": 2, "width": 16, "num_heads": 2},
    "dematch": {"num_layers": 2, "width": 32, "num_heads": 2, "num_sub_fields": 6},
    "demo": {"num_layers": 1, "width": 16, "num_heads": 2, "num_sub_fields": 6},
    "pointdsc": {"num_layers": 2, "width": 16},
}

N = TypeVar("N", bound=Network)
TINY = NetworkConfig(num_layers=2, width=16, num_sub_fields=6, num_heads=2, expert_width=4)


def tiny(**changes: object) -> GeoMoE:
    torch.manual_seed(0)
    return GeoMoE(build_config(NetworkConfig, {**TINY.model_dump(), **changes}))


def small(kind: str) -> Network:
    torch.manual_seed(0)
    return build_network(build_config(NetworkConfig, {"kind": kind, **SMALL[kind]}))


def sample(size: int, num: int, seed: int = 0, dim: int = 6) -> torch.Tensor:
    return torch.randn(size, num, dim, generator=torch.Generator().manual_seed(seed))


def settle(model: N) -> N:
    """Give the batch norms statistics of their own, so that evaluation is no trivial case."""
    model.train()
    for seed in range(3):
        model(sample(4, 60, seed, model.config.correspondence_dim))
    return model.eval()
