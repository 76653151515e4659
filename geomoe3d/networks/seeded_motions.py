"""A motion from seeds: each gathers the correspondences most like it, they give a motion, the best is kept.

The second half of PointDSC, which follows its network; with an affinity of lengths alone it needs no network.
Cost: quadratic in N for the affinity, then linear in N per seed.

Source: Bai et al., PointDSC (CVPR 2021): seeds, sets of k, leading eigenvectors, weighted Kabsch, choice by
inliers.
"""

from __future__ import annotations

import torch
from torch import Tensor

from geomoe3d.geometry.kabsch import weighted_kabsch


def spread_seeds(scores: Tensor, points: Tensor, radius: float) -> Tensor:
    """Rows (S,) that score best within ``radius`` of their source points, a tenth of all rows at most.

    Args:
        scores: (N,).
        points: (N, 3) source points.
        radius: unit of the points.
    """
    near = torch.cdist(points, points) < radius
    best_near = scores.expand(len(scores), -1).masked_fill(~near, -torch.inf).amax(1)
    peaks = (scores >= best_near).nonzero()[:, 0]
    count = max(1, int(len(scores) * 0.1))  # a tenth are seeds, as published
    return peaks[scores[peaks].argsort(descending=True, stable=True)[:count]]


def seeded_motion(points: Tensor, affinity: Tensor, seeds: Tensor, threshold: float) -> Tensor:
    """The motion with most inliers among those of the seeds, refitted to its inliers.

    Args:
        points: (N, 6) float64 rows [source, target], N >= 3.
        affinity: (N, N) how far two rows may both be inliers, 0 on the diagonal.
        seeds: (S,) rows.
        threshold: residual of an inlier, unit of the points.

    Returns:
        (4, 4) p_target = R p_source + t; some rotation where the rows fix none.
    """
    source, target = points[:, :3], points[:, 3:]
    sets = affinity[seeds].topk(min(40, len(points)), dim=1).indices
    local = affinity[sets[:, :, None], sets[:, None, :]].double()
    vector = torch.ones_like(local[:, :, :1])
    for _ in range(10):  # power iterations
        vector = torch.nn.functional.normalize(local @ vector, dim=1)
    motions = weighted_kabsch(source[sets], target[sets], vector[:, :, 0]).T_target_source
    # So many residuals are held at a time.
    size = max(1, 4_000_000 // len(points))
    counts = [
        (motion_residuals(some, source, target) < threshold).sum(1) for some in torch.split(motions, size)
    ]
    T = motions[int(torch.cat(counts).argmax())]
    last = -1
    for _ in range(20):  # refits, as published
        residual = motion_residuals(T[None], source, target)[0]
        inside = residual < threshold
        if int(inside.sum()) in (last, 0, 1, 2):
            break
        last = int(inside.sum())
        T = weighted_kabsch(source, target, inside / (1 + (residual / threshold).square())).T_target_source
    return T


def motion_residuals(motions: Tensor, source: Tensor, target: Tensor) -> Tensor:
    """|R p + t - q| of motions (K, 4, 4) and points (N, 3): (K, N)."""
    moved = source @ motions[:, :3, :3].transpose(1, 2) + motions[:, None, :3, 3]
    residuals: Tensor = (moved - target).norm(dim=2)
    return residuals


def length_affinity(points: Tensor, threshold: float) -> Tensor:
    """Second-order agreement of lengths: C * (C C), C_ij = 1 where | |p_i-p_j| - |q_i-q_j| | < threshold.

    Args:
        points: (N, 6).
        threshold: unit of the points.

    Source: the measure of SC2-PCR (Chen et al., CVPR 2022); the diagonal is 0.
    """
    C = _agreement(points[:, :3], points[:, 3:], threshold)
    return C * (C @ C)


def _agreement(source: Tensor, target: Tensor, threshold: float) -> Tensor:
    agree = ((torch.cdist(source, source) - torch.cdist(target, target)).abs() < threshold).float()
    return agree.fill_diagonal_(0)
