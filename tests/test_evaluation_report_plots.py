"""Plots of the report: errors count every pair, the bars of time add up."""

from __future__ import annotations

import re

import numpy as np
import pytest

from geomoe3d.evaluation.report_plots import figures


def test_cumulative_errors_count_pairs_without_an_answer(two_runs):
    score = two_runs[0][0]  # 7 right exactly, 4 turned by 40 degrees, 1 without an answer
    text = next(f for f in figures([score], [0]) if "<figcaption>Rotation error<" in f)
    (line,) = re.findall(r'class="line" d="M([^"]*)"', text)
    heights = [float(point.split()[1]) for point in line.split("L")]
    bottom, top = 250.0, 10.0  # of the plot in the figure
    shares = [(bottom - height) / (bottom - top) for height in heights]
    assert shares[0] == pytest.approx(7 / 12, abs=1e-3)
    assert shares[-1] == pytest.approx(11 / 12, abs=1e-3)
    assert shares == sorted(shares)


def test_time_bars_add_up(two_runs):
    score = two_runs[0][0]
    text = next(f for f in figures([score], [0]) if "Time per pair" in f)
    widths = {name: float(w) for w, name in re.findall(r'width:([\d.]+)%" title="([\w ]+):', text)}
    mean = np.mean([pair.seconds for pair in score.pairs])
    assert widths.keys() == {"match", "filter", "not told apart"}  # total is not a stage
    assert widths["filter"] == pytest.approx(100 * 0.010 / mean, abs=0.02)
    assert sum(widths.values()) == pytest.approx(100.0, abs=0.05)
