"""Homographies in torch: batched, with a gradient, and safe where the matches fix none."""

from __future__ import annotations

import torch
from torch import Tensor

from geomoe3d.geometry.essential import homogeneous, smallest_direction

MIN_MATCHES = 4


def weighted_dlt(matches: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """H (..., 3, 3) of unit norm that minimises the weighted algebraic error, and whether matches fix it (...,).

    Args:
        matches: (..., N, 4), any unit.
        weights: (..., N); negative and non-finite ones count as zero.

    Source:
        Hartley and Zisserman 2004, algorithm 4.2, with weights in normalisation and equations. Differentiable;
        gradients are finite where nothing is fixed.
    """
    usable = torch.isfinite(matches).all(-1) & torch.isfinite(weights)
    x = torch.where(usable[..., None], matches, 0.0).double()
    w = torch.where(usable, weights, 0.0).clamp(min=0).double()
    w = w / w.detach().amax(-1, keepdim=True).clamp(min=1e-300)
    halves, scalings = [], []
    for half in (x[..., :2], x[..., 2:]):
        share = (w / w.sum(-1, keepdim=True).clamp(min=1e-12))[..., None]
        mean = (share * half).sum(-2, keepdim=True)
        spread = ((share * (half - mean).square()).sum((-1, -2)) / 2 + 1e-24).sqrt()[..., None, None]
        halves.append(homogeneous((half - mean) / spread))
        S = torch.eye(3, dtype=x.dtype, device=x.device).repeat(*w.shape[:-1], 1, 1)
        S = torch.cat(
            [torch.cat([S[..., :2, :2] / spread, -(mean / spread).transpose(-1, -2)], -1), S[..., 2:, :]], -2
        )
        scalings.append(S)
    first, second = halves
    zero = torch.zeros_like(first)
    rows = torch.cat([
        torch.cat([first, zero, -second[..., :1] * first], -1), torch.cat([zero, first, -second[..., 1:2] * first], -1),
    ], dim=-2)  # fmt: skip
    both = torch.cat([w, w], dim=-1)[..., None]
    vector, values = smallest_direction((rows * both).transpose(-1, -2) @ rows)
    H = torch.linalg.solve(scalings[1], vector.reshape(*vector.shape[:-1], 3, 3) @ scalings[0])
    fixed = ((w > 0).sum(-1) >= MIN_MATCHES) & (values[..., 1] > 1e-10 * values[..., -1].clamp(min=1e-12))
    fixed = fixed & (torch.linalg.det(H).abs() > 1e-12 * H.square().sum((-1, -2)).pow(1.5))
    return H / H.square().sum((-1, -2)).sqrt().clamp(min=1e-300)[..., None, None], fixed
