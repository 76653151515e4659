"""OANet: clusters of correspondences, filtered in an order that the network learns, in two stages.

Source: Zhang et al., Learning two-view correspondences and geometry using order-aware network (ICCV 2019).
Its second stage sees residuals to the first stage's epipolar geometry, or to its rigid motion for points in space.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from geomoe3d.geometry.essential import symmetric_distance, weighted_eight_point
from geomoe3d.geometry.kabsch import weighted_kabsch
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.base import CorrespondenceNetwork
from geomoe3d.networks.blocks import PointCN, SubFieldPool
from geomoe3d.networks.layers import motion, weights_from_logits
from geomoe3d.networks.norms import BatchNorm, ContextNorm, Pointwise, norm_relu_linear


class OANet(CorrespondenceNetwork):
    """``num_layers`` stages with ``num_sub_fields`` clusters; 2,473,050 parameters (4D: 2,472,538)."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        # The first stage hands on two channels: residual and weight.
        later = [config.input_width + 2] * (config.num_layers - 1)
        self.stages = nn.ModuleList(
            Stage(num_in, config.width, config.num_sub_fields) for num_in in (config.input_width, *later)
        )

    def verdicts(
        self, coordinates: Tensor, neighbors: Tensor | None, mask: Tensor | None
    ) -> tuple[list[Tensor], Tensor | None]:
        """See `CorrespondenceNetwork.verdicts`: one verdict per stage."""
        plain = motion(coordinates, self.config.motion_form).transpose(1, 2)
        x, found = plain, []
        for stage in self.stages:
            logits = stage(x, mask)
            if mask is not None:
                logits = logits.masked_fill(~mask[:, 0], 0.0)
            found.append(logits)
            weights = weights_from_logits(logits.detach().float())
            residual = _residuals(coordinates.float(), weights)
            x = torch.cat([plain, torch.stack([residual, weights], dim=1).to(plain.dtype)], dim=1)
        return found, None


class Stage(nn.Module):
    """PointCN blocks, clusters with their order-aware filters, back to the correspondences, verdict."""

    def __init__(self, num_in: int, width: int, num_clusters: int) -> None:
        super().__init__()
        self.embedding = Pointwise(num_in, width)
        blocks = 3  # of each kind in a stage
        self.before = nn.ModuleList(PointCN(width) for _ in range(blocks))
        self.pool = SubFieldPool(width, num_clusters)
        self.filters = nn.ModuleList(OrderAwareFilter(width, num_clusters) for _ in range(blocks))
        self.unpool = SubFieldUnpool(width, num_clusters)
        self.merge = NarrowingPointCN(2 * width, width)
        self.after = nn.ModuleList(PointCN(width) for _ in range(blocks - 1))
        self.predict = Pointwise(width, 1)

    def forward(self, x: Tensor, mask: Tensor | None) -> Tensor:
        """(B, C, N) to logits (B, N)."""
        field = self.embedding(x)
        for block in self.before:
            field = block(field, mask)
        clusters, _ = self.pool(field, mask)
        for block in self.filters:
            clusters = block(clusters)
        field = self.merge(torch.cat([field, self.unpool(field, clusters, mask)], dim=1), mask)
        for block in self.after:
            field = block(field, mask)
        logits: Tensor = self.predict(field)[:, 0]
        return logits


class OrderAwareFilter(nn.Module):
    """Clusters mixed channel by channel, then cluster by cluster, then channel by channel."""

    def __init__(self, width: int, num_clusters: int) -> None:
        super().__init__()
        self.context_norm = ContextNorm()
        self.norm1, self.linear1 = BatchNorm(width), Pointwise(width, width)
        self.norm2, self.linear2 = BatchNorm(num_clusters), Pointwise(num_clusters, num_clusters)
        self.context_norm3 = ContextNorm()
        self.norm3, self.linear3 = BatchNorm(width), Pointwise(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """Clusters (B, C, M) to the same shape."""
        h = norm_relu_linear(self.context_norm(x), self.norm1, self.linear1)
        across = norm_relu_linear(h.transpose(1, 2).contiguous(), self.norm2, self.linear2)
        h = h + across.transpose(1, 2)
        return x + norm_relu_linear(self.context_norm3(h), self.norm3, self.linear3)


class SubFieldUnpool(nn.Module):
    """Clusters back to correspondences: each is a mean of clusters, weights summing to 1 over them."""

    def __init__(self, width: int, num_clusters: int) -> None:
        super().__init__()
        self.context_norm = ContextNorm()
        self.norm = BatchNorm(width)
        self.linear = Pointwise(width, num_clusters)

    def forward(self, x: Tensor, clusters: Tensor, mask: Tensor | None = None) -> Tensor:
        """Field (B, C, N) and clusters (B, C, M) to (B, C, N)."""
        scores = norm_relu_linear(self.context_norm(x, mask), self.norm, self.linear, mask)
        return clusters @ scores.softmax(dim=1)


class NarrowingPointCN(nn.Module):
    """PointCN block from one width to another; the residual is a 1x1 map."""

    def __init__(self, num_in: int, num_out: int) -> None:
        super().__init__()
        self.shortcut = Pointwise(num_in, num_out)
        self.context_norm1 = ContextNorm()
        self.norm1, self.linear1 = BatchNorm(num_in), Pointwise(num_in, num_out)
        self.context_norm2 = ContextNorm()
        self.norm2, self.linear2 = BatchNorm(num_out), Pointwise(num_out, num_out)

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, num_in, N) to (B, num_out, N)."""
        h = norm_relu_linear(self.context_norm1(x, mask), self.norm1, self.linear1, mask)
        h = norm_relu_linear(self.context_norm2(h, mask), self.norm2, self.linear2, mask)
        return torch.add(self.shortcut(x), h)


@torch.no_grad()
def _residuals(coordinates: Tensor, weights: Tensor) -> Tensor:
    """(B, N) distance of each target point from its source point under the weighted motion; 0 without one.

    Of image points the symmetric squared distance to the epipolar lines, at most 1.
    """
    if coordinates.shape[-1] == 4:
        fit = weighted_eight_point(coordinates, weights)
        square = symmetric_distance(fit.E, coordinates.double()).clamp(max=1.0)
        return (square * fit.valid[:, None]).to(coordinates.dtype)
    source, target = coordinates[..., :3], coordinates[..., 3:]
    T, solved = weighted_kabsch(source, target, weights)
    moved = source @ T[:, :3, :3].transpose(1, 2) + T[:, None, :3, 3]
    residuals: Tensor = (moved - target).norm(dim=-1) * solved[:, None]
    return residuals
