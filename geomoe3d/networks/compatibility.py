"""What rigid motion leaves unchanged: length compatibility between correspondences, and local hypotheses.

Two correct correspondences keep the distance between their points: C_ij = 1 where | |p_i-p_j| - |q_i-q_j| |
is under a threshold. Second order, S = C * (C C), asks that they also share many compatible others. From
both come channels per correspondence, and neighbours, that no rotation or translation of either cloud can
change. Up to ``compatibility_full`` correspondences all are compared with all; beyond it with a fixed
number of anchors, so time and memory stay linear in N.

Source: second-order compatibility as in SC2-PCR (Chen et al. 2022); the channels are this project's own.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from geomoe3d.geometry.kabsch import weighted_kabsch
from geomoe3d.networks.architecture import NetworkConfig


class CompatibilityInputs(NamedTuple):
    """What the network is given beside coordinates.

    Attributes:
        channels: (N, 4) in [0, 1] mostly: v, sqrt(v), 5 x mean compatibility, row sum of S over its
            largest; v is the leading eigenvector of S over its largest entry.
        hypotheses: (N, 4) from `hypothesis_channels`, or None.
        neighbors: (N, K) int64: the row itself, then its strongest entries of S; the row itself again
            where there are too few.
    """

    channels: Tensor
    hypotheses: Tensor | None
    neighbors: Tensor


@torch.no_grad()
def compatibility_inputs(points: Tensor, config: NetworkConfig) -> CompatibilityInputs:
    """Channels and neighbours of one pair.

    Args:
        points: (N, 6) float32 in voxels, each half centred.
        config: thresholds and sizes; hypotheses are computed if its extra channels name them.

    Returns:
        Zeros and self-neighbours where no correspondence is compatible with any other.
    """
    num = len(points)
    threshold = config.compatibility_threshold
    anchors = torch.arange(num, device=points.device)
    degree = None
    if num > config.compatibility_full:
        first = _order_by_content(points)[: config.compatibility_anchors]
        table = _Table(points, first, threshold)
        degree = table.degree
        anchors = (table.second @ table.leading()).topk(config.compatibility_anchors).indices
    table = _Table(points, anchors, threshold)
    v = table.second @ table.leading()
    v = v / v.max().clamp(min=1e-12)
    rows = table.second.sum(dim=1)
    channels = torch.stack(
        [
            v,
            v.sqrt(),
            5 * (table.degree if degree is None else degree),
            rows / rows.max().clamp(min=1e-12),
        ],
        dim=1,
    )
    needed = max(config.num_neighbors - 1, config.hypothesis_size)
    strength, index = table.strongest(needed)
    hypotheses = None
    if "hypothesis" in config.extra_channels:
        size = config.hypothesis_size
        hypotheses = hypothesis_channels(points, anchors, index[:, :size], strength[:, :size], threshold)
    return CompatibilityInputs(channels, hypotheses, _neighbors(index, strength, config.num_neighbors))


def hypothesis_channels(
    points: Tensor, anchors: Tensor, members: Tensor, strength: Tensor, threshold: float
) -> Tensor:
    """What the motion proposed by each correspondence's own neighbourhood is worth.

    Weighted Kabsch over the members gives each correspondence a hypothesis; its score is its soft inlier
    count over the anchors, max(0, 1 - r^2 / threshold^2) each.

    Args:
        points: (N, 6) float32, voxels.
        anchors: (A,) int64 rows that are counted, and whose hypotheses all others may support.
        members: (N, k) int64 rows from which each hypothesis is fitted.
        strength: (N, k) weights of the members.
        threshold: residual at which support ends, in the unit of the points.

    Returns:
        (N, 4): score over the largest; square root of the best (score^2 x support) among the hypotheses
        that the correspondence supports, over its largest; log(1 + score) / 3; support of the best one.
    """
    chosen = points[members]
    fit = weighted_kabsch(chosen[..., :3], chosen[..., 3:], strength)
    motions = _motion_features(fit.T_target_source, threshold)
    places = _place_features(points)
    usable = (fit.valid & ((strength > 0).sum(dim=1) >= 3)).to(points.dtype)
    columns = places[anchors].t().contiguous()
    score = torch.cat([(part @ columns).clamp_(min=0).sum(dim=1) for part in torch.split(motions, 4096)])
    score = score * usable
    anchor_score = score[anchors]
    best = motions[anchors[anchor_score.argmax()]]
    candidates = motions[anchors].t().contiguous()
    supported = torch.cat(
        [
            ((part @ candidates).clamp_(min=0) * anchor_score.square()).amax(dim=1)
            for part in torch.split(places, 4096)
        ]
    )
    return torch.stack(
        [
            score / score.max().clamp(min=1e-12),
            (supported / supported.max().clamp(min=1e-12)).sqrt(),
            torch.log1p(score) / 3,
            (places @ best).clamp(min=0) * (anchor_score.max() > 0),
        ],
        dim=1,
    )


class _Table:
    """Compatibility of N correspondences with A anchors: N x A entries, never N x N beyond the limit."""

    def __init__(self, points: Tensor, anchors: Tensor, threshold: float) -> None:
        self.anchors = anchors
        self.square = len(anchors) == len(points)
        source, target = points[:, :3], points[:, 3:]
        # 0 where incompatible, up to 1 for equal lengths: the threshold's soft margin breaks ties of S.
        soft = torch.cdist(source, source[anchors])
        soft.sub_(torch.cdist(target, target[anchors])).abs_().div_(-threshold).add_(1).clamp_(min=0)
        soft[anchors, torch.arange(len(anchors), device=points.device)] = 0
        self.soft = soft
        compatible = (soft > 0).to(points.dtype)
        self.degree = compatible.mean(dim=1)
        self.second = (compatible @ compatible[anchors]).mul_(compatible)

    def leading(self) -> Tensor:
        """(A,) leading eigenvector of S among the anchors, by power iteration."""
        block = self.second if self.square else self.second[self.anchors]
        v = torch.ones(len(self.anchors), device=block.device, dtype=block.dtype)
        for _ in range(10):  # power iterations
            v = block @ v
            v = v / v.max().clamp(min=1e-12)
        return v

    def strongest(self, num: int) -> tuple[Tensor, Tensor]:
        """(N, num) entries of S and the rows they stand for, strongest first; 0 and any row if too few."""
        wanted = min(num, len(self.anchors))
        rank, column = torch.add(self.second, self.soft, alpha=0.5).topk(wanted, dim=1)
        strength = torch.where(rank >= 1, rank, 0.0)
        if wanted < num:
            strength = torch.nn.functional.pad(strength, (0, num - wanted))
            column = torch.nn.functional.pad(column, (0, num - wanted))
        return strength, self.anchors[column]


def _neighbors(index: Tensor, strength: Tensor, num_neighbors: int) -> Tensor:
    rows = torch.arange(len(index), device=index.device)[:, None]
    others = torch.where(strength > 0, index, rows)[:, : num_neighbors - 1]
    return torch.cat([rows, others], dim=1)


def _order_by_content(points: Tensor) -> Tensor:
    """A scrambled order of the rows that depends on their values alone, not on where they stand."""
    bits = points.contiguous().view(torch.int32).long()
    state = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    for column in bits.unbind(dim=1):
        state = (state ^ column) * 0x2545F4914F6CDD1D
        state = state ^ (state >> 29)
    return state.argsort(stable=True)


def _motion_features(T: Tensor, threshold: float) -> Tensor:
    """(H, 17) so that a row times a place feature is 1 - |R p + t - q|^2 / threshold^2."""
    R, t = T[:, :3, :3], T[:, :3, 3]
    pulled = (R.transpose(1, 2) @ t[:, :, None])[..., 0]
    one = torch.ones_like(t[:, :1])
    square = t.square().sum(dim=1, keepdim=True)
    scale = threshold**-2
    return torch.cat(
        [2 * scale * R.flatten(1), -2 * scale * pulled, 2 * scale * t, 1 - scale * square, -scale * one],
        dim=1,
    )


def _place_features(points: Tensor) -> Tensor:
    """(N, 17), the partner of `_motion_features`."""
    p, q = points[:, :3], points[:, 3:]
    outer = (q[:, :, None] * p[:, None, :]).flatten(1)
    return torch.cat([outer, p, q, torch.ones_like(p[:, :1]), points.square().sum(1, keepdim=True)], dim=1)
