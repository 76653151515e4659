"""DeMo: the motion field as a regression in a reproducing kernel Hilbert space, solved in closed form.

Source: DeMo (deep motion field consensus for two-view correspondence learning): kernel ridge regression with
learned weights on pooled samples of the field, between attention blocks.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.base import CorrespondenceNetwork
from geomoe3d.networks.blocks import GraphAttention, PointCN, SubFieldPool
from geomoe3d.networks.layers import InlierPredictor, LocalOrthogonalContext, MotionInitialisation
from geomoe3d.networks.norms import Pointwise


class DeMo(CorrespondenceNetwork):
    """``num_layers`` double layers with ``num_sub_fields`` samples; 4,519,908 parameters (4D: 4,519,588)."""

    uses_neighbors = True

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        place_width = max(1, config.width // 2)
        self.initialise = MotionInitialisation(config)
        self.place = Pointwise(config.correspondence_dim // 2, place_width)
        self.place_block = PointCN(place_width)
        self.layers = nn.ModuleList(DoubleLayer(config, place_width) for _ in range(config.num_layers))

    def verdicts(
        self, coordinates: Tensor, neighbors: Tensor | None, mask: Tensor | None
    ) -> tuple[list[Tensor], Tensor | None]:
        """See `CorrespondenceNetwork.verdicts`: one verdict per double layer."""
        assert neighbors is not None
        field = self.initialise(coordinates, None, mask)
        places = self.place_block(self.place(coordinates.transpose(1, 2).chunk(2, dim=1)[0]), mask)
        found = []
        for layer in self.layers:
            field, logits = layer(field, places, neighbors, mask)
            found.append(logits)
        return found, None


class DoubleLayer(nn.Module):
    """Twice: local context, PointCN, regression; then one verdict."""

    def __init__(self, config: NetworkConfig, place_width: int) -> None:
        super().__init__()
        self.contexts = nn.ModuleList(
            LocalOrthogonalContext(config.width, config.num_neighbors, config.context_width, residual=True)
            for _ in range(2)
        )
        self.blocks = nn.ModuleList(PointCN(config.width) for _ in range(2))
        self.regressions = nn.ModuleList(
            KernelRegression(config.width, place_width, config.num_sub_fields, config.num_heads)
            for _ in range(2)
        )
        self.predict = InlierPredictor(config.width)

    def forward(
        self, field: Tensor, places: Tensor, neighbors: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Field (B, C, N), places (B, C', N) and neighbours (B, K, N) to the next field and logits (B, N)."""
        for context, block, regression in zip(self.contexts, self.blocks, self.regressions, strict=True):
            field = block(context(field, neighbors, mask), mask)
            field = regression(field, places, mask)
        return field, self.predict(field, mask)


class KernelRegression(nn.Module):
    """Samples of the field, smoothed over their places by weighted kernel ridge regression, and spread again.

    With values V, kernel K_ij = exp(-beta |x_i - x_j|^2) and W = diag(weights) the coefficients are
    C = (W K W + lambda I)^-1 W V, the smoothed samples K C.
    """

    def __init__(self, width: int, place_width: int, num_samples: int, num_heads: int) -> None:
        super().__init__()
        self.pool = SubFieldPool(width, num_samples)
        self.gather = GraphAttention(width, num_heads)
        self.trust = InlierPredictor(width)
        self.place = Pointwise(place_width, place_width)
        self.value = Pointwise(width, width)
        self.beta = nn.Parameter(torch.tensor(0.1))
        self.ridge = nn.Parameter(torch.tensor(8.0))
        self.rectify = GraphAttention(width, num_heads)
        self.spread = GraphAttention(width, num_heads)

    def forward(self, field: Tensor, places: Tensor, mask: Tensor | None) -> Tensor:
        """Field (B, C, N) and places (B, C', N) to the next field."""
        samples, shares = self.pool(field, mask)
        x = self.place(places @ shares.transpose(1, 2)).transpose(1, 2).float()
        samples, _ = self.gather(samples, field, b_mask=mask)
        weights = self.trust(samples, None).sigmoid().clamp(0.05, 0.95)
        values = self.value(samples).transpose(1, 2).float()
        apart = (x[:, :, None] - x[:, None]).square().sum(-1)
        K = torch.exp(-self.beta.clamp(min=1e-4) * apart)
        A = weights[:, :, None] * K * weights[:, None]
        A = A + self.ridge.clamp(min=1e-2) * torch.eye(A.shape[1], device=A.device)
        smooth = K @ torch.linalg.solve(A, weights[:, :, None] * values)
        samples = smooth.transpose(1, 2).to(field.dtype)
        samples, _ = self.rectify(samples, samples)
        result: Tensor = self.spread(field, samples, a_mask=mask)[0]
        return result
