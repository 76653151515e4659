"""How a figure of the report is drawn: lines over two axes as SVG for the inside of a page, by matplotlib.

Colours stand for variables of the page's style sheet, so that light and dark mode both work; what belongs to
a run carries its number as a class, so that the page can switch it off. Cost: some 50 ms per figure.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import ArrayLike

NUM_COLORS = 8
"""Run colours of the style sheet; further runs repeat them with broken lines."""
_DASHES = ("solid", "dashed", "dotted", "dashdot")
_SOFT, _LINE, _PAPER = "#abcdf0", "#abcdf1", "#abcdf2"
_VARIABLES = {_SOFT: "var(--soft)", _LINE: "var(--line)", _PAPER: "var(--paper)"}
_VARIABLES |= {f"#abcde{k}": f"var(--c{k})" for k in range(NUM_COLORS)}
"""Colours that are replaced by those of the style sheet."""


@dataclass(frozen=True)
class Figure:
    """A figure of the page: its caption, what is drawn, and a sentence below."""

    title: str
    svg: Markup
    note: str


@dataclass(frozen=True)
class Series:
    """One run in one figure.

    Attributes:
        run: number of the run's label, decides colour and dashes.
        name: the label.
        x, y: (n,) points; a NaN breaks the line.
        intervals: (n, 2) low and high, NaN where there are none; None for no intervals.
        tips: one text per point, shown on hover; empty for a line without marks.
        sizes: diameter of each mark in points; empty takes 5.
        steps: whether y keeps its value up to the next x.
    """

    run: int
    name: str
    x: ArrayLike
    y: ArrayLike
    intervals: ArrayLike | None = None
    tips: Sequence[str] = ()
    sizes: Sequence[float] = ()
    steps: bool = False


def draw(
    title: str,
    labels: tuple[str, str],
    series: Sequence[Series],
    *,
    x: tuple[float, float],
    y: tuple[float, float] = (0.0, 100.0),
    log: bool = False,
    ticks: dict[float, str] | None = None,
    limit: tuple[float, str] | None = None,
    diagonal: bool = False,
    note: str = "",
) -> Figure | None:
    """Lines over two axes; None where there are none.

    Args:
        title: caption.
        labels: of the horizontal and the vertical axis.
        series: drawn in this order.
        x, y: ends of the axes.
        log: True for decades on the horizontal axis.
        ticks: value -> text on the horizontal axis; None for round numbers.
        limit: a vertical line: x value, text.
        diagonal: True adds the dotted line from corner to corner.
        note: one sentence below.
    """
    if not series:
        return None
    from matplotlib import rc_context
    from matplotlib.figure import Figure as Canvas

    with rc_context({"svg.fonttype": "none"}):
        canvas = Canvas(figsize=(4.4, 2.9), layout="constrained")
        axes = canvas.add_subplot(xlim=x, ylim=y, xscale="log" if log else "linear")
        axes.set_xlabel(labels[0], color=_SOFT, parse_math=False)
        axes.set_ylabel(labels[1], color=_SOFT, parse_math=False)
        if ticks is not None:
            axes.set_xticks(list(ticks), labels=list(ticks.values()))
        elif log:
            axes.xaxis.set_major_formatter("{x:g}")
        axes.grid(color=_LINE, clip_on=False)
        axes.tick_params(length=0, which="both", pad=6, labelcolor=_SOFT)
        axes.spines[:].set_visible(False)
        if diagonal:
            axes.plot(x, y, color=_SOFT, linestyle="dotted", clip_on=False)
        if limit is not None:
            axes.axvline(limit[0], color=_SOFT, linestyle="dashed", linewidth=1, clip_on=False)
            axes.text(limit[0], 0.97 * y[1], f"{limit[1]} ", color=_SOFT, ha="right", va="top")
        for one in series:
            _draw_series(axes, one)
        buffer = io.StringIO()
        unsaid = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        canvas.savefig(buffer, format="svg", transparent=True, metadata=unsaid)
    names = ", ".join(one.name for one in series)
    words = f"{title}: {labels[1]} against {labels[0]}, for {names}"
    return Figure(title, _for_page(buffer.getvalue(), words), note)


def _draw_series(axes: Any, one: Series) -> None:
    x, y = np.asarray(one.x, dtype=np.float64), np.asarray(one.y, dtype=np.float64)
    color, dashes = f"#abcde{one.run % NUM_COLORS}", _DASHES[min(one.run // NUM_COLORS, 3)]
    name = f"run r{one.run}"
    if one.intervals is not None:
        low, high = np.asarray(one.intervals, dtype=np.float64).T
        known = np.isfinite(y) & np.isfinite(low) & np.isfinite(high)
        bars = axes.vlines(x[known], low[known], high[known], color, linewidth=5, alpha=0.25, clip_on=False)
        bars.set_gid(name)
    style = {"drawstyle": "steps-post" if one.steps else "default", "linestyle": dashes}
    axes.plot(x, y, color=color, gid=name, clip_on=False, **style)
    for k, tip in enumerate(one.tips):
        if math.isfinite(x[k]) and math.isfinite(y[k]):
            size = one.sizes[k] if one.sizes else 5.0
            mark = {"marker": "o", "markersize": size, "markeredgecolor": _PAPER}
            axes.plot(x[k], y[k], color=color, gid=f"{name}|{tip}", clip_on=False, **mark)


def _for_page(svg: str, words: str) -> Markup:
    """SVG for the inside of a page: no names of its own, classes for runs, colours of the style sheet.

    A mark that matplotlib draws by the name of its shape gets the shape itself.
    """
    found = re.search(r'viewBox="([^"]*)".*?</style>\s*</defs>(.*)', svg, re.DOTALL)
    assert found is not None
    box, inside = found.groups()
    shapes = dict(re.findall(r'<path id="(\w+)" d="([^"]*)"', inside))
    inside = re.sub(r"<defs>.*?</defs>", "", inside, flags=re.DOTALL)
    inside = re.sub(
        r'<use xlink:href="#(\w+)" x="([^"]*)" y="([^"]*)"',
        lambda m: f'<path d="{shapes[m[1]]}" transform="translate({m[2]} {m[3]})"',
        inside,
    )
    inside = re.sub(
        r'<g id="(?:(run r\d+)(?:\|([^"]*))?|[^"]*)">',
        lambda m: (f'<g class="{m[1]}">' if m[1] else "<g>") + (f"<title>{m[2]}</title>" if m[2] else ""),
        re.sub(r"<g [^>]*/>", "", inside),
    )
    inside = re.sub(r"font-family: [^;\"]*;? ?", "", inside)
    for color, variable in _VARIABLES.items():
        inside = inside.replace(color, variable)
    return Markup(f'<svg viewBox="{box}" role="img" aria-label="{escape(words)}">{inside.strip()}')
