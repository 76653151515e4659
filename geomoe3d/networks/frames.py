"""Canonical frames: clouds turned before a network sees them, so that it matters less how they lay.

Such a network profits from frames as scanners give them, where neighbouring scans differ by little. It loses
that where clouds are turned at random. A frame that follows from the correspondences gives some of it back.
"""

from __future__ import annotations

import torch
from torch import Tensor

from geomoe3d.networks.architecture import Frame
from geomoe3d.networks.config import FIXED
from geomoe3d.networks.seeded_motions import length_affinity, seeded_motion


def canonical_rotations(points: Tensor, voxel_size: float, frame: Frame) -> tuple[Tensor, Tensor]:
    """Rotations (3, 3) of source and target into a frame of their own.

    ``principal``: each half's axes of largest, middle and least spread, the third moment along the first two
    positive. ``hypothesis``: the target is turned as the motion with most inliers says, found from lengths
    alone; the source stays. ``principal_hypothesis``: that, then both by the source's principal axes, so that
    nothing of how the clouds lay is left.

    Args:
        points: (N, 6) float64 rows [source, target], N >= 3.
        voxel_size: same unit.
        frame: ``given`` turns nothing.
    """
    if frame == "given":
        return torch.eye(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    A = torch.eye(3, dtype=torch.float64) if frame == "hypothesis" else principal_axes(points[:, :3])
    if frame == "principal":
        return A, principal_axes(points[:, 3:])
    return A, A @ _hypothesis(points, FIXED.threshold_voxels * voxel_size).T


def principal_axes(points: Tensor) -> Tensor:
    """(3, 3) rotation whose rows are the axes of points (N, 3), largest spread first."""
    centred = points - points.mean(0)
    axes: Tensor = torch.linalg.eigh(centred.T @ centred)[1].flip(1).T
    skew = (centred @ axes.T).pow(3).sum(0)
    axes = axes * torch.where(skew < 0, -1.0, 1.0).to(axes.dtype)[:, None]
    if torch.linalg.det(axes) < 0:
        axes = torch.cat([axes[:2], -axes[2:]])
    return axes


def _hypothesis(points: Tensor, threshold: float) -> Tensor:
    """Rotation (3, 3) of the motion with most inliers, source to target."""
    # Evenly over the rows: which ones does not matter, and nothing is drawn at random.
    # So many are compared with all others.
    rows = points[torch.linspace(0, len(points) - 1, min(len(points), 2000)).long()]
    affinity = length_affinity(rows, threshold)
    seeds = affinity.sum(1).topk(max(1, int(len(rows) * 0.1))).indices  # a tenth
    R: Tensor = seeded_motion(rows, affinity, seeds, threshold)[:3, :3]
    return R
