"""Figures of the report: points where they belong, errors count every pair, the bars of time add up."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from report_runs import report

from geomoe3d.evaluation.report_drawing import Series, draw
from geomoe3d.evaluation.report_figures import figures, share_below, time_bars


def coordinates(path: str) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in re.findall(r"[ML] (-?[\d.]+) (-?[\d.]+)", path)]


def of_run(svg: str, run: int) -> list[str]:
    """What belongs to a run, without its tips."""
    return re.findall(rf'<g class="run r{run}">(?!<title>)(.*?)</g>', svg, re.DOTALL)


def test_a_figure_places_points_and_breaks_at_nan():
    nan = math.nan
    x, y = [0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 50.0, nan, 100.0, 100.0]
    intervals = [(0.0, 10.0), (40.0, 60.0), (nan, nan), (90.0, 100.0), (nan, nan)]
    one = Series(9, "r<b>", x, y, intervals, tips=["tip <&>"] * 5)
    figure = draw("T", ("x", "y"), [one], x=(0.0, 4.0))
    bars, line = of_run(figure.svg, 9)
    assert len(re.findall("<path", bars)) == 3
    assert len(re.findall("M ", line)) == 2  # two stretches
    points = coordinates(line)
    assert len(points) == 4
    (x0, y0), (x1, y1), (_, y3), _ = points
    assert x0 < x1
    assert y1 == pytest.approx((y0 + y3) / 2, abs=0.11)  # upwards, half way
    assert y3 < y0
    assert figure.svg.count("<title>tip &lt;&amp;&gt;</title>") == 4
    assert 'aria-label="T: y against x, for r&lt;b&gt;"' in figure.svg
    assert "var(--c1)" in figure.svg and "#abcd" not in figure.svg
    assert "stroke-dasharray" in line  # the second run of this colour
    assert draw("T", ("x", "y"), [], x=(0.0, 1.0)) is None


def test_decades_have_plain_numbers():
    figure = draw("T", ("x", "y"), [Series(0, "r", [0.01, 10.0], [0.0, 100.0])], x=(0.01, 10.0), log=True)
    texts = re.findall(r"<text[^>]*>([^<]*)</text>", figure.svg)
    assert [text for text in texts if text in ("0.01", "0.1", "1", "10")] == ["0.01", "0.1", "1", "10"]


def test_names_of_a_page_are_its_own(two_runs):
    """Two figures must not share a name."""
    other = [replace(pair, benchmark="3DLoMatch") for pair in two_runs[0][1]]
    score = replace(two_runs[0][0], info=replace(two_runs[0][0].info, benchmark="3DLoMatch"))
    text = report(*two_runs, (score, other, two_runs[0][2]))
    names = re.findall(r' id="([^"]*)"', text)
    assert len(names) == len(set(names))
    assert set(re.findall(r'href="#([^"]*)"', text)) <= set(names)
    assert "xlink" not in text and "url(" not in text.split("<body>")[1]


def test_cumulative_errors_count_pairs_without_an_answer(two_runs):
    score = two_runs[0][0]  # 7 right exactly, 4 turned by 40 degrees, 1 without an answer
    errors = np.array([pair.rotation_error_deg for pair in score.pairs])
    x, shares = share_below(errors, 0.1, 180.0)
    assert (x[0], x[-1]) == (0.1, 180.0)
    assert shares[0] == pytest.approx(100 * 7 / 12)
    assert shares[-1] == pytest.approx(100 * 11 / 12)
    assert list(shares) == sorted(shares)
    figure = next(f for f in figures([score], [0]) if f.title == "Rotation error")
    (line,) = of_run(figure.svg, 0)
    heights = [height for _, height in coordinates(line)]
    assert heights[0] > heights[-1]


def test_time_bars_add_up(two_runs):
    score = two_runs[0][0]
    (bar,) = time_bars([score], [0])
    mean = np.mean([pair.seconds for pair in score.pairs])
    assert bar.stages.keys() == {"match", "filter"}  # total is not a stage
    assert bar.stages["filter"] == pytest.approx(0.010)
    assert sum(bar.stages.values()) + bar.rest == pytest.approx(bar.mean) == pytest.approx(mean)
    text = report(two_runs[0])
    widths = {name: float(w) for w, name in re.findall(r'width:([\d.]+)%" title="([\w ]+):', text)}
    assert widths.keys() == {"match", "filter", "not told apart"}
    assert widths["filter"] == pytest.approx(100 * 0.010 / mean, abs=0.02)
    assert sum(widths.values()) == pytest.approx(100.0, abs=0.05)
