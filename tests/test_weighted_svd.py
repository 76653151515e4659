"""Weighted SVD: exact without outliers, SciPy's answer on noise."""

from __future__ import annotations

import numpy as np
import pytest
from estimator_problems import SVD, THRESHOLD, assert_motion, problem
from scipy.spatial.transform import Rotation

from geomoe3d.geometry.se3 import make_transform


def test_svd_is_exact_without_outliers_and_with_weights_that_remove_them() -> None:
    rows, T, true = problem(5, inliers=0.3)
    for found in (
        SVD(rows[true], inlier_threshold=THRESHOLD),
        SVD(rows, true.astype(float), inlier_threshold=THRESHOLD),
    ):
        assert_motion(found[0].T_target_source, T, degrees=1e-9, length=1e-10)
        assert found[0].proposal_score == pytest.approx(true.sum(), rel=1e-9)


def test_svd_equals_scipy_on_noisy_weighted_rows() -> None:
    rows, _, true = problem(6, inliers=0.5, noise=0.3)
    rows, weights = rows[true], np.random.default_rng(6).random(true.sum())
    means = np.average(rows, axis=0, weights=weights)
    oracle, _ = Rotation.align_vectors(*(rows - means)[:, [[3, 4, 5], [0, 1, 2]]].swapaxes(0, 1), weights)
    R = oracle.as_matrix()
    found = SVD(rows, weights, inlier_threshold=THRESHOLD)
    assert_motion(
        found[0].T_target_source, make_transform(R, means[3:] - R @ means[:3]), degrees=1e-6, length=1e-8
    )
