"""The one form of a network that weighs correspondences.

`GeoMoE` has this form; so have its baselines, which share its blocks. Training, weights on disk, counting
and filters ask for nothing else.
"""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor, nn

from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.geomoe import GeoMoEOutput, find_neighbors


class CorrespondenceNetwork(nn.Module):
    """Correspondences in, one logit each out, from every place of the network that gives a verdict.

    A baseline implements `verdicts`; this class looks after padding and the form of the output.

    Attributes:
        uses_neighbors: whether nearest neighbours are needed.
    """

    uses_neighbors = False

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.checkpoint_activations = False

    @abstractmethod
    def verdicts(
        self, coordinates: Tensor, neighbors: Tensor | None, mask: Tensor | None
    ) -> tuple[list[Tensor], Tensor | None]:
        """Weigh a batch.

        Args:
            coordinates: (B, N, 6), centred, in network units.
            neighbors: (B, K, N) int64, or None where they are not used.
            mask: (B, 1, N) bool, False at padding, or None.

        Returns:
            Logits (B, N), the last ones being the answer, and the similarity of features (B, N, N) or None.
        """

    def forward(
        self,
        coordinates: Tensor,
        channels: Tensor | None = None,
        neighbors: Tensor | None = None,
        mask: Tensor | None = None,
        *,
        insight: bool = False,
    ) -> GeoMoEOutput:
        """Weigh a batch of pairs; see `GeoMoE.forward`. Extra channels and insight are GeoMoE's alone."""
        wide = None if mask is None else mask[:, None]
        if self.uses_neighbors:
            if neighbors is None:
                neighbors = find_neighbors(coordinates, self.config, mask)
            neighbors = neighbors.transpose(1, 2).contiguous()
        if mask is not None:
            coordinates = coordinates * mask[..., None]
        found, similarity = self.verdicts(coordinates, neighbors, wide)
        logits = torch.stack(found)
        logits = logits.to(torch.promote_types(logits.dtype, torch.float32))
        if mask is not None:
            logits = logits.masked_fill(~mask, 0.0)
        positive = (logits.detach() > 0).float()
        kept = positive.mean(dim=(1, 2)) if mask is None else positive.sum(dim=(1, 2)) / mask.sum()
        return GeoMoEOutput(logits, logits.new_zeros(()), None, None, kept, similarity=similarity)
