"""A scan compared with all that a map keeps: what tells places apart that its grids do not."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from generated_buildings import AWAY, GRID, shift

from geomoe3d import Map
from geomoe3d.config import load_config
from geomoe3d.geometry.se3 import make_transform, motions_apart, shift_frames
from geomoe3d.maps.detail import FITS_IN_DETAIL, Detail
from geomoe3d.maps.finding import FITS_BETTER
from geomoe3d.maps.found import Found
from geomoe3d.maps.locate import Search
from geomoe3d.maps.voxels import VoxelSums
from geomoe3d.types import Hypothesis

STEP = 0.04


def wall(length, step):
    """(N, 3) of a wall along x, with a step of a few centimetres from ``step`` on, and of the floor before it."""
    x, z = np.meshgrid(np.arange(0, length, 0.01), np.arange(0, 1, 0.01))
    upright = np.stack([x, np.where(x > step, STEP, 0.0), z], -1).reshape(-1, 3)
    x, y = np.meshgrid(np.arange(0, length, 0.01), np.arange(-0.5, 0, 0.01))
    return np.concatenate([upright, np.stack([x, y, 0 * x], -1).reshape(-1, 3)])


@pytest.fixture(scope="module")
def detail():
    """A metre of such a wall with its step in the middle, in a wall of six metres with its step at 4.5."""
    voxels = VoxelSums.empty(0.02, np.zeros(3)).added(wall(6.0, 4.5))
    points = wall(1.0, 0.5)[::7]
    normals = np.where(np.arange(len(points))[:, None] < 10_000 / 7, [0.0, -1.0, 0.0], [0.0, 0.0, 1.0])
    drawn = np.random.default_rng(0).permutation(len(points))
    points, normals = points[drawn], normals[drawn]
    return Detail(voxels, 0.025, points, normals, points.mean(0), 1.0, None)


def test_a_step_of_centimetres_tells_a_wall_from_a_wall(detail):
    there, plain = (make_transform(np.eye(3), np.array([x, 0.0, 0.0])) for x in (4.0, 1.0))
    assert detail.score(there) > 0.95
    assert detail.score(plain) < 0.75


def test_what_is_off_by_little_is_drawn_to_its_place(detail):
    turn = np.deg2rad(2)
    R = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    T = detail.polished(make_transform(R, np.array([4.0, 0.03, 0.03])))
    away, turned = motions_apart(T, make_transform(np.eye(3), np.array([4.0, 0.0, 0.0])), detail.center)
    assert away < 0.02
    assert turned < 0.3
    assert detail.score(T) > 0.95


def test_motions_are_drawn_closer_together_as_each_is_alone(detail):
    starts = make_transform(
        np.tile(np.eye(3), (3, 1, 1)), np.array([[4.0, 0.03, 0.03], [1.0, -0.02, 0.01], [100.0, 0.0, 0.0]])
    )
    for together, start in zip(detail.polished(starts), starts, strict=True):
        np.testing.assert_allclose(together, detail.polished(start), atol=1e-9)


class Decided:
    """A decision of which only the answer and the doubt are asked."""

    def __init__(self, answer, reason=None):
        self.answer, self.reason = answer, reason

    def doubted(self, reason):
        return Decided(self.answer, reason)


def test_what_fits_best_in_detail_comes_first_and_is_not_ok_where_it_did_not(detail):
    there, plain = (Hypothesis(make_transform(np.eye(3), np.array([x, 0.0, 0.0]))) for x in (4.0, 1.0))
    search = SimpleNamespace(
        look=lambda h, fully: h, decide=lambda found: (Found(None, Decided(found[0]), sure=True), [])
    )
    before = Found(None, Decided(plain))
    best, ranked = detail.ordered(search, before, [plain, there])
    assert ranked == [there, plain]
    assert (best.decision.answer, best.decision.reason, best.sure) == (there, FITS_IN_DETAIL, False)
    assert detail.ordered(search, before, [there, plain]) == (before, [there, plain])


def test_where_nothing_is_near_a_motion_is_worth_nothing_and_stays(detail):
    far = make_transform(np.eye(3), np.full(3, 100.0))
    assert detail.score(far) == 0.0
    np.testing.assert_array_equal(detail.polished(far), far)


@pytest.fixture(scope="module")
def doubting(house):
    """A map that compares every answer in detail."""
    always = ["expert.detail.many_places=1", "expert.locating.checked_below=1"]
    made = Map(house._voxels, config=load_config(None, always))
    made.describe(2 * GRID)
    return made


def test_an_answer_is_not_ok_where_the_scan_fits_better_elsewhere(doubting, scan, monkeypatch):
    assert doubting.locate(scan[0]).ok  # its own place fits best

    def elsewhere(self, search, count):
        there = shift_frames(scan[1], np.zeros(3), -self.voxels.origin)
        there[:3, 3] += AWAY
        return [(2.0, there)]

    monkeypatch.setattr(Detail, "widely", elsewhere)
    found = doubting.locate(scan[0])
    assert found.status != "ok"
    assert FITS_BETTER in found.result.reasons
    assert shift(found.T_map_scan, scan[1]) < 0.05


def test_many_windows_find_what_the_likeliest_do_not(doubting, scan, monkeypatch):
    """The looks before it are given windows in which nothing fits: what is found in detail is the answer."""
    asked = []

    def none(self, **how):
        asked.append((how["more"], bool(how["given"])))
        return [] if not how["given"] else [(1.0, Hypothesis(T)) for T in how["given"]]

    monkeypatch.setattr(Search, "candidates", none)
    found = doubting.locate(scan[0])
    assert shift(found.T_map_scan, scan[1]) < 0.05
    assert asked == [(False, False), (True, True)]  # no further look at the whole map


def test_a_grid_made_in_the_end_is_not_asked_first(house):
    made = Map(house._voxels)
    made.describe(4 * GRID)
    before = made._level(4 * GRID, 5 * GRID, 300_000)
    assert made._level(1.5 * GRID, 2 * GRID, 1_000_000) is not before
    assert made._level(1.5 * GRID, 5 * GRID, 300_000) is before
    assert len(made.voxel_sizes) == 2
