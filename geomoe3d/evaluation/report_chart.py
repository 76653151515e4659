"""Lines over two axes as inline SVG, drawn here rather than by a library, in the colours of the page.

Colours are classes of the page's style sheet, so that light and dark mode both work; every series carries
the number of its run, so that the page can switch it off. Place: below `report_plots`. Cost: a millisecond
and 10 to 40 kB per figure.
"""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

NUM_COLORS = 8
"""Run colours of the style sheet; further runs repeat them with broken lines."""

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
        parts.append(f'<text x="{at - 4:.1f}" y="{_TOP + 11}" text-anchor="end">{escape(text)}</text>')
    parts += [_band(one, x, y) for one in series if one.band]
    for one in series:
        parts.append(f'<g class="{run_classes(one.run)}">')
        parts += [_line(stretch, x, y, "line") for stretch in _stretches(one.points)]
        parts += [_dot(one, k, x, y) for k in range(len(one.tips))]
        parts.append("</g>")
    names = ", ".join(one.name for one in series)
    below = f"<p>{escape(note)}</p>" if note else ""
    words = escape(f"{title}: {y.label} against {x.label}, for {names}")
    return (
        f"<figure><figcaption>{escape(title)}</figcaption>"
        f'<svg viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img" aria-label="{words}">{"".join(parts)}</svg>'
        f"{below}</figure>"
    )


def run_classes(run: int) -> str:
    """Classes of the style sheet for a run: to switch it, its colour, its dashes."""
    return f"run r{run} c{run % NUM_COLORS} d{min(run // NUM_COLORS, 3)}"


def escape(text: str) -> str:
    """Text for the inside of an element or of an attribute in double quotes."""
    return html.escape(text, quote=True)


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
        f'<text x="{(_LEFT + right) / 2}" y="{_HEIGHT - 6}" text-anchor="middle">{escape(x.label)}</text>'
        f'<text transform="translate(12 {middle}) rotate(-90)" text-anchor="middle">{escape(y.label)}</text>'
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
        f"<title>{escape(one.tips[k])}</title></circle>"
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
