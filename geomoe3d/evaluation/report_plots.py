"""The plots of the HTML report: small inline SVG, drawn here rather than by a library, one call per figure.

Colours are classes of the page's style sheet, so that light and dark mode both work; every series carries
the number of its run, so that the page can switch it off. Place: between `records` and `report_page`. Cost:
a millisecond per figure and 10 to 40 kB; curves over all pairs are thinned to 200 points.
"""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from geomoe3d.evaluation.measures import ROTATION_LIMIT_DEG, TRANSLATION_LIMIT
from geomoe3d.evaluation.records import Measure, RunScore

NUM_COLORS = 8
"""Run colours of the style sheet; further runs repeat them with broken lines."""
NUM_STAGE_COLORS = 16
MAX_CURVE_POINTS = 200

_WIDTH, _HEIGHT = 440.0, 290.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 12.0, 10.0, 40.0


@dataclass(frozen=True)
class Axis:
    """One axis of a figure.

    Attributes:
        label: what and unit.
        low: value at its beginning, more than 0 for ``log``.
        high: value at its end, more than ``low``.
        log: True for decades.
        names: (value, text) of the ticks; empty for round numbers.
    """

    label: str
    low: float
    high: float
    log: bool = False
    names: tuple[tuple[float, str], ...] = ()

    def share(self, value: float) -> float:
        """Where a value lies, 0 at the beginning to 1 at the end; values outside lie on the nearer end."""
        low, high = self.low, self.high
        value = min(max(value, low), high)
        if self.log:
            return math.log(value / low) / math.log(high / low)
        return (value - low) / (high - low)

    def ticks(self) -> list[tuple[float, str]]:
        """Values on the axis with their texts."""
        return list(self.names) or [(value, f"{value:g}") for value in self._round_values()]

    def _round_values(self) -> list[float]:
        """At most about eight."""
        if self.log:
            first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
            steps = (1.0, 2.0, 5.0) if math.log10(self.high / self.low) < 2.5 else (1.0,)
            found = [s * 10.0**k for k in range(first, last + 1) for s in steps]
        else:
            step = 10.0 ** math.floor(math.log10((self.high - self.low) / 3.0))
            step *= max(f for f in (1.0, 2.0, 5.0) if f * step <= (self.high - self.low) / 3.0)
            first = math.ceil(self.low / step - 1e-9)
            found = [k * step for k in range(first, math.floor(self.high / step + 1e-9) + 1)]
        slack = 1e-9 * (self.high - self.low)
        return [value for value in found if self.low - slack <= value <= self.high + slack]


@dataclass(frozen=True)
class Series:
    """One run in one figure.

    Attributes:
        run: number of the run's label, decides colour and dashes.
        name: the label.
        points: (x, y); a NaN breaks the line.
        band: (low, high) per point, NaN where there is none; empty for no band.
        tips: one text per point, shown on hover; empty for a line without marks.
        sizes: radius of each mark in pixels; empty takes 3.
    """

    run: int
    name: str
    points: Sequence[tuple[float, float]]
    band: Sequence[tuple[float, float]] = ()
    tips: Sequence[str] = ()
    sizes: Sequence[float] = ()


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
            f'title="{_escape(name)}: {_duration(value)}"></i>'
            for name, value in parts.items()
        )
        pieces += (
            f'<i class="rest" style="width:{100 * rest / longest:.2f}%" '
            f'title="not told apart: {_duration(rest)}"></i>'
        )
        text += (
            f'<div class="bar run r{run}"><span>{_escape(score.info.label)}</span>'
            f'<span class="track">{pieces}<b style="left:{100 * median / longest:.2f}%"></b></span>'
            f"<span>{_duration(median)}<small>mean {_duration(mean)}</small></span></div>"
        )
    key = "".join(f'<li><i class="s{k}"></i>{_escape(name)}</li>' for name, k in stages.items())
    key += '<li><i class="rest"></i>not told apart</li><li><i class="tick"></i>median</li>'
    return (
        f'<figure class="wide"><figcaption>Time per pair</figcaption><div class="bars">{text}</div>'
        f'<ul class="key">{key}</ul><p>Bars: mean wall time per pair, split by stage where the method tells '
        "them apart. Bold number: median.</p></figure>"
    )


def chart(
    title: str,
    x: Axis,
    y: Axis,
    series: Sequence[Series],
    *,
    marks: Sequence[tuple[float, str]] = (),
    diagonal: bool = False,
    note: str = "",
) -> str:
    """Lines over two axes as a figure element.

    Args:
        title: caption.
        x: horizontal axis.
        y: vertical axis.
        series: drawn in this order, bands below all lines.
        marks: vertical lines (x value, text).
        diagonal: True adds the dotted line from corner to corner.
        note: one sentence below.
    """
    parts = [_grid(x, y)]
    if diagonal:
        parts.append(_line([(x.low, y.low), (x.high, y.high)], x, y, "ideal"))
    for value, text in marks:
        at = _across(x, value)
        parts.append(f'<path class="mark" d="M{at:.1f} {_TOP}V{_HEIGHT - _BOTTOM}"/>')
        parts.append(f'<text x="{at - 4:.1f}" y="{_TOP + 11}" text-anchor="end">{_escape(text)}</text>')
    parts += [_band(one, x, y) for one in series if one.band]
    for one in series:
        parts.append(f'<g class="{run_classes(one.run)}">')
        parts += [_line(stretch, x, y, "line") for stretch in _stretches(one.points)]
        parts += [_dot(one, k, x, y) for k in range(len(one.tips))]
        parts.append("</g>")
    names = ", ".join(one.name for one in series)
    below = f"<p>{_escape(note)}</p>" if note else ""
    words = _escape(f"{title}: {y.label} against {x.label}, for {names}")
    return (
        f"<figure><figcaption>{_escape(title)}</figcaption>"
        f'<svg viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img" aria-label="{words}">{"".join(parts)}</svg>'
        f"{below}</figure>"
    )


def run_classes(run: int) -> str:
    """Classes of the style sheet for a run: to switch it, its colour, its dashes."""
    return f"run r{run} c{run % NUM_COLORS} d{min(run // NUM_COLORS, 3)}"


def is_unrelated(score: RunScore) -> bool:
    """Whether the pairs of a run have no true motion; False for a run without pairs."""
    return bool(score.pairs) and all(pair.rotation_error_deg is None for pair in score.pairs)


def _grid(x: Axis, y: Axis) -> str:
    right, bottom = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
    parts = []
    for value, text in x.ticks():
        at = _across(x, value)
        parts.append(f'<path d="M{at:.1f} {_TOP}V{bottom}"/>')
        parts.append(f'<text x="{at:.1f}" y="{bottom + 15}" text-anchor="middle">{text}</text>')
    for value, text in y.ticks():
        at = _down(y, value)
        parts.append(f'<path d="M{_LEFT} {at:.1f}H{right}"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{text}</text>')
    middle = (_TOP + bottom) / 2
    parts.append(
        f'<text x="{(_LEFT + right) / 2}" y="{_HEIGHT - 6}" text-anchor="middle">{_escape(x.label)}</text>'
        f'<text transform="translate(12 {middle}) rotate(-90)" text-anchor="middle">{_escape(y.label)}</text>'
    )
    return f'<g class="grid">{"".join(parts)}</g>'


def _band(one: Series, x: Axis, y: Axis) -> str:
    rows = [
        (px, *limits) if math.isfinite(py) and all(map(math.isfinite, limits)) else (px, math.nan, math.nan)
        for (px, py), limits in zip(one.points, one.band, strict=True)
    ]
    text = ""
    for stretch in _stretches([(px, low + high) for px, low, high in rows]):
        inside = [row for row in rows if any(row[0] == px for px, _ in stretch)]
        if len(inside) == 1:  # a bin between two empty ones: a bar instead of an area
            px, low, high = inside[0]
            text += (
                f'<path class="whisker" d="M{_across(x, px):.1f} {_down(y, low):.1f}V{_down(y, high):.1f}"/>'
            )
            continue
        outline = [(px, high) for px, _, high in inside] + [(px, low) for px, low, _ in reversed(inside)]
        text += f'<path class="band" d="M{_path(outline, x, y)}Z"/>'
    return f'<g class="{run_classes(one.run)}">{text}</g>'


def _line(points: Sequence[tuple[float, float]], x: Axis, y: Axis, kind: str) -> str:
    return f'<path class="{kind}" d="M{_path(points, x, y)}"/>'


def _dot(one: Series, k: int, x: Axis, y: Axis) -> str:
    px, py = one.points[k]
    if not (math.isfinite(px) and math.isfinite(py)):
        return ""
    radius = one.sizes[k] if one.sizes else 3.0
    return (
        f'<circle cx="{_across(x, px):.1f}" cy="{_down(y, py):.1f}" r="{radius:.1f}">'
        f"<title>{_escape(one.tips[k])}</title></circle>"
    )


def _path(points: Iterable[tuple[float, float]], x: Axis, y: Axis) -> str:
    return "L".join(f"{_across(x, px):.1f} {_down(y, py):.1f}" for px, py in points)


def _stretches(points: Sequence[tuple[float, float]]) -> list[list[tuple[float, float]]]:
    """The points between NaNs."""
    found: list[list[tuple[float, float]]] = [[]]
    for point in points:
        if math.isfinite(point[0]) and math.isfinite(point[1]):
            found[-1].append(point)
        elif found[-1]:
            found.append([])
    return [stretch for stretch in found if stretch]


def _across(x: Axis, value: float) -> float:
    return _LEFT + x.share(value) * (_WIDTH - _LEFT - _RIGHT)


def _down(y: Axis, value: float) -> float:
    return _HEIGHT - _BOTTOM - y.share(value) * (_HEIGHT - _TOP - _BOTTOM)


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


def _escape(text: str) -> str:
    return html.escape(text, quote=True)
