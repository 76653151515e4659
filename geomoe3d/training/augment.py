"""Random changes of a training pair that keep its labels right, or nearly so (`bend`).

One or both clouds turned by any rotation, or up to an angle, and moved, roles exchanged, coordinates
jittered, bent as a drifting sensor bends them, correspondences left out. Scale needs none:
the network divides by the voxel size. Matches of two images are only exchanged and left out: their frame is
that of the camera.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from geomoe3d.config import Section
from geomoe3d.geometry.se3 import inverse, make_transform
from geomoe3d.training.pairs import TrainingPair
from geomoe3d.types import FloatArray


class AugmentationConfig(Section):
    """What may happen to a pair."""

    rotate: bool = Field(True, description="turn the clouds by random rotations, as the next two keys say")
    turned: Literal["both", "target"] = Field("both", description="which clouds are turned")
    largest_rotation_deg: float = Field(
        180.0,
        gt=0,
        le=180,
        description="largest angle, about any axis, angles evenly up to it; 180: uniform over rotations",
    )
    swap: float = Field(0.5, ge=0, le=1, description="chance that source and target change roles")
    jitter: float = Field(0.1, ge=0, description="largest shift of a coordinate, in voxels")
    bend: float = Field(
        0.0,
        ge=0,
        description="largest amplitude of a smooth bend of the clouds, in voxels: three waves, each of it "
        "over root three; labels stay those of the straight pair",
    )


def augment(
    pair: TrainingPair, config: AugmentationConfig, max_rows: int | None, rng: np.random.Generator
) -> TrainingPair:
    """A changed copy with at most ``max_rows`` correspondences (None: all), labels kept per row."""
    if max_rows is not None and len(pair) > max_rows:
        pair = pair.take(rng.permutation(len(pair))[:max_rows])
    halves = np.split(pair.correspondences.astype(np.float64), 2, axis=1)
    T = pair.T_target_source
    if rng.random() < config.swap:
        halves.reverse()
        T = inverse(T)
    if pair.correspondences.shape[1] == 4:
        return replace(pair, correspondences=np.hstack(halves).astype(np.float32), T_target_source=T)
    if config.rotate:
        # About each cloud's middle: origins far away would cost digits.
        middles = [half.mean(axis=0) for half in halves]
        A, B = (_turn(config.largest_rotation_deg, rng) for _ in range(2))
        if config.turned == "target":
            A = np.eye(3)
        halves = [(halves[0] - middles[0]) @ A.T, (halves[1] - middles[1]) @ B.T]
        R = B @ T[:3, :3] @ A.T
        T = make_transform(R, B @ (T[:3, :3] @ middles[0] + T[:3, 3] - middles[1]))
    if config.bend:
        halves = [_bent(half, config.bend, pair.voxel_size, rng) for half in halves]
    points = np.concatenate(halves, axis=1)
    if config.jitter:
        points = points + rng.uniform(-config.jitter, config.jitter, points.shape) * pair.voxel_size
    return replace(pair, correspondences=points.astype(np.float32), T_target_source=T)


def _turn(largest_deg: float, rng: np.random.Generator) -> FloatArray:
    """A random rotation (3, 3) of at most so many degrees."""
    if largest_deg == 180:
        return Rotation.from_quat(rng.normal(size=4)).as_matrix()
    axis = rng.normal(size=3)
    angle = np.radians(largest_deg) * rng.random()
    return Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle).as_matrix()


def _bent(points: FloatArray, most: float, voxel_size: float, rng: np.random.Generator) -> FloatArray:
    """Points (N, 3) moved by a sum of long waves; equal points stay equal."""
    waves = 3
    amplitude = rng.uniform(0, most) * voxel_size / np.sqrt(waves)
    moved: FloatArray = points.copy()
    for _ in range(waves):
        # Wavelengths of 1.5 to 7.5 m at 5 cm: from a piece of furniture to more than a fragment.
        low, high = np.log((30.0, 150.0))
        length = np.exp(rng.uniform(low, high)) * voxel_size
        along, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        phase = points @ along * (2 * np.pi / length) + rng.uniform(0, 2 * np.pi)
        moved += amplitude * np.sin(phase)[:, None] * shift
    return moved
