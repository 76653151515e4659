"""The same GeoMoE, faster, for one pair at a time: norms and projections folded into fewer products.

In evaluation batch norms are affine maps and disappear into their neighbours. In both attentions between
N correspondences and M sub-fields the N side is never projected: queries, keys and values of the M side are
multiplied into the weights first, so per layer only six products run over all correspondences. Constants
that a softmax cancels are dropped. Logits agree with `GeoMoE` to 1e-4; tests hold it to that. Linear in N.
"""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
from torch import Tensor

from geomoe3d.filters.blocks import GraphAttention, PointCN
from geomoe3d.filters.folded_blocks import (
    FoldedExperts,
    FoldedRectifier,
    FoldedUpdate,
    affine,
    norm_relu,
    scale_relu,
    scale_shift,
    two_layer,
)
from geomoe3d.filters.geomoe import PRIOR_KERNEL, GeoMoE, together_under_motion
from geomoe3d.filters.layers import (
    GeoMoELayer,
    LocalOrthogonalContext,
    MotionInitialisation,
    PriorGuidedDecomposition,
    motion,
    weights_from_logits,
)


class FoldedOutput(NamedTuple):
    """Logits of every layer and, if asked for, what the last layer did.

    Attributes:
        logits: (L, N) float32.
        sub_field: (N,) int64 sub-field from which each correspondence is mostly rebuilt, or None.
        expert: (M,) int64 main expert of each sub-field, or None (also without experts).
        verdict: scalar logit that the motion is right, or None for a network that is given none.
    """

    logits: Tensor
    sub_field: Tensor | None
    expert: Tensor | None
    verdict: Tensor | None = None


class FoldedGeoMoE:
    """Inference with a trained network, one pair at a time.

    Args:
        model: its weights are copied; later changes to it are not seen.
    """

    def __init__(self, model: GeoMoE) -> None:
        self.config = model.config
        with torch.no_grad():
            self._initialise = _Initialise(model.initialise)
            self._layers = [_Layer(layer) for layer in model.layers if isinstance(layer, GeoMoELayer)]
            self._verdict = None if model.verdict is None else copy.deepcopy(model.verdict)

    @torch.inference_mode()
    def __call__(
        self, coordinates: Tensor, channels: Tensor | None, neighbors: Tensor, *, insight: bool = False
    ) -> FoldedOutput:
        """Weigh one pair.

        Args:
            coordinates: (N, 2d) float32 as `geomoe3d.filters.inputs` gives them.
            channels: (N, C) float32 or None.
            neighbors: (N, K) int64.
            insight: also say which sub-field and expert each correspondence belongs to.
        """
        index = neighbors.t().reshape(-1)
        field = self._initialise(coordinates, channels)
        together = None if self._verdict is None else together_under_motion(channels)
        logits: Tensor | None = None if together is None else together - PRIOR_KERNEL
        verdicts = []
        attention = expert = None
        for layer in self._layers:
            field, logits, attention, expert = layer(field, logits, index)
            verdicts.append(logits)
        stacked, verdict = torch.stack(verdicts), None
        if self._verdict is not None and channels is not None and together is not None:
            verdict = self._verdict(channels[None], field[None], together[None], None)[0]
        if not insight or attention is None:
            return FoldedOutput(stacked, None, None, verdict)
        return FoldedOutput(stacked, attention.mean(dim=0).argmax(dim=0), expert, verdict)


class _Initialise:
    def __init__(self, module: MotionInitialisation) -> None:
        self.motion_form = module.motion_form
        self.weight, self.bias = affine(module.embedding)
        block: PointCN = module.block
        self.leading = block.context_norm1 is not None
        self.norm1 = scale_shift(block.norm1)
        self.norm2 = scale_shift(block.norm2)
        self.linear1 = affine(block.linear1)
        self.linear2 = affine(block.linear2)

    def __call__(self, coordinates: Tensor, channels: Tensor | None) -> Tensor:
        inputs = [] if self.motion_form == "none" else [motion(coordinates, self.motion_form)]
        if channels is not None:
            inputs.append(channels)
        x = torch.addmm(self.bias, self.weight, torch.cat(inputs, dim=1).t())
        h = norm_relu(x, self.norm1) if self.leading else scale_relu(x, self.norm1)
        h = torch.addmm(self.linear1[1], self.linear1[0], h)
        h = norm_relu(h, self.norm2)
        return x.add_(self.linear2[1]).addmm_(self.linear2[0], h)


class _Layer:
    def __init__(self, layer: GeoMoELayer) -> None:
        self.context = None if layer.context is None else _Context(layer.context)
        pool = layer.decompose.pool
        self.pool_norm = scale_shift(pool.norm)
        self.pool_weight = affine(pool.linear)[0]  # the bias cancels in the softmax over the points
        self.experts = FoldedExperts(layer.decompose.experts)
        self.gather = _Gather(layer.decompose)
        self.rectify = FoldedRectifier(layer.rectify)
        self.rebuild = _Rebuild(layer.reconstruct)
        self.predict_norm = scale_shift(layer.predict.norm)
        self.predict = affine(layer.predict.linear)

    def __call__(
        self, field: Tensor, logits: Tensor | None, index: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        if self.context is not None:
            field = self.context(field, index)
        weights = torch.mm(self.pool_weight, norm_relu(field, self.pool_norm)).softmax(dim=1)
        z, _ = self.experts(torch.mm(field, weights.t()))
        z, routing = self.rectify(self.gather(z, field, logits))
        field, attention = self.rebuild(field, z)
        h = scale_relu(field, self.predict_norm)
        verdict = torch.addmm(self.predict[1], self.predict[0], h)[0]
        return field, verdict, attention, routing


class _Context:
    """Local context on (d', K, N): channels are mixed as (d', K N), neighbours as d' products (K, N)."""

    def __init__(self, module: LocalOrthogonalContext) -> None:
        self.residual = module.residual
        self.reduce = affine(module.reduce)[0]  # the bias cancels in differences
        self.channels = two_layer(module.mix_channels)
        self.neighbors = two_layer(module.mix_neighbors)
        self.collapse = two_layer(module.collapse)
        self.restore, self.restore_bias = affine(module.restore)

    def __call__(self, field: Tensor, index: Tensor) -> Tensor:
        f = torch.mm(self.reduce, field)
        width, num = f.shape
        h = torch.sub(f[:, None], f.index_select(1, index).view(width, -1, num)).view(width, -1)
        a, a_bias, b, b_bias = self.channels
        mixed = torch.addmm(a_bias, a, h).relu_()
        h = h.add_(b_bias).addmm_(b, mixed)
        g = h.view(width, -1, num)
        a, a_bias, b, b_bias = self.neighbors
        mixed = torch.baddbmm(a_bias, a.expand(width, -1, -1), g).relu_()
        g = g.add_(b_bias).baddbmm_(b.expand(width, -1, -1), mixed)
        a, a_bias, b, b_bias = self.collapse
        mixed = torch.baddbmm(a_bias, a.expand(width, -1, -1), g).relu_()
        c = torch.baddbmm(b_bias, b.expand(width, -1, -1), mixed)[:, 0]
        if self.residual:
            return field.add_(self.restore_bias).addmm_(self.restore, c)
        return torch.addmm(self.restore_bias, self.restore, c)


class _Gather:
    """Sub-fields attend to the correspondences that the prior keeps; the others are not even touched."""

    def __init__(self, module: PriorGuidedDecomposition) -> None:
        block = module.gather
        self.prior = module.prior
        self.heads = block.num_heads
        width = block.query.in_channels
        scale = (width // self.heads) ** -0.5
        self.query, self.query_bias = (x * scale for x in affine(block.query))
        # A key's bias adds the same to every score of a query, which the softmax cancels.
        self.key = affine(block.key)[0].reshape(self.heads, -1, width)
        value, value_bias = affine(block.value)
        self.value = value.reshape(self.heads, -1, width)
        self.update = FoldedUpdate(block, value_bias)

    def __call__(self, z: Tensor, field: Tensor, logits: Tensor | None) -> Tensor:
        width, num_fields = z.shape
        if logits is not None and self.prior == "soft":
            field = field * weights_from_logits(logits)
        elif logits is not None and self.prior == "mask":
            kept = (logits > 0).nonzero()[:, 0]
            if len(kept) == 0:  # all rejected: uniform attention
                return self.update(
                    z, (self.value.view(-1, width) @ field.mean(1, True)).expand(-1, num_fields)
                )
            if len(kept) < field.shape[1]:
                field = field.index_select(1, kept)
        q = torch.addmm(self.query_bias, self.query, z).view(self.heads, -1, num_fields)
        into = torch.bmm(q.transpose(1, 2), self.key).view(-1, width)
        attention = torch.mm(into, field).softmax(dim=1)
        gathered = torch.mm(attention, field.t()).view(self.heads, num_fields, width)
        return self.update(z, torch.bmm(self.value, gathered.transpose(1, 2)).view(width, num_fields))


class _Rebuild:
    """All correspondences attend to the sub-fields."""

    def __init__(self, block: GraphAttention) -> None:
        self.heads = block.num_heads
        width = block.query.in_channels
        query, query_bias = affine(block.query)
        scale = (width // self.heads) ** -0.5
        self.query = (query * scale).reshape(self.heads, -1, width)
        self.query_bias = (query_bias * scale).reshape(self.heads, -1, 1)
        value, self.value_bias = affine(block.value)
        self.key_value = torch.cat([affine(block.key)[0], value])
        first, first_bias, self.second, self.second_bias = two_layer(block.update)
        message, message_bias = affine(block.message)
        self.own = first[:, :width].contiguous()
        self.from_heads = (first[:, width:] @ message).reshape(-1, self.heads, width // self.heads)
        self.from_heads = self.from_heads.transpose(0, 1).contiguous()
        self.bias = first_bias + first[:, width:] @ message_bias

    def __call__(self, field: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        width, num_fields = z.shape
        key_value = torch.mm(self.key_value, z)
        k = key_value[:width].view(self.heads, -1, num_fields)
        v = (key_value[width:] + self.value_bias).view(self.heads, -1, num_fields)
        into = torch.matmul(k.transpose(1, 2), self.query).view(-1, width)
        bias = torch.matmul(k.transpose(1, 2), self.query_bias).view(-1, 1)
        num = field.shape[1]
        attention = torch.addmm(bias, into, field).view(self.heads, num_fields, num).softmax(dim=1)
        back = torch.matmul(self.from_heads, v).transpose(0, 1).reshape(-1, self.heads * num_fields)
        hidden = torch.addmm(self.bias, self.own, field)
        hidden.addmm_(back, attention.view(-1, num)).relu_()
        return torch.addmm(field, self.second, hidden).add_(self.second_bias), attention
