"""How far a measure may be off: seeded bootstrap over pairs and over scenes, many measures in one pass.

Two intervals, because they answer two questions. Over pairs: other pairs of the same scenes. Over scenes:
other rooms; a scene is drawn with all its pairs, which are not independent of each other. With the four to
eight scenes of a benchmark the latter is rough and rather too narrow.

A resample is a row of counts, how often each pair was drawn, so that means are matrix products and
quantiles cumulative sums; scipy's bootstrap knows neither scenes nor many quantities over one resample. Cost:
2,000 resamples of 1,887 pairs take 0.1 s to draw, then 0.1 s per quantile and 0.01 s per mean. Memory is
bounded: resamples are worked off in blocks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from geomoe3d.errors import InputError
from geomoe3d.evaluation.config import RULES
from geomoe3d.evaluation.records import Measure
from geomoe3d.types import FloatArray, IntArray

_BLOCK = 4_000_000
_UNDEFINED = (math.nan, math.nan)

Interval = tuple[float, float]
Statistic = Callable[[FloatArray], FloatArray]
"""Counts (B, n), row b how often each of n pairs was drawn, to B values; NaN where not defined."""


@dataclass(frozen=True)
class Quantity:
    """Values of n pairs and what is to be made of them.

    Attributes:
        values: (n,) in ``unit`` (a proportion is 0 or 100 per pair); NaN: the pair is not counted.
        unit: as in `Measure`; the mean of a ``%`` must lie between 0 and 100.
        statistic: ``mean``; ``scene_mean``, the mean of the scenes' means; a number q in [0, 1], the
            q-quantile with linear interpolation; or any function of counts (it may use more than ``values``).
        reflected: True takes the interval 2 v - [high, low] instead of [low, high] (the "basic" bootstrap),
            no end below 0: for values that resampling pushes to one side.
    """

    values: FloatArray
    unit: str
    statistic: Literal["mean", "scene_mean"] | float | Statistic = "mean"
    reflected: bool = False


def measure_all(
    quantities: Mapping[str, Quantity],
    scenes: Sequence[str],
    *,
    resamples: int = RULES.resamples,
    seed: int = 0,
) -> dict[str, Measure]:
    """Values with 95 % percentile bootstrap intervals of many quantities over the same n pairs.

    All quantities see the same resamples. A mean in ``%`` that is exactly 0 or 100 has no spread to
    resample: there the interval over pairs is Wilson's (for n pairs of independent outcome), and the one over
    scenes is not defined. Resamples in which a statistic is not defined are left out.

    Args:
        quantities: by name.
        scenes: n scene names.
        resamples: number of resamples of either kind.
        seed: decides the resamples; the same seed and n give the same ones.

    Returns:
        By the same names in the same order. A value is NaN where no pair is counted; intervals are
        (NaN, NaN) for fewer than two counted pairs (but for Wilson's), and the interval over scenes for fewer
        than two scenes with counted pairs.

    Raises:
        InputError: a quantity has another number of values than there are scene names.
    """
    names, labels = np.unique(np.asarray(scenes, dtype=np.str_), return_inverse=True)
    labels = labels.reshape(-1).astype(np.int64)
    n = len(scenes)
    for name, quantity in quantities.items():
        if quantity.values.shape != (n,):
            raise InputError(f"'{name}' has values of shape {quantity.values.shape}, expected ({n},)")
    if n == 0:
        return {name: Measure(math.nan, q.unit, 0, _UNDEFINED, _UNDEFINED) for name, q in quantities.items()}
    statistics = [_statistic(quantity, labels) for quantity in quantities.values()]
    points = [float(statistic(np.ones((1, n)), np.ones((1, len(names))))[0]) for statistic in statistics]
    over_pairs, over_scenes = (
        np.random.Generator(np.random.PCG64(stream)) for stream in np.random.SeedSequence(seed).spawn(2)
    )
    pair_samples = [
        [statistic(counts, np.ones((len(counts), len(names)))) for statistic in statistics]
        for counts in _draws(n, n, resamples, over_pairs)
    ]
    scene_samples = [
        [statistic(drawn[:, labels], drawn) for statistic in statistics]
        for drawn in _draws(len(names), n, resamples, over_scenes)
    ]
    by_pair, by_scene = np.concatenate(pair_samples, axis=1), np.concatenate(scene_samples, axis=1)
    found = {}
    for row, (name, quantity) in enumerate(quantities.items()):
        counted = ~np.isnan(quantity.values)
        count, value = int(counted.sum()), points[row]
        interval = scene_interval = _UNDEFINED
        share = quantity.statistic in ("mean", "scene_mean") and quantity.unit == "%"
        if share and value in (0.0, 100.0):
            interval = wilson(value / 100.0, count)
        else:
            if count >= 2:
                interval = _interval(by_pair[row], value, quantity.reflected)
            if len(np.unique(labels[counted])) >= 2:
                scene_interval = _interval(by_scene[row], value, quantity.reflected)
        found[name] = Measure(value, quantity.unit, count, interval, scene_interval)
    return found


def wilson(share: float, count: int) -> Interval:
    """Wilson's 95 % interval in % for a share in [0, 1] of ``count`` independent outcomes; NaN for none."""
    if count == 0:
        return _UNDEFINED
    from scipy.stats import binomtest

    found = binomtest(round(share * count), count).proportion_ci(method="wilson")
    return 100.0 * float(found.low), 100.0 * float(found.high)


def quantile(values: FloatArray, counts: FloatArray, q: float) -> FloatArray:
    """The q-quantile of every resample, linear between order statistics as `numpy.quantile`.

    Args:
        values: (n,) may be infinite; NaN is not counted.
        counts: (B, n) how often each value was drawn.
        q: in [0, 1].

    Returns:
        (B,) NaN where nothing counted was drawn.
    """
    rows = np.flatnonzero(~np.isnan(values))
    rows = rows[np.argsort(values[rows], kind="stable")]
    if rows.size == 0:
        return np.full(len(counts), np.nan)
    ordered = values[rows]
    upto = np.cumsum(counts[:, rows], axis=1)
    total = upto[:, -1]
    position = q * np.maximum(total - 1.0, 0.0)
    # Sums of products such as 0.9 x 10 must not fall a last bit short of the whole number they are.
    position = np.where(np.abs(position - np.rint(position)) < 1e-9, np.rint(position), position)
    below = np.floor(position)
    low, high = (
        ordered[np.minimum((upto <= k[:, None]).sum(axis=1), len(rows) - 1)] for k in (below, below + 1.0)
    )
    share = position - below
    with np.errstate(invalid="ignore"):
        between = np.where((share == 0.0) | (low == high), low, low + share * (high - low))
    return np.where(total > 0, between, np.nan)


def _statistic(quantity: Quantity, labels: IntArray) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """A quantity as a function of counts (B, n) and of how often each scene was drawn as a whole (B, S).

    ``labels`` (n,) number the pairs' scenes from 0 to S - 1.
    """
    statistic, values = quantity.statistic, quantity.values
    if isinstance(statistic, (int, float)):
        return lambda counts, drawn: quantile(values, counts, float(statistic))
    if callable(statistic):
        return lambda counts, drawn: statistic(counts)
    if statistic not in ("mean", "scene_mean"):
        raise InputError(f"there is no statistic '{statistic}'; there are mean and scene_mean")
    if np.isinf(values).any():
        raise InputError("a mean of infinite values was asked for; leave them out (NaN) or take a median")
    counted, known = ~np.isnan(values), np.nan_to_num(values)
    if statistic == "mean":
        return lambda counts, drawn: _ratio(counts @ known, counts @ counted.astype(np.float64))
    in_scene = np.eye(labels.max() + 1)[labels]

    def scene_mean(counts: FloatArray, drawn: FloatArray) -> FloatArray:
        rates = _ratio(counts @ (in_scene * known[:, None]), counts @ (in_scene * counted[:, None]))
        there = ~np.isnan(rates)
        return _ratio((drawn * np.where(there, rates, 0.0)).sum(axis=1), (drawn * there).sum(axis=1))

    return scene_mean


def _ratio(sums: NDArray[Any], counts: NDArray[Any]) -> FloatArray:
    """Sums over counts, NaN where a count is 0."""
    found: FloatArray = np.divide(sums, counts, out=np.full(np.shape(sums), np.nan), where=counts > 0)
    return found


def _draws(size: int, width: int, resamples: int, rng: np.random.Generator) -> Iterator[FloatArray]:
    """Blocks (b, size) of counts of ``size`` draws with replacement, ``resamples`` rows in all."""
    block = max(1, _BLOCK // max(width, size))
    for first in range(0, resamples, block):
        rows = min(block, resamples - first)
        drawn = rng.integers(size, size=(rows, size)) * rows + np.arange(rows)[:, None]
        counts = np.bincount(drawn.ravel(), minlength=rows * size).reshape(size, rows)
        yield counts.astype(np.float64).T  # one pair after the other in memory, as quantiles want it


def _interval(samples: FloatArray, value: float, reflected: bool) -> Interval:
    """The middle 95 % of the samples that are defined, whole order statistics, rounded outwards."""
    ordered = np.sort(samples[~np.isnan(samples)])
    if ordered.size == 0:
        return _UNDEFINED
    tail = (1.0 - 0.95) / 2.0 * (ordered.size - 1)  # intervals of 95 %
    low, high = float(ordered[math.floor(tail)]), float(ordered[ordered.size - 1 - math.floor(tail)])
    if reflected:
        return max(0.0, 2.0 * value - high), max(0.0, 2.0 * value - low)
    return low, high
