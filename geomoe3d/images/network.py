"""A trained network that weighs the matches of two images."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from geomoe3d.errors import CheckpointError
from geomoe3d.geometry.essential import MIN_MATCHES
from geomoe3d.networks.neighbors import neighbors_in_batch
from geomoe3d.networks.pretrained import load_network
from geomoe3d.types import FloatArray, IntArray


class Verdict(NamedTuple):
    """What a network says of N matches; GeoMoE alone has sub-fields and experts."""

    logits: FloatArray  # (N,), above 0 for inliers
    sub_field: IntArray | None  # (N,) from which each match is rebuilt by most more than the mean match
    expert: IntArray | None  # (N,) with the largest weight for that sub-field

    @property
    def weights(self) -> FloatArray:
        """(N,) in [0, 1), tanh of positive logits and 0 else, as the network is trained."""
        return np.maximum(np.tanh(self.logits), 0.0)


class ImageNetwork:
    """GeoMoE or one of its baselines with 4D input, loaded once from a .safetensors file with its card beside it.
    Raises CheckpointError: not found, damaged, or a network for clouds."""

    def __init__(self, weights: str | Path) -> None:
        self.model, self.card = load_network(weights)
        if self.model.config.correspondence_dim != 4:
            need = "matches of images need one with 4D input, trained by configs/train/images"
            raise CheckpointError(f"'{weights}' holds a network for clouds; {need}")

    @torch.no_grad()
    def __call__(self, rays: FloatArray) -> Verdict:
        """Weigh matches (N, 4), finite and normalised by the intrinsics; with fewer than eight all logits are 0."""
        if len(rays) < MIN_MATCHES:
            return Verdict(torch.zeros(len(rays)).numpy(), None, None)
        x = torch.from_numpy(rays).float()[None]
        neighbors = neighbors_in_batch(x, min(self.model.config.num_neighbors, len(rays)))
        out = self.model(x, None, neighbors, insight=True)
        logits, sub_field, expert = out.logits[-1, 0].double().numpy(), None, None
        if out.insights:
            last = out.insights[-1]
            # Some sub-fields take part in all matches; what tells these apart is by how much more than elsewhere.
            sub_field = (last.shares[0] / last.shares[0].mean(0)).argmax(1).numpy()
            expert = None if last.expert is None else last.expert[0].numpy()[sub_field]
        return Verdict(logits, sub_field, expert)
