"""How far a method's confidence can be believed: reliability, ranking, and what it accepts.

Three different questions: does confidence 0.8 mean right in 8 of 10 pairs (reliability diagram and its
error), do right pairs have the higher confidence (AUROC, risk against coverage), and is what the method calls
``ok`` right (acceptance)? On unrelated scans nothing is right: there the accepted share is what matters, and
it should be 0. Cost: 0.5 s for 1,887 pairs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from geomoe3d.evaluation.config import RULES
from geomoe3d.evaluation.intervals import Quantity, Statistic, measure_all
from geomoe3d.evaluation.records import Calibration, Measure, PairScore, ReliabilityBin
from geomoe3d.types import BoolArray, FloatArray, IntArray


def calibrate(
    scores: Sequence[PairScore], *, resamples: int = RULES.resamples, seed: int = 0
) -> Calibration | None:
    """Reliability, AUROC, risk and acceptance of a run, "right" meaning 15 deg and 0.30 m.

    Pairs without confidence (an error instead of an answer) enter the accepted share, as not accepted, and
    the coverage, as never covered; the diagram, its error and the AUROC are over the others.

    The calibration error is the mean of |share right - mean confidence| over 10 bins of equal width, weighted
    by their counts. It is never 0 for a finite number of pairs, resampling pushes it up once more, and so its
    interval is the reflected one; near 0 it remains too high.

    Args:
        scores: of all pairs of a run.
        resamples: of the bootstrap.
        seed: of the bootstrap.

    Returns:
        None where no pair has a confidence.
    """
    confident = [score for score in scores if score.confidence is not None]
    if not confident:
        return None
    confidence = np.array([score.confidence for score in confident], dtype=np.float64)
    right = np.array([score.right for score in confident], dtype=np.bool_)
    nothing = np.zeros(len(confident))
    measures = measure_all(
        {
            "calibration_error": Quantity(
                nothing, "", calibration_error_of(confidence, right), reflected=True
            ),
            "auroc": Quantity(nothing, "", auroc_of(confidence, right)),
        },
        [score.scene for score in confident],
        resamples=resamples,
        seed=seed,
    )
    accepted, accepted_right = acceptance(scores, resamples=resamples, seed=seed)
    return Calibration(
        bins=reliability_bins(confidence, right),
        calibration_error=measures["calibration_error"],
        auroc=measures["auroc"],
        risk_coverage=risk_coverage(confidence, right, len(scores)),
        accepted=accepted,
        accepted_right=accepted_right,
    )


def acceptance(
    scores: Sequence[PairScore], *, resamples: int = RULES.resamples, seed: int = 0
) -> tuple[Measure, Measure]:
    """Share of pairs with status ok in %, and the share of right ones among them (NaN where none is)."""
    accepted = np.array([score.status == "ok" for score in scores], dtype=np.bool_)
    right = np.array([score.right for score in scores], dtype=np.bool_)
    measures = measure_all(
        {
            "accepted": Quantity(_percent_of(accepted, np.ones_like(accepted)), "%"),
            "accepted_right": Quantity(_percent_of(right, accepted), "%"),
        },
        [score.scene for score in scores],
        resamples=resamples,
        seed=seed,
    )
    return measures["accepted"], measures["accepted_right"]


def reliability_bins(confidence: FloatArray, right: BoolArray) -> tuple[ReliabilityBin, ...]:
    """10 bins of equal width from 0 to 1, the last one closed; confidence (n,) in [0, 1], right (n,)."""
    where = _bin_of(confidence)
    bins = []
    for k in range(RULES.num_bins):
        inside = where == k
        count = int(inside.sum())
        mean = float(confidence[inside].mean()) if count else math.nan
        success = float(right[inside].mean()) if count else math.nan
        bins.append(ReliabilityBin(k / RULES.num_bins, (k + 1) / RULES.num_bins, count, mean, success))
    return tuple(bins)


def calibration_error_of(confidence: FloatArray, right: BoolArray) -> Statistic:
    """The expected calibration error as a function of counts, see `intervals.Statistic`."""
    gap = np.zeros((len(confidence), RULES.num_bins))
    gap[np.arange(len(confidence)), _bin_of(confidence)] = right - confidence

    def statistic(counts: FloatArray) -> FloatArray:
        error: FloatArray = np.abs(counts @ gap).sum(axis=1) / counts.sum(axis=1)
        return error

    return statistic


def auroc_of(confidence: FloatArray, right: BoolArray) -> Statistic:
    """Area under the ROC curve as a function of counts; ties count half, NaN where one side is empty."""
    values, group = np.unique(confidence, return_inverse=True)
    order = np.argsort(group.reshape(-1), kind="stable")
    starts = np.searchsorted(group.reshape(-1)[order], np.arange(len(values)))
    right_in_order = right[order].astype(np.float64)[:, None]

    def statistic(counts: FloatArray) -> FloatArray:
        ordered = counts.T[order]
        rights = np.add.reduceat(ordered * right_in_order, starts, axis=0)
        wrongs = np.add.reduceat(ordered * (1.0 - right_in_order), starts, axis=0)
        below = np.cumsum(wrongs, axis=0) - wrongs
        wins = (rights * (below + 0.5 * wrongs)).sum(axis=0)
        contests = rights.sum(axis=0) * wrongs.sum(axis=0)
        area: FloatArray = np.divide(wins, contests, out=np.full(len(counts), np.nan), where=contests > 0)
        return area

    return statistic


def risk_coverage(confidence: FloatArray, right: BoolArray, total: int) -> tuple[tuple[float, float], ...]:
    """(coverage, share wrong among the covered) as confidence falls, one entry per pair with confidence.

    Pairs of equal confidence come in no particular order, so that each of them adds their mean risk.

    Args:
        confidence: (n,).
        right: (n,).
        total: pairs of the run, those without confidence included.
    """
    _, group = np.unique(-confidence, return_inverse=True)
    group = group.reshape(-1)
    risk_of_group = np.bincount(group, weights=~right) / np.bincount(group)
    covered = np.arange(1, len(confidence) + 1)
    wrong = np.cumsum(risk_of_group[np.sort(group)])
    return tuple(
        (float(share), float(risk)) for share, risk in zip(covered / total, wrong / covered, strict=True)
    )


def _percent_of(right: BoolArray, accepted: BoolArray) -> FloatArray:
    values: FloatArray = np.full(len(right), np.nan)
    values[accepted] = 100.0 * right[accepted]
    return values


def _bin_of(confidence: FloatArray) -> IntArray:
    found: IntArray = np.clip(np.floor(confidence * RULES.num_bins), 0, RULES.num_bins - 1).astype(np.int64)
    return found
