"""The figures of the HTML report: all runs on one benchmark and track in each, drawn in `report_drawing`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geomoe3d.evaluation.config import RULES
from geomoe3d.evaluation.records import Measure, RunScore
from geomoe3d.evaluation.report_drawing import Figure, Series, draw
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray, IntArray


def figures(scores: Sequence[RunScore], runs: Sequence[int]) -> list[Figure]:
    """Figures of the runs on one benchmark and track; those without anything to show are left out.

    Args:
        scores: runs of the same benchmark and track.
        runs: number of each run's label, for its colour.
    """
    pairs = list(zip(runs, scores, strict=True))
    names = dict.fromkeys(name for score in scores for name in score.curves)
    return [
        *filter(None, (_recall_figure(name, pairs) for name in names)),
        *_error_figures(pairs),
        *_confidence_figures(pairs),
    ]


def _recall_figure(name: str, runs: Sequence[tuple[int, RunScore]]) -> Figure | None:
    """A recall in bins (`RunScore.curves`) of all runs with its 95 % intervals; empty bins break the line.

    Bins are equally wide in the figure, whatever they are in the quantity; empty ones at either end are cut
    off. Runs whose bins differ from those of the first run are named below instead of drawn.
    """
    known = [(run, score.info.label, score.curves[name]) for run, score in runs if name in score.curves]
    known = [entry for entry in known if any(measure.count for measure in entry[2].measures)]
    if not known:
        return None
    quantity, edges = known[0][2].quantity, known[0][2].edges
    drawn = [entry for entry in known if entry[2].edges == edges]
    occupied = [k for k in range(len(edges) - 1) if any(curve.measures[k].count for *_, curve in drawn)]
    bins = range(occupied[0], occupied[-1] + 1)
    series = [
        Series(
            run,
            label,
            [k + 0.5 for k in bins],
            [curve.measures[k].value for k in bins],
            [curve.measures[k].interval for k in bins],
            [
                f"{label}: {_measure_words(curve.measures[k])}, {quantity} {edges[k]:g} to {edges[k + 1]:g}, "
                + counted(curve.measures[k].count, "pair")
                for k in bins
            ],
        )
        for run, label, curve in drawn
    ]
    note = "Bars: 95 % intervals over pairs."
    others = [label for _, label, curve in known if curve.edges != edges]
    if others:
        note += f" Not drawn, because their bins differ: {', '.join(others)}."
    return draw(
        f"Recall against {quantity}",
        (quantity, "% recall, 15 deg and 0.30 m"),
        series,
        x=(bins[0], bins[-1] + 1),
        ticks={float(k): f"{edges[k]:g}" for k in (*bins, bins[-1] + 1)},
        note=note,
    )


def _error_figures(runs: Sequence[tuple[int, RunScore]]) -> list[Figure]:
    found = []
    for what, key, unit, ends, limit in (
        ("Rotation", "rotation_error_deg", "deg", (0.1, 180.0), (RULES.rotation_limit_deg, "15°")),
        ("Translation", "translation_error", "m", (0.01, 10.0), (RULES.translation_limit, "0.3 m")),
    ):
        series = []
        for run, score in runs:
            values = np.array([getattr(p, key) for p in score.pairs], dtype=np.float64)
            if not np.isnan(values).all():
                series.append(Series(run, score.info.label, *share_below(values, *ends), steps=True))
        figure = draw(
            f"{what} error",
            (f"{what.lower()} error below, {unit}", "% of pairs"),
            series,
            x=ends,
            log=True,
            limit=limit,
            note="Cumulative, over all predicted pairs; pairs without an answer never count as below.",
        )
        found += [figure] if figure else []
    return found


def share_below(values: FloatArray, low: float, high: float) -> tuple[FloatArray, FloatArray]:
    """Points (x, %) of the share of values (n,) up to x, for x from low to high; NaN is not counted."""
    ordered = np.sort(values[~np.isnan(values)])
    inside = ordered[(ordered > low) & (ordered <= high)]
    x = np.concatenate([[low], inside[_some(len(inside))], [high]])
    return x, 100.0 * np.searchsorted(ordered, x, side="right") / len(ordered)


def _some(count: int, most: int = 200) -> IntArray:
    """At most so many rows of a curve, evenly spread: more are not seen."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def _confidence_figures(runs: Sequence[tuple[int, RunScore]]) -> list[Figure]:
    """Reliability, risk against coverage, and what is believed of unrelated scans."""
    reliable, risky, believed = [], [], []
    for run, score in runs:
        label, calibration = score.info.label, score.calibration
        if is_unrelated(score):
            known = np.sort([p.confidence for p in score.pairs if p.confidence is not None])
            at = np.linspace(0.0, 1.0, 101)
            above = 100.0 * (known.size - np.searchsorted(known, at, side="right")) / len(score.pairs)
            believed += [Series(run, label, at, above)] if known.size else []
        elif calibration is not None:
            bins = [b for b in calibration.bins if b.count and math.isfinite(b.success)]
            most = max((b.count for b in bins), default=1)
            tips = [
                f"{label}: {100 * b.success:.1f} % right at mean confidence {b.confidence:.2f} "
                f"({b.low:.2f} to {b.high:.2f}), {counted(b.count, 'pair')}"
                for b in bins
            ]
            x, y = [b.confidence for b in bins], [100.0 * b.success for b in bins]
            sizes = [3.0 + 8.0 * math.sqrt(b.count / most) for b in bins]
            reliable += [Series(run, label, x, y, tips=tips, sizes=sizes)] if bins else []
            curve = 100.0 * np.reshape(calibration.risk_coverage, (-1, 2))
            risky += [Series(run, label, *curve[_some(len(curve))].T)] if len(curve) else []
    top = max([1.0, *(float(np.max(one.y)) for one in risky)])
    found = (
        draw(
            "Reliability",
            ("stated confidence", "% right"),
            reliable,
            x=(0.0, 1.0),
            diagonal=True,
            note="On the dotted line the confidence is what it says. Larger marks hold more pairs.",
        ),
        draw(
            "Risk and coverage",
            ("% of pairs kept, most confident first", "% wrong among them"),
            risky,
            x=(0.0, 100.0),
            y=(0.0, top),
            note="Lower is better; a useful confidence keeps the left part near zero.",
        ),
        draw(
            "Confidence in unrelated scans",
            ("confidence above", "% of pairs"),
            believed,
            x=(0.0, 1.0),
            note="These scans have nothing in common: every confident answer is wrong, lower is better.",
        ),
    )
    return [figure for figure in found if figure is not None]


@dataclass(frozen=True)
class TimeBar:
    """Times of one run: mean seconds by stage, what is left of the mean, and the median."""

    run: int
    name: str
    stages: dict[str, float]
    rest: float
    mean: float
    median: float


def time_bars(scores: Sequence[RunScore], runs: Sequence[int]) -> list[TimeBar]:
    """Mean time per pair by stage, because means add up; runs whose times are not known are left out."""
    bars = []
    for run, score in zip(runs, scores, strict=True):
        seconds = [pair.seconds for pair in score.pairs if math.isfinite(pair.seconds)]
        if not seconds:
            continue
        mean = float(np.mean(seconds))
        stages: dict[str, float] = {}
        for pair in score.pairs:
            for name, value in pair.stages.items():
                if name != "total" and math.isfinite(value):
                    stages[name] = stages.get(name, 0.0) + value / len(seconds)
        whole = sum(stages.values())
        if whole > mean:  # stages measured inside the method may overlap or be rounded up
            stages = {name: value * mean / whole for name, value in stages.items()}
        rest = max(0.0, mean - whole)
        bars.append(TimeBar(run, score.info.label, stages, rest, mean, float(np.median(seconds))))
    return bars


def is_unrelated(score: RunScore) -> bool:
    """Whether the pairs of a run have no true motion; False for a run without pairs."""
    return bool(score.pairs) and all(pair.rotation_error_deg is None for pair in score.pairs)


def _measure_words(measure: Measure) -> str:
    low, high = measure.interval
    between = f" ({low:.1f} to {high:.1f})" if math.isfinite(low) and math.isfinite(high) else ""
    return f"{measure.value:.1f}{between} {measure.unit}".strip()
