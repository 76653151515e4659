"""From correspondences to what a network that scores transforms sees of them; numpy alone.

See `geomoe3d.networks.inputs` for networks that weigh correspondences.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomoe3d.clouds.keypoints import KeypointSurfaces
from geomoe3d.errors import InputError, NonFiniteError
from geomoe3d.networks.aligned import AlignedChannels
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.config import FIXED
from geomoe3d.networks.neighbors import nearest_rows
from geomoe3d.types import Float32Array, FloatArray


class MotionInputs:
    """Prepares one pair for a network that scores transforms; build once per pair, then ask for any motions.

    Args:
        correspondences: (N, 6) float, N >= 3, any unit.
        viewpoints: (3,) where the two sensors stood, same coordinates, or None for both.
        voxel_size: in the same unit.
        config: of a network with the channels ``aligned``.
        surfaces: of the correspondences in units of its compatibility threshold, where somebody has them.

    Attributes:
        coordinates: (N, 6) float32, centred, in network units.
        neighbors: (N, K) int64, the row itself first.

    Raises:
        InputError, NonFiniteError: see `centred_voxels`.
    """

    def __init__(
        self,
        correspondences: NDArray[Any],
        viewpoints: tuple[NDArray[Any] | None, NDArray[Any] | None],
        voxel_size: float,
        config: NetworkConfig,
        surfaces: KeypointSurfaces | None = None,
    ) -> None:
        points, voxels = centred_voxels(correspondences, voxel_size, config)
        self.coordinates: Float32Array = voxels / np.float32(config.unit_voxels)
        self.neighbors = nearest_rows(self.coordinates[:, :3], config.num_neighbors)
        threshold = config.compatibility_threshold * voxel_size
        self._aligned = AlignedChannels(points, viewpoints, threshold, surfaces)

    def channels(self, motions: FloatArray) -> Float32Array:
        """(K, N, C), under motions p_target = R p_source + t, (K, 4, 4), in the correspondences' frames."""
        return self._aligned(motions[:, :3, :3], motions[:, :3, 3])


def centred_voxels(
    correspondences: NDArray[Any], voxel_size: float, config: NetworkConfig
) -> tuple[FloatArray, Float32Array]:
    """The points (N, 2d) in double precision, and centred in voxels. Raises InputError: wrong shape, fewer
    than 3 rows, or a voxel size that is not positive; NonFiniteError: a coordinate is NaN or infinite."""
    points = np.asarray(correspondences, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != config.correspondence_dim:
        raise InputError(
            f"correspondences must be (N, {config.correspondence_dim}) for this network, found {points.shape}"
        )
    if len(points) < FIXED.min_correspondences:
        raise InputError(
            f"{len(points)} correspondences; the network needs at least {FIXED.min_correspondences}"
        )
    if not (np.isfinite(voxel_size) and voxel_size > 0):
        raise InputError(f"voxel_size must be positive, found {voxel_size}")
    if not np.isfinite(points).all():
        raise NonFiniteError("correspondences hold NaN or infinite coordinates; drop those rows first")
    return points, ((points - points.mean(axis=0)) / voxel_size).astype(np.float32)
