"""What surfaces around correspondences say of pairs and motions: against definitions, on made-up rooms."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomoe3d.clouds.pair import Pair
from geomoe3d.clouds.range_image import RangeImage
from geomoe3d.config import EstimatorConfig, MatchingConfig
from geomoe3d.errors import InputError
from geomoe3d.estimators.base import Estimator
from geomoe3d.estimators.compatibility import compatibility
from geomoe3d.estimators.consensus import ConsensusEstimator
from geomoe3d.estimators.fitting import score
from geomoe3d.estimators.proposals import propose
from geomoe3d.estimators.surroundings import Surroundings
from geomoe3d.geometry.rigid_fit import products
from geomoe3d.geometry.se3 import make_transform, rotation_error_deg, transform_points
from geomoe3d.matching.nearest import match
from geomoe3d.training import motions
from geomoe3d.training.pairs import TrainingPair
from geomoe3d.types import Correspondences, PreparedCloud

THRESHOLD = 0.1
ALL = slice(0, None)


def room(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points inside a 5 x 4 x 2.5 m box's faces, sensor at zero, and normals turned to it."""
    half = np.array([2.5, 2.0, 1.25])
    points = rng.uniform(-1, 1, (count, 3)) * half
    axis, sign = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
    points[np.arange(count), axis] = sign * half[axis]
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = -sign
    return points, normals


def motion(seed: int, shift: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return make_transform(Rotation.from_quat(rng.normal(size=4)).as_matrix(), rng.normal(size=3) * shift)


def rows_of(seed: int, count: int, inliers: int) -> tuple[Correspondences, np.ndarray]:
    """Correspondences of a room with its normals, the first ``inliers`` true, and the motion."""
    rng = np.random.default_rng(seed)
    T = motion(seed + 500)
    p, n = room(rng, count)
    q, m = room(rng, count)
    q[:inliers], m[:inliers] = p[:inliers], n[:inliers]
    q, m = transform_points(T, q), m @ T[:3, :3].T
    return Correspondences(np.hstack([p, q]), normals=(n, m), normals_signed=True), T


def surroundings_of(seed: int = 0, count: int = 60, inliers: int = 20) -> tuple[Surroundings, np.ndarray]:
    given, T = rows_of(seed, count, inliers)
    return Surroundings.of(given, THRESHOLD), T


def pair_agreement(around: Surroundings) -> np.ndarray:
    p, q = ((x - x.mean(0)).astype(np.float32) for x in around.points)
    apart = np.linalg.norm(p[:, None] - p[None], axis=2)
    return around.of_pairs(p, q)(ALL, apart)


@pytest.mark.parametrize("signed", [True, False])
def test_pairs_agree_as_documented(signed: bool) -> None:
    around = replace(surroundings_of()[0], signed=signed)
    found = pair_agreement(around)
    p, q = around.points
    n, m = around.normals
    for i, j in ((0, 1), (3, 50), (40, 41), (59, 7)):
        apart = max(np.linalg.norm(p[i] - p[j]), 1.0)
        heights = [(n[i] @ (p[j] - p[i]), m[i] @ (q[j] - q[i])), (n[j] @ (p[i] - p[j]), m[j] @ (q[i] - q[j]))]
        turn = (n[i] @ n[j], m[i] @ m[j])
        if not signed:
            heights, turn = [tuple(np.abs(h)) for h in heights], tuple(np.abs(turn))
        error = sum((a - b) ** 2 for a, b in heights) / (2 * (0.3 * apart) ** 2)
        error += (turn[0] - turn[1]) ** 2 / (2 * 0.35**2)
        assert found[i, j] == pytest.approx(0.1 + 0.9 * np.exp(-error), abs=2e-3)
    assert found.min() >= 0.1 and found.max() <= 1 + 1e-6
    np.testing.assert_allclose(found, found.T, atol=1e-5)


def test_true_pairs_agree_and_wrong_ones_mostly_do_not() -> None:
    found = pair_agreement(surroundings_of(1, 200, 50)[0])
    assert found[:50, :50].min() > 0.999
    assert np.median(found[50:, 50:]) < 0.3


def test_signs_count_only_where_they_are_known() -> None:
    around, _ = surroundings_of(2)
    n, m = around.normals
    flipped = replace(around, normals=(n, -m))
    assert np.abs(pair_agreement(flipped) - pair_agreement(around)).max() > 0.5
    unsigned, unsigned_flipped = replace(around, signed=False), replace(flipped, signed=False)
    np.testing.assert_allclose(pair_agreement(unsigned), pair_agreement(unsigned_flipped), atol=1e-6)
    R = np.eye(3)[None]
    np.testing.assert_allclose(unsigned.matched(R), unsigned_flipped.matched(R), atol=1e-6)


def test_compatibility_weighs_lengths_by_planes() -> None:
    around, _ = surroundings_of(3)
    p, q = ((x - x.mean(0)).astype(np.float32) for x in around.points)
    _, lengths = compatibility(p, q)
    _, both = compatibility(p, q, surroundings=around)
    expected = lengths * pair_agreement(around)
    np.testing.assert_allclose(both, expected, atol=2e-3)
    assert (both[lengths == 0] == 0).all() and (both[lengths == 1] > 0).all()


def test_matched_normals_weigh_as_documented() -> None:
    around, T = surroundings_of(4)
    R = np.stack([T[:3, :3], motion(9)[:3, :3]])
    n, m = around.normals
    cosine = np.einsum("kij,nj,ni->kn", R, n, m)
    np.testing.assert_allclose(around.matched(R), np.maximum(0.3 + 0.7 * cosine, 0.05), atol=1e-5)
    assert (around.matched(R)[0, :20] > 0.999).all()


def test_score_weighs_each_term_by_its_normals() -> None:
    around, T = surroundings_of(5)
    p, q = (x.astype(np.float32) for x in around.points)
    vote = np.ones(len(p), dtype=np.float32)
    R, t = T[None, :3, :3].astype(np.float32), (T[None, :3, 3] / THRESHOLD).astype(np.float32)
    kernel = np.exp(-((p @ R[0].T + t[0] - q) ** 2).sum(1) / (2 * 0.75**2))
    found = score(R, t, products(p, q), vote, around)
    assert found[0] == pytest.approx((kernel * around.matched(R)[0]).sum(), rel=1e-3)


def test_points_in_the_others_free_space_make_a_motion_implausible() -> None:
    rng = np.random.default_rng(6)
    p, n = room(rng, 900)
    zero = np.zeros(3)
    given = Correspondences(np.hstack([p, p]), viewpoints=(zero, zero), normals=(n, n), normals_signed=True)
    around = Surroundings.of(given, THRESHOLD)
    R = np.repeat(np.eye(3)[None], 3, axis=0)
    t = np.array([[0, 0, 0], [0.05, 0, 0], [1.0, 0, 0]]) / THRESHOLD  # the last puts a wall inside
    found = around.plausibility(R, t)
    assert found[0] > 0.99 and found[1] > 0.9 and found[2] < 0.3
    assert ((found > 0) & (found <= 1)).all()
    blind = Surroundings.of(replace(given, viewpoints=None), THRESHOLD)
    assert blind.views is None
    np.testing.assert_array_equal(blind.plausibility(R, t), np.ones(3))


def test_plausibility_does_not_depend_on_the_frames() -> None:
    rng = np.random.default_rng(7)
    p, n = room(rng, 600)
    zero = np.zeros(3)
    wrong = make_transform(Rotation.from_euler("z", 20, degrees=True).as_matrix(), np.array([0.6, 0.2, 0.0]))
    A, B = motion(70), motion(71)
    factors = []
    for S, U in ((np.eye(4), np.eye(4)), (A, B)):
        rows = np.hstack([transform_points(S, p), transform_points(U, p)])
        views = (transform_points(S, zero[None])[0], transform_points(U, zero[None])[0])
        given = Correspondences(rows, viewpoints=views, normals=(n @ S[:3, :3].T, n @ U[:3, :3].T))
        T = U @ wrong @ np.linalg.inv(S)
        around = Surroundings.of(given, THRESHOLD)
        factors.append(around.plausibility(T[None, :3, :3], T[None, :3, 3] / THRESHOLD)[0])
    assert 0 < factors[0] < 0.9
    assert factors[0] == pytest.approx(factors[1], rel=0.5)  # pixels lie otherwise


def test_normals_are_fitted_to_the_keypoints_where_none_are_given() -> None:
    rng = np.random.default_rng(8)
    p, n = room(rng, 800)
    rows = np.hstack([p, p])
    rows[400:, 3:] = rows[:400, 3:]  # matches that share a target point
    zero = np.zeros(3)
    around = Surroundings.of(Correspondences(rows, viewpoints=(zero, zero)), THRESHOLD)
    assert around.signed
    cosine = np.einsum("ni,ni->n", around.normals[0], n)
    assert np.mean(cosine > 0.95) > 0.7  # near an edge a plane goes through both sides of it
    np.testing.assert_array_equal(around.normals[1][:400], around.normals[1][400:])
    assert not Surroundings.of(Correspondences(rows), THRESHOLD).signed


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_few_correspondences_have_surroundings_too(count: int) -> None:
    rows = np.random.default_rng(9).normal(size=(count, 6))
    zero = np.zeros(3)
    around = Surroundings.of(Correspondences(rows, viewpoints=(zero, zero)), THRESHOLD)
    assert np.isfinite(around.normals[0]).all() and np.isfinite(pair_agreement(around)).all()
    assert np.isfinite(around.plausibility(np.eye(3)[None], np.zeros((1, 3)))).all()


def test_taking_some_keeps_the_rest_in_step() -> None:
    around, _ = surroundings_of(10)
    some = around.take(np.array([5, 3]))
    np.testing.assert_array_equal(some.normals[1], around.normals[1][[5, 3]])
    np.testing.assert_array_equal(some.points[0], around.points[0][[5, 3]])


def test_planes_find_inliers_that_lengths_alone_do_not() -> None:
    alone, helped = [], []
    for seed in range(10):
        given, T = rows_of(20 + seed, 1000, 5)
        noise = np.random.default_rng(seed).normal(size=given.points.shape)
        given = replace(given, points=given.points + 0.03 * noise)
        around = Surroundings.of(given, THRESHOLD)
        for found, near in ((alone, None), (helped, around)):
            guesses = ConsensusEstimator()(given.points, inlier_threshold=THRESHOLD, surroundings=near)
            found.append(any(rotation_error_deg(h.T_target_source, T) < 5 for h in guesses))
    assert sum(helped) >= 9 > sum(alone), (helped, alone)


def two_motions(seed: int) -> tuple[Correspondences, Surroundings, np.ndarray, np.ndarray]:
    """Rows for the true motion and somewhat more for one that walks a wall into the room, sensors apart.

    Normals say nothing here; what the sensors saw is the whole room, not the rows' own points.
    """
    rng = np.random.default_rng(seed)
    S, U = motion(seed + 1, 40.0), motion(seed + 2, 40.0)
    D = make_transform(Rotation.from_euler("z", 30, degrees=True).as_matrix(), np.array([0.9, 0.3, 0.0]))
    p, _ = room(rng, 420)
    q = p.copy()
    q[200:] = transform_points(D, q[200:])
    rows = np.hstack([transform_points(S, p), transform_points(U, q)])
    scan, _ = room(rng, 4000)
    views = []
    for frame, place in ((S, [1.5, -1.0, 0.4]), (U, [-1.2, 1.1, -0.3])):
        seen = transform_points(frame, np.vstack([scan, [place]]))
        views.append(RangeImage.of(seen[:-1] / THRESHOLD, seen[-1] / THRESHOLD, 5.0))
    zero = np.zeros((420, 3), dtype=np.float32)
    points = (rows[:, :3] / THRESHOLD, rows[:, 3:] / THRESHOLD)
    around = Surroundings((zero, zero), True, points, (views[0], views[1]))
    back = np.linalg.inv(S)
    return Correspondences(rows), around, U @ back, U @ D @ back


@pytest.mark.parametrize("seed", range(4))
def test_free_space_decides_between_two_motions(seed: int) -> None:
    given, around, right, wrong = two_motions(seed)
    for near, expected in ((replace(around, views=None), wrong), (around, right)):
        best = ConsensusEstimator()(given.points, inlier_threshold=THRESHOLD, surroundings=near)[0]
        assert rotation_error_deg(best.T_target_source, expected) < 2


@pytest.mark.parametrize("seed", range(4))
def test_each_scan_is_asked_about_the_other(seed: int) -> None:
    _, around, right, wrong = two_motions(seed)
    true = transform_points(right, around.points[0] * THRESHOLD) / THRESHOLD
    around = replace(around, points=(around.points[0], true))
    assert around.views is not None
    first, second = around.views
    nothing = RangeImage.of(np.array([[1e6, 0.0, 0.0]]), np.zeros(3), 5.0)
    R, t = np.stack([right, wrong])[:, :3, :3], np.stack([right, wrong])[:, :3, 3] / THRESHOLD
    for views in ((first, nothing), (nothing, second)):
        of_right, of_wrong = replace(around, views=views).plausibility(R, t)
        assert of_right > 0.8 > 0.4 > of_wrong


def test_rows_of_weight_zero_are_as_if_absent() -> None:
    given, _ = rows_of(14, 300, 60)
    around = Surroundings.of(given, THRESHOLD)
    weights = (np.arange(300) % 3 > 0) * 1.0
    estimate = ConsensusEstimator()
    some = estimate(given.points, weights, inlier_threshold=THRESHOLD, surroundings=around)
    rows = weights > 0
    alone = estimate(given.points[rows], inlier_threshold=THRESHOLD, surroundings=around.take(rows))
    assert len(some) > 0
    for a, b in zip(some, alone, strict=True):
        np.testing.assert_array_equal(a.T_target_source, b.T_target_source)


def test_more_rows_than_are_compared_keep_their_surroundings() -> None:
    given, T = rows_of(15, 1000, 100)
    weights = np.where(np.arange(1000) % 2 == 0, 1.0, 0.5)  # the heavy half takes part in proposing
    estimate = ConsensusEstimator(max_dense=500, num_seeds=200)
    asking = partial(estimate, surroundings=Surroundings.of(given, THRESHOLD))
    best = asking(given.points, weights, inlier_threshold=THRESHOLD)[0]
    assert rotation_error_deg(best.T_target_source, T) < 1
    assert best.num_inliers >= 100


def test_a_normal_that_is_no_number_spoils_nothing_else() -> None:
    given, T = rows_of(16, 300, 60)
    assert given.normals is not None
    given.normals[0][7] = np.nan
    asking = partial(ConsensusEstimator(), surroundings=Surroundings.of(given, THRESHOLD))
    assert rotation_error_deg(asking(given.points, inlier_threshold=THRESHOLD)[0].T_target_source, T) < 1


def test_motions_for_training_are_proposed_with_the_sensors_at_zero(monkeypatch) -> None:
    seen = []
    monkeypatch.setattr(motions, "propose", lambda estimate, pair, *_: seen.append(pair.matched) or [])
    points = np.random.default_rng(17).normal(size=(20, 6)).astype(np.float32)
    motions.with_motions(TrainingPair(points, np.ones(20, dtype=bool), np.eye(4), 0.05))
    np.testing.assert_array_equal(seen[0].viewpoints, np.zeros((2, 3)))


def test_matching_hands_on_the_normals() -> None:
    rng = np.random.default_rng(11)
    features = np.abs(rng.normal(size=(50, 33))).astype(np.float32)
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    p, n = room(rng, 50)
    source = PreparedCloud(p, n, features, 0.05, np.zeros(3), np.zeros(3))
    order = rng.permutation(50)
    target = replace(source, points=p[order], normals=-n[order], features=features[order])
    found = match(source, target, MatchingConfig(max_correspondences=20))
    assert len(found) == 20 and found.normals is not None and found.normals_signed
    np.testing.assert_array_equal(found.normals[0], n[found.source_index])
    np.testing.assert_array_equal(found.normals[1], -n[order][found.target_index])
    assert not match(source, replace(target, viewpoint=None), MatchingConfig()).normals_signed


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda rows: rows.__setitem__((3, 2), np.nan), "correspondence 3 holds a NaN"),
        (lambda rows: rows.__setitem__((4, 5), np.inf), "correspondence 4 holds a NaN"),
    ],
)
def test_bad_rows_are_named_before_anything_is_fitted_to_them(spoil, message) -> None:
    rows = np.random.default_rng(13).normal(size=(50, 6))
    spoil(rows)
    with pytest.raises(InputError, match=message):
        pair = Pair(Correspondences(rows), THRESHOLD / 2, THRESHOLD)
        propose(ConsensusEstimator(), pair, np.ones(50), EstimatorConfig())


def test_proposing_hands_the_surroundings_to_the_estimator() -> None:
    given, _ = rows_of(12, 100, 30)
    given = replace(given, mutual=np.arange(100) < 40)
    seen = []

    class Asking(Estimator):
        uses_surroundings = True

        def __call__(self, correspondences, weights=None, *, inlier_threshold, seed=0, surroundings=None):
            seen.append((np.asarray(correspondences), surroundings))
            return []

    config = EstimatorConfig(mutual_round=True)
    propose(Asking(), Pair(given, THRESHOLD / 2, THRESHOLD), np.ones(100), config)
    assert [len(rows) for rows, _ in seen] == [100, 40]
    for rows, around in seen:
        np.testing.assert_allclose(around.points[0] * THRESHOLD, rows[:, :3], atol=1e-12)
        np.testing.assert_array_equal(around.normals[0], given.normals[0][: len(rows)].astype(np.float32))
