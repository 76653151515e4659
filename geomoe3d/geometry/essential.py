"""Essential matrices in torch: batched, with a gradient, and safe where the matches fix none.

All coordinates are normalised by the intrinsics, x = (u - c) / f, and x1, x2 belong to image 0 and 1. A pose
maps image 0's camera frame into image 1's: X1 = R X0 + t, with t of unknown length; then x1^T E x0 = 0 for
E = [t]x R. Cost: one 9 x 9 decomposition per set of weights, linear in the number of matches.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

MIN_MATCHES = 8
_TINY = 1e-15


class EssentialFit(NamedTuple):
    """What `weighted_eight_point` found.

    Attributes:
        E: (..., 3, 3) of unit norm; without meaning where ``valid`` is False.
        valid: (...,) bool, True where one direction alone solves the equations: eight positive weights or
            more, and a second smallest eigenvalue above rounding.
        gap: (...,) second smallest eigenvalue over the largest; near 0 for planes and pure rotations.
    """

    E: Tensor
    valid: Tensor
    gap: Tensor


def essential_of(T: Tensor) -> Tensor:
    """E (..., 3, 3) = [t]x R of unit norm, for poses (..., 4, 4); zero where t is zero."""
    E = cross_matrix(T[..., :3, 3]) @ T[..., :3, :3]
    unit: Tensor = E / E.flatten(-2).norm(dim=-1).clamp(min=_TINY)[..., None, None]
    return unit


def cross_matrix(v: Tensor) -> Tensor:
    """[v]x (..., 3, 3) of vectors (..., 3)."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*v.shape, 3)


def homogeneous(x: Tensor) -> Tensor:
    """(..., 2) to (..., 3) with a one behind."""
    return torch.cat([x, torch.ones_like(x[..., :1])], dim=-1)


def symmetric_distance(E: Tensor, matches: Tensor) -> Tensor:
    """Squared distances to the epipolar lines in both images, added, (..., N); of any scale of E.

    Args:
        E: (..., 3, 3).
        matches: (..., N, 4) rows [x0, y0, x1, y1].
    """
    first, second = homogeneous(matches[..., :2]), homogeneous(matches[..., 2:])
    lines1, lines0 = first @ E.transpose(-1, -2), second @ E
    product = (second * lines1).sum(-1)
    inverse = [1 / (lines[..., :2].square().sum(-1) + _TINY) for lines in (lines1, lines0)]
    return product.square() * (inverse[0] + inverse[1])


def label_threshold(side: Tensor | float) -> Tensor:
    """Symmetric squared epipolar distance, in focal lengths, below which a match is an inlier of the true pose.

    Args:
        side: longer side of the image, in focal lengths.

    Source:
        1e-4, as Yi et al. (CVPR 2018) and all who follow; through a lens longer than the image's side, where
        this would be more than 1 % of that side, it shrinks with the field of view.
    """
    return 1e-4 * torch.as_tensor(side).clamp(max=1.0).square()


def weighted_eight_point(matches: Tensor, weights: Tensor) -> EssentialFit:
    """E of unit norm that minimises sum_i w_i (x1_i^T E x0_i)^2.

    Args:
        matches: (..., N, 4), normalised.
        weights: (..., N), negative and non-finite ones count as zero; leading shapes are broadcast.

    Source:
        Longuet-Higgins 1981; weights as in Yi et al., CVPR 2018. The solution is not projected onto
        matrices with two equal singular values.
    """
    first, second = homogeneous(matches[..., :2]).double(), homogeneous(matches[..., 2:]).double()
    rows = (second[..., :, None] * first[..., None, :]).flatten(-2)
    usable = torch.isfinite(rows).all(-1) & torch.isfinite(weights)
    rows = torch.where(usable[..., None], rows, 0.0)
    w = torch.where(usable, weights, 0.0).clamp(min=0).double()
    largest = w.detach().amax(-1, keepdim=True)
    w = w / torch.where(largest > 0, largest, 1.0)
    vector, values = smallest_direction((rows * w[..., None]).transpose(-1, -2) @ rows)
    top = values[..., -1].clamp(min=_TINY)
    gap = values[..., 1].clamp(min=0) / top
    valid = ((w > 0).sum(-1) >= MIN_MATCHES) & (gap > 1e-12)
    return EssentialFit(vector.reshape(*vector.shape[:-1], 3, 3), valid, gap)


def smallest_direction(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvector of the smallest eigenvalue of symmetric (..., n, n), and all eigenvalues, ascending.

    Its gradient divides by differences to the smallest eigenvalue alone, and is damped where those vanish:
    finite for a zero matrix.
    """
    result: tuple[Tensor, Tensor] = _SmallestDirection.apply(matrix)  # type: ignore[no-untyped-call]
    return result


class _SmallestDirection(torch.autograd.Function):
    """A -> (v, values), with the adjoint dL/dA = sym((l I - A)^+ g v^T)."""

    @staticmethod
    def forward(ctx: Any, matrix: Tensor) -> tuple[Tensor, Tensor]:
        values, vectors = torch.linalg.eigh(matrix)
        ctx.save_for_backward(values, vectors)
        ctx.mark_non_differentiable(values)
        return vectors[..., 0], values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        values, vectors = ctx.saved_tensors
        scale = values[..., -1:].abs().clamp(min=_TINY)
        gaps = (values[..., :1] - values) / scale
        inverse = gaps / (gaps.square() + 1e-6**2) / scale
        along = (vectors.transpose(-1, -2) @ gradients[0][..., None])[..., 0] * inverse
        side = (vectors @ along[..., None]) @ vectors[..., None, :, 0]
        gradient: Tensor = (side + side.transpose(-1, -2)) / 2
        return gradient


def virtual_matches(E: Tensor, per_edge: int) -> Tensor:
    """Matches (B, 2 n^2, 4) that fulfil E exactly: a grid over [-1, 1) in one image, each point with the nearest
    point of its epipolar line to the same place in the other image; and the other way round.

    Points whose line lies at infinity stay where they are.
    """
    steps = torch.arange(per_edge, device=E.device, dtype=E.dtype) * (2 / per_edge) - 1
    grid = torch.cartesian_prod(steps, steps).expand(*E.shape[:-2], -1, -1)
    halves = []
    for lines in (homogeneous(grid) @ E.transpose(-1, -2), homogeneous(grid) @ E):
        normal = lines[..., :2]
        offset = (homogeneous(grid) * lines).sum(-1, keepdim=True)
        halves.append(grid - normal * offset / (normal.square().sum(-1, keepdim=True) + _TINY))
    return torch.cat([torch.cat([grid, halves[0]], -1), torch.cat([halves[1], grid], -1)], dim=-2)


def decompose(E: Tensor, matches: Tensor, weights: Tensor) -> Tensor:
    """The pose (B, 4, 4), |t| = 1, of the four that E (B, 3, 3) allows, with most weight before both cameras.

    Args:
        E: any scale.
        matches: (B, N, 4).
        weights: (B, N), 0 or more.
    """
    U, _, Vt = torch.linalg.svd(E.double())
    U = U * torch.linalg.det(U)[:, None, None].sign()
    Vt = Vt * torch.linalg.det(Vt)[:, None, None].sign()
    W = E.new_tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    candidates = []
    for turn in (W, W.T):
        for sign in (1.0, -1.0):
            T = torch.eye(4, dtype=torch.float64, device=E.device).repeat(len(E), 1, 1)
            T[:, :3, :3], T[:, :3, 3] = U @ turn @ Vt, sign * U[:, :, 2]
            candidates.append(T)
    poses = torch.stack(candidates, dim=1)
    z0, z1 = depths(poses, matches.double()[:, None])
    before = ((z0 > 0) & (z1 > 0)).double() * weights.double()[:, None]
    best = before.sum(-1).argmax(1)
    return poses[torch.arange(len(E), device=E.device), best]


def depths(T: Tensor, matches: Tensor) -> tuple[Tensor, Tensor]:
    """Depths (..., N) of matches (..., N, 4) in both cameras under poses (..., 4, 4), least squares along the rays.

    In units of |t|; of points at infinity they are large, of either sign.
    """
    rays0 = homogeneous(matches[..., :2]) @ T[..., :3, :3].transpose(-1, -2)
    rays1 = homogeneous(matches[..., 2:])
    t = T[..., None, :3, 3]
    aa, bb, ab = (rays0 * rays0).sum(-1), (rays1 * rays1).sum(-1), (rays0 * rays1).sum(-1)
    at, bt = (rays0 * t).sum(-1), (rays1 * t).sum(-1)
    below = (aa * bb - ab * ab).clamp(min=_TINY)
    return (ab * bt - bb * at) / below, (aa * bt - ab * at) / below


def pose_errors_deg(found: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Angles of rotation and of translation direction between poses (..., 4, 4), degrees.

    The translation is compared as a line, min(a, 180 - a), as the two-view benchmarks do.
    """
    product = (found[..., :3, :3].double() * truth[..., :3, :3].double()).sum((-1, -2))
    rotation = torch.rad2deg(torch.arccos(((product - 1) / 2).clamp(-1, 1)))
    a, b = (T[..., :3, 3].double() for T in (found, truth))
    cosine = (a * b).sum(-1).abs() / (a.norm(dim=-1) * b.norm(dim=-1)).clamp(min=_TINY)
    return rotation, torch.rad2deg(torch.arccos(cosine.clamp(0, 1)))
