"""Random changes of a training pair that keep its labels right.

Clouds turned by any rotation and moved, roles exchanged, coordinates jittered, correspondences left out.
Scale needs none: the network divides by the voxel size.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from geomoe3d.config import Section
from geomoe3d.training.pairs import TrainingPair
from geomoe3d.types import FloatArray


class AugmentationConfig(Section):
    """What may happen to a pair."""

    rotate: bool = Field(True, description="turn each cloud by a uniform random rotation")
    swap: float = Field(0.5, ge=0, le=1, description="chance that source and target change roles")
    jitter: float = Field(0.1, ge=0, description="largest shift of a coordinate, in voxels")


def augment(
    pair: TrainingPair, config: AugmentationConfig, max_rows: int | None, rng: np.random.Generator
) -> TrainingPair:
    """A changed copy with at most ``max_rows`` correspondences (None: all), labels kept per row."""
    if max_rows is not None and len(pair) > max_rows:
        pair = pair.take(rng.permutation(len(pair))[:max_rows])
    halves = [pair.correspondences[:, :3].astype(np.float64), pair.correspondences[:, 3:].astype(np.float64)]
    T = pair.T_target_source
    if rng.random() < config.swap:
        halves.reverse()
        R = T[:3, :3].T
        T = _motion(R, -R @ T[:3, 3])
    if config.rotate:
        # About each cloud's middle: origins far away would cost digits.
        middles = [half.mean(axis=0) for half in halves]
        A, B = (Rotation.from_quat(rng.normal(size=4)).as_matrix() for _ in range(2))
        halves = [(halves[0] - middles[0]) @ A.T, (halves[1] - middles[1]) @ B.T]
        R = B @ T[:3, :3] @ A.T
        T = _motion(R, B @ (T[:3, :3] @ middles[0] + T[:3, 3] - middles[1]))
    points = np.concatenate(halves, axis=1)
    if config.jitter:
        points = points + rng.uniform(-config.jitter, config.jitter, points.shape) * pair.voxel_size
    return replace(pair, correspondences=points.astype(np.float32), T_target_source=T)


def _motion(R: FloatArray, t: FloatArray) -> FloatArray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T
