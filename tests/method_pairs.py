"""Pairs with a known motion for the methods of an evaluation, and whether an answer lands on it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from geomoe3d.evaluation.records import MethodInput
from geomoe3d.geometry.se3 import make_transform, rotation_error_deg, transform_points, translation_error

MOTION = make_transform(Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix(), np.array([1.5, -0.5, 2.0]))


def correspondences(share: float = 0.6, seed: int = 0, count: int = 300) -> np.ndarray:
    """Rows (count, 6) in a room, a share of which agree with MOTION up to 1 cm."""
    rng = np.random.default_rng(seed)
    source = rng.uniform(-2, 2, (count, 3))
    target = transform_points(MOTION, source) + rng.normal(0, 0.01, (count, 3))
    wrong = rng.permutation(count)[: round((1 - share) * count)]
    target[wrong] = rng.uniform(-3, 3, (len(wrong), 3)) + MOTION[:3, 3]
    return np.hstack([source, target])


def pair_of(rows: np.ndarray, seed: int = 0) -> MethodInput:
    return MethodInput("room/0-1", correspondences=rows, seed=seed)


def lands(
    T: np.ndarray | None, truth: np.ndarray = MOTION, degrees: float = 1.0, metres: float = 0.05
) -> bool:
    return T is not None and (rotation_error_deg(T, truth) < degrees and translation_error(T, truth) < metres)
