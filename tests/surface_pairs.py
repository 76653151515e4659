"""Surfaces with a known shape, some sampled twice: to be prepared, refined and judged."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from geomoe3d.clouds.prepare import prepare
from geomoe3d.config import PreparationConfig
from geomoe3d.geometry.se3 import make_transform, transform_points
from geomoe3d.types import PointCloud, PreparedCloud

VOXEL = 0.1


def perturbation(rotation: np.ndarray, translation: np.ndarray, center: np.ndarray) -> np.ndarray:
    """p -> exp(rotation) (p - center) + center + translation."""
    R = Rotation.from_rotvec(rotation).as_matrix()
    return make_transform(R, center + translation - R @ center)


def surfaces(kind: str, seed: int = 0, count: int = 12_000) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 3, (count, 3))
    if kind == "corner":
        points[np.arange(count), rng.integers(0, 3, count)] = 0
    elif kind == "plane":
        points[:, 2] = 0
    elif kind == "channel":  # two planes: slides along their common line
        points[np.arange(count), rng.integers(0, 2, count)] = 0
    elif kind == "cylinder":
        angle = rng.uniform(0, 2 * np.pi, count)
        points[:, 0], points[:, 1] = np.cos(angle), np.sin(angle)
    elif kind == "sphere":
        points = points - 1.5
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    return points


def corner(rng: np.random.Generator, count: int = 4000, noise: float = 0.0) -> np.ndarray:
    """Three faces of a 2 m cube that meet at (0, 0, 0)."""
    points = rng.uniform(0, 2, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = 0
    return points + noise * rng.normal(size=points.shape)


def prepared(points: np.ndarray, voxel: float = VOXEL) -> PreparedCloud:
    return prepare(PointCloud(points), voxel, PreparationConfig(viewpoint="centroid"))


def motion(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return make_transform(Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3) * 3)


def pair(kind: str = "corner", seed: int = 0) -> tuple[PreparedCloud, PreparedCloud, np.ndarray]:
    """Two samples of one surface, and the motion between them."""
    T = motion(seed + 1)
    source, target = surfaces(kind, 2 * seed), surfaces(kind, 2 * seed + 1)
    return prepared(source), prepared(transform_points(T, target)), T
