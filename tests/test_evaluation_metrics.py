"""Measures of one pair: cases with answers known by hand, brute force, and the real ground truth."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geomoe3d.data.threedmatch import find_data_root, load_benchmark
from geomoe3d.errors import InputError
from geomoe3d.evaluation.metrics import (
    benchmark_rmse,
    has_motion,
    is_right,
    motion_errors,
    precision_recall_f1,
    score_pair,
)
from geomoe3d.evaluation.records import EvaluationPair, Labels, PairScore, Prediction
from geomoe3d.geometry.se3 import inverse, make_transform, rotation_angle_deg, transform_points

NOWHERE = Path("nowhere.ply")


def motion(seed: int, angle_deg: float | None = None, length: float | None = None) -> np.ndarray:
    """A random motion, with a given angle about a random axis and a given length of its translation."""
    rng = np.random.default_rng(seed)
    axis, t = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    angle = rng.uniform(0, math.pi) if angle_deg is None else math.radians(angle_deg)
    R = Rotation.from_rotvec(axis * angle).as_matrix()
    return make_transform(R, t * (rng.uniform(0, 3) if length is None else length))


def pair(T: np.ndarray | None, **changes) -> EvaluationPair:
    return EvaluationPair("room/0-2", "test", "room", NOWHERE, NOWHERE, T, **changes)


def prediction(T: np.ndarray | None, **changes) -> Prediction:
    plain = Prediction("room/0-2", T, None, None, (), None, None, 0.25, {"solve": 0.2}, 2**20)
    return dataclasses.replace(plain, **changes)


def score(T: np.ndarray | None, T_truth: np.ndarray | None, **changes) -> PairScore:
    return score_pair(pair(T_truth), prediction(T, **changes))


def off(T_truth: np.ndarray, seed: int, angle_deg: float, length: float) -> np.ndarray:
    """An estimate with exactly these errors: rotated by an angle, translated by a length."""
    error = motion(seed, angle_deg, length)
    return make_transform(error[:3, :3] @ T_truth[:3, :3], T_truth[:3, 3] + error[:3, 3])


# ---- rotation and translation error, right or not -------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_the_limits_are_strict(seed: int) -> None:
    """15 deg and 0.30 m exactly fail, whatever the last bit of the computed error."""
    truth = motion(seed)
    assert not score(off(truth, seed + 100, 15.0, 0.1), truth).right
    assert score(off(truth, seed + 100, 15.0 - 1e-6, 0.1), truth).right
    assert score(off(truth, seed + 100, 15.0, 0.1), truth).right_20
    assert not score(off(truth, seed + 100, 20.0, 0.1), truth).right_20
    assert score(off(truth, seed + 100, 20.0 - 1e-6, 0.1), truth).right_20
    for angle in (0.0, 3.0):
        at_limit, below = (score(off(truth, seed, angle, d), truth) for d in (0.30, 0.30 - 1e-6))
        assert not at_limit.right and not at_limit.right_20
        assert below.right and below.right_20


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-3, 14.0, 90.0, 179.0, 179.9999, 180.0])
@pytest.mark.parametrize("seed", range(4))
def test_errors_are_those_that_were_put_in(angle: float, seed: int) -> None:
    truth = motion(seed)
    found = score(off(truth, seed + 50, angle, 0.123), truth)
    assert found.rotation_error_deg == pytest.approx(angle, abs=2e-6 if angle > 179 else 1e-12, rel=1e-6)
    assert found.translation_error == pytest.approx(0.123, abs=1e-12)


@pytest.mark.parametrize(
    "T",
    [
        None,
        np.full((4, 4), np.nan),
        np.where(np.eye(4) == 1, np.eye(4), np.nan),
        np.diag([2.0, 2.0, 2.0, 1.0]),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.diag([1.0, 1.0, 1.0, 2.0]),
        np.zeros((4, 4)),
        np.eye(3),
        np.diag([1.0, 1.0, np.inf, 1.0]),
    ],
    ids=["none", "nan", "some nan", "scaled", "mirrored", "last row", "zero", "3x3", "inf"],
)
def test_no_rigid_motion_is_no_answer(T: np.ndarray | None) -> None:
    """The truth is the identity, so that a careless trace formula would call some of these right."""
    found = score_pair(pair(np.eye(4), information=np.eye(6)), prediction(T))
    assert not has_motion(T)
    assert found.rotation_error_deg == found.translation_error == found.rmse == math.inf
    assert not (found.right or found.right_20 or found.any_right)


def test_single_precision_is_a_motion() -> None:
    T = motion(3)
    assert has_motion(T.astype(np.float32).astype(np.float64))
    assert score(T.astype(np.float32).astype(np.float64), T).rotation_error_deg < 1e-4


def test_unrelated_scans_have_no_errors_and_nothing_is_right() -> None:
    labels = Labels(np.zeros(4, bool), np.ones(4, bool), np.ones(4, bool))
    found = score(np.eye(4), None, labels=labels, confidence=0.9, status="ok", hypotheses=(np.eye(4),))
    for name in ("rotation_error_deg", "translation_error", "rmse", "inlier_ratio", "f1", "verified_f1"):
        assert getattr(found, name) is None
    assert not (found.right or found.right_20 or found.any_right)
    assert (found.confidence, found.status) == (0.9, "ok")


def test_any_right_looks_at_answer_and_hypotheses() -> None:
    truth = motion(1)
    wrong, right = off(truth, 2, 40.0, 0.0), off(truth, 3, 5.0, 0.1)
    assert score(right, truth, hypotheses=(wrong,)).any_right
    found = score(wrong, truth, hypotheses=(wrong, np.full((4, 4), np.nan), right))
    assert found.any_right and not found.right
    assert score(None, truth, hypotheses=(right,)).any_right
    assert not score(wrong, truth, hypotheses=(wrong,)).any_right


def test_everything_else_is_passed_on() -> None:
    found = score_pair(pair(np.eye(4), overlap=0.4), prediction(None, error="too few", confidence=math.nan))
    assert (found.pair, found.scene, found.overlap) == ("room/0-2", "room", 0.4)
    assert (found.seconds, found.stages, found.peak_memory) == (0.25, {"solve": 0.2}, 2**20)
    assert found.error == "too few"
    assert found.confidence is None


def test_a_prediction_of_another_pair_is_refused() -> None:
    with pytest.raises(InputError, match=r"'room/0-9', not of 'room/0-2'"):
        score_pair(pair(np.eye(4)), prediction(np.eye(4), pair="room/0-9"))


def test_a_random_rotation_is_right_as_often_as_theory_says() -> None:
    """Share of SO(3) within an angle: (a - sin a) / pi."""
    rotations = Rotation.random(25000, random_state=0).as_matrix()
    for limit in (15.0, 20.0):
        expected = (math.radians(limit) - math.sin(math.radians(limit))) / math.pi
        hits = sum(is_right(rotation_angle_deg(R), 0.0, limit) for R in rotations)
        deviation = math.sqrt(expected * 25000)
        assert abs(hits - expected * 25000) < 4 * deviation
        assert hits > 8


# ---- the truth as published -----------------------------------------------------------------------


def test_raw_truth_has_the_floor_of_the_trace_formula() -> None:
    """A rotation shrunk by 3e-4: acos((3 (1 - 3e-4) - 1) / 2) = 1.716 deg for the perfect answer."""
    truth = motion(7)
    raw = truth.copy()
    raw[:3, :3] *= 1 - 3e-4
    with_raw = pair(truth, raw_T_target_source=raw)
    clean = score_pair(with_raw, prediction(truth))
    assert clean.rotation_error_deg == pytest.approx(0.0, abs=1e-12)
    found = score_pair(with_raw, prediction(truth), raw_truth=True)
    assert found.rotation_error_deg == pytest.approx(math.degrees(math.acos(1 - 4.5e-4)), rel=1e-9)
    assert found.right and found.any_right


def test_raw_truth_clamps_and_equals_the_other_formula_on_rotations() -> None:
    truth = motion(8)
    raw = truth.copy()
    raw[:3, :3] *= 1 + 3e-4
    grown = score_pair(pair(truth, raw_T_target_source=raw), prediction(truth), raw_truth=True)
    assert grown.rotation_error_deg == 0.0
    for seed in range(10):
        T = motion(seed)
        assert motion_errors(T, truth, raw=True) == pytest.approx(motion_errors(T, truth), rel=1e-7)


# ---- RMSE of gt.info ------------------------------------------------------------------------------


def information_of(points: np.ndarray) -> np.ndarray:
    """Sum of G^T G with G = [1, -[x]x], as the benchmark's files are made."""
    total = np.zeros((6, 6))
    for x, y, z in points:
        G = np.hstack([np.eye(3), -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])])
        total += G.T @ G
    return total


def displaced_by_half_rotation(T: np.ndarray, truth: np.ndarray, points: np.ndarray) -> float:
    """Root mean square of t + q_xyz x p over the points of the target, the motion as in gt.log."""
    delta = inverse(inverse(truth)) @ inverse(T)
    q = Rotation.from_matrix(delta[:3, :3]).as_quat(canonical=True)[:3]
    moved = delta[:3, 3] + np.cross(q, points)
    return float(np.sqrt((moved**2).sum(axis=1).mean()))


@pytest.mark.parametrize("seed", range(10))
def test_rmse_is_the_displacement_of_target_points_with_half_the_rotation(seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(60, 3)) * (1.0, 2.0, 0.5) + (3.0, 0.0, 1.0)
    truth = motion(seed)
    for angle in (0.1, 5.0, 60.0, 179.0):
        T = off(truth, seed + 10, angle, 0.2)
        found = benchmark_rmse(T, truth, information_of(points))
        assert found == pytest.approx(displaced_by_half_rotation(T, truth, points), rel=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_rmse_of_a_translation_is_true_and_of_a_rotation_half_true(seed: int) -> None:
    """Brute force over the points: T_source_target, estimated against true, in the source's frame."""
    points = np.random.default_rng(seed).normal(size=(200, 3)) * 2.0
    truth, information = motion(seed), information_of(points)

    def true_rms(T: np.ndarray) -> float:
        moved = transform_points(inverse(T), points) - transform_points(inverse(truth), points)
        return float(np.sqrt((moved**2).sum(axis=1).mean()))

    shifted = off(truth, seed, 0.0, 0.7)
    assert benchmark_rmse(shifted, truth, information) == pytest.approx(true_rms(shifted), rel=1e-9)
    for angle in (0.01, 1.0, 30.0, 170.0, 180.0):
        rotation = make_transform(motion(seed + 5, angle)[:3, :3], np.zeros(3))
        turned = rotation @ truth  # a pure rotation in the frame of the target
        assert benchmark_rmse(turned, truth, information) == pytest.approx(true_rms(turned) / 2, rel=1e-7)


def test_rmse_is_left_out_where_the_benchmark_leaves_it_out() -> None:
    T = motion(0)
    info = information_of(np.eye(3))
    assert score_pair(pair(T, information=info), prediction(T)).rmse == pytest.approx(0.0, abs=1e-12)
    assert score_pair(pair(T, information=info, consecutive=True), prediction(T)).rmse is None
    assert score_pair(pair(T), prediction(T)).rmse is None
    assert benchmark_rmse(T, T, np.zeros((6, 6))) is None
    assert benchmark_rmse(T, T, np.full((6, 6), np.nan)) is None


@pytest.mark.parametrize("angle", [0.5, 90.0, 180.0])
def test_a_truth_that_is_not_quite_a_rotation_counts_as_the_nearest_one(angle: float) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    truth = make_transform(motion(5)[:3, :3], np.zeros(3))
    T = make_transform(motion(6, angle)[:3, :3], np.zeros(3)) @ truth
    published = make_transform(truth[:3, :3] * 1.001, np.zeros(3))
    found = benchmark_rmse(T, published, information_of(points))
    assert found == pytest.approx(benchmark_rmse(T, truth, information_of(points)), rel=1e-9)


# ---- labels of correspondences --------------------------------------------------------------------


def mask(text: str) -> np.ndarray:
    return np.array([sign == "1" for sign in text], dtype=bool)


@pytest.mark.parametrize(
    ("labels", "truth", "expected"),
    [
        ("1100", "1110", (1.0, 2 / 3, 0.8)),
        ("1111", "1000", (0.25, 1.0, 0.4)),
        ("0000", "1100", (0.0, 0.0, 0.0)),
        ("1100", "0000", (0.0, 0.0, 0.0)),
        ("0000", "0000", (0.0, 0.0, 0.0)),
        ("0011", "1100", (0.0, 0.0, 0.0)),
        ("", "", (0.0, 0.0, 0.0)),
        ("1010", "1010", (1.0, 1.0, 1.0)),
    ],
)
def test_precision_recall_f1_by_hand(labels: str, truth: str, expected: tuple[float, ...]) -> None:
    assert precision_recall_f1(mask(labels), mask(truth)) == pytest.approx(expected)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=30))
def test_f1_is_the_harmonic_mean(rows: list[tuple[bool, bool]]) -> None:
    labels, truth = (np.array([row[k] for row in rows], dtype=bool) for k in (0, 1))
    precision, recall, f1 = precision_recall_f1(labels, truth)
    expected = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    assert f1 == pytest.approx(expected)


def test_labels_are_measured_both_ways() -> None:
    labels = Labels(mask("1100"), mask("1111"), mask("0100"))
    found = score(np.eye(4), np.eye(4), labels=labels)
    assert found.inlier_ratio == 0.5
    assert (found.precision, found.recall, found.f1) == pytest.approx((0.5, 1.0, 2 / 3))
    verified = (found.verified_precision, found.verified_recall, found.verified_f1)
    assert verified == pytest.approx((1.0, 0.5, 2 / 3))


def test_an_empty_prediction_scores_0() -> None:
    nothing = np.zeros(0, dtype=bool)
    found = score(None, np.eye(4), labels=Labels(nothing, nothing, nothing))
    assert found.precision == found.recall == found.f1 == found.verified_f1 == found.inlier_ratio == 0.0
    assert not found.right


def test_labels_that_a_method_does_not_make_are_none() -> None:
    found = score(np.eye(4), np.eye(4), labels=Labels(mask("10"), None, mask("10")))
    assert found.precision is found.recall is found.f1 is None
    assert found.verified_f1 == 1.0
    found = score(np.eye(4), np.eye(4))
    assert (
        found.inlier_ratio is found.verified_precision is found.verified_recall is found.verified_f1 is None
    )


# ---- the real ground truth ------------------------------------------------------------------------


def real_pairs(benchmark: str) -> list[EvaluationPair]:
    try:
        root = find_data_root()
    except InputError as error:
        pytest.skip(str(error))
    clean, raw = (load_benchmark(root, benchmark, raw=flag) for flag in (False, True))
    return [
        EvaluationPair(
            f"{one.scene}/{one.source_index}-{one.target_index}",
            benchmark,
            one.scene,
            one.source,
            one.target,
            one.T_target_source,
            written.T_target_source,
            one.overlap,
            one.information,
            one.target_index - one.source_index == 1,
        )
        for one, written in zip(clean, raw, strict=True)
    ]


def answered(pairs: list[EvaluationPair], answer, raw_truth: bool = False) -> list[PairScore]:
    return [
        score_pair(one, prediction(answer(one.T_target_source), pair=one.id), raw_truth=raw_truth)
        for one in pairs
    ]


@pytest.mark.real_data
@pytest.mark.parametrize(("benchmark", "count"), [("3DMatch", 843), ("3DLoMatch", 1044)])
def test_on_real_pairs_the_truth_is_right_and_its_inverse_is_not(benchmark: str, count: int) -> None:
    pairs = real_pairs(benchmark)
    assert len(pairs) == count
    perfect = answered(pairs, lambda T: T)
    assert all(one.right and one.right_20 for one in perfect)
    defined = [one.rmse for one in perfect if one.rmse is not None]
    assert len(defined) == sum(not one.consecutive for one in pairs)
    assert max(defined) < 1e-12
    # Only where the scans hardly moved, and that a motion and its inverse are near, may the inverse pass.
    for one, truth in zip(answered(pairs, inverse), pairs, strict=True):
        T = truth.T_target_source
        back_and_forth = rotation_angle_deg(T[:3, :3] @ T[:3, :3])
        way = np.linalg.norm(T[:3, 3] + T[:3, :3].T @ T[:3, 3])
        assert one.right == (back_and_forth < 15 and way < 0.30)
        assert one.rotation_error_deg == pytest.approx(back_and_forth, abs=1e-6)
    moved = [
        one
        for one, truth in zip(answered(pairs, inverse), pairs, strict=True)
        if rotation_angle_deg(truth.T_target_source[:3, :3]) > 10
    ]
    assert len(moved) > 0.8 * count
    assert sum(one.right for one in moved) <= 0.01 * count


@pytest.mark.real_data
@pytest.mark.parametrize("benchmark", ["3DMatch", "3DLoMatch"])
def test_on_real_pairs_raw_truth_has_a_floor_in_redkitchen_only(benchmark: str) -> None:
    pairs = real_pairs(benchmark)
    found = answered(pairs, lambda T: T, raw_truth=True)
    assert all(one.right for one in found)
    kitchen = [one.rotation_error_deg for one in found if "redkitchen" in one.scene]
    others = [one.rotation_error_deg for one in found if "redkitchen" not in one.scene]
    assert 1.0 < max(kitchen) < 1.52
    assert max(others) < 0.23
    assert max(one.rmse for one in found if one.rmse is not None) < 1e-12


@pytest.mark.real_data
def test_on_real_pairs_the_information_counts_points_of_the_target() -> None:
    """A shift of 1 m is an RMSE of 1 m in every frame; the matrices are sums of G^T G."""
    for one in real_pairs("3DMatch")[::20]:
        info = one.information
        assert info is not None
        assert info[0, 0] == pytest.approx(round(info[0, 0]), abs=1e-6)
        shifted = one.T_target_source.copy()
        shifted[:3, 3] += shifted[:3, :3] @ np.array([0.6, 0.0, 0.8])
        assert benchmark_rmse(shifted, one.T_target_source, info) == pytest.approx(1.0, rel=1e-6)
