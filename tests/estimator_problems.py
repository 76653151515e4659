"""Correspondences with a known motion and structured outliers, and the estimators that are tried on them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomoe3d.estimators.consensus import ConsensusEstimator
from geomoe3d.estimators.ransac import RansacEstimator
from geomoe3d.estimators.weighted_svd import WeightedSvdEstimator
from geomoe3d.geometry.se3 import make_transform, rotation_error_deg, transform_points, translation_error

THRESHOLD = 0.1
CONSENSUS = ConsensusEstimator(num_seeds=100)
RANSAC = RansacEstimator(iterations=5000)
SVD = WeightedSvdEstimator()
ALL = pytest.mark.parametrize("estimator", [CONSENSUS, RANSAC, SVD], ids=["consensus", "ransac", "svd"])
ROBUST = pytest.mark.parametrize("estimator", [CONSENSUS, RANSAC], ids=["consensus", "ransac"])


def random_motion(seed: int, reach: float = 3.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return make_transform(Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3) * reach)


def room_points(rng: np.random.Generator, count: int) -> np.ndarray:
    """Points on the floor, two walls and a box of a 5 x 4 x 2.5 m room."""
    points = rng.uniform(0, 1, (count, 3)) * [5, 4, 2.5]
    face = rng.integers(0, 4, count)
    points[face == 0, 2], points[face == 1, 0], points[face == 2, 1] = 0, 0, 4
    box = face == 3
    points[box] = points[box] * 0.25 + [2, 1, 0]
    return points


def problem(
    seed: int, count: int = 600, inliers: float = 0.1, noise: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Correspondences, the true motion and which rows are true.

    Of the wrong rows a third is random, a third falls in bundles on few target points, and a third lies on
    the right walls but slid along them, which preserves many lengths nearly.
    """
    rng = np.random.default_rng(seed)
    T = random_motion(seed + 1000)
    source = room_points(rng, count)
    target = source.copy()
    true = np.zeros(count, dtype=bool)
    true[rng.permutation(count)[: round(inliers * count)]] = True
    wrong = np.flatnonzero(~true)
    random, bundled, slid = np.array_split(wrong, 3)
    target[random] = room_points(rng, len(random))
    target[bundled] = room_points(rng, max(3, len(bundled) // 10))[
        rng.integers(0, max(3, len(bundled) // 10), len(bundled))
    ]
    target[slid] += rng.uniform(0.3, 1.5, (len(slid), 1)) * np.eye(3)[rng.integers(0, 3, len(slid))]
    target += noise * rng.normal(size=target.shape)
    return np.hstack([source, transform_points(T, target)]), T, true


def assert_motion(
    found: np.ndarray, expected: np.ndarray, degrees: float = 1e-4, length: float = 1e-5
) -> None:
    assert rotation_error_deg(found, expected) < degrees
    assert translation_error(found, expected) < length
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-9)
    np.testing.assert_array_equal(found[3], [0, 0, 0, 1])


def line(count: int) -> np.ndarray:
    return np.outer(np.linspace(0, 4, count), [1.0, 0.5, 0.2])
