"""What every estimator keeps to: invariances, degenerate and invalid input, the same answer every time."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from estimator_problems import (
    ALL,
    CONSENSUS,
    RANSAC,
    ROBUST,
    SVD,
    THRESHOLD,
    assert_motion,
    line,
    problem,
    random_motion,
    room_points,
)

from geomoe3d.config import EstimatorConfig
from geomoe3d.errors import InputError
from geomoe3d.estimators.base import estimator as estimators
from geomoe3d.estimators.consensus import ConsensusEstimator
from geomoe3d.estimators.ransac import RansacEstimator
from geomoe3d.estimators.weighted_svd import WeightedSvdEstimator
from geomoe3d.geometry.se3 import inverse, transform_points


@ALL
@pytest.mark.parametrize("seed", range(3))
def test_three_correspondences_are_enough(estimator, seed: int) -> None:
    rng, T = np.random.default_rng(seed), random_motion(seed)
    source = np.array([[0.0, 0, 0], [2, 0.3, 0], [0.5, 1.5, 1]]) + 0.1 * rng.normal(size=(3, 3))
    found = estimator(np.hstack([source, transform_points(T, source)]), inlier_threshold=THRESHOLD)
    assert_motion(found[0].T_target_source, T, degrees=1e-3, length=1e-4)
    assert found[0].num_inliers == 3


def test_a_mirrored_scene_is_not_called_a_fit() -> None:
    source = room_points(np.random.default_rng(24), 300)
    rows = np.hstack([source, source * [1, 1, -1]])
    for estimator in (CONSENSUS, RANSAC, SVD):
        found = estimator(rows, inlier_threshold=THRESHOLD)
        assert found  # what is flat fits all the same
        for h in found:
            assert np.linalg.det(h.T_target_source[:3, :3]) == pytest.approx(1)
            assert h.num_inliers < 200


# ---- what must not matter, and what must follow -------------------------------------------------------


@ALL
@pytest.mark.parametrize("seed", range(3))
def test_moving_the_clouds_moves_the_answer(estimator, seed: int) -> None:
    rows, _, true = problem(seed, inliers=0.3, noise=0.005)
    if estimator is SVD:
        rows = rows[true]
    A, B = random_motion(seed + 50), random_motion(seed + 60)
    moved = np.hstack([transform_points(A, rows[:, :3]), transform_points(B, rows[:, 3:])])
    T = estimator(rows, inlier_threshold=THRESHOLD)[0].T_target_source
    T_moved = estimator(moved, inlier_threshold=THRESHOLD)[0].T_target_source
    # RANSAC gives its best sample, which rounding may change; the others are exact.
    loose = estimator is RANSAC
    assert_motion(T_moved, B @ T @ inverse(A), degrees=1 if loose else 1e-3, length=0.1 if loose else 1e-4)


@ALL
@pytest.mark.parametrize("scale", [1e-3, 1e3, 1024.0])
def test_the_unit_of_length_does_not_matter(estimator, scale: float) -> None:
    rows, _, true = problem(3, inliers=0.3, noise=0.005)
    if estimator is SVD:
        rows = rows[true]
    a = estimator(rows, inlier_threshold=THRESHOLD)[0]
    b = estimator(rows * scale, inlier_threshold=THRESHOLD * scale)[0]
    T = b.T_target_source.copy()
    T[:3, 3] /= scale
    loose = estimator is RANSAC
    assert_motion(T, a.T_target_source, degrees=1 if loose else 1e-3, length=0.1 if loose else 1e-4)
    if scale == 1024.0 and not loose:  # a power of two leaves every digit
        np.testing.assert_array_equal(T, a.T_target_source)
        assert b.proposal_score == a.proposal_score


@ALL
def test_the_order_of_rows_does_not_matter(estimator) -> None:
    rows, _, true = problem(4, inliers=0.3, noise=0.005)
    if estimator is SVD:
        rows = rows[true]
    weights = np.random.default_rng(4).uniform(0.5, 1, len(rows))
    order = np.random.default_rng(5).permutation(len(rows))
    a = estimator(rows, weights, inlier_threshold=THRESHOLD)[0]
    b = estimator(rows[order], weights[order], inlier_threshold=THRESHOLD)[0]
    loose = estimator is RANSAC
    assert_motion(
        b.T_target_source, a.T_target_source, degrees=1 if loose else 1e-3, length=0.1 if loose else 1e-4
    )


@ALL
def test_exchanging_the_clouds_inverts_the_answer(estimator) -> None:
    rows, _, true = problem(8, inliers=0.3)
    if estimator is SVD:
        rows = rows[true]
    a = estimator(rows, inlier_threshold=THRESHOLD)[0]
    b = estimator(rows[:, [3, 4, 5, 0, 1, 2]], inlier_threshold=THRESHOLD)[0]
    assert_motion(b.T_target_source, inverse(a.T_target_source), degrees=1, length=0.1)


@ALL
def test_weight_zero_is_absence(estimator) -> None:
    rows, _, true = problem(9, inliers=0.4)
    weights = np.where(true, 0.7, 0.0)
    a = estimator(rows, weights, inlier_threshold=THRESHOLD, seed=3)
    b = estimator(rows[true], weights[true], inlier_threshold=THRESHOLD, seed=3)
    assert len(a) == len(b) > 0
    for x, y in zip(a, b, strict=True):
        np.testing.assert_allclose(x.T_target_source, y.T_target_source, atol=1e-12)
        assert x.proposal_score == pytest.approx(y.proposal_score, rel=1e-9)


@ALL
@pytest.mark.parametrize("scale", [1e-30, 1e-6, 1e6, 1e30])
def test_scaling_all_weights_keeps_the_motion(estimator, scale: float) -> None:
    rows, _, true = problem(9, inliers=0.4)
    weights = np.where(true, 0.7, 0.01)
    a = estimator(rows, weights, inlier_threshold=THRESHOLD)[0]
    b = estimator(rows, weights * scale, inlier_threshold=THRESHOLD)[0]
    np.testing.assert_allclose(a.T_target_source, b.T_target_source, atol=1e-9)


@ALL
def test_lists_and_float32_are_taken_and_inputs_stay_as_they_are(estimator) -> None:
    rows, T, true = problem(10, inliers=0.5)
    rows, weights = rows[true], np.ones(true.sum())
    rows_before, weights_before = rows.copy(), weights.copy()
    expected = estimator(rows, weights, inlier_threshold=THRESHOLD)[0]
    np.testing.assert_array_equal(rows, rows_before)
    np.testing.assert_array_equal(weights, weights_before)
    listed = estimator(rows.tolist(), weights.tolist(), inlier_threshold=THRESHOLD)[0]
    # Open3D's RANSAC adds up in the order in which its threads finish.
    np.testing.assert_allclose(listed.T_target_source, expected.T_target_source, rtol=0, atol=1e-12)
    found = estimator(rows.astype(np.float32), inlier_threshold=THRESHOLD)[0]
    assert found.T_target_source.dtype == np.float64
    assert_motion(found.T_target_source, T, degrees=0.1, length=0.01)


def test_consensus_and_svd_do_not_mind_coordinates_far_away() -> None:
    rows, T, true = problem(11, inliers=0.3)
    far = np.array([583394.0, 5283100.0, 498.0])
    for estimator, data in ((CONSENSUS, rows), (SVD, rows[true])):
        near = estimator(data, inlier_threshold=THRESHOLD)[0].T_target_source
        T = estimator(data + np.tile(far, 2), inlier_threshold=THRESHOLD)[0].T_target_source
        moved = transform_points(T, data[:, :3] + far) - far
        assert np.abs(moved - transform_points(near, data[:, :3])).max() < 1e-4


# ---- nothing to be found, nothing to be made up ------------------------------------------------------


@ALL
@pytest.mark.parametrize(
    "source",
    [
        np.zeros((0, 3)),
        np.array([[1.0, 2, 3]]),
        np.array([[1.0, 2, 3], [3, 2, 1]]),
        np.full((10, 3), 2.5),
        line(3),
        line(40),
        np.repeat([[0.0, 0, 0], [1, 2, 0.5]], 10, axis=0),
    ],
    ids=["none", "one", "two", "coincident", "3 on a line", "40 on a line", "two places"],
)
def test_undetermined_motions_are_not_given(estimator, source: np.ndarray) -> None:
    T = random_motion(70)
    rows = np.hstack([source, transform_points(T, source)])
    assert estimator(rows, inlier_threshold=THRESHOLD) == []
    assert estimator(rows, np.zeros(len(rows)), inlier_threshold=THRESHOLD) == []


@ALL
def test_a_line_is_not_saved_by_rows_of_weight_zero(estimator) -> None:
    rows, T, true = problem(12, inliers=0.5)
    rows = rows[true]
    rows[:20] = np.hstack([line(20), transform_points(T, line(20))])
    weights = (np.arange(len(rows)) < 20).astype(float)
    assert estimator(rows, weights, inlier_threshold=THRESHOLD) == []
    assert estimator(rows, (np.arange(len(rows)) < 2).astype(float), inlier_threshold=THRESHOLD) == []


@ALL
def test_targets_on_one_point_determine_nothing(estimator) -> None:
    source = room_points(np.random.default_rng(71), 50)
    assert estimator(np.hstack([source, np.ones((50, 3))]), inlier_threshold=THRESHOLD) == []
    assert estimator(np.hstack([np.ones((50, 3)), source]), inlier_threshold=THRESHOLD) == []


@ROBUST
def test_garbage_gives_no_identity(estimator) -> None:
    """Random rows: nothing, or a motion that at least three rows follow; by chance some do."""
    num_found = 0
    for seed in range(5):
        rows = np.random.default_rng(seed).uniform(-5, 5, (30, 6))
        for h in estimator(rows, inlier_threshold=0.5, seed=seed):
            T = h.T_target_source
            assert not np.allclose(T, np.eye(4))
            residuals = np.linalg.norm(transform_points(T, rows[:, :3]) - rows[:, 3:], axis=1)
            assert h.num_inliers == (residuals < 0.5).sum() >= 3
            num_found += 1
    assert num_found > 0


@pytest.mark.parametrize("count", [4, 10])
def test_rows_that_agree_about_no_length_give_nothing(count: int) -> None:
    source = np.random.default_rng(count).normal(size=(count, 3))
    rows = np.hstack([source, 10 * source])
    for estimator in (CONSENSUS, RANSAC):
        assert estimator(rows, inlier_threshold=0.01) == []


@ROBUST
def test_inliers_on_a_line_are_no_motion(estimator) -> None:
    """Twenty true rows on one line leave the turn about it free, whatever the wrong rows look like."""
    T, wrong = random_motion(1), np.random.default_rng(0).uniform(-5, 5, (8, 6))
    rows = np.vstack([np.hstack([line(20), transform_points(T, line(20))]), wrong])
    assert estimator(rows, inlier_threshold=THRESHOLD) == []
    beside = room_points(np.random.default_rng(0), 5)  # these do not leave it free
    rows = np.vstack([rows, np.hstack([beside, transform_points(T, beside)])])
    found = estimator(rows, inlier_threshold=THRESHOLD)
    assert_motion(found[0].T_target_source, T)
    assert found[0].num_inliers == 25


GOOD = np.hstack([room_points(np.random.default_rng(0), 10)] * 2)


@ALL
@pytest.mark.parametrize(
    ("rows", "weights", "threshold", "message"),
    [
        (GOOD[:, :5], None, 0.1, r"\(N, 6\).*\(10, 5\)"),
        (GOOD[0], None, 0.1, r"\(N, 6\)"),
        (GOOD[None], None, 0.1, r"\(N, 6\)"),
        (np.where(np.arange(60).reshape(10, 6) == 27, np.nan, GOOD), None, 0.1, "correspondence 4 .*NaN"),
        (np.where(np.arange(60).reshape(10, 6) == 27, np.inf, GOOD), None, 0.1, "correspondence 4 "),
        (GOOD, np.ones(9), 0.1, r"shape \(10,\).*\(9,\)"),
        (GOOD, np.ones((10, 1)), 0.1, r"shape \(10,\)"),
        (GOOD, np.r_[np.ones(9), -1e-9], 0.1, "negative"),
        (GOOD, np.r_[np.ones(9), np.nan], 0.1, "finite"),
        (GOOD, np.r_[np.ones(9), np.inf], 0.1, "finite"),
        (GOOD, None, 0.0, "inlier_threshold.*0"),
        (GOOD, None, -1.0, "inlier_threshold.*-1"),
        (GOOD, None, np.nan, "inlier_threshold"),
        (GOOD, None, np.inf, "inlier_threshold"),
    ],
)
def test_invalid_input_is_named(estimator, rows, weights, threshold: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        estimator(rows, weights, inlier_threshold=threshold)


@pytest.mark.parametrize("name", ["consensus", "ransac", "svd"])
def test_configuration_reaches_the_estimator(name: str) -> None:
    config = EstimatorConfig(name=name, num_hypotheses=3, ransac_iterations=123, ransac_confidence=0.5)
    made = estimators.make(config)
    expected = {
        "consensus": ConsensusEstimator(num_hypotheses=3),
        "ransac": RansacEstimator(iterations=123, confidence=0.5),
        "svd": WeightedSvdEstimator(),
    }
    assert made == expected[name]


# ---- the same answer every time ----------------------------------------------------------------------
THREADS_SCRIPT = """
from functools import partial

import numpy as np
from geomoe3d.estimators.consensus import ConsensusEstimator
from geomoe3d.estimators.ransac import RansacEstimator
from geomoe3d.estimators.surroundings import Surroundings
from geomoe3d.estimators.weighted_svd import WeightedSvdEstimator
from geomoe3d.types import Correspondences

def asking(estimator, rows):
    zero = np.zeros(3)
    around = Surroundings.of(Correspondences(rows, viewpoints=(zero, zero)), 0.1)
    return partial(estimator, surroundings=around)

def show(name, estimator, rows, weights):
    for h in estimator(rows, weights, inlier_threshold=0.1, seed=5):
        print(name, len(rows), h.T_target_source.tobytes().hex(), h.proposal_score.hex(), h.num_inliers)

for seed, count in ((0, 300), (1, 1500), (2, 4000), (3, 40000)):
    rng = np.random.default_rng(seed)
    R, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    R *= np.linalg.det(R)
    source = rng.uniform(-2, 2, (count, 3))
    target = source @ R.T + [1, 2, 3] + 0.02 * rng.normal(size=source.shape)
    weights = rng.random(count)
    rows = np.hstack([source, target])
    show("svd", WeightedSvdEstimator(), rows, weights)
    wrong = rng.random(count) < 0.8
    target[wrong] = target[rng.integers(0, max(count // 2, 1), count)][wrong]
    rows = np.hstack([source, target])
    show("consensus", ConsensusEstimator(max_dense=2500, num_seeds=200), rows, weights)
    show("asking", asking(ConsensusEstimator(max_dense=2500, num_seeds=200), rows), rows, weights)
    show("ransac", RansacEstimator(iterations=2000), rows[:4000], weights[:4000])
"""


def test_the_same_bytes_for_any_number_of_threads() -> None:
    """Every estimator, in fresh processes with one and two threads."""
    answers = []
    for threads in ("1", "2", "2"):
        names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
        done = subprocess.run(
            [sys.executable, "-c", THREADS_SCRIPT],
            env={**os.environ, **dict.fromkeys(names, threads)},
            capture_output=True,
            text=True,
            timeout=300,
            check=True,
        )
        answers.append(done.stdout.splitlines())
    lines = {answer.split()[0] for answer in answers[0]}
    assert lines == {"svd", "consensus", "asking", "ransac"}
    assert answers[1] == answers[2], "two runs with two threads differ"
    differing = {tuple(a.split()[:2]) for a, b in zip(*answers[:2], strict=True) if a != b}
    assert not differing, "one thread and two threads differ"


@ROBUST
def test_the_same_bytes_twice_whatever_was_drawn_before(estimator) -> None:
    rows, _, _ = problem(13, inliers=0.3, noise=0.01)
    first = estimator(rows, inlier_threshold=THRESHOLD, seed=7)
    np.random.default_rng().random(10)
    estimator(rows, inlier_threshold=THRESHOLD, seed=8)
    second = estimator(rows, inlier_threshold=THRESHOLD, seed=7)
    assert [h.T_target_source.tobytes() for h in first] == [h.T_target_source.tobytes() for h in second]
    assert [(h.proposal_score, h.num_inliers) for h in first] == [
        (h.proposal_score, h.num_inliers) for h in second
    ]
