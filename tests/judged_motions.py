"""A small network that scores transforms, and what it is given: channels, pairs to learn from, turns."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from corner_scenes import AT_ZERO, VOXEL, scene
from scipy.spatial.transform import Rotation

from geomoe3d.config import build_config
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.networks.aligned import CHANNELS, AlignedChannels
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.geomoe import GeoMoE
from geomoe3d.networks.inputs import collate, under_motions
from geomoe3d.networks.motion_inputs import MotionInputs
from geomoe3d.training.pairs import TrainingPair
from geomoe3d.types import FloatArray

SMALL: dict[str, Any] = {
    "num_layers": 2, "width": 16, "num_sub_fields": 6, "num_heads": 2, "expert_width": 4,
    "motion_form": "none", "embedding_norm": False, "extra_channels": ("aligned",), "knn_space": "source",
}  # fmt: skip


def aligned(rows: FloatArray, motions: FloatArray, views: Any = AT_ZERO) -> FloatArray:
    channels = AlignedChannels(rows, views, 2 * VOXEL)
    return channels(motions[:, :3, :3], motions[:, :3, 3]).astype(np.float64)


def column(channels: FloatArray, name: str) -> FloatArray:
    return channels[..., CHANNELS.index(name)]


def network(**changes: object) -> GeoMoE:
    torch.manual_seed(0)
    model = GeoMoE(build_config(NetworkConfig, {**SMALL, **changes})).train()
    rows, T = scene()
    batch = collate(
        under_motions(MotionInputs(rows, (None, None), VOXEL, model.config), T[None].repeat(3, 0))
    )
    model(batch.coordinates, batch.channels, batch.neighbors)
    return model.eval()


def training_pair(seed: int = 0) -> TrainingPair:
    rows, T = scene(seed)
    labels = np.linalg.norm(transform_points(T, rows[:, :3]) - rows[:, 3:], axis=1) < 2 * VOXEL
    return TrainingPair(rows.astype(np.float32), labels, T, VOXEL)


def turned(degrees: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return T
