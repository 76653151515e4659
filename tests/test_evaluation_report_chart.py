"""A chart as SVG: ticks and points where they belong, broken lines where nothing is known."""

from __future__ import annotations

import math
import re

import pytest

from geomoe3d.evaluation.report_chart import Axis, Series, chart


def test_axis():
    linear, decades = Axis("x", 2.0, 4.0), Axis("x", 0.01, 10.0, log=True)
    assert [linear.share(v) for v in (2.0, 2.5, 4.0, 9.0, -1.0)] == [0.0, 0.25, 1.0, 1.0, 0.0]
    assert decades.share(1.0) == pytest.approx(2 / 3)
    assert [text for _, text in decades.ticks()] == ["0.01", "0.1", "1", "10"]
    for high in (0.013, 0.5, 1.0, 7.0, 100.0, 2345.0):
        values = [value for value, _ in Axis("x", 0.0, high).ticks()]
        assert 3 <= len(values) <= 11
        assert values[0] == 0.0
        assert high * 0.6 <= values[-1] <= high * (1 + 1e-9)


def test_chart_places_points_and_breaks_at_nan():
    nan = math.nan
    points = [(0.0, 0.0), (1.0, 50.0), (2.0, nan), (3.0, 100.0), (4.0, 100.0)]
    band = [(0.0, 10.0), (40.0, 60.0), (nan, nan), (90.0, 100.0), (nan, nan)]
    text = chart("T", Axis("x", 0.0, 4.0), Axis("y", 0.0, 100.0), [Series(9, "r", points, band, ["tip"] * 5)])
    lines = re.findall(r'class="line" d="M([^"]*)"', text)
    assert [len(line.split("L")) for line in lines] == [2, 2]
    circles = [tuple(map(float, c)) for c in re.findall(r'cx="([\d.]+)" cy="([\d.]+)"', text)]
    assert len(circles) == 4
    (x0, y0), (x1, y1), (_, y3), _ = circles
    assert x0 < x1
    assert y1 == pytest.approx((y0 + y3) / 2, abs=0.11)  # upwards, half way
    assert len(re.findall('class="band"', text)) == 1
    assert len(re.findall('class="whisker"', text)) == 1
    assert 'class="run r9 c1 d1"' in text
