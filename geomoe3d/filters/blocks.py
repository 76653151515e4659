"""Building blocks of correspondence networks, in one (B, C, N) layout with 1-D operations.

A ``mask`` is always (B, 1, N) bool with True on real correspondences and False on padding, or None where
nothing is padded. Padding never reaches a real correspondence: norms leave it out of their statistics,
attention and pooling give it no weight. What stands at padded places afterwards has no meaning.
All blocks are linear in N.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 - the field's name for it
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

# Score of a key that the prior rejects: far below any real one, yet finite, so that a row in which every
# key is rejected becomes uniform attention instead of NaN.
REJECTED_SCORE = -1e6


class Pointwise(nn.Conv1d):
    """1x1 convolution: the same affine map of the channels at every place."""

    def __init__(self, num_in: int, num_out: int) -> None:
        super().__init__(num_in, num_out, kernel_size=1)


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
            normed: Tensor = super().forward(x)
            return normed
        normed, mean, variance = _normalize(x, mask, (0, 2), self.eps)
        self._track(mean.flatten(), variance.flatten(), mask.sum())
        return normed * self.weight[:, None].to(x.dtype) + self.bias[:, None].to(x.dtype)

    @torch.no_grad()
    def _track(self, mean: Tensor, variance: Tensor, count: Tensor) -> None:
        assert self.running_mean is not None
        assert self.running_var is not None
        assert self.num_batches_tracked is not None
        momentum = self.momentum or 0.0
        unbiased = variance * (count / (count - 1).clamp(min=1))
        self.running_mean.lerp_(mean.to(self.running_mean.dtype), momentum)
        self.running_var.lerp_(unbiased.to(self.running_var.dtype), momentum)
        self.num_batches_tracked.add_(1)


class ContextNorm(nn.Module):
    """Each pair's channels to zero mean and unit (biased) variance over its own correspondences."""

    eps = 1e-3

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, C, N) to the same shape."""
        if mask is None:
            return F.instance_norm(x, eps=self.eps)
        return _normalize(x, mask, (2,), self.eps)[0]


class PointCN(nn.Module):
    """Residual block of two (ContextNorm, BatchNorm, ReLU, 1x1); ``leading_norm`` False drops the first CN.

    Source: PointCN (Yi et al. 2018) in its pre-activation form.
    """

    def __init__(self, width: int, leading_norm: bool = True) -> None:
        super().__init__()
        self.context_norm1 = ContextNorm() if leading_norm else None
        self.norm1 = BatchNorm(width)
        self.linear1 = Pointwise(width, width)
        self.context_norm2 = ContextNorm()
        self.norm2 = BatchNorm(width)
        self.linear2 = Pointwise(width, width)

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, C, N) to the same shape."""
        h = x if self.context_norm1 is None else self.context_norm1(x, mask)
        h = self.linear1(F.relu(self.norm1(h, mask)))
        h = F.relu(self.norm2(self.context_norm2(h, mask), mask))
        return torch.add(x, self.linear2(h))


class TwoLayer(nn.Module):
    """1x1, BatchNorm, ReLU, 1x1."""

    def __init__(self, num_in: int, num_hidden: int, num_out: int) -> None:
        super().__init__()
        self.linear1 = Pointwise(num_in, num_hidden)
        self.norm = BatchNorm(num_hidden)
        self.linear2 = Pointwise(num_hidden, num_out)

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, num_in, N) to (B, num_out, N)."""
        return self.linear2(F.relu(self.norm(self.linear1(x), mask)))  # type: ignore[no-any-return]


class GraphAttention(nn.Module):
    """G(a, b): the rows of a gather from b by multi-head attention; residual on a.

    Message = 1x1(concat of heads), update = TwoLayer(concat[a, message]), result = a + update.

    Source: the "GAT" of the paper, which in its released code is an attentional graph block as in
    SuperGlue, not the additive attention of Velickovic et al.
    """

    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.query = Pointwise(width, width)
        self.key_value = Pointwise(width, 2 * width)
        self.message = Pointwise(width, width)
        self.update = TwoLayer(2 * width, 2 * width, width)

    def forward(
        self,
        a: Tensor,
        b: Tensor,
        *,
        a_mask: Tensor | None = None,
        b_mask: Tensor | None = None,
        b_kept: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Update ``a`` from ``b``.

        Args:
            a: (B, C, N) queries.
            b: (B, C, M) keys and values.
            a_mask: (B, 1, N) padding of a.
            b_mask: (B, 1, M) padding of b; a padded key gets no weight at all.
            b_kept: (B, 1, M) bool prior; a rejected key gets no weight unless all are rejected.

        Returns:
            The updated a (B, C, N), and the attention (B, heads, N, M), rows summing to one.
        """
        q = self._heads(self.query(a))
        k, v = (self._heads(x) for x in self.key_value(b).chunk(2, dim=1))
        scores = (q * q.shape[2] ** -0.5).transpose(2, 3) @ k
        if b_kept is not None:
            scores = scores.masked_fill(~b_kept[:, None], REJECTED_SCORE)
        if b_mask is not None:
            scores = scores.masked_fill(~b_mask[:, None], -torch.inf)
        attention = scores.softmax(dim=-1)
        message = self.message((v @ attention.transpose(2, 3)).flatten(1, 2))
        return a + self.update(torch.cat([a, message], dim=1), a_mask), attention

    def _heads(self, x: Tensor) -> Tensor:
        return x.reshape(x.shape[0], self.num_heads, -1, x.shape[2])


class SubFieldPool(nn.Module):
    """Soft assignment of N correspondences to M sub-fields, each one's weights summing to 1 over the points.

    Source: Z = S F of the paper with S (M, N); differentiable pooling as in OANet.
    """

    def __init__(self, width: int, num_sub_fields: int) -> None:
        super().__init__()
        self.context_norm = ContextNorm()
        self.norm = BatchNorm(width)
        self.linear = Pointwise(width, num_sub_fields)

    def forward(self, x: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """(B, C, N) to sub-fields (B, C, M) and their weights S (B, M, N)."""
        scores = self.linear(F.relu(self.norm(self.context_norm(x, mask), mask)))
        if mask is not None:
            scores = scores.masked_fill(~mask, -torch.inf)
        weights = scores.softmax(dim=2)
        return x @ weights.transpose(1, 2), weights


def _normalize(x: Tensor, mask: Tensor, dims: tuple[int, ...], eps: float) -> tuple[Tensor, Tensor, Tensor]:
    result: tuple[Tensor, Tensor, Tensor] = _MaskedNormalize.apply(x, mask, dims, eps)  # type: ignore[no-untyped-call]
    return result


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
