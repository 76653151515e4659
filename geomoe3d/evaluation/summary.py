"""From stored answers to everything that a report shows of one run.

Place: above measures, intervals and calibration, below the reports; it reads no file. Pairs of the benchmark
without a stored answer are counted and enter no measure. Cost: about 3 s for 1,887 pairs with 1,000
correspondences each.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from geomoe3d.errors import InputError
from geomoe3d.evaluation.calibration import acceptance, calibrate
from geomoe3d.evaluation.config import RULES
from geomoe3d.evaluation.intervals import Quantity, measure_all
from geomoe3d.evaluation.metrics import has_motion, score_pair
from geomoe3d.evaluation.records import (
    Curve,
    EvaluationPair,
    Measure,
    PairScore,
    Prediction,
    RunInfo,
    RunScore,
)
from geomoe3d.types import FloatArray

TITLES = {
    "recall_15": "Registration recall (15 deg, 0.30 m), mean over pairs",
    "recall_15_scene_mean": "Registration recall (15 deg, 0.30 m), mean over scenes",
    "recall_20": "Registration recall (20 deg, 0.30 m), mean over pairs",
    "recall_20_scene_mean": "Registration recall (20 deg, 0.30 m), mean over scenes",
    "rmse_recall": "RMSE recall (0.20 m, pairs not consecutive), mean over pairs",
    "rmse_recall_scene_mean": "RMSE recall (0.20 m, pairs not consecutive), mean over scenes",
    "any_recall_15": "Answer or any hypothesis right (15 deg, 0.30 m)",
    "accepted": "Acceptance rate: pairs with status ok",
    "accepted_right": "Precision of acceptance: right among the pairs with status ok",
    "rotation_median": "Rotation error, median over right pairs",
    "rotation_mean": "Rotation error, mean over right pairs",
    "translation_median": "Translation error, median over right pairs",
    "translation_mean": "Translation error, mean over right pairs",
    "rotation_q25": "Rotation error, 25 % quantile over all pairs",
    "rotation_q50": "Rotation error, 50 % quantile over all pairs",
    "rotation_q75": "Rotation error, 75 % quantile over all pairs",
    "rotation_q90": "Rotation error, 90 % quantile over all pairs",
    "translation_q25": "Translation error, 25 % quantile over all pairs",
    "translation_q50": "Translation error, 50 % quantile over all pairs",
    "translation_q75": "Translation error, 75 % quantile over all pairs",
    "translation_q90": "Translation error, 90 % quantile over all pairs",
    "precision": "Inlier precision, method's own labels",
    "recall": "Inlier recall, method's own labels",
    "f1": "Inlier F1, method's own labels",
    "verified_precision": "Inlier precision, labels from the transform",
    "verified_recall": "Inlier recall, labels from the transform",
    "verified_f1": "Inlier F1, labels from the transform",
    "time_median": "Time per pair, median",
    "time_q90": "Time per pair, 90 % quantile",
    "peak_memory": "Peak memory, largest",
    "no_answer": "Pairs without a transform",
    "errors": "Pairs with an error",
}
"""Name of a measure -> what a reader is told; times of stages have names of their own, see `title`."""

STAGE_PREFIX = "stage_"
OVERLAP_EDGES = tuple(round(0.1 * k, 1) for k in range(11))
_INLIER_MEASURES = ("precision", "recall", "f1", "verified_precision", "verified_recall", "verified_f1")


def title(name: str) -> str:
    """What a reader is told of a measure, times of stages included."""
    if name.startswith(STAGE_PREFIX):
        return f"Time of stage {name[len(STAGE_PREFIX) :]}, median"
    return TITLES[name]


def summarise(
    info: RunInfo,
    benchmark_pairs: Sequence[EvaluationPair],
    predictions: Sequence[Prediction],
    *,
    raw_truth: bool = False,
    seed: int = 0,
    resamples: int = RULES.resamples,
) -> RunScore:
    """Everything that reports show of one run.

    A measure that is defined for no pair is left out: recall and errors of unrelated scans, RMSE recall
    without gt.info, inlier measures of methods that show no correspondences. Where a method labels some pairs
    and fails on others, those others count as 0 in the inlier measures, which are means over all pairs.

    Args:
        info: what the predictions came from.
        benchmark_pairs: all pairs of the benchmark.
        predictions: in any order; those of an unfinished run are fewer than the pairs.
        raw_truth: see `measures.score_pair`.
        seed: of the bootstrap.
        resamples: of the bootstrap.

    Returns:
        Scores in the order of the benchmark.

    Raises:
        InputError: a prediction of a pair that the benchmark does not have, or two of the same pair, or two
            pairs of the same id.
    """
    by_id = _by_id(info, benchmark_pairs, predictions)
    found = [
        (score_pair(pair, by_id[pair.id], raw_truth=raw_truth), by_id[pair.id])
        for pair in benchmark_pairs
        if pair.id in by_id
    ]
    scores = tuple(score for score, _ in found)
    silent = [not has_motion(prediction.T_target_source) for _, prediction in found]
    with_truth = any(pair.T_target_source is not None for pair in benchmark_pairs)
    return RunScore(
        info=info,
        num_pairs=len(benchmark_pairs),
        num_missing=len(benchmark_pairs) - len(scores),
        raw_truth=raw_truth,
        pairs=scores,
        measures=_measures(scores, silent, with_truth, resamples, seed),
        scenes=_scenes(scores, with_truth, resamples, seed),
        curves=_curves(scores, resamples, seed) if with_truth else {},
        calibration=calibrate(scores, resamples=resamples, seed=seed),
    )


def _by_id(
    info: RunInfo, pairs: Sequence[EvaluationPair], predictions: Sequence[Prediction]
) -> dict[str, Prediction]:
    known = {pair.id for pair in pairs}
    if len(known) != len(pairs):
        raise InputError(f"benchmark '{info.benchmark}' has two pairs of the same id")
    by_id: dict[str, Prediction] = {}
    for prediction in predictions:
        if prediction.pair not in known:
            raise InputError(
                f"run '{info.label}' answers pair '{prediction.pair}', which is none of the {len(known)} of "
                f"benchmark '{info.benchmark}'; was it made on other data?"
            )
        if prediction.pair in by_id:
            raise InputError(f"run '{info.label}' answers pair '{prediction.pair}' twice")
        by_id[prediction.pair] = prediction
    return by_id


def _measures(
    scores: Sequence[PairScore], silent: Sequence[bool], with_truth: bool, resamples: int, seed: int
) -> dict[str, Measure]:
    quantities: dict[str, Quantity] = {}
    if with_truth:
        quantities |= _recalls(scores)
        quantities |= _errors(scores)
        quantities |= _inliers(scores)
    quantities |= _times(scores)
    quantities["no_answer"] = Quantity(100.0 * np.array(silent, dtype=np.float64), "%")
    quantities["errors"] = _percent(scores, lambda score: score.error is not None)
    measures = measure_all(quantities, [score.scene for score in scores], resamples=resamples, seed=seed)
    if any(score.status is not None for score in scores):
        accepted, accepted_right = acceptance(scores, resamples=resamples, seed=seed)
        measures["accepted"] = accepted
        if with_truth:
            measures["accepted_right"] = accepted_right
    memory = [score.peak_memory for score in scores if score.peak_memory is not None]
    if memory:  # a bootstrap says nothing about a maximum
        nothing = (math.nan, math.nan)
        measures["peak_memory"] = Measure(max(memory) / 2**20, "MiB", len(memory), nothing, nothing)
    stages = [name for name in measures if name.startswith(STAGE_PREFIX)]
    order = [name for name in TITLES if name in measures]
    at = order.index("time_q90") + 1
    return {name: measures[name] for name in order[:at] + stages + order[at:]}


def _recalls(scores: Sequence[PairScore]) -> dict[str, Quantity]:
    right, right_20 = _percent(scores, lambda s: s.right), _percent(scores, lambda s: s.right_20)
    quantities = {
        "recall_15": right,
        "recall_15_scene_mean": Quantity(right.values, "%", "scene_mean"),
        "recall_20": right_20,
        "recall_20_scene_mean": Quantity(right_20.values, "%", "scene_mean"),
    }
    rmse = _rmse_right(scores)
    if not np.isnan(rmse).all():
        quantities["rmse_recall"] = Quantity(rmse, "%")
        quantities["rmse_recall_scene_mean"] = Quantity(rmse, "%", "scene_mean")
    quantities["any_recall_15"] = _percent(scores, lambda s: s.any_right)
    return quantities


def _errors(scores: Sequence[PairScore]) -> dict[str, Quantity]:
    right = np.array([score.right for score in scores], dtype=np.bool_)
    rotation = _numbers(score.rotation_error_deg for score in scores)
    translation = 100.0 * _numbers(score.translation_error for score in scores)
    quantities: dict[str, Quantity] = {}
    for name, values, unit in (("rotation", rotation, "deg"), ("translation", translation, "cm")):
        of_right = np.where(right, values, np.nan)
        quantities[f"{name}_median"] = Quantity(of_right, unit, 0.5)
        quantities[f"{name}_mean"] = Quantity(of_right, unit)
        for percent in (25, 50, 75, 90):
            quantities[f"{name}_q{percent}"] = Quantity(values, unit, percent / 100.0)
    return quantities


def _inliers(scores: Sequence[PairScore]) -> dict[str, Quantity]:
    quantities = {}
    for name in _INLIER_MEASURES:
        values = 100.0 * _numbers(getattr(score, name) for score in scores)
        if not np.isnan(values).all():
            quantities[name] = Quantity(np.nan_to_num(values, nan=0.0), "%")
    return quantities


def _times(scores: Sequence[PairScore]) -> dict[str, Quantity]:
    seconds = 1000.0 * _numbers(score.seconds for score in scores)
    quantities = {"time_median": Quantity(seconds, "ms", 0.5), "time_q90": Quantity(seconds, "ms", 0.9)}
    for stage in dict.fromkeys(stage for score in scores for stage in score.stages):
        times = 1000.0 * _numbers(score.stages.get(stage) for score in scores)
        quantities[f"{STAGE_PREFIX}{stage}"] = Quantity(times, "ms", 0.5)
    return quantities


def _scenes(
    scores: Sequence[PairScore], with_truth: bool, resamples: int, seed: int
) -> dict[str, dict[str, Measure]]:
    found = {}
    for scene in dict.fromkeys(score.scene for score in scores):
        inside = [score for score in scores if score.scene == scene]
        quantities: dict[str, Quantity] = {}
        if with_truth:
            recalls = _recalls(inside)
            names = ("recall_15", "recall_20", "rmse_recall")
            quantities = {name: recalls[name] for name in names if name in recalls}
        elif any(score.status is not None for score in inside):
            quantities["accepted"] = _percent(inside, lambda score: score.status == "ok")
        quantities["time_median"] = _times(inside)["time_median"]
        found[scene] = measure_all(quantities, [scene] * len(inside), resamples=resamples, seed=seed)
    return found


def _curves(scores: Sequence[PairScore], resamples: int, seed: int) -> dict[str, Curve]:
    curves = {}
    for name, quantity, values, edges in (
        ("recall_15_by_overlap", "overlap", _numbers(s.overlap for s in scores), OVERLAP_EDGES),
        (
            "recall_15_by_inlier_ratio",
            "inlier ratio",
            _numbers(s.inlier_ratio for s in scores),
            (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0),
        ),
    ):
        if np.isnan(values).all():
            continue
        # NaN sorts above every edge and would fall into the last bin.
        bins = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
        measures = []
        for k in range(len(edges) - 1):
            inside = [
                s for s, own, v in zip(scores, bins, values, strict=True) if own == k and not np.isnan(v)
            ]
            right = _percent(inside, lambda score: score.right)
            scenes = [score.scene for score in inside]
            measures.append(measure_all({"": right}, scenes, resamples=resamples, seed=seed)[""])
        curves[name] = Curve(quantity, edges, tuple(measures))
    return curves


def _rmse_right(scores: Sequence[PairScore]) -> FloatArray:
    """(n,) 0 or 100, NaN where the RMSE is not defined; rounded so that a last bit does not decide."""
    rmse = np.round(_numbers(score.rmse for score in scores), 9)
    return np.where(np.isnan(rmse), np.nan, 100.0 * (rmse <= RULES.rmse_limit))


def _percent(scores: Sequence[PairScore], test: Callable[[PairScore], bool]) -> Quantity:
    return Quantity(100.0 * np.array([test(score) for score in scores], dtype=np.float64), "%")


def _numbers(values: Iterable[float | None]) -> FloatArray:
    """(n,) with NaN for None."""
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
