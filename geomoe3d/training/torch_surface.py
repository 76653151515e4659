"""Neighbours, normals and FPFH in torch, so that training makes them on a GPU, anew for every noise and thinning.

Registration takes Open3D's; these are the same up to rounding, which tests hold together. Quadratic in the points:
about 10 ms for 5,000 points on a GPU, half a second on one core.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

_CHUNK = 2048  # rows of the distance matrix at a time
_BINS = 11
_TINY = 1e-12


def nearest_points(at: Tensor, of: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Distances and rows (m, k) of the nearest of n points, nearest first; k: ``count``, or n if that is less.

    Args:
        at: (m, 3) float32. of: (n, 3). count: how many.
    """
    k = min(count, len(of))
    found = [
        torch.cdist(part, of, compute_mode="donot_use_mm_for_euclid_dist").topk(k, largest=False)
        for part in torch.split(at, _CHUNK)
    ]
    return torch.cat([f.values for f in found]), torch.cat([f.indices for f in found])


def plane_normals(points: Tensor, radius: float, near: tuple[Tensor, Tensor]) -> Tensor:
    """Unit normals (n, 3) of the planes through each point's neighbours, itself among them; sign arbitrary.

    Args:
        points: (n, 3) float32. radius: farther neighbours do not count.
        near: distances and rows (n, k) of the nearest points, see `nearest_points`.
    """
    distance, rows = near
    weight = (distance <= radius).to(points.dtype)[..., None]
    total = weight.sum(1, keepdim=True)
    way = points[rows] - points[:, None]
    way = (way - (weight * way).sum(1, keepdim=True) / total) * weight
    return smallest_axes(way.transpose(1, 2) @ way)


def smallest_axes(matrices: Tensor) -> Tensor:
    """Unit eigenvectors (n, 3) of the least eigenvalues of symmetric (n, 3, 3) matrices.

    In closed form, since a library's solver takes a second for a few thousand of them on a GPU.

    Source: Smith, Eigenvalues of a symmetric 3 x 3 matrix, CACM 1961; the vector is the longest cross product of two
    rows of the matrix less the eigenvalue.
    """
    A = matrices.double()
    eye = torch.eye(3, dtype=A.dtype, device=A.device)
    mean = A.diagonal(dim1=1, dim2=2).sum(1) / 3
    B = A - mean[:, None, None] * eye
    spread = (B.square().sum((1, 2)) / 6).sqrt().clamp_min(_TINY)
    half = (torch.linalg.det(B / spread[:, None, None]) / 2).clamp(-1, 1)
    least = mean + 2 * spread * torch.cos(torch.arccos(half) / 3 + 2 * math.pi / 3)
    rows = A - least[:, None, None] * eye
    crossed = torch.stack(
        [torch.linalg.cross(rows[:, i], rows[:, j]) for i, j in ((0, 1), (0, 2), (1, 2))], 1
    )
    length = crossed.norm(dim=2)
    longest = length.argmax(1)
    picked = torch.arange(len(A), device=A.device)
    found = crossed[picked, longest] / length[picked, longest, None].clamp_min(_TINY)
    found = torch.where(length[picked, longest, None] > 0, found, eye[2])
    return found.to(matrices.dtype)


def fpfh(points: Tensor, normals: Tensor, radius: float, near: tuple[Tensor, Tensor]) -> Tensor:
    """FPFH (n, 33) of length 1; zero where a point has no neighbour.

    Args:
        points: (n, 3) float32. normals: (n, 3) unit. radius: of the neighbourhood, unit of the points.
        near: distances and rows (n, k) of the nearest points, the point itself first; no more make a feature.

    Source: Rusu et al., ICRA 2009, with the conventions of Open3D: the normal that is the steeper to the connection
    comes first, neighbours count by 1 / distance^2, every third of a feature sums to 100 before its own is added.
    """
    distance, rows = near
    seen = (distance <= radius) & (torch.arange(rows.shape[1], device=rows.device) > 0)
    bins = _bins(points[:, None], normals[:, None], points[rows], normals[rows])
    share = 100.0 / seen.sum(1).clamp_min(1).to(points.dtype)
    simple = points.new_zeros(len(points), 3 * _BINS)
    worth = (seen.to(points.dtype) * share[:, None])[..., None].expand(bins.shape)
    simple.scatter_add_(1, bins.flatten(1), worth.flatten(1))
    weight = torch.where(seen & (distance > 0), distance.square().clamp_min(_TINY).reciprocal(), 0.0)
    joined = torch.cat(
        [
            (w[:, None] @ simple[r])[:, 0]
            for w, r in zip(torch.split(weight, _CHUNK), torch.split(rows, _CHUNK), strict=True)
        ]
    )
    thirds = joined.view(-1, 3, _BINS)
    joined = (thirds * (100.0 / thirds.sum(2, keepdim=True).clamp_min(_TINY))).flatten(1)
    return torch.nn.functional.normalize(joined + simple, dim=1, eps=1e-6)


def _bins(p: Tensor, n: Tensor, q: Tensor, m: Tensor) -> Tensor:
    """Bins (n, k, 3) of the three angles of every point with its neighbours."""
    way = torch.nn.functional.normalize(q - p, dim=2, eps=_TINY)
    of_p, of_q = (n * way).sum(2), (m * way).sum(2)
    swap = (of_p.abs() < of_q.abs())[..., None]
    n, m = torch.where(swap, m, n), torch.where(swap, n, m)
    way = torch.where(swap, -way, way)
    slope = torch.where(swap[..., 0], -of_q, of_p)
    v = torch.linalg.cross(way, n.expand_as(way))
    length = v.norm(dim=2, keepdim=True)
    v = v / length.clamp_min(_TINY)
    w = torch.linalg.cross(n.expand_as(v), v)
    lift = (v * m).sum(2)
    turn = torch.atan2((w * m).sum(2), (n * m).sum(2))
    flat = length[..., 0] <= 0  # no plane to measure angles in: Open3D gives zeros
    angles = torch.stack([turn / (2 * math.pi) + 0.5, (lift + 1) / 2, (slope + 1) / 2], 2)
    angles = torch.where(flat[..., None], 0.5, angles)
    third = torch.arange(3, device=p.device) * _BINS
    return (angles * _BINS).floor().long().clamp(0, _BINS - 1) + third
