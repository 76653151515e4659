"""Places in which a scan fits anywhere along a line, seen by sensors whose own pattern fits at one place only."""

from __future__ import annotations

import numpy as np
import pytest

import geomoe3d
from geomoe3d.types import FloatArray


def corridor(
    shift: float, turn_deg: float, *, rings: int, step_deg: float, reach: float, seed: int
) -> FloatArray:
    """One turn of a spinning sensor ``shift`` off the middle of an endless corridor, 3 by 2.6 units, in its frame."""
    rng = np.random.default_rng(seed)
    polar, azimuth = np.radians(np.linspace(-25, 15, rings)), np.radians(np.arange(0, 360, step_deg))
    E, A = (v.ravel() for v in np.meshgrid(polar, azimuth, indexing="ij"))
    turn = np.radians(turn_deg)
    out = np.stack([np.cos(E) * np.cos(A + turn), np.cos(E) * np.sin(A + turn), np.sin(E)], axis=1)
    with np.errstate(divide="ignore"):
        sides = np.where(out[:, 1] > 0, 1.5 - shift, -1.5 - shift) / out[:, 1]
        ends = np.where(out[:, 2] > 0, 1.2, -1.4) / out[:, 2]
    ranges = np.minimum(sides, ends)
    seen = (ranges < reach) & (ranges > 0.5)
    rays = np.stack([np.cos(E) * np.cos(A), np.cos(E) * np.sin(A), np.sin(E)], axis=1)[seen]
    points: FloatArray = rays * (ranges[seen] + rng.normal(0, 0.01, seen.sum()))[:, None]
    return points


def test_a_sensor_that_matches_itself_is_not_believed() -> None:
    source, target = (
        corridor(shift, turn, rings=80, step_deg=0.9, reach=14.4, seed=seed)
        for seed, shift, turn in ((1, 0.0, 10.0), (2, 0.3, -3.0))
    )
    result = geomoe3d.register(source, target)
    assert result.status == "ambiguous"
    assert "slide" in result.reasons[0]


def test_a_flat_cloud_is_named() -> None:
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, (2, 1500))
    ranges = 4 + np.sin(3 * angle) + 0.5 * np.cos(7 * angle)
    flat = [
        np.stack([r * np.cos(a), r * np.sin(a), 0 * a], axis=1) for r, a in zip(ranges, angle, strict=True)
    ]
    result = geomoe3d.register(*flat)
    assert not result.ok
    assert sum("is flat: all its points lie in one plane" in reason for reason in result.reasons) == 2


def test_a_straight_line_is_named_once_and_nothing_else_speaks(capfd: pytest.CaptureFixture[str]) -> None:
    line = geomoe3d.load_points(np.outer(np.linspace(-5, 5, 3000), [1.0, 2.0, 3.0]), name="line")
    result = geomoe3d.register(line, line)
    assert result.status == "failed"
    assert sum("lie on one straight line" in reason for reason in result.reasons) == 1
    few = np.random.default_rng(0).uniform(0, 5, (7, 3))
    found = geomoe3d.register(few, np.random.default_rng(1).uniform(0, 5, (4000, 3)), voxel_size=2.0)
    assert not found.ok
    assert capfd.readouterr().err == ""  # the library's own warnings on few points
