"""Bootstrap intervals and calibration: against theory, brute force, scipy and hand-made cases."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binomtest
from scored_pairs import undefined

from geomoe3d.errors import InputError
from geomoe3d.evaluation import intervals
from geomoe3d.evaluation.intervals import Quantity, measure_all, quantile, wilson
from geomoe3d.evaluation.records import Measure

NAN = math.nan


def measure(values, scenes, *, unit, statistic="mean", **how) -> Measure:
    """One array of values alone."""
    quantity = Quantity(np.asarray(values, dtype=np.float64), unit, statistic)
    return measure_all({"": quantity}, scenes, **how)[""]


# ---- values -----------------------------------------------------------------------------------------


def test_pair_mean_and_scene_mean_by_hand() -> None:
    """Scene a: 3 of 4 right, scene b: 0 of 2. Pair mean 50, scene mean 37.5."""
    values, scenes = [100.0, 100.0, 100.0, 0.0, 0.0, 0.0], list("aaaabb")
    assert measure(values, scenes, unit="%").value == 50.0
    assert measure(values, scenes, unit="%", statistic="scene_mean").value == 37.5


def test_values_that_are_nan_are_not_counted() -> None:
    found = measure([1.0, NAN, 3.0, NAN, 8.0], list("aabbc"), unit="cm")
    assert (found.value, found.count) == (4.0, 3)
    assert measure([1.0, NAN, 3.0, NAN, 8.0], list("aabbc"), unit="cm", statistic=0.5).value == 3.0
    # Scene b counts nobody and is no scene of the mean: (1 + 3 + 8) with a, b, c of one each but for b.
    found = measure([1.0, NAN, NAN, NAN, 8.0], list("aabbc"), unit="cm", statistic="scene_mean")
    assert found.value == 4.5


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.floats(-5, 5) | st.just(NAN) | st.just(math.inf), min_size=1, max_size=130),
    st.integers(0, 10**6),
    st.sampled_from([0.0, 0.25, 0.5, 0.75, 0.9, 1.0]),
)
def test_quantiles_of_counts_are_those_of_the_drawn_values(values: list[float], seed: int, q: float) -> None:
    array = np.array(values)
    drawn = np.random.default_rng(seed).integers(len(values), size=(5, len(values)))
    counts = np.stack([np.bincount(row, minlength=len(values)) for row in drawn]).astype(float)
    found = quantile(array, counts, q)
    for row, value in zip(drawn, found, strict=True):
        kept = np.sort(array[row][~np.isnan(array[row])])
        if kept.size == 0:
            assert math.isnan(value)
            continue
        position = q * (kept.size - 1)
        low, high = kept[math.floor(position + 1e-9)], kept[math.ceil(position - 1e-9)]
        if math.isinf(high):
            assert value == high
        else:
            assert low <= value <= high
            assert value == pytest.approx(np.quantile(kept[np.isfinite(kept)], q), abs=1e-9) or math.isinf(
                kept[-1]
            )


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(-5, 5), min_size=1, max_size=100), st.floats(0, 1))
def test_the_value_of_a_quantile_is_that_of_numpy(values: list[float], q: float) -> None:
    found = measure(values, ["a"] * len(values), unit="", statistic=q, resamples=5)
    assert found.value == pytest.approx(np.quantile(values, q), abs=1e-8)


# ---- intervals over pairs -----------------------------------------------------------------------------


def test_interval_of_a_mean_is_as_wide_as_theory_says() -> None:
    values = np.random.default_rng(0).normal(10.0, 2.0, size=1887)
    found = measure(values, ["a"] * 1887, unit="cm")
    half = 1.96 * values.std() / math.sqrt(1887)
    assert found.interval == pytest.approx((found.value - half, found.value + half), abs=0.1 * half)


def test_interval_of_a_subset_counts_that_its_size_is_random_too() -> None:
    rng = np.random.default_rng(1)
    values = np.where(rng.random(1000) < 0.3, rng.exponential(1.0, size=1000), NAN)
    found = measure(values, ["a"] * 1000, unit="cm")
    kept = values[~np.isnan(values)]
    half = 1.96 * kept.std() / math.sqrt(kept.size)
    assert found.interval == pytest.approx((found.value - half, found.value + half), abs=0.15 * half)


@pytest.mark.parametrize(("statistic", "truth"), [("mean", 1.0), (0.5, math.log(2.0)), (0.9, math.log(10.0))])
def test_95_of_100_intervals_hold_the_truth(statistic: str | float, truth: float) -> None:
    """Of 200 samples of an exponential distribution; four standard deviations of the count of hits."""
    rng = np.random.default_rng(2)
    hits = 0
    for seed in range(200):
        sample = rng.exponential(1.0, size=300)
        low, high = measure(
            sample, ["a"] * 300, unit="", statistic=statistic, resamples=400, seed=seed
        ).interval
        hits += low <= truth <= high
    assert 0.95 * 200 - 4 * math.sqrt(200 * 0.95 * 0.05) - 2 <= hits <= 200


def test_proportions_without_spread_take_wilsons_interval() -> None:
    for right, value in ((100.0, 100.0), (0.0, 0.0)):
        for statistic in ("mean", "scene_mean"):
            found = measure([right] * 50, list("ab") * 25, unit="%", statistic=statistic)
            assert found.value == value
            expected = binomtest(int(right / 2), 50).proportion_ci(method="wilson")
            assert found.interval == pytest.approx((100 * expected.low, 100 * expected.high), abs=1e-9)
            assert undefined(found.scene_interval)
    assert measure([100.0], ["a"], unit="%").interval == pytest.approx((20.654, 100.0), abs=1e-3)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 300), st.integers(1, 300))
def test_wilson_agrees_with_scipy(hits: int, count: int) -> None:
    hits = min(hits, count)
    expected = binomtest(hits, count).proportion_ci(method="wilson")
    assert wilson(hits / count, count) == pytest.approx((100 * expected.low, 100 * expected.high), abs=1e-9)


def test_means_of_other_units_are_no_proportions() -> None:
    found = measure([0.0, 0.0, 0.0], list("abc"), unit="cm")
    assert found.interval == (0.0, 0.0)


def test_infinite_errors_stay_infinite() -> None:
    values = [1.0, 2.0, 3.0, math.inf, math.inf, math.inf, math.inf, math.inf]
    found = measure(values, list("aaaabbbb"), unit="deg", statistic=0.5)
    assert found.value == math.inf
    assert found.interval[0] < math.inf and found.interval[1] == math.inf
    with pytest.raises(InputError, match="mean of infinite"):
        measure(values, list("aaaabbbb"), unit="deg")


# ---- intervals over scenes ----------------------------------------------------------------------------


def test_over_scenes_a_scene_comes_with_all_its_pairs() -> None:
    """Two scenes, so three outcomes: a twice (75 %), both (50 %), b twice (0 %)."""
    values, scenes = [100.0, 100.0, 100.0, 0.0, 0.0, 0.0], list("aaaabb")
    for statistic in ("mean", "scene_mean"):
        assert measure(values, scenes, unit="%", statistic=statistic).scene_interval == (0.0, 75.0)


def test_over_scenes_of_one_size_both_means_are_one() -> None:
    """A scene that is drawn twice counts twice in either mean."""
    rng = np.random.default_rng(8)
    values, scenes = (
        100.0 * (rng.random(120) < np.repeat([0.2, 0.5, 0.9, 0.95], 30)),
        np.repeat(list("abcd"), 30),
    )
    by_pair, by_scene = (measure(values, scenes, unit="%", statistic=s) for s in ("mean", "scene_mean"))
    assert by_scene.value == pytest.approx(by_pair.value)
    assert by_scene.scene_interval == pytest.approx(by_pair.scene_interval)


def test_over_scenes_medians_too() -> None:
    found = measure([1.0, 1.0, 5.0, 5.0, 5.0], list("aabbb"), unit="cm", statistic=0.5)
    assert (found.value, found.scene_interval) == (5.0, (1.0, 5.0))


def test_one_scene_gives_no_interval_over_scenes() -> None:
    values = np.random.default_rng(0).normal(size=30)
    for statistic in ("mean", "scene_mean", 0.5):
        found = measure(values, ["a"] * 30, unit="", statistic=statistic)
        assert undefined(found.scene_interval)
        assert found.interval[0] < found.value < found.interval[1]
    # Two scenes, one of which counts nobody, are one scene.
    half = np.where(np.arange(30) < 15, values, NAN)
    assert undefined(measure(half, ["a"] * 15 + ["b"] * 15, unit="").scene_interval)


def test_scenes_that_differ_widen_the_interval_over_scenes_alone() -> None:
    rng = np.random.default_rng(3)
    levels = rng.normal(0.0, 5.0, size=8)
    values = np.concatenate([level + rng.normal(size=100) for level in levels])
    scenes = [name for name in "abcdefgh" for _ in range(100)]
    found = measure(values, scenes, unit="")
    assert found.scene_interval[1] - found.scene_interval[0] > 4 * (found.interval[1] - found.interval[0])


# ---- everything at once ------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_and_another_seed_nearly_the_same() -> None:
    values, scenes = np.random.default_rng(0).normal(size=200), list("abcd") * 50
    first, again, other = (measure(values, scenes, unit="", seed=seed) for seed in (4, 4, 5))
    assert first == again
    assert first.interval != other.interval
    assert first.interval == pytest.approx(other.interval, abs=0.03)


def test_blocks_change_nothing_but_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    values, scenes = np.random.default_rng(0).normal(size=200), list("abcd") * 50
    whole = measure_all({"m": Quantity(values, ""), "q": Quantity(values, "", 0.5)}, scenes)
    monkeypatch.setattr(intervals, "_BLOCK", 7 * 200)
    parts = measure_all({"m": Quantity(values, ""), "q": Quantity(values, "", 0.5)}, scenes)
    for name in ("m", "q"):
        assert parts[name].value == whole[name].value
        assert parts[name].interval == pytest.approx(whole[name].interval, abs=0.03)
        assert parts[name].scene_interval == pytest.approx(whole[name].scene_interval, abs=0.03)


def test_quantities_together_are_the_same_as_one_by_one() -> None:
    rng = np.random.default_rng(5)
    scenes = list("abc") * 40
    quantities = {
        "mean": Quantity(rng.normal(size=120), "cm"),
        "some": Quantity(np.where(rng.random(120) < 0.5, rng.normal(size=120), NAN), "cm"),
        "scene": Quantity(100.0 * (rng.random(120) < 0.5), "%", "scene_mean"),
        "q": Quantity(rng.normal(size=120), "cm", 0.75),
    }
    together = measure_all(quantities, scenes)
    assert list(together) == list(quantities)
    for name, one in quantities.items():
        alone = measure(one.values, scenes, unit=one.unit, statistic=one.statistic)
        assert alone.value == pytest.approx(together[name].value)
        assert alone.interval == pytest.approx(together[name].interval)
        assert alone.scene_interval == pytest.approx(together[name].scene_interval)


def test_no_pairs_one_pair_and_the_wrong_number() -> None:
    nothing = measure([], [], unit="cm")
    assert math.isnan(nothing.value) and nothing.count == 0 and undefined(nothing.interval)
    one = measure([3.0], ["a"], unit="cm")
    assert one.value == 3.0 and undefined(one.interval) and undefined(one.scene_interval)
    none_counted = measure([NAN, NAN], ["a", "b"], unit="%")
    assert math.isnan(none_counted.value) and undefined(none_counted.interval)
    with pytest.raises(InputError, match=r"shape \(2,\), expected \(3,\)"):
        measure([1.0, 2.0], ["a"] * 3, unit="cm")
    with pytest.raises(InputError, match="no statistic 'mode'"):
        measure([1.0, 2.0], ["a"] * 2, unit="cm", statistic="mode")
