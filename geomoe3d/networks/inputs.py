"""From correspondences in any unit and frame to what the network sees.

Each half is centred on its own mean and divided by the voxel size (and by a fixed number of voxels), in
float64, so neither the unit nor the clouds' origins matter. Extra channels and neighbours are found per
pair, before anything is padded. Cost: a k-d tree, or the compatibility table.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from geomoe3d.errors import InputError, NonFiniteError
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.compatibility import compatibility_inputs
from geomoe3d.networks.frames import canonical_rotations
from geomoe3d.networks.geomoe import find_neighbors
from geomoe3d.networks.motion_inputs import MotionInputs, centred_voxels


@dataclass(frozen=True)
class PairInput:
    """One pair as the network sees it.

    Attributes:
        coordinates: (N, 2d) float32, centred, in network units.
        channels: (N, C) float32 extra channels, or None.
        neighbors: (N, K) int64, the row itself first.
        turned: rotations (3, 3) that source and target were turned by, or None where they were not.
    """

    coordinates: Tensor
    channels: Tensor | None
    neighbors: Tensor
    turned: tuple[Tensor, Tensor] | None = None


@dataclass(frozen=True)
class BatchInput:
    """Several pairs, padded to the longest; the arguments of `GeoMoE.forward`.

    Attributes:
        coordinates: (B, N, 2d) float32, 0 at padding.
        channels: (B, N, C) float32 or None.
        neighbors: (B, N, K) int64; padding is its own neighbour.
        mask: (B, N) bool, or None where all pairs are equally long.
    """

    coordinates: Tensor
    channels: Tensor | None
    neighbors: Tensor
    mask: Tensor | None

    def to(self, device: torch.device | str) -> BatchInput:
        """The same batch on another device."""

        def move(x: Tensor | None) -> Tensor | None:
            return None if x is None else x.to(device, non_blocking=True)

        return BatchInput(
            self.coordinates.to(device, non_blocking=True),
            move(self.channels),
            self.neighbors.to(device, non_blocking=True),
            move(self.mask),
        )


def pair_input(
    correspondences: NDArray[Any] | Tensor,
    voxel_size: float,
    config: NetworkConfig,
    *,
    feature_distance: NDArray[Any] | Tensor | None = None,
    ratio: NDArray[Any] | Tensor | None = None,
    mutual: NDArray[Any] | Tensor | None = None,
) -> PairInput:
    """Prepare one pair.

    Args:
        correspondences: (N, 2d) float, N >= 3, rows [source, target], any unit.
        voxel_size: in the same unit; 1 for image points.
        config: of the network that is to see them.
        feature_distance: (N,) needed if the configuration names this channel; likewise the others.
        ratio: (N,) distance over that of the second best match.
        mutual: (N,) bool.

    Raises:
        InputError: wrong shape, fewer than 3 rows, a voxel size that is not positive, or a channel that
            the network was trained with and that is not given.
        NonFiniteError: a coordinate is NaN or infinite.
    """
    points, voxels = map(torch.from_numpy, centred_voxels(np.asarray(correspondences), voxel_size, config))
    turned = None
    if config.frame != "given":
        A, B = turned = canonical_rotations(points, voxel_size, config.frame)
        voxels = torch.cat([voxels[:, :3] @ A.T.float(), voxels[:, 3:] @ B.T.float()], dim=1)
    coordinates = voxels / config.unit_voxels
    if config.judges_motions:
        raise InputError("this network scores transforms; prepare it with MotionInputs, which is given some")
    given = {"feature_distance": feature_distance, "ratio": ratio, "mutual": mutual}
    compatibility = compatibility_inputs(voxels, config) if config.needs_compatibility else None
    channels: list[Tensor] = []
    for name in config.extra_channels:
        if name in given:
            channels.append(_column(name, given[name], voxels))
        elif compatibility is not None:
            chosen = compatibility.channels if name == "compatibility" else compatibility.hypotheses
            assert chosen is not None
            channels.append(chosen)
    if config.knn_space == "compatibility":
        assert compatibility is not None
        neighbors = compatibility.neighbors
    else:
        neighbors = find_neighbors(coordinates[None], config)[0]
    return PairInput(coordinates, torch.cat(channels, dim=1) if channels else None, neighbors, turned)


def under_motions(inputs: MotionInputs, motions: NDArray[Any]) -> list[PairInput]:
    """One input for each motion (K, 4, 4), for a network that judges them."""
    coordinates, neighbors = torch.from_numpy(inputs.coordinates), torch.from_numpy(inputs.neighbors)
    return [
        PairInput(coordinates, channels, neighbors) for channels in torch.from_numpy(inputs.channels(motions))
    ]


def collate(pairs: list[PairInput]) -> BatchInput:
    """Pad pairs to the longest and stack them."""
    lengths = [len(pair.coordinates) for pair in pairs]
    longest = max(lengths)
    coordinates = torch.stack([_pad(pair.coordinates, longest) for pair in pairs])
    channels = None
    if pairs[0].channels is not None:
        channels = torch.stack([_pad(pair.channels, longest) for pair in pairs if pair.channels is not None])
    num_neighbors = pairs[0].neighbors.shape[1]
    neighbors = torch.arange(longest)[None, :, None].repeat(len(pairs), 1, num_neighbors)
    for i, pair in enumerate(pairs):
        neighbors[i, : lengths[i]] = pair.neighbors
    mask = None
    if min(lengths) < longest:
        mask = torch.arange(longest)[None] < torch.tensor(lengths)[:, None]
    return BatchInput(coordinates, channels, neighbors, mask)


def _column(name: str, values: NDArray[Any] | Tensor | None, like: Tensor) -> Tensor:
    if values is None:
        raise InputError(
            f"this network was trained with the channel '{name}', which these correspondences do not have; "
            f"give it, or use weights without it"
        )
    column = torch.as_tensor(values).to(like.dtype)
    if column.shape != like.shape[:1]:
        raise InputError(f"'{name}' must have shape ({len(like)},), found {tuple(column.shape)}")
    if not bool(torch.isfinite(column).all()):
        raise NonFiniteError(f"'{name}' holds NaN or infinite values")
    return column[:, None]


def _pad(x: Tensor, length: int) -> Tensor:
    return torch.nn.functional.pad(x, (0, 0, 0, length - len(x)))
