"""Recentring: an origin in whole units, near zero none, that neither order nor stray points move."""

from __future__ import annotations

import numpy as np
from cloud_files import MANY, UTM, cloud
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.recentre import choose_origin


@MANY
@given(seed=st.integers(0, 10**6), far=st.booleans(), num=st.integers(1, 60))
def test_row_order_does_not_change_the_origin(seed: int, far: bool, num: int) -> None:
    points = cloud(num, seed, UTM if far else 40.0)
    shuffled = np.random.default_rng(seed).permutation(points)
    assert np.array_equal(choose_origin(points), choose_origin(shuffled))


@MANY
@given(
    grid=hnp.arrays(
        np.int64, st.tuples(st.integers(2, 40), st.just(3)), elements=st.integers(-50_000, 50_000)
    ),
    first=st.tuples(*[st.integers(10**6, 10**7)] * 3),
    second=st.tuples(*[st.integers(-(10**7), -(10**6))] * 3),
)
def test_copies_moved_by_whole_units_have_the_same_local_points(grid, first, second) -> None:
    points = grid / 1024.0  # sums with whole numbers below 2^33 are exact
    a, b = load_points(points + first), load_points(points + second)
    assert a.points.tobytes() == b.points.tobytes()
    assert np.array_equal(a.origin - b.origin, np.subtract(first, second))
    assert np.array_equal(a.file_points, points + first)


def test_origin_is_zero_near_zero_and_whole_units_far_away() -> None:
    near = cloud(center=[100.0, 0.0, 0.0])
    assert not load_points(near).origin.any()
    assert np.array_equal(load_points(near).points, near)
    far = load_points(cloud(center=UTM))
    assert np.array_equal(far.origin, np.floor(np.median(cloud(center=UTM), axis=0) + 0.5))
    assert np.abs(np.median(far.points, axis=0)).max() <= 0.5


def test_stray_points_do_not_move_the_origin_or_hide_the_distance() -> None:
    points = cloud(center=UTM)
    stray = np.concatenate([points, [[0.0, 0.0, 0.0], [9e11, 0.0, 0.0]]])
    assert np.abs(load_points(stray).origin - load_points(points).origin).max() <= 3
    assert load_points(stray).origin.any()


def test_coordinates_of_1e9_keep_their_local_geometry() -> None:
    grid = np.random.default_rng(0).integers(0, 2**12, size=(100, 3)) / 2.0**10  # exact at 1e9
    loaded = load_points(grid + 1e9)
    shift = loaded.points[0] - grid[0]
    assert np.array_equal(loaded.points, grid + shift)
