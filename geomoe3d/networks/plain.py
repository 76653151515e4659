"""Any trained network that weighs correspondences, GeoMoE or a baseline, run on one pair.

GeoMoE has a faster way (`geomoe3d.networks.folded`); this is the plain one, which serves all. Calls share
nothing and draw nothing at random; rows with a NaN or infinity get weight 0.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from geomoe3d.errors import CheckpointError
from geomoe3d.networks.build import Network
from geomoe3d.networks.config import FIXED
from geomoe3d.networks.inference import finite_part
from geomoe3d.networks.inputs import pair_input
from geomoe3d.networks.layers import weights_from_logits
from geomoe3d.networks.seeded_motions import motion_residuals, seeded_motion, spread_seeds
from geomoe3d.types import Correspondences, FilterOutput


class PlainNetwork:
    """A trained network that weighs the correspondences of one pair at a time.

    Weights are relu(tanh(logit)). A network that compares features (PointDSC) gives seeds and motions, as
    published: a row within r = 2 voxels under the best motion weighs 1 / (1 + (d / r)^2), any other nothing.

    Args:
        model: trained, not one that scores transforms.
    """

    def __init__(self, model: Network) -> None:
        if model.config.judges_motions:
            raise CheckpointError("this network scores transforms, see scoring.weights")
        self.config = model.config
        self._network = model.eval()

    @torch.no_grad()
    def __call__(self, correspondences: Correspondences, *, voxel_size: float) -> FilterOutput:
        """Weigh correspondences. With fewer than 3 finite rows all weights are 0. Raises InputError: the
        network was trained with a channel that these correspondences lack."""
        weights = np.zeros(len(correspondences))
        logits = np.full(len(correspondences), -np.inf)
        seen, part = finite_part(correspondences)
        if len(seen) < FIXED.min_correspondences:
            return FilterOutput(weights, logits=logits)
        wanted = set(self.config.extra_channels)
        channels = {
            name: getattr(part, name) for name in ("feature_distance", "ratio", "mutual") if name in wanted
        }
        given = pair_input(part.points, voxel_size, self.config, **channels)
        extra = None if given.channels is None else given.channels[None]
        out = self._network(given.coordinates[None], extra, given.neighbors[None])
        verdict = out.logits[-1, 0].double()
        kept = weights_from_logits(verdict)
        if out.similarity is not None:
            kept, verdict = self._under_best_motion(given.coordinates.double(), verdict, out.similarity[0])
        weights[seen] = kept.numpy()
        logits[seen] = verdict.numpy()
        return FilterOutput(weights, logits=logits)

    def _under_best_motion(
        self, coordinates: Tensor, verdict: Tensor, similarity: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Weights of the rows under the best motion of the seeds, and the log odds that these stand for."""
        source, target = coordinates[:, :3], coordinates[:, 3:]
        threshold = FIXED.threshold_voxels / self.config.unit_voxels
        apart = torch.cdist(source, source) - torch.cdist(target, target)
        affinity = similarity.double() * (1 - (apart / threshold).square()).clamp(min=0)
        seeds = spread_seeds(verdict, source, threshold)
        T = seeded_motion(coordinates, affinity, seeds, threshold)
        share = motion_residuals(T[None], source, target)[0] / threshold
        weights = (share < 1) / (1 + share.square())
        return weights, 1 - share
