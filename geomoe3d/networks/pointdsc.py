"""PointDSC: attention weighed by how well lengths agree, and features that are alike among inliers.

Source: Bai et al., PointDSC: robust point cloud registration using deep spatial consistency (CVPR 2021).
Memory grows with N^2. Seeds and hypotheses from what it says: `geomoe3d.networks.seeded_motions`.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.base import CorrespondenceNetwork
from geomoe3d.networks.layers import motion
from geomoe3d.networks.norms import BatchNorm, Pointwise, norm_relu_linear


class PointDSC(CorrespondenceNetwork):
    """``num_layers`` maps and non-local blocks, one classifier; 1,053,667 parameters.

    The scale of the features' similarity and that of the length differences are parameters.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        width = config.width
        self.embedding = Pointwise(config.input_width, width)
        self.maps = nn.ModuleList(Pointwise(width, width) for _ in range(config.num_layers))
        self.norms = nn.ModuleList(BatchNorm(width) for _ in range(config.num_layers))
        self.blocks = nn.ModuleList(NonLocalBlock(width) for _ in range(config.num_layers))
        narrow = max(1, width // 4)
        self.classify = nn.Sequential(
            Pointwise(width, narrow), nn.ReLU(), Pointwise(narrow, narrow), nn.ReLU(), Pointwise(narrow, 1)
        )
        self.feature_scale = nn.Parameter(torch.tensor(1.0))
        self.length_scale = nn.Parameter(torch.tensor(config.compatibility_threshold / config.unit_voxels))

    def verdicts(
        self, coordinates: Tensor, neighbors: Tensor | None, mask: Tensor | None
    ) -> tuple[list[Tensor], Tensor | None]:
        """See `CorrespondenceNetwork.verdicts`: one verdict, and the similarity of all rows' features."""
        consistency = length_consistency(coordinates, self.length_scale)
        field = self.embedding(motion(coordinates, self.config.motion_form).transpose(1, 2))
        for linear, norm, block in zip(self.maps, self.norms, self.blocks, strict=True):
            field = block(F.relu(norm(linear(field), mask)), consistency, mask)
        features = F.normalize(field, dim=1)
        alike = features.transpose(1, 2) @ features
        similarity = (1 - (1 - alike) / self.feature_scale.square().clamp(min=1e-6)).clamp(0, 1)
        num = similarity.shape[1]
        similarity = similarity * (1 - torch.eye(num, device=similarity.device))
        if mask is not None:
            similarity = similarity * (mask & mask.transpose(1, 2))
        return [self.classify(field)[:, 0]], similarity


class NonLocalBlock(nn.Module):
    """One head of attention whose scores are multiplied by the consistency of lengths; residual."""

    def __init__(self, width: int) -> None:
        super().__init__()
        half = max(1, width // 2)
        self.query, self.key, self.value = (Pointwise(width, width) for _ in range(3))
        self.linear1, self.norm1 = Pointwise(width, half), BatchNorm(half)
        self.linear2, self.norm2 = Pointwise(half, half), BatchNorm(half)
        self.linear3 = Pointwise(half, width)

    def forward(self, x: Tensor, consistency: Tensor, mask: Tensor | None) -> Tensor:
        """(B, C, N) and (B, N, N) to (B, C, N)."""
        q, k, v = self.query(x) * x.shape[1] ** -0.5, self.key(x), self.value(x)
        scores = (q.transpose(1, 2) @ k) * consistency
        if mask is not None:
            scores = scores.masked_fill(~mask, -torch.inf)
        message = self.linear1(v @ scores.softmax(dim=2).transpose(1, 2))
        h = norm_relu_linear(message, self.norm1, self.linear2, mask)
        return x + norm_relu_linear(h, self.norm2, self.linear3, mask)


def length_consistency(coordinates: Tensor, scale: Tensor) -> Tensor:
    """C_ij = max(0, 1 - (|p_i - p_j| - |q_i - q_j|)^2 / scale^2), (B, N, 6) to (B, N, N)."""
    with torch.no_grad():
        difference = _lengths(coordinates[..., :3]) - _lengths(coordinates[..., 3:])
        square = difference.square()
    return (1 - square / scale.square().clamp(min=1e-8)).clamp(min=0)


def _lengths(points: Tensor) -> Tensor:
    return torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
