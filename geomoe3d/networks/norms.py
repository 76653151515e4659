"""Norms and 1x1 maps over (B, C, N) that leave padding out and keep little for the backward pass.

A ``mask`` is (B, 1, N) bool, False at padding, or None where nothing is padded. All are linear in N.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 - the field's name for it
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from geomoe3d.networks.config import FIXED

_recomputing = threading.local()


@contextmanager
def frozen_statistics() -> Iterator[None]:
    """Within, a forward pass is a repetition: batch norms leave their running statistics as they are."""
    _recomputing.on = True
    try:
        yield
    finally:
        _recomputing.on = False


class Pointwise(nn.Conv1d):
    """1x1 convolution: the same affine map of the channels at every place."""

    def __init__(self, num_in: int, num_out: int) -> None:
        super().__init__(num_in, num_out, kernel_size=1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, num_in, N) to (B, num_out, N)."""
        return pointwise(x, self.weight, self.bias)


def pointwise(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """The product behind `Pointwise`, weight (num_out, num_in, 1); faster on CPUs than a convolution."""
    matrix = weight[:, :, 0].expand(len(x), -1, -1)
    return torch.bmm(matrix, x) if bias is None else torch.baddbmm(bias[:, None], matrix, x)


class BatchNorm(nn.BatchNorm1d):
    """Batch normalisation over (B, N) that leaves padding out of its statistics.

    With a single value per channel in training (a pooled vector at batch size 1) there are no statistics
    to take, so the running ones are used and left as they are.
    """

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, C, N) to the same shape."""
        if not self.training or x.shape[0] * x.shape[2] == 1:
            return F.batch_norm(x, self.running_mean, self.running_var, self.weight, self.bias, eps=self.eps)
        if mask is None:
            running_mean, running_var = self.tracked()
            momentum = self.momentum or 0.0
            return F.batch_norm(
                x, running_mean, running_var, self.weight, self.bias, True, momentum, self.eps
            )
        normed, mean, variance = _normalize(x, mask, (0, 2), self.eps)
        self._track(mean.flatten(), variance.flatten(), mask.sum())
        return normed * self.weight[:, None].to(x.dtype) + self.bias[:, None].to(x.dtype)

    def tracked(self) -> tuple[Tensor | None, Tensor | None]:
        """The running statistics that this pass is to update: none while it is only repeated."""
        if getattr(_recomputing, "on", False):
            return None, None
        if self.num_batches_tracked is not None:
            self.num_batches_tracked.add_(1)
        return self.running_mean, self.running_var

    @torch.no_grad()
    def _track(self, mean: Tensor, variance: Tensor, count: Tensor) -> None:
        running_mean, running_var = self.tracked()
        if running_mean is None or running_var is None:
            return
        momentum = self.momentum or 0.0
        unbiased = variance * (count / (count - 1).clamp(min=1))
        running_mean.lerp_(mean.to(running_mean.dtype), momentum)
        running_var.lerp_(unbiased.to(running_var.dtype), momentum)


def norm_relu_linear(x: Tensor, norm: BatchNorm, linear: Pointwise, mask: Tensor | None = None) -> Tensor:
    """linear(relu(norm(x))), keeping only x for the backward pass where that is possible.

    (B, C, N) to (B, C', N). In training without padding, the normalised activations are computed again in
    the backward pass, an elementwise step; that is a fifth of what a training step would otherwise hold.
    """
    plain = not norm.training or mask is not None or x.shape[0] * x.shape[2] == 1
    if plain or not torch.is_grad_enabled() or torch.is_autocast_enabled(x.device.type):
        return linear(F.relu(norm(x, mask)))  # type: ignore[no-any-return]
    mean, variance = norm.tracked()
    result: Tensor = _NormReluLinear.apply(  # type: ignore[no-untyped-call]
        x, norm.weight, norm.bias, linear.weight, linear.bias, mean, variance, norm.momentum, norm.eps
    )
    return result


class ContextNorm(nn.Module):
    """Each pair's channels to zero mean and unit (biased) variance over its own correspondences."""

    eps = FIXED.context_norm_eps

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, C, N) to the same shape."""
        if mask is None:
            return F.instance_norm(x, eps=self.eps)
        return _normalize(x, mask, (2,), self.eps)[0]


def _normalize(x: Tensor, mask: Tensor, dims: tuple[int, ...], eps: float) -> tuple[Tensor, Tensor, Tensor]:
    result: tuple[Tensor, Tensor, Tensor] = _MaskedNormalize.apply(x, mask, dims, eps)  # type: ignore[no-untyped-call]
    return result


class _NormReluLinear(torch.autograd.Function):
    """1x1 of ReLU of batch norm in training mode; what lies between is recomputed, not kept."""

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        gain: Tensor,
        shift: Tensor,
        weight: Tensor,
        bias: Tensor,
        running_mean: Tensor | None,
        running_variance: Tensor | None,
        momentum: float,
        eps: float,
    ) -> Tensor:
        h, mean, inverse = torch.native_batch_norm(
            x, gain, shift, running_mean, running_variance, True, momentum, eps
        )
        ctx.eps = eps
        ctx.save_for_backward(x, gain, shift, weight, mean, inverse)
        return pointwise(h.relu_(), weight, bias)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        x, gain, shift, weight, mean, inverse = ctx.saved_tensors
        gradient = gradients[0].contiguous()
        scale = gain * inverse
        h = torch.addcmul((shift - mean * scale)[:, None], x, scale[:, None]).relu_()
        into_weight = torch.bmm(gradient, h.transpose(1, 2)).sum(0)[:, :, None]
        into_h = torch.bmm(weight[:, :, 0].t().expand(len(x), -1, -1), gradient)
        into_h = torch.ops.aten.threshold_backward(into_h, h, 0)
        into_x, into_gain, into_shift = torch.ops.aten.native_batch_norm_backward(
            into_h, x, gain, None, None, mean, inverse, True, ctx.eps, [True, True, True]
        )
        into_bias = gradient.sum(dim=(0, 2))
        return into_x, into_gain, into_shift, into_weight, into_bias, None, None, None, None


class _MaskedNormalize(torch.autograd.Function):
    """(x - mean) / sqrt(var + eps) over ``dims`` of the unmasked entries, 0 elsewhere; saves one tensor."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, mask: Tensor, dims: tuple[int, ...], eps: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        wide = x.float() if x.dtype in (torch.bfloat16, torch.float16) else x
        share = mask.to(wide.dtype)
        count = share.sum(dims, keepdim=True).clamp(min=1)
        mean = (wide * share).sum(dims, keepdim=True) / count
        centred = (wide - mean) * share
        variance = centred.square().sum(dims, keepdim=True) / count
        inverse = torch.rsqrt(variance + eps)
        normed = (centred * inverse).to(x.dtype)
        ctx.dims = dims
        ctx.save_for_backward(normed, inverse, share, count)
        ctx.mark_non_differentiable(mean, variance)
        return normed, mean, variance

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None, None]:
        normed, inverse, share, count = ctx.saved_tensors
        gradient = gradients[0].to(share.dtype) * share
        mean = gradient.sum(ctx.dims, keepdim=True) / count
        slope = (gradient * normed).sum(ctx.dims, keepdim=True) / count
        result = inverse * (gradient - mean - normed * slope) * share
        return result.to(normed.dtype), None, None, None
