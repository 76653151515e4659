"""How far a measure may be off: seeded bootstrap over pairs and over scenes, many measures in one pass.

Two intervals, because they answer two questions. Over pairs: other pairs of the same scenes. Over scenes:
other rooms; a scene is drawn with all its pairs, which are not independent of each other. With the four to
eight scenes of a benchmark the latter is rough and rather too narrow.

A resample is a row of counts, how often each pair was drawn, so that means are matrix products and
quantiles cumulative sums. Cost: 2,000 resamples of 1,887 pairs take 0.1 s to draw, then 0.05 s per
quantile and 0.01 s per mean. Memory is bounded: resamples are worked off in blocks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from geomoe3d.errors import InputError
from geomoe3d.evaluation.records import Measure
from geomoe3d.types import FloatArray, IntArray

RESAMPLES = 2000
_LEVEL = 0.95
Z = 1.959963984540054
"""Standard deviations to either side that hold 95 % of a normal distribution."""
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
    resamples: int = RESAMPLES,
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
    values = list(quantities.values())
    if n == 0:
        return {name: Measure(math.nan, q.unit, 0, _UNDEFINED, _UNDEFINED) for name, q in quantities.items()}
    evaluator = _Evaluator(values, labels, len(names))
    points = evaluator.over_pairs(np.ones((1, n)))[:, 0]
    streams = np.random.SeedSequence(seed).spawn(2)
    by_pair = [
        evaluator.over_pairs(block)
        for block in _draws(n, n, resamples, np.random.Generator(np.random.PCG64(streams[0])))
    ]
    by_scene = [
        evaluator.over_scenes(block)
        for block in _draws(len(names), n, resamples, np.random.Generator(np.random.PCG64(streams[1])))
    ]
    pair_samples, scene_samples = np.concatenate(by_pair, axis=1), np.concatenate(by_scene, axis=1)
    found = {}
    for row, (name, quantity) in enumerate(quantities.items()):
        counted = ~np.isnan(quantity.values)
        count, value = int(counted.sum()), float(points[row])
        interval = scene_interval = _UNDEFINED
        if _is_degenerate(quantity, value):
            interval = wilson(value / 100.0, count)
        else:
            if count >= 2:
                interval = _interval(pair_samples[row], value, quantity.reflected)
            if len(np.unique(labels[counted])) >= 2:
                scene_interval = _interval(scene_samples[row], value, quantity.reflected)
        found[name] = Measure(value, quantity.unit, count, interval, scene_interval)
    return found


def wilson(share: float, count: int) -> Interval:
    """Wilson's 95 % interval in % for a share in [0, 1] of ``count`` independent outcomes; NaN for none."""
    if count == 0:
        return _UNDEFINED
    z2 = Z * Z / count
    center = (share + z2 / 2.0) / (1.0 + z2)
    half = Z * math.sqrt(share * (1.0 - share) / count + z2 / (4.0 * count)) / (1.0 + z2)
    low = 0.0 if share == 0.0 else max(0.0, center - half)
    high = 1.0 if share == 1.0 else min(1.0, center + half)
    return 100.0 * low, 100.0 * high


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
    columns = counts.T[rows]
    draws = _SortedDraws(columns)
    total = draws.upto[-1]
    position = q * np.maximum(total - 1.0, 0.0)
    # Sums of products such as 0.9 x 10 must not fall a last bit short of the whole number they are.
    position = np.where(np.abs(position - np.rint(position)) < 1e-9, np.rint(position), position)
    below = np.floor(position)
    low, high = ordered[draws.row_of(below)], ordered[draws.row_of(below + 1.0)]
    share = position - below
    with np.errstate(invalid="ignore"):
        between = np.where((share == 0.0) | (low == high), low, low + share * (high - low))
    return np.where(total > 0, between, np.nan)


class _SortedDraws:
    """Finds order statistics in counts (m, B) of sorted values: first the block of rows, then the row in it.

    A fifth of the time of cumulative sums over all rows.
    """

    _STEP = 40

    def __init__(self, columns: FloatArray):
        self.columns = columns
        self.sums = np.add.reduceat(columns, np.arange(0, len(columns), self._STEP), axis=0)
        self.upto = np.cumsum(self.sums, axis=0)

    def row_of(self, k: FloatArray) -> IntArray:
        """(B,) row of the k-th smallest draw (k (B,) from 0) of every resample; the last for k beyond all."""
        resample = np.arange(self.columns.shape[1])
        block = np.minimum((self.upto <= k).sum(axis=0), len(self.upto) - 1)
        before = self.upto[block, resample] - self.sums[block, resample]
        rows = np.minimum(block * self._STEP + np.arange(self._STEP)[:, None], len(self.columns) - 1)
        inside = before + np.cumsum(self.columns[rows, resample], axis=0)
        found: IntArray = np.minimum(block * self._STEP + (inside <= k).sum(axis=0), len(self.columns) - 1)
        return found


class _Evaluator:
    """All statistics of a set of quantities for blocks of resamples; means together, as matrix products."""

    def __init__(self, quantities: Sequence[Quantity], labels: IntArray, num_scenes: int):
        self.quantities = quantities
        self.labels = labels
        self.one_hot = np.zeros((len(labels), num_scenes))
        self.one_hot[np.arange(len(labels)), labels] = 1.0
        self.means = [k for k, q in enumerate(quantities) if q.statistic == "mean"]
        self.scene_means = [k for k, q in enumerate(quantities) if q.statistic == "scene_mean"]
        self.others = sorted(set(range(len(quantities))) - set(self.means) - set(self.scene_means))
        self.sums, self.counted = self._columns(self.means)
        self.scene_sums, self.scene_counted = self._columns(self.scene_means)

    def over_pairs(self, counts: FloatArray) -> FloatArray:
        """(number of quantities, B) for counts (B, n)."""
        found = np.empty((len(self.quantities), len(counts)))
        found[self.means] = _ratio(counts @ self.sums, counts @ self.counted).T
        for column, k in enumerate(self.scene_means):
            sums = counts @ (self.one_hot * self.scene_sums[:, column, None])
            counted = counts @ (self.one_hot * self.scene_counted[:, column, None])
            rates = _ratio(sums, counted)
            there = ~np.isnan(rates)
            found[k] = _ratio(np.where(there, rates, 0.0).sum(axis=1), there.sum(axis=1))
        for k in self.others:
            found[k] = self._other(k, counts)
        return found

    def over_scenes(self, scene_counts: FloatArray) -> FloatArray:
        """(number of quantities, B) for counts of scenes (B, S), each with all its pairs."""
        found = np.empty((len(self.quantities), len(scene_counts)))
        sums, counted = self.one_hot.T @ self.sums, self.one_hot.T @ self.counted
        found[self.means] = _ratio(scene_counts @ sums, scene_counts @ counted).T
        rates = _ratio(self.one_hot.T @ self.scene_sums, self.one_hot.T @ self.scene_counted)
        there = ~np.isnan(rates)
        found[self.scene_means] = _ratio(
            scene_counts @ np.where(there, rates, 0.0), scene_counts @ there.astype(np.float64)
        ).T
        if self.others:
            counts = scene_counts.T[self.labels].T
            for k in self.others:
                found[k] = self._other(k, counts)
        return found

    def _other(self, k: int, counts: FloatArray) -> FloatArray:
        quantity = self.quantities[k]
        if isinstance(quantity.statistic, (int, float)):
            return quantile(quantity.values, counts, float(quantity.statistic))
        if callable(quantity.statistic):
            return quantity.statistic(counts)
        raise InputError(f"there is no statistic '{quantity.statistic}'; there are mean and scene_mean")

    def _columns(self, which: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        values = np.zeros((len(self.labels), len(which)))
        for column, k in enumerate(which):
            values[:, column] = self.quantities[k].values
        if np.isinf(values).any():
            raise InputError("a mean of infinite values was asked for; leave them out (NaN) or take a median")
        counted = ~np.isnan(values)
        return np.where(counted, values, 0.0), counted.astype(np.float64)


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


def _is_degenerate(quantity: Quantity, value: float) -> bool:
    return quantity.statistic in ("mean", "scene_mean") and quantity.unit == "%" and value in (0.0, 100.0)


def _interval(samples: FloatArray, value: float, reflected: bool) -> Interval:
    """The middle 95 % of the samples that are defined, whole order statistics, rounded outwards."""
    ordered = np.sort(samples[~np.isnan(samples)])
    if ordered.size == 0:
        return _UNDEFINED
    tail = (1.0 - _LEVEL) / 2.0 * (ordered.size - 1)
    low, high = float(ordered[math.floor(tail)]), float(ordered[ordered.size - 1 - math.floor(tail)])
    if reflected:
        return max(0.0, 2.0 * value - high), max(0.0, 2.0 * value - low)
    return low, high
