"""Weighted Kabsch: the rigid motion that best lays weighted source points on their targets.

Batched over any leading dimensions and differentiable. The rotation has its own backward pass in closed
form, because autograd through a singular value decomposition divides by differences of singular values
and gives NaN for the identity, collinear points, zero weights and reflection ties; the closed form
divides by their sums only. Cost: one 3x3 decomposition per motion, linear in the number of points.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from geomoe3d.errors import InputError

# Eigenvalues of tr(B) I - B below this share of the largest singular value are damped in the backward pass.


class RigidFit(NamedTuple):
    """Motions found by `weighted_kabsch`.

    Attributes:
        T_target_source: (..., 4, 4), p_target = R p_source + t. Where ``valid`` is False it is a proper
            rigid motion without meaning, never to be reported as an answer.
        valid: (...,) bool. True where the data fix the motion: finite, some positive weight, and source
            and target spread along at least two directions without a reflection tie.
    """

    T_target_source: Tensor
    valid: Tensor


def weighted_kabsch(source: Tensor, target: Tensor, weights: Tensor | None = None) -> RigidFit:
    """The motion minimising sum_i w_i |R p_i + t - q_i|^2, with R a proper rotation.

    Differentiable once with respect to all three arguments; every gradient is finite, for degenerate
    input too. Means and moments are accumulated in the dtype of the input, the 3x3 problem in float64.

    Args:
        source: (..., N, 3) float points p in any frame.
        target: (..., N, 3) float points q, same leading shape or broadcastable.
        weights: (..., N) float; negative and non-finite entries count as zero; None means all ones.

    Returns:
        Motions (..., 4, 4) of the dtype of ``source``, and whether the data determine them.

    Raises:
        InputError: no rows at all, or shapes that are not (..., N, 3).

    Source:
        Kabsch 1976 with the reflection guard of Umeyama 1991.
    """
    if source.shape[-1:] != (3,) or target.shape[-2:] != source.shape[-2:] or source.shape[-2] == 0:
        raise InputError(
            f"source and target must be (..., N, 3) with the same N >= 1, found {tuple(source.shape)} and "
            f"{tuple(target.shape)}"
        )
    if weights is None:
        weights = source.new_ones(source.shape[:-1])
    usable = torch.isfinite(source).all(-1) & torch.isfinite(target).all(-1) & torch.isfinite(weights)
    if not bool(usable.all()):
        source = torch.where(usable[..., None], source, 0.0)
        target = torch.where(usable[..., None], target, 0.0)
        weights = torch.where(usable, weights, 0.0)
    weights = weights.clamp(min=0)
    # Dividing by the largest first keeps sums of huge weights finite and of tiny ones above zero.
    largest = weights.detach().amax(-1, keepdim=True)
    weights = weights / torch.where(largest > 0, largest, 1.0)
    total = weights.sum(-1, keepdim=True)
    share = (weights / torch.where(total > 0, total, 1.0))[..., None]
    source_mean = (share * source).sum(-2, keepdim=True)
    target_mean = (share * target).sum(-2, keepdim=True)
    covariance = ((source - source_mean) * share).transpose(-1, -2) @ (target - target_mean)
    R, spread = _rotation(covariance.double())
    R = R.to(source.dtype)
    t = target_mean[..., 0, :] - (source_mean @ R.transpose(-1, -2))[..., 0, :]
    fixed = spread[..., 1] > 16 * torch.finfo(source.dtype).eps * spread[..., 0]
    valid = fixed & (largest[..., 0] > 0) & torch.isfinite(spread).all(-1)
    return RigidFit(_assemble(R, t), valid)


def _rotation(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """R maximising tr(R H) for H (..., 3, 3) = sum_i w_i (p_i - p_mean)(q_i - q_mean)^T, and its spread.

    Some rotation where H does not determine one (zero, rank one, reflection tie). With H = U S V^T it is
    V diag(1, 1, det(V U^T)) U^T.
    """
    result: tuple[Tensor, Tensor] = _ProcrustesRotation.apply(covariance)  # type: ignore[no-untyped-call]
    return result


def _assemble(R: Tensor, t: Tensor) -> Tensor:
    bottom = torch.zeros_like(R[..., :1, :])
    last = torch.ones_like(t[..., :1])
    right = torch.cat([t, last], dim=-1)[..., None]
    return torch.cat([torch.cat([R, bottom], dim=-2), right], dim=-1)


class _ProcrustesRotation(torch.autograd.Function):
    """H -> (R, [s1, s2 + d s3]) with the adjoint dL/dH = -R^T [y]x, (tr(B) I - B) y = g, B = R H."""

    @staticmethod
    def forward(ctx: Any, covariance: Tensor) -> tuple[Tensor, Tensor]:
        finite = torch.isfinite(covariance).all(-1).all(-1)
        H = torch.where(finite[..., None, None], covariance, 0.0)
        U, S, Vt = torch.linalg.svd(H)
        V = Vt.transpose(-1, -2)
        sign = torch.sign(torch.linalg.det(U) * torch.linalg.det(V))
        signs = torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], dim=-1)
        R = (V * signs[..., None, :]) @ U.transpose(-1, -2)
        signed = S * signs
        ctx.save_for_backward(R, V, signed)
        spread = torch.stack([signed[..., 0], signed[..., 1] + signed[..., 2]], dim=-1)
        ctx.mark_non_differentiable(spread)
        return R, spread

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        R, V, signed = ctx.saved_tensors
        A = gradients[0] @ R.transpose(-1, -2)
        g = torch.stack(
            [A[..., 2, 1] - A[..., 1, 2], A[..., 0, 2] - A[..., 2, 0], A[..., 1, 0] - A[..., 0, 1]], dim=-1
        )
        # tr(B) I - B has the eigenvectors V and, as eigenvalues, sums of two signed singular values.
        scale = torch.where(signed[..., :1] > 0, signed[..., :1], 1.0)
        eigenvalues = (signed.sum(-1, keepdim=True) - signed) / scale
        inverse = eigenvalues / (eigenvalues.square() + 1e-6**2)
        y = (V * (inverse / scale)[..., None, :]) @ (V.transpose(-1, -2) @ g[..., None])
        gradient: Tensor = -R.transpose(-1, -2) @ _cross_matrix(y[..., 0])
        return gradient


def _cross_matrix(y: Tensor) -> Tensor:
    zero = torch.zeros_like(y[..., 0])
    rows = [zero, -y[..., 2], y[..., 1], y[..., 2], zero, -y[..., 0], -y[..., 1], y[..., 0], zero]
    return torch.stack(rows, dim=-1).reshape(*y.shape[:-1], 3, 3)
