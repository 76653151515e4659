"""DeMatch: the motion field decomposed into learned tokens, which are refined and give a cleaner field.

Source: Zhang et al., DeMatch: deep decomposition of motion field for two-view correspondence learning
(CVPR 2024).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.base import CorrespondenceNetwork
from geomoe3d.networks.blocks import GraphAttention
from geomoe3d.networks.norms import BatchNorm, ContextNorm, Pointwise, norm_relu_linear


class DeMatch(CorrespondenceNetwork):
    """``num_layers`` layers of seven attention blocks each; 5,859,013 parameters (4D: 5,858,949)."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.of_motion = Embedding(config.width, config.correspondence_dim // 2)
        self.of_position = Embedding(config.width, config.correspondence_dim // 2)
        self.tokens = nn.Parameter(torch.randn(config.width, config.num_sub_fields))
        self.layers = nn.ModuleList(
            DecompositionLayer(config.width, config.num_heads) for _ in range(config.num_layers)
        )

    def verdicts(
        self, coordinates: Tensor, neighbors: Tensor | None, mask: Tensor | None
    ) -> tuple[list[Tensor], Tensor | None]:
        """See `CorrespondenceNetwork.verdicts`: one verdict per layer."""
        source, target = coordinates.transpose(1, 2).chunk(2, dim=1)
        field = self.of_motion(target - source, mask) + self.of_position(source, mask)
        tokens = self.tokens.expand(len(field), -1, -1)
        found: list[Tensor] = []
        for layer in self.layers:  # the tokens start anew in every layer
            field, logits = layer(field, tokens, found[-1] if found else None, mask)
            found.append(logits)
        return found, None


class Embedding(nn.Module):
    """Coordinates of a point to ``width`` channels by three 1x1 maps."""

    def __init__(self, width: int, num_in: int) -> None:
        super().__init__()
        narrow, middle = max(1, width // 4), max(1, width // 2)
        self.linear1 = Pointwise(num_in, narrow)
        self.norm1, self.linear2 = BatchNorm(narrow), Pointwise(narrow, middle)
        self.norm2, self.linear3 = BatchNorm(middle), Pointwise(middle, width)

    def forward(self, x: Tensor, mask: Tensor | None) -> Tensor:
        """(B, num_in, N) to (B, width, N)."""
        h = norm_relu_linear(self.linear1(x), self.norm1, self.linear2, mask)
        return norm_relu_linear(h, self.norm2, self.linear3, mask)


class DecompositionLayer(nn.Module):
    """Tokens gather from likely inliers, attend to each other, give the field back; verdict by its change."""

    def __init__(self, width: int, num_heads: int) -> None:
        super().__init__()
        self.cluster = nn.ModuleList(GraphAttention(width, num_heads) for _ in range(2))
        self.refine = nn.ModuleList(GraphAttention(width, num_heads) for _ in range(4))
        self.rebuild = GraphAttention(width, num_heads)
        self.predict = ChangePredictor(width)

    def forward(
        self, field: Tensor, tokens: Tensor, logits: Tensor | None, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Field (B, C, N), tokens (B, C, M) and the previous logits (B, N) to the next field and logits."""
        kept = None if logits is None else (logits > 0)[:, None]
        for block in self.cluster:
            tokens, _ = block(tokens, field, b_mask=mask, b_kept=kept)
        for block in self.refine:
            tokens, _ = block(tokens, tokens)
        rebuilt, _ = self.rebuild(field, tokens, a_mask=mask)
        return rebuilt, self.predict(rebuilt - field, mask)


class ChangePredictor(nn.Module):
    """Four 1x1 maps, ever narrower, to one logit per correspondence."""

    def __init__(self, width: int) -> None:
        super().__init__()
        widths = [max(1, width // k) for k in (1, 2, 8, 32)]
        self.first = Pointwise(widths[0], widths[1])
        self.context_norm = ContextNorm()
        self.rest = nn.ModuleList(NormLinear(a, b) for a, b in zip(widths[1:], (*widths[2:], 1), strict=True))

    def forward(self, change: Tensor, mask: Tensor | None) -> Tensor:
        """(B, C, N) to logits (B, N), 0 at padding."""
        h = self.first(change)
        for norm_linear in self.rest:
            h = norm_linear(self.context_norm(h, mask), mask)
        logits: Tensor = h[:, 0]
        return logits if mask is None else logits.masked_fill(~mask[:, 0], 0.0)


class NormLinear(nn.Module):
    """BatchNorm, ReLU, 1x1."""

    def __init__(self, num_in: int, num_out: int) -> None:
        super().__init__()
        self.norm, self.linear = BatchNorm(num_in), Pointwise(num_in, num_out)

    def forward(self, x: Tensor, mask: Tensor | None) -> Tensor:
        """(B, num_in, N) to (B, num_out, N)."""
        return norm_relu_linear(x, self.norm, self.linear, mask)
