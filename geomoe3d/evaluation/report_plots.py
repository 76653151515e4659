"""Which figures the HTML report shows of the runs on one benchmark and track, all runs in each.

Place: between `report_chart`, which draws, and `report_page`. Cost: a few milliseconds; curves over all pairs
are thinned to 200 points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from geomoe3d.evaluation.measures import ROTATION_LIMIT_DEG, TRANSLATION_LIMIT
from geomoe3d.evaluation.records import Measure, RunScore
from geomoe3d.evaluation.report_chart import Axis, Series, chart, escape

NUM_STAGE_COLORS = 16
MAX_CURVE_POINTS = 200


def figures(scores: Sequence[RunScore], runs: Sequence[int]) -> list[str]:
    """Figures of the runs on one benchmark and track, as HTML; those without anything to show are left out.

    Args:
        scores: runs of the same benchmark and track.
        runs: number of each run's label, for its colour.
    """
    pairs = list(zip(runs, scores, strict=True))
    names = dict.fromkeys(name for score in scores for name in score.curves)
    found = [curve_figure(name, pairs) for name in names]
    found += [
        error_figure(
            "Rotation error",
            Axis("rotation error below, deg", 0.1, 180.0, log=True),
            pairs,
            [[p.rotation_error_deg for p in score.pairs] for score in scores],
            (ROTATION_LIMIT_DEG, f"{ROTATION_LIMIT_DEG:g}°"),
        ),
        error_figure(
            "Translation error",
            Axis("translation error below, m", 0.01, 10.0, log=True),
            pairs,
            [[p.translation_error for p in score.pairs] for score in scores],
            (TRANSLATION_LIMIT, f"{TRANSLATION_LIMIT:g} m"),
        ),
        reliability_figure(pairs),
        risk_figure(pairs),
        acceptance_figure(pairs),
        time_figure(pairs),
    ]
    return [figure for figure in found if figure]


def curve_figure(name: str, runs: Sequence[tuple[int, RunScore]]) -> str:
    """A recall in bins (`RunScore.curves`) of all runs with its 95 % intervals; empty bins break the line.

    Bins are equally wide in the figure, whatever they are in the quantity; empty ones at either end are cut
    off. Runs whose bins differ from those of the first run are named below instead of drawn.
    """
    known = [(run, score, score.curves[name]) for run, score in runs if name in score.curves]
    known = [entry for entry in known if any(measure.count for measure in entry[2].measures)]
    if not known:
        return ""
    quantity, edges = known[0][2].quantity, known[0][2].edges
    curves = [entry for entry in known if entry[2].edges == edges]
    occupied = [k for k in range(len(edges) - 1) if any(c.measures[k].count for _, _, c in curves)]
    first, last = occupied[0], occupied[-1] + 1
    series = [
        Series(
            run,
            score.info.label,
            [(k + 0.5, curve.measures[k].value) for k in range(first, last)],
            [curve.measures[k].interval for k in range(first, last)],
            [
                f"{score.info.label}: {_measure_words(curve.measures[k])}, {quantity} {edges[k]:g} to "
                f"{edges[k + 1]:g}, {curve.measures[k].count:,} pairs"
                for k in range(first, last)
            ],
        )
        for run, score, curve in curves
    ]
    note = "Bands: 95 % intervals over pairs."
    others = [score.info.label for _, score, curve in known if curve.edges != edges]
    if others:
        note += f" Not drawn, because their bins differ: {', '.join(others)}."
    x = Axis(quantity, first, last, names=tuple((float(k), f"{edges[k]:g}") for k in range(first, last + 1)))
    return chart(
        f"Recall against {quantity}", x, Axis("% recall, 15 deg and 0.30 m", 0.0, 100.0), series, note=note
    )


def error_figure(
    title: str,
    x: Axis,
    runs: Sequence[tuple[int, RunScore]],
    errors: Sequence[Sequence[float | None]],
    limit: tuple[float, str],
) -> str:
    """Share of all pairs whose error is below a value; a pair without an answer is never below any."""
    series = []
    for (run, score), values in zip(runs, errors, strict=True):
        known = np.array([value for value in values if value is not None and not math.isnan(value)])
        if known.size == 0:
            continue
        finite = np.sort(known[np.isfinite(known)])
        shares = 100.0 * np.arange(1, len(finite) + 1) / known.size
        keep = np.unique(np.linspace(0, len(finite) - 1, min(len(finite), MAX_CURVE_POINTS)).astype(int))
        reached = 100.0 * float(np.mean(known <= x.low))
        points = [(x.low, reached)]
        for k in keep:
            if x.low < finite[k] <= x.high:  # a step: level up to the error, then up
                points += [(float(finite[k]), reached), (float(finite[k]), float(shares[k]))]
                reached = float(shares[k])
        points.append((x.high, 100.0 * float(np.mean(known <= x.high))))
        series.append(Series(run, score.info.label, points))
    if not series:
        return ""
    return chart(
        title,
        x,
        Axis("% of pairs", 0.0, 100.0),
        series,
        marks=(limit,),
        note="Cumulative, over all predicted pairs; pairs without an answer never count as below.",
    )


def reliability_figure(runs: Sequence[tuple[int, RunScore]]) -> str:
    """Share of right answers against stated confidence; the size of a mark goes with its pairs."""
    series = []
    for run, score in runs:
        if score.calibration is None or is_unrelated(score):
            continue
        bins = [b for b in score.calibration.bins if b.count and math.isfinite(b.success)]
        if not bins:
            continue
        most = max(b.count for b in bins)
        series.append(
            Series(
                run,
                score.info.label,
                [(b.confidence, 100.0 * b.success) for b in bins],
                tips=[
                    f"{score.info.label}: {100 * b.success:.1f} % right at mean confidence "
                    f"{b.confidence:.2f} ({b.low:.2f} to {b.high:.2f}), {b.count} pairs"
                    for b in bins
                ],
                sizes=[2.0 + 5.0 * math.sqrt(b.count / most) for b in bins],
            )
        )
    if not series:
        return ""
    return chart(
        "Reliability",
        Axis("stated confidence", 0.0, 1.0),
        Axis("% right", 0.0, 100.0),
        series,
        diagonal=True,
        note="On the dotted line the confidence is what it says. Larger marks hold more pairs.",
    )


def risk_figure(runs: Sequence[tuple[int, RunScore]]) -> str:
    """Share of wrong answers among those kept when only the most confident are kept."""
    series = []
    for run, score in runs:
        if score.calibration is None or not score.calibration.risk_coverage or is_unrelated(score):
            continue
        curve = np.asarray(score.calibration.risk_coverage, dtype=np.float64) * 100.0
        keep = np.unique(np.linspace(0, len(curve) - 1, min(len(curve), MAX_CURVE_POINTS)).astype(int))
        series.append(Series(run, score.info.label, [(float(a), float(b)) for a, b in curve[keep]]))
    if not series:
        return ""
    tops = [y for one in series for _, y in one.points if math.isfinite(y)]
    return chart(
        "Risk and coverage",
        Axis("% of pairs kept, most confident first", 0.0, 100.0),
        Axis("% wrong among them", 0.0, _round_up(max([1.0, *tops]))),
        series,
        note="Lower is better; a useful confidence keeps the left part near zero.",
    )


def acceptance_figure(runs: Sequence[tuple[int, RunScore]]) -> str:
    """For scans without a true motion: share of pairs whose confidence exceeds a value."""
    series = []
    for run, score in runs:
        if not is_unrelated(score):
            continue
        known = np.sort([p.confidence for p in score.pairs if p.confidence is not None])
        if known.size == 0:
            continue
        at = np.linspace(0.0, 1.0, 101)
        above = 100.0 * (known.size - np.searchsorted(known, at, side="right")) / len(score.pairs)
        series.append(Series(run, score.info.label, list(zip(at.tolist(), above.tolist(), strict=True))))
    if not series:
        return ""
    return chart(
        "Confidence in unrelated scans",
        Axis("confidence above", 0.0, 1.0),
        Axis("% of pairs", 0.0, 100.0),
        series,
        note="These scans have nothing in common: every confident answer is wrong, lower is better.",
    )


def time_figure(runs: Sequence[tuple[int, RunScore]]) -> str:
    """Mean time per pair by stage as bars, because means add up; a tick marks the median."""
    rows = []
    stages: dict[str, int] = {}
    for run, score in runs:
        seconds = np.array([p.seconds for p in score.pairs if math.isfinite(p.seconds)])
        if seconds.size == 0:
            continue
        mean = float(seconds.mean())
        parts: dict[str, float] = {}
        for pair in score.pairs:
            for name, value in pair.stages.items():
                if name != "total" and math.isfinite(value):
                    parts[name] = parts.get(name, 0.0) + value / len(seconds)
        whole = sum(parts.values())
        if whole > mean:  # stages measured inside the method may overlap or be rounded up
            parts = {name: value * mean / whole for name, value in parts.items()}
        for name in parts:
            stages.setdefault(name, len(stages) % NUM_STAGE_COLORS)
        rows.append((run, score, mean, float(np.median(seconds)), parts))
    if not rows:
        return ""
    longest = max(max(mean, median) for _, _, mean, median, _ in rows) or 1.0
    text = ""
    for run, score, mean, median, parts in rows:
        rest = max(0.0, mean - sum(parts.values()))
        pieces = "".join(
            f'<i class="s{stages[name]}" style="width:{100 * value / longest:.2f}%" '
            f'title="{escape(name)}: {_duration(value)}"></i>'
            for name, value in parts.items()
        )
        pieces += (
            f'<i class="rest" style="width:{100 * rest / longest:.2f}%" '
            f'title="not told apart: {_duration(rest)}"></i>'
        )
        text += (
            f'<div class="bar run r{run}"><span>{escape(score.info.label)}</span>'
            f'<span class="track">{pieces}<b style="left:{100 * median / longest:.2f}%"></b></span>'
            f"<span>{_duration(median)}<small>mean {_duration(mean)}</small></span></div>"
        )
    key = "".join(f'<li><i class="s{k}"></i>{escape(name)}</li>' for name, k in stages.items())
    key += '<li><i class="rest"></i>not told apart</li><li><i class="tick"></i>median</li>'
    return (
        f'<figure class="wide"><figcaption>Time per pair</figcaption><div class="bars">{text}</div>'
        f'<ul class="key">{key}</ul><p>Bars: mean wall time per pair, split by stage where the method tells '
        "them apart. Bold number: median.</p></figure>"
    )


def is_unrelated(score: RunScore) -> bool:
    """Whether the pairs of a run have no true motion; False for a run without pairs."""
    return bool(score.pairs) and all(pair.rotation_error_deg is None for pair in score.pairs)


def _measure_words(measure: Measure) -> str:
    low, high = measure.interval
    between = f" ({low:.1f} to {high:.1f})" if math.isfinite(low) and math.isfinite(high) else ""
    return f"{measure.value:.1f}{between} {measure.unit}".strip()


def _duration(seconds: float) -> str:
    if seconds >= 1.0:
        return f"{seconds:.2f} s"
    return f"{1e3 * seconds:.3g} ms"


def _round_up(value: float) -> float:
    step = 10.0 ** math.floor(math.log10(value))
    return next(f * step for f in (1.0, 2.0, 5.0, 10.0) if f * step >= value * (1 - 1e-9))
