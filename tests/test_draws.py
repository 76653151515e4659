"""Seeded draws by place: what one point more, less or elsewhere may change."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geomoe3d.geometry.draws import OFF_ROUND, cell_ranks, drawn_rows

SEEDS = st.integers(0, 2**32 - 1)


def drawn(points: np.ndarray, limit: int, seed: int = 0) -> set[tuple[float, ...]]:
    return {tuple(p) for p in points[drawn_rows(points, 1.0, limit, seed)]}


@given(SEEDS, st.integers(1, 400))
@settings(max_examples=30, deadline=None)
def test_one_point_more_changes_one_of_the_drawn_at_most(seed: int, limit: int) -> None:
    rng = np.random.default_rng(seed)
    points = 100 * rng.normal(size=(300, 3))
    more = np.insert(points, rng.integers(300), 100 * rng.normal(size=3), axis=0)
    assert len(drawn(points, limit) - drawn(more, limit)) <= 1
    assert drawn(points[rng.permutation(300)], limit) == drawn(points, limit)


def test_points_of_a_cell_share_their_rank_and_others_do_not() -> None:
    rng = np.random.default_rng(1)
    cells = rng.integers(-1000, 1000, (500, 6)).astype(float)
    inside = cells + OFF_ROUND + rng.uniform(0.01, 0.99, cells.shape)
    np.testing.assert_array_equal(
        cell_ranks(0.1 * inside, 0.1, 7), cell_ranks(cells + OFF_ROUND + 0.5, 1.0, 7)
    )
    assert len(set(cell_ranks(inside, 1.0, 7).tolist())) == len(np.unique(cells, axis=0))


def test_neighbours_are_drawn_as_independently_as_others() -> None:
    """Every place is as likely whatever its neighbours are, over seeds: a draw of a quarter."""
    places = np.stack(np.meshgrid(*2 * [np.arange(30.0)], [0.0]), -1).reshape(-1, 3) + 0.1
    often = np.zeros((200, 30, 30))
    for seed, taken in enumerate(often):
        taken.ravel()[drawn_rows(places, 1.0, 225, seed)] = 1
    assert often.mean(0).std() == pytest.approx(np.sqrt(0.25 * 0.75 / 200), rel=0.1)
    both = (often[:, 1:] * often[:, :-1]).mean()
    assert both == pytest.approx(1 / 16, abs=0.002)


def test_what_goes_first_goes_first_and_rows_rise() -> None:
    points = 100 * np.random.default_rng(2).normal(size=(200, 3))
    first = np.arange(200) % 4 == 0
    rows = drawn_rows(points, 1.0, 80, first=first)
    assert first[rows].sum() == 50
    assert (np.diff(rows) > 0).all()
    assert set(rows[~first[rows]]) < set(np.flatnonzero(~first)[drawn_rows(points[~first], 1.0, 31)])
    np.testing.assert_array_equal(drawn_rows(points, 1.0, 200), np.arange(200))
    assert len(drawn_rows(np.zeros((0, 3)), 1.0, 5)) == 0


def test_far_places_and_all_seeds_have_ranks() -> None:
    far = np.array([[1e30, -1e30, 0.0], [0, 0, 0]])
    with np.errstate(invalid="ignore"):
        assert len(cell_ranks(far, 1e-3, 2**63)) == 2
