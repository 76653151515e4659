"""U-Match: correspondences thinned out three times, attending to the finer level, and spread out again.

Source: Li et al., U-Match: two-view correspondence learning with hierarchy-aware local context aggregation
(IJCAI 2023).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.base import CorrespondenceNetwork
from geomoe3d.networks.blocks import GraphAttention, PointCN, TwoLayer
from geomoe3d.networks.layers import InlierPredictor, motion, weights_from_logits
from geomoe3d.networks.norms import ContextNorm, Pointwise


class UMatch(CorrespondenceNetwork):
    """``num_layers`` U-shaped layers, global context after the second and fourth; 7,764,824 parameters."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.embedding = Pointwise(config.input_width, config.width)
        self.layers = nn.ModuleList(
            UShapedLayer(config.width, config.num_heads) for _ in range(config.num_layers)
        )
        self.context = nn.ModuleDict(
            # Layers, counted from 0, that a global context follows.
            {str(k): GlobalContext(config.width) for k in (1, 3) if k < config.num_layers}
        )

    def verdicts(
        self, coordinates: Tensor, neighbors: Tensor | None, mask: Tensor | None
    ) -> tuple[list[Tensor], Tensor | None]:
        """See `CorrespondenceNetwork.verdicts`: one verdict per layer."""
        field = self.embedding(motion(coordinates, self.config.motion_form).transpose(1, 2))
        found = []
        for number, layer in enumerate(self.layers):
            field, logits = layer(field, mask)
            found.append(logits)
            if str(number) in self.context:
                field = self.context[str(number)](field, logits, mask)
        return found, None


class UShapedLayer(nn.Module):
    """Three levels down, attention among the coarsest, three levels up, verdict."""

    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__()
        ratios = (0.125, 0.5, 0.5)
        self.down = nn.ModuleList(Thinning(width, num_heads, ratio) for ratio in ratios)
        self.bottom = GraphAttention(width, num_heads)
        self.up = nn.ModuleList(GraphAttention(width, num_heads) for _ in ratios)
        self.mix = Pointwise(width, width)
        self.context_norm = ContextNorm()
        self.predict = InlierPredictor(width)

    def forward(self, field: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
        """Field (B, C, N) to the next field and its logits (B, N)."""
        levels = [(field, mask)]
        for thin in self.down:
            levels.append(thin(*levels[-1]))
        coarse, coarse_mask = levels.pop()
        coarse, _ = self.bottom(coarse, coarse, a_mask=coarse_mask, b_mask=coarse_mask)
        for spread in self.up:
            finer, finer_mask = levels.pop()
            coarse, _ = spread(finer, coarse, a_mask=finer_mask, b_mask=coarse_mask)
            coarse_mask = finer_mask
        logits: Tensor = self.predict(self.context_norm(self.mix(coarse), mask), mask)
        return coarse, logits


class Thinning(nn.Module):
    """The rows with the best scores, gated by them, gather from all rows."""

    def __init__(self, width: int, num_heads: int, ratio: float) -> None:
        super().__init__()
        self.ratio = ratio
        self.score = Pointwise(width, 1)
        self.block = PointCN(width)
        self.gather = GraphAttention(width, num_heads)

    def forward(self, x: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """(B, C, N) to (B, C, k), k a share of the real rows and at least 2, and its mask."""
        score = self.score(x)[:, 0].sigmoid()
        kept, fewest = None, 2  # rows: one alone has no statistics
        if mask is None:
            count = min(x.shape[2], max(fewest, int(x.shape[2] * self.ratio)))
        else:
            each = (mask.sum((1, 2)) * self.ratio).long().clamp(min=fewest)
            count = int(each.max())
            kept = (torch.arange(count, device=x.device)[None] < each[:, None])[:, None]
        order = score if mask is None else score.masked_fill(~mask[:, 0], -1.0)
        rows = order.topk(count, dim=1).indices[:, None].expand(-1, x.shape[1], -1)
        gated = (self.block(x, mask) * score[:, None]).gather(2, rows)
        return self.gather(gated, x, a_mask=kept, b_mask=mask)[0], kept


class GlobalContext(nn.Module):
    """What the likely inliers have in common, and what of each correspondence is orthogonal to it."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.common = TwoLayer(width, max(1, width // 4), width)
        self.fuse = TwoLayer(2 * width, width, width)

    def forward(self, field: Tensor, logits: Tensor, mask: Tensor | None) -> Tensor:
        """Field (B, C, N) and logits (B, N) to the field in context."""
        weights = weights_from_logits(logits)[:, :, None].to(field.dtype)
        mean = field @ (weights / weights.sum(1, keepdim=True).clamp(min=1e-6))
        direction = nn.functional.normalize(self.common(mean), dim=1)
        apart = field - direction * (direction * field).sum(1, keepdim=True)
        return torch.add(field, self.fuse(torch.cat([field, apart], dim=1), mask))
