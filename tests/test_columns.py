"""Reductions by columns give what numpy gives along the axes."""

from __future__ import annotations

import numpy as np
import pytest

from geomoe3d.geometry.columns import bounds, crossed, exponential, extents, finite_rows


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("count", [1, 7, 1000])
def test_same_as_along_the_axes(count: int, order: str) -> None:
    points = np.asarray(np.random.default_rng(count).normal(0, 1e6, (count, 3)), order=order)
    low, high = bounds(points)
    assert np.array_equal(low, points.min(0))
    assert np.array_equal(high, points.max(0))
    assert np.array_equal(extents(points), np.ptp(points, axis=0))
    np.testing.assert_allclose(crossed(points, points[::-1]), np.cross(points, points[::-1]), rtol=1e-12)


def test_rows_with_anything_that_is_no_number_are_not_finite() -> None:
    points = np.zeros((6, 3))
    points[1, 0], points[2, 1], points[4, 2] = np.nan, np.inf, -np.inf
    before = points.copy()
    assert finite_rows(points).tolist() == [True, False, False, True, False, True]
    assert np.array_equal(points, before, equal_nan=True)
    assert finite_rows(np.zeros((0, 3))).shape == (0,)


def test_an_exponential_keeps_no_number_that_slows_the_processor_and_no_sum_changes() -> None:
    x = np.linspace(0, -200, 2001, dtype=np.float32)
    plain, found = np.exp(x), exponential(x.copy())
    assert np.array_equal(found[x >= -80], plain[x >= -80])
    assert found.min() >= np.finfo(np.float32).tiny
    assert found.max() == 1 and np.array_equal(np.cumsum(found), np.cumsum(plain))
