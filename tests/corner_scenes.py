"""Correspondences of one corner that two sensors see, each from zero of its own frame."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from geomoe3d.geometry.se3 import make_transform, transform_points
from geomoe3d.types import FloatArray

VOXEL = 0.05


def random_motion(rng: np.random.Generator) -> FloatArray:
    return make_transform(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-2, 2, 3))


def seen_corner(rng: np.random.Generator, count: int) -> FloatArray:
    """Points on a floor and two walls, seen from the sensor at zero in front of them."""
    u, v = rng.uniform(-1.5, 1.5, (2, count))
    side = rng.integers(3, size=count)
    floor = np.stack([u, np.full(count, -1.0), v + 3], 1)
    back = np.stack([u, v + 0.5, np.full(count, 4.5)], 1)
    left = np.stack([np.full(count, -1.5), v + 0.5, u + 3], 1)
    return np.where((side == 0)[:, None], floor, np.where((side == 1)[:, None], back, left))


def scene(seed: int = 0, count: int = 300, share: float = 0.4) -> tuple[FloatArray, FloatArray]:
    """Correspondences (N, 6) of one corner seen twice, the first ``share`` true, and the true motion."""
    rng = np.random.default_rng(seed)
    source = seen_corner(rng, count)
    T = make_transform(Rotation.from_rotvec([0.05, 0.3, -0.1]).as_matrix(), np.array([0.3, -0.1, 0.2]))
    target = transform_points(T, seen_corner(rng, count))
    right = np.arange(count) < share * count
    target[right] = transform_points(T, source[right]) + rng.normal(0, 0.01, (int(right.sum()), 3))
    return np.hstack([source, target]), T


AT_ZERO = (np.zeros(3), np.zeros(3))
