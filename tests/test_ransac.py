"""RANSAC: the motion found among half outliers, drawn by its seed."""

from __future__ import annotations

import pytest
from estimator_problems import RANSAC, THRESHOLD, assert_motion, problem

from geomoe3d.estimators.ransac import RansacEstimator


@pytest.mark.parametrize("seed", range(3))
def test_ransac_recovers_the_motion_among_half_outliers(seed: int) -> None:
    rows, T, true = problem(seed, inliers=0.5, noise=0.005)
    found = RANSAC(rows, inlier_threshold=THRESHOLD, seed=seed)
    assert len(found) == 1
    assert_motion(found[0].T_target_source, T, degrees=1, length=0.1)
    assert found[0].num_inliers >= 0.95 * true.sum()


def test_ransac_draws_by_its_seed() -> None:
    rows, _, _ = problem(13, inliers=0.05, noise=0.02)
    few = RansacEstimator(
        iterations=3000
    )  # too few among so many wrong rows: what is found depends on the draw
    answers = {few(rows, inlier_threshold=THRESHOLD, seed=s)[0].T_target_source.tobytes() for s in range(4)}
    assert len(answers) > 1
