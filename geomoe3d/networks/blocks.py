"""Building blocks of correspondence networks, in one (B, C, N) layout with 1-D operations.

A ``mask`` is always (B, 1, N) bool with True on real correspondences and False on padding, or None where
nothing is padded. Padding never reaches a real correspondence: norms leave it out of their statistics,
attention and pooling give it no weight. What stands at padded places afterwards has no meaning.
All blocks are linear in N.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from geomoe3d.networks.norms import BatchNorm, ContextNorm, Pointwise, norm_relu_linear

# Score of a key that the prior rejects: far below any real one, yet finite, so that a row in which every
# key is rejected becomes uniform attention instead of NaN.


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
        h = norm_relu_linear(h, self.norm1, self.linear1, mask)
        return x + norm_relu_linear(self.context_norm2(h, mask), self.norm2, self.linear2, mask)


class TwoLayer(nn.Module):
    """1x1, BatchNorm, ReLU, 1x1."""

    def __init__(self, num_in: int, num_hidden: int, num_out: int) -> None:
        super().__init__()
        self.linear1 = Pointwise(num_in, num_hidden)
        self.norm = BatchNorm(num_hidden)
        self.linear2 = Pointwise(num_hidden, num_out)

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, num_in, N) to (B, num_out, N)."""
        return norm_relu_linear(self.linear1(x), self.norm, self.linear2, mask)


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
        # Apart, since halves of one product are no views that a batched product can use without a copy.
        self.key = Pointwise(width, width)
        self.value = Pointwise(width, width)
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
        q, k, v = self._heads(self.query(a)), self._heads(self.key(b)), self._heads(self.value(b))
        scale = q.shape[2] ** -0.5
        if a.shape[2] < b.shape[2]:  # scale the smaller side: the result is kept for the backward pass
            q = q * scale
        else:
            k = k * scale
        scores = q.transpose(2, 3) @ k
        if b_kept is not None:
            scores = scores.masked_fill(~b_kept[:, None], -1e6)  # no weight after the softmax
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
        scores = norm_relu_linear(self.context_norm(x, mask), self.norm, self.linear, mask)
        if mask is not None:
            scores = scores.masked_fill(~mask, -torch.inf)
        weights = scores.softmax(dim=2)
        return x @ weights.transpose(1, 2), weights
