"""Surfaces draw their scans into place, and leave alone what overlaps nothing."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from pose_graphs import largest_error
from scipy.spatial.transform import Rotation
from small_scans import CUTS, SETTINGS, cut, scene

from geomoe3d.clouds.prepare import prepare
from geomoe3d.config import load_config
from geomoe3d.config.expert import in_force
from geomoe3d.geometry.se3 import inverse, make_transform, transform_points
from geomoe3d.multiway.alignment import Surface, align_scans, chosen_neighbors
from geomoe3d.multiway.overlaps import Overlaps
from geomoe3d.types import PointCloud

CONFIG = load_config(None, SETTINGS)


@pytest.fixture(scope="module")
def surfaces():
    """Six scans of one scene as surfaces, and one of another scene; true poses."""
    points, truth, made = scene(3), {}, {}
    for k, (low, high) in enumerate([*CUTS, (2.0, 4.4)]):
        part, truth[k] = cut(points, low, high, seed=20 + k)
        cloud = prepare(PointCloud(part), 0.12, CONFIG.preparation, viewpoint=None, seed=0)
        made[k] = Surface(cloud.points, cloud.normals, signed=False)
    elsewhere = prepare(PointCloud(scene(5) + 50), 0.12, CONFIG.preparation, viewpoint=None, seed=0)
    made[6], truth[6] = Surface(elsewhere.points, elsewhere.normals, signed=False), np.eye(4)
    return made, truth, Overlaps({k: s.points for k, s in made.items()}, 0.12)


def moved_about(truth, rng, turn=0.02, shift=0.1):
    poses = {}
    for k, T in truth.items():
        R = Rotation.from_rotvec(turn * rng.normal(size=3)).as_matrix()
        poses[k] = T @ make_transform(R, shift * rng.normal(size=3))
    return poses


def test_surfaces_draw_scans_into_place(surfaces):
    made, truth, overlaps = surfaces
    start = moved_about({k: truth[k] for k in range(6)}, np.random.default_rng(1))
    found = align_scans(start, made, overlaps, 0.12)
    assert np.abs(found[0] - start[0]).max() < 1e-12
    assert largest_error(start, truth) > 0.15
    assert largest_error(found, truth) < 0.03
    for T in found.values():
        assert np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-12
    # The frame of the group changes nothing: it may lie far away and be turned.
    away = make_transform(Rotation.random(random_state=9).as_matrix(), np.array([300.0, -40.0, 7.0]))
    far = align_scans({k: away @ T for k, T in start.items()}, made, overlaps, 0.12)
    assert max(np.abs(inverse(away) @ far[k] - found[k]).max() for k in found) < 1e-6


def test_a_scan_that_overlaps_nothing_stays_where_it_was(surfaces):
    made, truth, overlaps = surfaces
    start = {0: truth[0], 6: truth[6]}
    found = align_scans(start, made, overlaps, 0.12)
    assert all(np.abs(found[k] - start[k]).max() < 1e-12 for k in start)
    one = align_scans({3: truth[3]}, made, overlaps, 0.12)
    assert np.abs(one[3] - truth[3]).max() < 1e-12
    among = align_scans(moved_about(truth, np.random.default_rng(2), 0.01, 0.05), made, overlaps, 0.12)
    assert largest_error({k: among[k] for k in range(6)}, truth) < 0.03


def test_a_scan_is_laid_in_so_many_others_at_most_the_nearest_and_the_farthest_among_them(surfaces):
    made, truth, overlaps = surfaces
    shared = {(0, k): share for k, share in enumerate([0.9, 0.5, 0.7, 0.3, 0.2], start=1)} | {(1, 0): 0.9}
    start = moved_about({k: truth[k] for k in range(6)}, np.random.default_rng(1))
    known = overlaps.between(start, start, 0.1)
    with in_force(load_config(None, ["expert.many_poses.most_neighbors=3"]).expert):
        assert chosen_neighbors(shared) == [(0, 1), (0, 2), (0, 5), (1, 0)]
        assert len(chosen_neighbors(known)) < len(known)
        assert largest_error(align_scans(start, made, overlaps, 0.12), truth) < 0.03
    assert chosen_neighbors(shared) == sorted(shared)


@pytest.mark.parametrize(("least", "asked"), [(0.0, 2), (1000.0, 1)])
def test_it_is_asked_again_who_overlaps_whom_only_where_a_scan_moved(surfaces, least, asked):
    made, truth, overlaps = surfaces
    calls = []

    class Counted:
        def between(self, *given):
            calls.append(given)
            return overlaps.between(*given)

    start = moved_about({k: truth[k] for k in range(6)}, np.random.default_rng(1))
    with in_force(load_config(None, [f"expert.many_poses.moved_again={least}"]).expert):
        found = align_scans(start, made, Counted(), 0.12)
    assert len(calls) == asked
    assert largest_error(found, truth) < 0.03


def test_overlaps_of_many_are_the_shares_of_points_within_reach(surfaces):
    _, truth, overlaps = surfaces
    found = overlaps.between(truth, truth)
    some = overlaps.between(truth, truth, 0.3)
    assert some == {pair: share for pair, share in found.items() if share >= 0.3}
    assert 4 <= len(some) < len(found)
    for source, target in product(range(7), range(7)):
        if source == target:
            continue
        T = inverse(truth[target]) @ truth[source]
        asked, known = overlaps._points[source], overlaps._points[target]
        gaps = np.linalg.norm(transform_points(T, asked)[:, None] - known[None], axis=2).min(axis=1)
        expected = (gaps < overlaps._tree(target)[1]).mean()
        assert found.get((source, target), 0.0) == pytest.approx(expected, abs=0.003)
        assert overlaps.of(source, target, T) == pytest.approx(expected, abs=0.003)
    assert overlaps.of(0, 99, np.eye(4)) == 0.0
