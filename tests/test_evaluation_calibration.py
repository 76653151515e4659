"""How far a confidence tells right from wrong, and how far it is a probability."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu
from scored_pairs import scored, undefined

from geomoe3d.evaluation.calibration import (
    acceptance,
    auroc_of,
    calibrate,
    calibration_error_of,
    reliability_bins,
    risk_coverage,
)
from geomoe3d.evaluation.intervals import Quantity, measure_all, wilson

NAN = math.nan


@settings(max_examples=80, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from([0.0, 0.2, 0.5, 0.7, 1.0]), st.booleans()), min_size=1, max_size=25)
)
def test_auroc_counts_won_contests(rows: list[tuple[float, bool]]) -> None:
    confidence, right = np.array([r[0] for r in rows]), np.array([r[1] for r in rows])
    found = auroc_of(confidence, right)(np.ones((1, len(rows))))[0]
    contests = [(a > b) + 0.5 * (a == b) for a in confidence[right] for b in confidence[~right]]
    if not contests:
        assert math.isnan(found)
    else:
        assert found == pytest.approx(np.mean(contests))


def test_auroc_agrees_with_scipy_and_its_interval_holds_the_truth() -> None:
    """Two normal distributions one deviation apart: the area is Phi(1 / sqrt 2) = 0.7602."""
    rng = np.random.default_rng(0)
    right = rng.random(800) < 0.6
    confidence = 1 / (1 + np.exp(-(rng.normal(size=800) + right)))
    scores = [scored(c, r, scene) for c, r, scene in zip(confidence, right, list("abcd") * 200, strict=True)]
    found = calibrate(scores)
    assert found is not None
    u = mannwhitneyu(confidence[right], confidence[~right]).statistic
    assert found.auroc.value == pytest.approx(u / (right.sum() * (~right).sum()))
    assert found.auroc.interval[0] < 0.7602 < found.auroc.interval[1]
    assert found.auroc.interval[1] - found.auroc.interval[0] < 0.1
    assert found.auroc.scene_interval[0] <= found.auroc.value <= found.auroc.scene_interval[1]


def test_auroc_with_counts_is_that_of_the_repeated_pairs() -> None:
    rng = np.random.default_rng(1)
    confidence, right = np.round(rng.random(40), 1), rng.random(40) < 0.5
    counts = rng.integers(0, 4, size=(6, 40))
    found = auroc_of(confidence, right)(counts.astype(float))
    error = calibration_error_of(confidence, right)(counts.astype(float))
    for row in range(6):
        many = np.repeat(confidence, counts[row]), np.repeat(right, counts[row])
        assert found[row] == pytest.approx(auroc_of(*many)(np.ones((1, len(many[0]))))[0])
        assert error[row] == pytest.approx(calibration_error_of(*many)(np.ones((1, len(many[0]))))[0])


def test_calibration_error_by_hand() -> None:
    """Bin 0.9-1: two pairs of confidence 0.9 and 1, one right: |0.5 - 0.95|. Bin 0.2-0.3: |1 - 0.2| once."""
    found = calibrate([scored(0.9, True), scored(1.0, False), scored(0.2, True)])
    assert found is not None
    assert found.calibration_error.value == pytest.approx((2 * 0.45 + 0.8) / 3)
    full = {k: b for k, b in enumerate(found.bins) if b.count}
    assert set(full) == {2, 9} and len(found.bins) == 10
    assert (full[9].count, full[9].confidence, full[9].success) == (2, pytest.approx(0.95), 0.5)
    assert (full[2].low, full[2].high, full[2].success) == (0.2, 0.3, 1.0)
    assert math.isnan(found.bins[0].confidence) and math.isnan(found.bins[0].success)


def test_bins_hold_every_pair_and_edges_go_up() -> None:
    confidence = np.array([k / 10 for k in range(11)])
    bins = reliability_bins(confidence, np.ones(11, dtype=bool))
    assert [b.count for b in bins] == [1] * 9 + [2]
    assert all(b.low <= b.confidence <= b.high for b in bins)


def test_a_calibrated_method_has_a_small_error_and_a_boastful_one_has_not() -> None:
    rng = np.random.default_rng(2)
    confidence = rng.random(2000)
    honest = calibrate([scored(c, rng.random() < c) for c in confidence])
    boastful = calibrate([scored(c, rng.random() < c**3) for c in confidence])
    assert honest is not None and boastful is not None
    assert honest.calibration_error.value < 0.05
    # The area between c and c^3 over [0, 1] is 1/2 - 1/4.
    low, high = boastful.calibration_error.interval
    assert low < 0.25 < high
    assert 0.0 <= honest.calibration_error.interval[0] <= honest.calibration_error.value


def test_risk_and_coverage_by_hand() -> None:
    """Most confident first: right, then two of equal confidence of which one is wrong, then wrong."""
    confidence, right = np.array([0.1, 0.9, 0.5, 0.5]), np.array([False, True, True, False])
    found = risk_coverage(confidence, right, 5)
    assert [c for c, _ in found] == pytest.approx([0.2, 0.4, 0.6, 0.8])
    assert [r for _, r in found] == pytest.approx([0.0, 0.25, 1 / 3, 0.5])


def test_errors_are_not_accepted_and_not_calibrated() -> None:
    scores = [scored(0.9, True, status="ok"), scored(0.8, False, status="ok"), scored(None, False)]
    found = calibrate(scores)
    assert found is not None
    assert sum(b.count for b in found.bins) == 2
    assert found.accepted.value == pytest.approx(200 / 3) and found.accepted.count == 3
    assert found.accepted_right.value == 50.0 and found.accepted_right.count == 2
    assert found.risk_coverage[-1] == pytest.approx((2 / 3, 0.5))


def test_without_confidence_there_is_no_calibration() -> None:
    assert calibrate([scored(None, True), scored(None, False)]) is None
    assert calibrate([]) is None


def test_unrelated_scans_accepted_by_mistake() -> None:
    scores = [scored(0.1, False, status="low_confidence") for _ in range(19)]
    scores.append(scored(0.9, False, status="ok"))
    found = calibrate(scores)
    assert found is not None
    assert found.accepted.value == 5.0
    assert found.accepted_right.value == 0.0
    assert math.isnan(found.auroc.value) and undefined(found.auroc.interval)
    nobody, right = acceptance(scores[:19])
    assert nobody.value == 0.0
    assert nobody.interval == pytest.approx(wilson(0.0, 19))
    assert math.isnan(right.value) and right.count == 0


def test_the_interval_of_the_calibration_error_is_reflected() -> None:
    """Resampling only adds to the error of a nearly calibrated method; the interval goes the other way."""
    rng = np.random.default_rng(6)
    confidence = rng.random(300)
    right = rng.random(300) < confidence
    nothing, scenes, statistic = np.zeros(300), list("abc") * 100, calibration_error_of(confidence, right)
    plain = measure_all({"": Quantity(nothing, "", statistic)}, scenes)[""]
    reflected = measure_all({"": Quantity(nothing, "", statistic, reflected=True)}, scenes)[""]
    value, (low, high) = plain.value, plain.interval
    assert value < (low + high) / 2
    assert reflected.value == value
    assert reflected.interval == pytest.approx((max(0.0, 2 * value - high), 2 * value - low))
    found = calibrate([scored(c, r, s) for c, r, s in zip(confidence, right, scenes, strict=True)])
    assert found is not None and found.calibration_error == reflected
