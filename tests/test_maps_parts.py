"""What a map is made of: voxels, features of some of its points, normals with signs, votes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomoe3d.config import PreparationConfig, RegistrationConfig, expert
from geomoe3d.features.base import with_features
from geomoe3d.features.learned import LearnedDescriptor
from geomoe3d.features.multiscale import MultiscaleDescriptor
from geomoe3d.features.pyramid import pyramid
from geomoe3d.geometry.se3 import make_transform, transform_points
from geomoe3d.maps import finding
from geomoe3d.maps.facing import both_sides, facing_alike
from geomoe3d.maps.found import Found
from geomoe3d.maps.level import Compared, Level
from geomoe3d.maps.locate import Search
from geomoe3d.maps.places import Query, Window, likest
from geomoe3d.maps.sight import Sight, seen_through
from geomoe3d.maps.voxels import VoxelSums
from geomoe3d.runtime.timing import StageClock
from geomoe3d.types import Hypothesis, PointCloud, PreparedCloud

UTM = np.array([583394.0, 5283100.0, 498.0])


def test_of_a_small_scan_also_second_choices_propose():
    rng = np.random.default_rng(11)
    points, T = rng.uniform(-1, 1, (60, 3)), make_transform(Rotation.random(rng=3).as_matrix(), np.ones(3))
    normals, features = rng.normal(size=(60, 3)), rng.normal(size=(60, 65)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    alike = features + rng.normal(0, 0.02, features.shape).astype(np.float32)
    alike /= np.linalg.norm(alike, axis=1, keepdims=True)
    there = Compared(  # each point has its partner, and elsewhere one that is more like it
        np.concatenate([transform_points(T, points), rng.uniform(-2, 2, (60, 3))]),
        np.concatenate([normals @ T[:3, :3].T, normals]),
        np.concatenate([alike, features]),
    )
    level = SimpleNamespace(compared=there, voxel_size=0.02)
    window = Window(np.ones(3), np.arange(120), 1.0)
    best = Query(Compared(points, normals, features), level).motions(window, 1)[0]
    np.testing.assert_allclose(best.T_target_source, T, atol=1e-3)


def test_a_place_with_no_point_of_the_map_around_it_is_worth_nothing():
    """A scan of two far ends: its middle lies where the map has nothing."""
    ends = np.random.default_rng(0).uniform(0, 1, (200, 3)) * (1, 1, 0) + np.repeat(
        [[0, 0, 0], [50, 0, 0]], 100, axis=0
    )
    up = np.tile([0.0, 0.0, 1.0], (200, 1))
    rows, none = np.arange(200), np.zeros(0, dtype=np.int64)
    fpfh, features = np.zeros((200, 33), np.float16), np.zeros((200, 65), np.float32)
    level = Level(0.1, ends, up, fpfh, rows, features, none, features[:0], np.zeros((0, 3)))
    scan = SimpleNamespace(points=ends, normals=up)
    search = SimpleNamespace(
        level=level,
        _sight=level,
        scan=scan,
        center=ends.mean(0),
        reach=1.0,
        _rows=np.arange(200),
        _order=np.arange(200),
        _view=object(),
    )
    assert Search.quick(search, np.eye(4)) == 0.0
    search._view = None
    assert Search.quick(search, np.eye(4)) == 1.0


def test_a_place_is_followed_by_those_where_the_map_is_the_same():
    def at(x):
        return make_transform(np.eye(3), np.array([x, 0.0, 0.0]))

    search = SimpleNamespace(
        differ=lambda a, b: abs(a.T_target_source[0, 3] - b.T_target_source[0, 3]) > 0.5,
        twins=lambda T, count: [at(T[0, 3] + 10.02), at(T[0, 3] + 20)],
    )
    ranked = [Hypothesis(at(x), scores={}) for x in (0.0, 5.0, 10.0)]
    listed = finding._with_twins(search, ranked, 5)
    assert [h.T_target_source[0, 3] for h in listed] == [0.0, 10.0, 20.0, 5.0, 15.02]
    assert finding._with_twins(search, ranked, 2) == [ranked[0], ranked[2]]


def test_as_many_windows_are_looked_into_for_copies_as_copies_are_asked_for():
    windows = [Window(np.array([float(x), 0, 0]), np.arange(3), 1.0) for x in (0, 1.2, 1.4, 2, 3, 4, 5)]
    windows.append(Window(np.array([6.0, 0, 0]), np.arange(3), 0.1))  # too few votes
    for most, expected in ((1, [1.2, 2]), (3, [1.2, 1.4, 2, 3, 4])):
        assert [w.center[0] for w in likest(windows, np.zeros(3), 1.0, most)] == expected


def test_where_a_sensor_of_the_map_saw_through_no_surface_stands():
    """A wall at x = 3, its sensor at the origin: only what stands before it is seen through."""
    grid = np.stack(np.meshgrid([3.0], np.arange(-2, 2, 0.1), np.arange(-1, 1, 0.1)), -1).reshape(-1, 3)
    from_origin = (
        VoxelSums.empty(0.1, np.zeros(3)).added(grid, np.zeros(3)).added(grid + 0.01, np.full(3, 0.01))
    )
    assert len(from_origin.sensors) == 1
    level = Level.of(from_origin, 0.1, PreparationConfig())
    patch = np.random.default_rng(3).uniform(-0.3, 0.3, (50, 3)) * (0.1, 1, 1)
    for x, y, expected in ((1.5, 0, 1.0), (3.0, 0, 0.0), (5.0, 0, 0.0), (1.5, 8, 0.0)):
        placed = patch + np.array([x, y, 0])
        assert seen_through(level, placed).mean() == expected
    place = make_transform(np.eye(3), np.array([1.5, 0, 0]))
    assert Sight(level, patch).factor(place) == pytest.approx(np.exp(-expert().surfaces.violation_weight))
    place[0, 3] = 3.0
    assert Sight(level, patch).factor(place) == 1.0
    unknown = Level.of(VoxelSums.empty(0.1, np.zeros(3)).added(grid), 0.1, PreparationConfig())
    assert not seen_through(unknown, patch + np.array([1.5, 0, 0])).any()


def test_on_a_part_of_a_map_the_sensors_of_the_whole_are_asked(monkeypatch):
    """The next room stands behind a wall at x = 3; where that was cut away, the sensor seems to see into the room."""
    near, far = (
        np.stack(np.meshgrid([x], np.arange(-2, 2, 0.1), np.arange(-1, 1, 0.1)), -1).reshape(-1, 3)
        for x in (3.0, 6.0)
    )
    voxels = VoxelSums.empty(0.1, np.zeros(3)).added(near, np.zeros(3)).added(far)
    whole = Level.of(voxels, 0.2, PreparationConfig())
    part = Level.of(voxels.within(np.array([[5.5, 0.0, 0.0]]), 2.2), 0.1, PreparationConfig())
    inside = np.random.default_rng(3).uniform(-0.3, 0.3, (50, 3)) * (0.1, 1, 1) + (4.5, 0, 0)
    assert not seen_through(whole, inside).any()
    assert seen_through(part, inside).all()

    asked = []

    def search(line, scan, compared, level, own, clock, sight=None, cells=None):
        asked.append((level, sight))
        return SimpleNamespace(level=level, has_many_places=False, candidates=lambda **_: [])

    monkeypatch.setattr(finding, "prepare", lambda *_, **__: SimpleNamespace(points=inside))
    monkeypatch.setattr(finding, "compared_rows", lambda _: np.arange(len(inside)))
    monkeypatch.setattr(finding, "described", lambda *_: (None, None))
    monkeypatch.setattr(finding, "Search", search)
    monkeypatch.setattr(finding.Finder, "_around", lambda *_: part)
    monkeypatch.setattr(finding.Finder, "_in_detail", lambda *_: (None, []))
    line = SimpleNamespace(config=RegistrationConfig(), descriptor=None)
    finder = finding.Finder(line, voxels, lambda *_: whole, "map")
    scan = PointCloud(inside, np.zeros(3))
    assert finder(scan, scan, [], None, 4, StageClock()) == (None, [])
    assert asked == [(whole, None), (part, whole)]


def test_what_fits_in_detail_is_looked_at_also_where_no_finer_grid_can_be_made(monkeypatch):
    """A view of a large part of a building: around its place are too many points for a finer grid than the map's."""
    fits, asked = make_transform(np.eye(3), (1.0, 2.0, 3.0)), []

    def candidates(*, given=(), **_):
        asked.append(list(given))
        return []

    nothing = SimpleNamespace(answer=None, judgement=SimpleNamespace(confidence=0.0))
    looked = Found(None, nothing)
    level = SimpleNamespace(voxel_size=0.2, compared=None)
    search = SimpleNamespace(level=level, has_many_places=True, candidates=candidates)
    search.look, search.decide = lambda *_, **__: looked, lambda found: (found[0], [])
    detail = SimpleNamespace(ordered=lambda _, best, others: (best, others))
    monkeypatch.setattr(finding.Finder, "_begun", lambda *_: search)
    monkeypatch.setattr(finding.Finder, "_around", lambda *_: None)
    monkeypatch.setattr(finding.Finder, "_in_detail", lambda *_: (detail, [(0.97, fits), (0.6, np.eye(4))]))
    line = SimpleNamespace(config=RegistrationConfig(), descriptor=None)
    finder = finding.Finder(line, VoxelSums.empty(0.1, np.zeros(3)), lambda *_: level, "map")
    scan = PointCloud(np.random.default_rng(3).uniform(-1, 1, (50, 3)), np.zeros(3))
    assert finder(scan, scan, [], None, 4, StageClock()) == (None, [])
    first, last = asked
    assert first == []
    assert [T.tolist() for T in last] == [fits.tolist()]


def test_voxels_are_those_of_the_whole_in_whatever_pieces():
    points = np.random.default_rng(1).uniform(-3, 3, (3000, 3))
    whole = VoxelSums.empty(0.5, np.zeros(3)).added(points)
    pieces = VoxelSums.empty(0.5, np.zeros(3))
    for part in np.array_split(points, 7):
        pieces = pieces.added(part)
    np.testing.assert_array_equal(pieces.keys, whole.keys)
    np.testing.assert_allclose(pieces.points, whole.points, atol=1e-12)
    cells, index = np.unique(np.floor(points / 0.5), axis=0, return_inverse=True)
    means = [points[index.ravel() == k].mean(0) for k in range(len(cells))]
    np.testing.assert_allclose(whole.points, means, atol=1e-12)
    coarse = VoxelSums.empty(1.0, np.zeros(3)).added(points)
    np.testing.assert_array_equal(whole.coarser().keys, coarse.keys)
    np.testing.assert_allclose(whole.coarser().points, coarse.points, atol=1e-12)


def test_the_edge_for_a_count_is_the_one_that_gives_it():
    rng = np.random.default_rng(7)
    points = rng.uniform(0, 8, (40_000, 3)) * (1, 1, 0)  # a plane fills voxels like 1 / size^2
    voxels = VoxelSums.empty(0.05, np.zeros(3)).added(points)
    for count in (200, 900, 4000):
        edge = voxels.edge_for(count)
        assert len(VoxelSums.empty(edge, np.zeros(3)).added(points)) == pytest.approx(count, rel=0.15)
    assert voxels.edge_for(10**6) == voxels.edge


def test_a_part_of_a_map_is_what_lies_near_some_places():
    points = np.random.default_rng(8).uniform(-3, 3, (3000, 3))
    whole = VoxelSums.empty(0.5, np.zeros(3)).added(points)
    places = np.array([[-2.0, 0, 0], [2.0, 1, 0]])
    part = whole.within(places, 1.0)
    away = np.linalg.norm(whole.points[:, None] - places, axis=2).min(axis=1)
    np.testing.assert_array_equal(part.keys, whole.keys[away <= 1.0])
    np.testing.assert_array_equal(part.points, whole.points[away <= 1.0])


def test_some_points_are_described_as_all_are():
    rng = np.random.default_rng(9)
    points = rng.uniform(0, 1, (900, 3)) * (3, 3, 0.3)
    normals = rng.normal(size=(900, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = PreparedCloud(points, normals, None, 0.1, None, np.zeros(3))
    rows = np.arange(5, 900, 7)
    some = LearnedDescriptor().at(pyramid(cloud), rows)
    np.testing.assert_allclose(some, LearnedDescriptor()(cloud)[rows], atol=1e-5)


def test_signs_run_along_a_sphere():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(2000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    flipped = points * rng.choice([-1.0, 1.0], (2000, 1))
    outward = np.einsum("ij,ij->i", facing_alike(points, flipped), points) > 0
    assert outward.all() or not outward.any()


def test_both_sides_are_the_features_of_turned_normals():
    rng = np.random.default_rng(4)
    points = rng.uniform(0, 1, (800, 3)) * (3, 3, 0.3)
    normals = rng.normal(size=(800, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    def features(signed):
        cloud = PreparedCloud(points, signed, None, 0.1, None, np.zeros(3))
        return with_features(cloud, MultiscaleDescriptor()).features

    # The histograms count pairs in bins; one at a bin's edge may fall to either side.
    off = np.abs(both_sides(features(normals)) - features(-normals)).max(axis=1)
    assert np.median(off) < 1e-5
    assert np.median(np.abs(features(normals) - features(-normals)).max(axis=1)) > 0.01
    assert both_sides(np.zeros((0, 99), dtype=np.float32)).shape == (0, 99)
