"""Consensus: the motion among many outliers, several hypotheses, bounded memory, each step by definition."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from estimator_problems import CONSENSUS, THRESHOLD, assert_motion, problem, random_motion, room_points
from scipy.spatial.distance import cdist

from geomoe3d.estimators import compatibility, fitting
from geomoe3d.estimators.consensus import ConsensusEstimator
from geomoe3d.geometry.rigid_fit import products
from geomoe3d.geometry.se3 import rotation_error_deg, transform_points

# ---- recovery ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_consensus_recovers_the_exact_motion_among_90_percent_structured_outliers(seed: int) -> None:
    rows, T, true = problem(seed)
    found = CONSENSUS(rows, inlier_threshold=THRESHOLD)
    assert_motion(found[0].T_target_source, T, degrees=0.2, length=0.02)
    # Outliers that agree with the motion by chance pull a little; without them the fit is exact.
    residuals = np.linalg.norm(transform_points(T, rows[:, :3]) - rows[:, 3:], axis=1)
    clean = true | (residuals > 2 * THRESHOLD)
    found = CONSENSUS(rows[clean], inlier_threshold=THRESHOLD)
    assert_motion(found[0].T_target_source, T)
    assert found[0].num_inliers == true.sum()


@pytest.mark.parametrize("seed", range(3))
def test_consensus_finds_few_noisy_inliers(seed: int) -> None:
    rows, T, true = problem(seed, count=1000, inliers=0.04, noise=0.01)
    found = ConsensusEstimator()(rows, inlier_threshold=THRESHOLD)
    assert_motion(found[0].T_target_source, T, degrees=2, length=0.1)
    assert found[0].num_inliers >= 0.9 * true.sum()


def test_consensus_says_what_is_settled_and_proposes_the_same_with_less(seed: int = 3) -> None:
    rows, T, true = problem(seed, count=1000, inliers=0.3, noise=0.01)
    found = ConsensusEstimator()(rows, inlier_threshold=THRESHOLD)
    assert [hypothesis.settled for hypothesis in found] == [True] + [False] * (len(found) - 1)
    assert_motion(found[0].T_target_source, T, degrees=0.5, length=0.05)
    assert found[0].num_inliers >= 0.95 * true.sum()
    longer = ConsensusEstimator(settled_share=1.0)(rows, inlier_threshold=THRESHOLD)
    assert not longer[0].settled
    np.testing.assert_allclose(found[0].T_target_source, longer[0].T_target_source, atol=1e-6)
    few, *_ = problem(seed, count=1000, inliers=0.02, noise=0.01)
    assert not any(h.settled for h in ConsensusEstimator()(few, inlier_threshold=THRESHOLD))


@pytest.mark.parametrize(
    ("count", "first", "second"),
    [(500, 300, 200), (2000, 400, 300), (2000, 600, 400)],
    ids=["all rows true", "more wrong rows than true", "more rows of the first motion than seeds"],
)
def test_consensus_keeps_two_motions_of_a_scene_best_first(count: int, first: int, second: int) -> None:
    """As in a building with two rooms alike: the second motion is what tells that the answer is ambiguous."""
    rng = np.random.default_rng(20)
    A, B = random_motion(21), random_motion(22)
    source = room_points(rng, count)
    moved = transform_points(A, source)
    moved[first:] = transform_points(B, source[first:])
    moved[first + second :] = transform_points(A, room_points(rng, count - first - second))
    moved += 0.005 * rng.normal(size=moved.shape)
    mixed = rng.permutation(count)
    rows = np.hstack([source, moved])[mixed]
    found = ConsensusEstimator()(rows, inlier_threshold=THRESHOLD)
    assert_motion(found[0].T_target_source, A, degrees=0.5, length=0.05)
    assert len(found) >= 2
    assert_motion(found[1].T_target_source, B, degrees=0.5, length=0.05)
    assert found[0].num_inliers == pytest.approx(first, abs=10)
    assert found[1].num_inliers == pytest.approx(second, abs=10)
    assert not any(hypothesis.settled for hypothesis in found)
    # Weights decide which of the two comes first.
    weights = np.where(np.arange(count) < first, 0.2, 1.0)[mixed]
    found = ConsensusEstimator()(rows, weights, inlier_threshold=THRESHOLD)
    assert_motion(found[0].T_target_source, B, degrees=0.5, length=0.05)


def test_consensus_hypotheses_are_distinct_sorted_and_counted_right() -> None:
    rng = np.random.default_rng(23)
    source = room_points(rng, 600)
    moved = np.concatenate(
        [transform_points(random_motion(30 + k), part) for k, part in enumerate(np.split(source, 6))]
    )
    rows = np.hstack([source, moved])
    for limit in (1, 2, 4, 15):
        found = ConsensusEstimator(num_hypotheses=limit)(rows, inlier_threshold=THRESHOLD)
        assert len(found) == limit or limit > 6
        assert len(found) >= min(limit, 6)
        scores = [h.proposal_score for h in found]
        assert scores == sorted(scores, reverse=True)
        for i, h in enumerate(found):
            T = h.T_target_source
            residuals = np.linalg.norm(transform_points(T, source) - moved, axis=1)
            assert h.num_inliers == (residuals < THRESHOLD).sum()
            assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
            for other in found[:i]:
                shift = np.linalg.norm((T - other.T_target_source) @ [*source.mean(0), 1])
                turn = rotation_error_deg(T, other.T_target_source)
                # The last fit in float64 may bring two hypotheses nearer by a little.
                assert turn > 14 or shift > 0.8 * 3 * THRESHOLD
    assert {np.argmin([rotation_error_deg(h.T_target_source, random_motion(30 + k)) for k in range(6)])
            for h in found[:6]} == set(range(6))  # fmt: skip


# ---- bounded memory ----------------------------------------------------------------------------------


def test_twelve_thousand_correspondences_stay_within_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """No table of all pairs of all rows; the heaviest rows propose, all rows are scored."""
    rows, T, true = problem(14, count=12_000, inliers=0.02, noise=0.005)
    weights = np.where(true, 1.0, 0.5)
    sizes = []
    plain = compatibility.distances
    monkeypatch.setattr(compatibility, "distances", lambda p, q: (sizes.append(len(q)), plain(p, q))[1])
    tracemalloc.start()
    found = ConsensusEstimator(max_dense=1000, num_seeds=100)(rows, weights, inlier_threshold=THRESHOLD)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert max(sizes) == 1000
    assert peak < 150e6  # one float32 table of all pairs would take 576 MB
    assert_motion(found[0].T_target_source, T, degrees=1, length=0.1)
    residuals = np.linalg.norm(transform_points(found[0].T_target_source, rows[:, :3]) - rows[:, 3:], axis=1)
    assert found[0].num_inliers == (residuals < THRESHOLD).sum() >= true.sum()


def test_default_bound_of_all_pairs() -> None:
    assert ConsensusEstimator().max_dense <= 5000  # 100 MB a table


# ---- the steps, against their definitions ------------------------------------------------------------


def test_distances_and_compatibility_equal_their_definitions() -> None:
    rng = np.random.default_rng(80)
    p, q = rng.normal(size=(2, 60, 3)).astype(np.float32) * 20
    np.testing.assert_allclose(
        compatibility.distances(*compatibility.distance_factors(p)), cdist(p, p), atol=0.05
    )
    q[:30] = p[:30]
    expected = np.abs(cdist(p, p) - cdist(q, q))
    close, compatible = compatibility.compatibility(p / 20, q / 20, 1 / 20)
    known = np.abs(cdist(p, p) / 20 - 1) > 1e-3
    assert (close == (cdist(p, p) / 20 < 1))[known & ~np.eye(60, dtype=bool)].all()
    assert close.any() and not close.all()
    sure = np.abs(expected - 1) > 1e-3
    off_diagonal = ~np.eye(60, dtype=bool)
    assert ((compatible == 1) == (expected < 1))[sure & off_diagonal].all()
    assert (compatible[:30, :30] == ~np.eye(30, dtype=bool)).all()
    assert set(np.unique(compatible)) == {0, 1}


def test_bundles_share_their_vote() -> None:
    target = np.array([[1.0, 2, 3], [1, 2, 3], [0, 0, 0], [1, 2, 3], [1, 2, 3], [5, 5, 5], [-0.0, 0, 0]])
    expected = 1 / np.sqrt([4, 4, 2, 4, 4, 1, 2])
    np.testing.assert_allclose(compatibility.bundle_weights(target), expected, rtol=1e-6)


def test_local_sets_are_the_best_by_second_order_compatibility() -> None:
    rng = np.random.default_rng(81)
    n, size = 40, 6
    compatible = (rng.random((n, n)) < 0.4).astype(np.float32)
    compatible = np.triu(compatible, 1) + np.triu(compatible, 1).T
    vote = rng.uniform(0.1, 1, n).astype(np.float32)
    seeds = np.array([3, 17, 39])
    witnesses = np.arange(0, n, 2)
    members, weights = compatibility.local_sets(compatible, seeds, vote, size, witnesses)
    assert members.shape == weights.shape == (3, size + 1)
    for row, seed in enumerate(seeds):
        S = [
            compatible[seed, j]
            * vote[j]
            * sum(compatible[seed, k] * vote[k] * compatible[k, j] for k in witnesses)
            for j in range(n)
        ]
        assert members[row, 0] == seed
        assert list(members[row, 1:]) == list(np.argsort(S)[::-1][:size])
        np.testing.assert_allclose(weights[row, 1:], np.sort(S)[::-1][:size], rtol=1e-4)
        assert weights[row, 0] == pytest.approx(max(S), rel=1e-3)


def test_seeds_are_the_best_supported_and_spread() -> None:
    rng = np.random.default_rng(82)
    points = rng.normal(size=(50, 3)).astype(np.float32) * 100
    points[:10] = points[0] + 0.01 * rng.normal(size=(10, 3))  # one bundle with the largest supports
    support = np.r_[np.linspace(50, 41, 10), np.linspace(40, 26, 40)].astype(np.float32)
    ranks = rng.permutation(50).astype(np.uint64)
    strength = compatibility.strengths(support, cdist(points, points) < 1)
    seeds = compatibility.choose_seeds(strength, ranks, 30)
    # 0 leads; all others of the bundle count half, less than any of the scattered ones. Three quarters of
    # the seeds are the strongest in that order, the others those of the rest that have the lowest ranks.
    order = [0, *range(10, 50), *range(1, 10)]
    assert list(seeds[:23]) == order[:23]
    assert list(seeds[23:]) == sorted(order[23:], key=lambda k: ranks[k])[:7]
    assert list(compatibility.choose_seeds(strength, ranks, 50)) == list(range(50))


def test_score_is_the_documented_sum() -> None:
    rng = np.random.default_rng(83)
    source, target = rng.normal(size=(2, 30, 3)).astype(np.float32)
    vote = rng.random(30).astype(np.float32)
    T = [random_motion(k, 0.3) for k in range(4)]
    R, t = np.array([x[:3, :3] for x in T]), np.array([x[:3, 3] for x in T])
    expected = [
        (vote * np.exp(-((transform_points(x, source) - target) ** 2).sum(1) / (2 * 0.75**2))).sum()
        for x in T
    ]
    np.testing.assert_allclose(fitting.score(R, t, products(source, target), vote), expected, rtol=1e-4)


def test_refit_leaves_a_motion_with_two_inliers() -> None:
    source = np.array([[0.0, 0, 0], [5, 0, 0], [0, 5, 0], [0, 0, 5]], dtype=np.float32)
    target = source + np.array([[0.1, 0, 0], [0.1, 0, 0], [30, 0, 0], [0, 30, 0]])
    R, t = np.eye(3, dtype=np.float32)[None], np.zeros((1, 3), dtype=np.float32)
    R_new, t_new = fitting.refit(R, t, products(source, target), np.ones(4, dtype=np.float32))
    np.testing.assert_array_equal(R_new, R)
    np.testing.assert_array_equal(t_new, t)
    target[2] = source[2] + [0.1, 0, 0]
    _, t_new = fitting.refit(R, t, products(source, target), np.ones(4, dtype=np.float32))
    np.testing.assert_allclose(t_new, [[0.1, 0, 0]], atol=1e-5)
