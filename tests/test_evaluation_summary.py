"""Summaries of whole runs: predictors whose recall is known, hand-made means, and the time it takes."""

from __future__ import annotations

import dataclasses
import math
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomoe3d.errors import InputError
from geomoe3d.evaluation.records import EvaluationPair, Labels, Prediction, RunInfo, RunScore
from geomoe3d.evaluation.summary import TITLES, summarise, title
from geomoe3d.geometry.se3 import make_transform

NOWHERE = Path("nowhere.ply")
INFO = RunInfo("ours", "geomoe", "1k", "test", {}, "abc1234", "2 cores", 0, "geomoe3d evaluate", "2025-01-01")


def benchmark(sizes: dict[str, int], seed: int = 0, **changes) -> list[EvaluationPair]:
    rng = np.random.default_rng(seed)
    return [
        dataclasses.replace(
            EvaluationPair(
                f"{scene}/0-{k + 1}",
                "test",
                scene,
                NOWHERE,
                NOWHERE,
                make_transform(Rotation.random(random_state=rng).as_matrix(), rng.uniform(1, 3, size=3)),
                information=np.diag([9.0, 9.0, 9.0, 30.0, 30.0, 30.0]),
                consecutive=k == 0,
            ),
            **changes,
        )
        for scene, size in sizes.items()
        for k in range(size)
    ]


def answer(pair: EvaluationPair, T: np.ndarray | None, **changes) -> Prediction:
    plain = Prediction(pair.id, T, None, None, (), None, None, 0.25, {}, None)
    return dataclasses.replace(plain, **changes)


def shifted(pair: EvaluationPair, length: float) -> np.ndarray:
    T = pair.T_target_source.copy()
    T[2, 3] += length
    return T


def values(run: RunScore, *names: str) -> tuple[float, ...]:
    return tuple(run.measures[name].value for name in names)


RECALLS = (
    "recall_15",
    "recall_15_scene_mean",
    "recall_20",
    "recall_20_scene_mean",
    "rmse_recall",
    "rmse_recall_scene_mean",
    "any_recall_15",
)


# ---- predictors ---------------------------------------------------------------------------------------


def test_a_perfect_predictor_is_always_right() -> None:
    pairs = benchmark({"a": 7, "b": 3})
    run = summarise(INFO, pairs, [answer(pair, pair.T_target_source) for pair in pairs])
    assert values(run, *RECALLS) == (100.0,) * 7
    assert values(run, "rotation_q90", "translation_q90", "no_answer", "errors") == pytest.approx((0,) * 4)
    assert run.measures["rmse_recall"].count == 8
    assert run.measures["recall_15"].interval[0] == pytest.approx(72.2467, abs=1e-3)
    assert (run.num_pairs, run.num_missing) == (10, 0)


@pytest.mark.parametrize("T", [np.eye(4), None, np.full((4, 4), np.nan)], ids=["identity", "none", "nan"])
def test_identity_and_silence_are_never_right(T: np.ndarray | None) -> None:
    """The true translations are at least 1.7 m long."""
    pairs = benchmark({"a": 7, "b": 3})
    run = summarise(INFO, pairs, [answer(pair, T) for pair in pairs])
    assert values(run, *RECALLS) == (0.0,) * 7
    assert run.measures["rotation_median"].count == 0
    assert math.isnan(run.measures["rotation_median"].value)
    silent = T is None or bool(np.isnan(T).any())
    assert run.measures["no_answer"].value == (100.0 if silent else 0.0)
    assert math.isinf(run.measures["rotation_q25"].value) == silent


def test_a_predictor_that_is_right_at_random_has_that_recall() -> None:
    rng = np.random.default_rng(0)
    pairs = benchmark({"a": 600, "b": 200})
    run = summarise(
        INFO, pairs, [answer(pair, shifted(pair, 0.0 if rng.random() < 0.7 else 5.0)) for pair in pairs]
    )
    found = run.measures["recall_15"]
    assert found.interval[0] < 70.0 < found.interval[1]
    assert found.interval[1] - found.interval[0] == pytest.approx(2 * 196 * math.sqrt(0.21 / 800), rel=0.15)


def test_an_empty_run_and_an_empty_prediction() -> None:
    pairs = benchmark({"a": 2})
    run = summarise(INFO, pairs, [])
    assert (run.num_pairs, run.num_missing, run.pairs) == (2, 2, ())
    assert math.isnan(run.measures["recall_15"].value) and run.measures["recall_15"].count == 0
    nothing = np.zeros(0, dtype=bool)
    empty = [answer(p, None, labels=Labels(nothing, nothing, nothing), error="too few") for p in pairs]
    run = summarise(INFO, pairs, empty)
    assert values(run, "recall_15", "f1", "verified_f1", "precision", "recall") == (0.0,) * 5
    assert values(run, "no_answer", "errors") == (100.0, 100.0)


# ---- by hand ------------------------------------------------------------------------------------------


def test_pair_mean_scene_mean_and_rmse_by_hand() -> None:
    """Scene a: 4 pairs off by 0, .1, .25, .5 m. Scene b: 2 pairs off by .1 and 9 m. The first of each is
    consecutive."""
    pairs = benchmark({"a": 4, "b": 2})
    lengths = [0.0, 0.1, 0.25, 0.5, 0.1, 9.0]
    run = summarise(
        INFO, pairs, [answer(pair, shifted(pair, d)) for pair, d in zip(pairs, lengths, strict=True)]
    )
    assert values(run, "recall_15", "recall_20") == pytest.approx((400 / 6, 400 / 6))
    assert run.measures["recall_15_scene_mean"].value == pytest.approx((75 + 50) / 2)
    # RMSE of a shift is its length: a has .1 right and .25, .5 wrong; b has 9 m wrong.
    assert run.measures["rmse_recall"].value == pytest.approx(25.0)
    assert run.measures["rmse_recall"].count == 4
    assert run.measures["rmse_recall_scene_mean"].value == pytest.approx((100 / 3 + 0) / 2)
    assert run.measures["translation_mean"].value == pytest.approx(100 * (0 + 0.1 + 0.25 + 0.1) / 4)
    assert run.measures["translation_median"].value == pytest.approx(10.0)
    assert run.measures["translation_mean"].count == 4
    assert run.measures["translation_q50"].value == pytest.approx(100 * (0.1 + 0.25) / 2)
    assert {name: scene["recall_15"].value for name, scene in run.scenes.items()} == {"a": 75.0, "b": 50.0}
    assert run.scenes["a"]["rmse_recall"].count == 3
    assert [score.pair for score in run.pairs] == [pair.id for pair in pairs]


def test_an_rmse_of_exactly_the_limit_is_right_as_published() -> None:
    pairs = benchmark({"a": 3}, consecutive=False)
    run = summarise(
        INFO, pairs, [answer(p, shifted(p, d)) for p, d in zip(pairs, (0.2, 0.2, 0.2001), strict=True)]
    )
    assert run.measures["rmse_recall"].value == pytest.approx(200 / 3)


def test_times_stages_memory_by_hand() -> None:
    pairs = benchmark({"a": 3})
    predictions = [
        answer(pair, None, seconds=s, stages=stages, peak_memory=m)
        for pair, s, stages, m in zip(
            pairs,
            (0.1, 0.4, 0.2),
            ({"match": 0.05, "solve": 0.01}, {"match": 0.15}, {}),
            (2**20, 3 * 2**20, None),
            strict=True,
        )
    ]
    run = summarise(INFO, pairs, predictions)
    assert values(run, "time_median", "time_q90") == pytest.approx((200.0, 360.0))
    assert values(run, "stage_match", "stage_solve", "peak_memory") == pytest.approx((100.0, 10.0, 3.0))
    assert run.measures["stage_match"].count == 2
    assert run.scenes["a"]["time_median"].value == pytest.approx(200.0)
    names = list(run.measures)
    assert names.index("time_q90") + 1 == names.index("stage_match") < names.index("peak_memory")
    assert title("stage_match") == "Time of stage match, median"
    assert all(title(name) for name in names)


def test_inlier_measures_are_means_over_all_pairs() -> None:
    """F1 of 1 and of 0.5; the third pair ended with an error and counts as 0."""
    pairs = benchmark({"a": 3})
    true = np.array([True, True, False, False])
    some = np.array([True, False, True, False])
    predictions = [
        answer(pairs[0], None, labels=Labels(true, true, true)),
        answer(pairs[1], None, labels=Labels(true, None, some)),
        answer(pairs[2], None, error="no"),
    ]
    run = summarise(INFO, pairs, predictions)
    assert values(run, "verified_f1", "verified_precision") == pytest.approx((50.0, 50.0))
    assert values(run, "f1", "recall") == pytest.approx((100 / 3, 100 / 3))
    assert run.measures["f1"].count == 3
    assert run.measures["errors"].value == pytest.approx(100 / 3)
    run = summarise(INFO, pairs, [dataclasses.replace(p, labels=None) for p in predictions])
    assert not {"f1", "verified_f1"} & set(run.measures)


def test_curves_by_hand() -> None:
    pairs = benchmark({"a": 5})
    overlaps = (0.05, 0.1, 0.3, 0.95, None)
    ratios = (0.0, 0.01, 0.4, 0.5, 1.0)
    right = (False, True, True, True, False)
    pairs = [dataclasses.replace(pair, overlap=o) for pair, o in zip(pairs, overlaps, strict=True)]
    predictions = []
    for pair, ratio, good in zip(pairs, ratios, right, strict=True):
        true = np.arange(100) < round(100 * ratio)
        T = pair.T_target_source if good else None
        predictions.append(answer(pair, T, labels=Labels(true, None, true)))
    run = summarise(INFO, pairs, predictions)
    curve = run.curves["recall_15_by_overlap"]
    assert curve.quantity == "overlap" and len(curve.edges) == 11 == len(curve.measures) + 1
    assert [m.count for m in curve.measures] == [1, 1, 0, 1, 0, 0, 0, 0, 0, 1]
    assert [m.value for m in curve.measures if m.count] == [0.0, 100.0, 100.0, 100.0]
    curve = run.curves["recall_15_by_inlier_ratio"]
    assert curve.edges == (0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1)
    assert [m.count for m in curve.measures] == [1, 1, 0, 0, 0, 1, 2]
    assert curve.measures[-1].value == 50.0
    assert math.isnan(curve.measures[2].value)


# ---- what is not defined --------------------------------------------------------------------------------


def test_unrelated_pairs_have_only_what_is_defined() -> None:
    pairs = benchmark({"a": 4, "b": 4}, T_target_source=None, information=None)
    said = ["ok"] + ["failed"] * 7
    labels = Labels(np.zeros(3, bool), np.ones(3, bool), np.ones(3, bool))
    run = summarise(
        INFO,
        pairs,
        [
            answer(pair, np.eye(4), status=status, confidence=0.5, labels=labels, peak_memory=1)
            for pair, status in zip(pairs, said, strict=True)
        ],
    )
    assert set(run.measures) == {
        "accepted",
        "time_median",
        "time_q90",
        "peak_memory",
        "no_answer",
        "errors",
    }
    assert run.measures["accepted"].value == 12.5
    assert run.curves == {}
    assert set(run.scenes["a"]) == {"accepted", "time_median"}
    assert run.calibration is not None
    assert run.calibration.accepted == run.measures["accepted"]


def test_without_gt_info_there_is_no_rmse_recall() -> None:
    pairs = benchmark({"a": 2}, information=None)
    run = summarise(INFO, pairs, [answer(pair, pair.T_target_source) for pair in pairs])
    assert not {"rmse_recall", "rmse_recall_scene_mean", "accepted"} & set(run.measures)
    assert run.calibration is None
    assert "rmse_recall" not in run.scenes["a"]
    assert list(run.measures) == [name for name in TITLES if name in run.measures]


def test_missing_pairs_are_counted_and_enter_nothing() -> None:
    pairs = benchmark({"a": 4})
    run = summarise(INFO, pairs, [answer(pair, pair.T_target_source) for pair in reversed(pairs[:3])])
    assert (run.num_pairs, run.num_missing) == (4, 1)
    assert run.measures["recall_15"].value == 100.0 and run.measures["recall_15"].count == 3
    assert [score.pair for score in run.pairs] == [pair.id for pair in pairs[:3]]


def test_foreign_and_repeated_predictions_are_refused() -> None:
    pairs = benchmark({"a": 2})
    good = answer(pairs[0], None)
    with pytest.raises(InputError, match="'elsewhere/0-1', which is none of the 2"):
        summarise(INFO, pairs, [good, dataclasses.replace(good, pair="elsewhere/0-1")])
    with pytest.raises(InputError, match="twice"):
        summarise(INFO, pairs, [good, good])
    with pytest.raises(InputError, match="two pairs of the same id"):
        summarise(INFO, [pairs[0], pairs[0]], [good])


def test_raw_truth_reaches_the_pairs() -> None:
    pairs = benchmark({"a": 3})
    raw = [pair.T_target_source * np.array([[0.9997] * 3 + [1.0]] * 3 + [[1.0] * 4]) for pair in pairs]
    pairs = [dataclasses.replace(p, raw_T_target_source=T) for p, T in zip(pairs, raw, strict=True)]
    predictions = [answer(pair, pair.T_target_source) for pair in pairs]
    assert summarise(INFO, pairs, predictions).measures["rotation_median"].value < 1e-9
    run = summarise(INFO, pairs, predictions, raw_truth=True)
    assert run.raw_truth
    assert run.measures["rotation_median"].value == pytest.approx(math.degrees(math.acos(1 - 4.5e-4)))


# ---- speed ------------------------------------------------------------------------------------------------


def test_both_benchmarks_are_summarised_in_20_seconds() -> None:
    rng = np.random.default_rng(0)
    pairs = benchmark({"a": 1000, "b": 500, "c": 287, "d": 100})
    pairs = [dataclasses.replace(pair, overlap=rng.random()) for pair in pairs]
    predictions = []
    for pair in pairs:
        masks = rng.random((3, 1000)) < 0.1
        predictions.append(
            answer(
                pair,
                shifted(pair, rng.exponential(0.3)),
                labels=Labels(*masks),
                confidence=rng.random(),
                status="ok",
                stages={"match": rng.random(), "solve": rng.random()},
                seconds=rng.random(),
                peak_memory=1000,
                hypotheses=(np.eye(4),) * 3,
            )
        )
    start = time.process_time()
    run = summarise(INFO, pairs, predictions)
    assert time.process_time() - start < 20.0
    assert len(run.pairs) == 1887
