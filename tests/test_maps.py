"""A map and scans in it: right places with their true poses, twins, strangers, and files."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from generated_buildings import AWAY, GRID, UTM, scanned, shift, view

import geomoe3d
from geomoe3d import Map
from geomoe3d.config import expert, load_config
from geomoe3d.decision.confidence import Judgement
from geomoe3d.errors import EmptyCloudError, FormatError, InputError, MissingFileError, OutputError
from geomoe3d.geometry.se3 import make_transform
from geomoe3d.maps import locate, store
from geomoe3d.maps.finding import Finder
from geomoe3d.maps.locate import ANOTHER_STANDS, Search
from geomoe3d.maps.places import Query

# ---- finding -------------------------------------------------------------------------------------------


def test_a_scan_is_found_in_its_room(house, scan):
    points, true = scan
    found = house.locate(points)
    assert found.ok
    assert shift(found.T_map_scan, true) < 0.05
    np.testing.assert_allclose(found.T_map_scan[:3, :3], true[:3, :3], atol=0.02)
    np.testing.assert_array_equal(found.places[0].T_map_scan, found.T_map_scan)
    assert json.loads(found.to_json())["places"][0]["T_map_scan"] == found.T_map_scan.tolist()


def test_of_alike_rooms_none_is_ok_and_all_are_named(rooms, scan):
    points, true = scan
    room, copies = scanned(rooms[0], UTM, 1), [k * AWAY for k in range(5)]
    made = Map.from_cloud(np.concatenate([room + away for away in copies]), voxel_size=GRID)
    found = made.locate(points, k=5)
    assert found.status == "ambiguous"
    assert len(found.places) == 5
    for away in copies:
        twin = true.copy()
        twin[:3, 3] += away
        assert min(shift(place.T_map_scan, twin) for place in found.places) < 0.1


def test_the_twin_of_a_room_is_seen_though_the_first_place_fits_plainly(rooms, scan):
    room = scanned(rooms[0], UTM, 1)
    found = Map.from_cloud(np.concatenate([room, room + AWAY]), voxel_size=GRID).locate(scan[0])
    assert found.status == "ambiguous"
    assert sorted(round(shift(place.T_map_scan, scan[1])) for place in found.places[:2]) == [0, 7]


def test_a_copy_of_the_answers_place_is_found_though_no_window_of_the_scan_shows_it(rooms, scan, monkeypatch):
    """The map itself says where it is alike: a scan that looks into one room alone is not ok for that."""
    room = scanned(rooms[0], UTM, 1)
    made = Map.from_cloud(np.concatenate([room, room + AWAY, room + 2 * AWAY]), voxel_size=GRID)
    for copy in range(3):  # who says in which of them it is gets that one
        there = scan[1][:3, 3] + copy * AWAY
        found = made.locate(scan[0], near=there, within=2.0)
        assert found.ok
        assert np.linalg.norm(found.T_map_scan[:3, 3] - there) < 0.05

    def windows(self, count, within=None, *, voters=None, _made=Query.windows):
        found = _made(self, count, within, voters=voters)
        return found if voters is not None else found[:1]

    monkeypatch.setattr(Query, "windows", windows)
    found = made.locate(scan[0])
    assert found.status == "ambiguous"
    assert found.places[1].relative_score > 0.8
    monkeypatch.setattr(Search, "twins", lambda self, T, count: [])
    assert made.locate(scan[0]).ok  # what it would be without


def test_where_another_place_would_be_ok_by_itself_none_is(rooms, scan, monkeypatch):
    """Copies that were scanned anew have few votes, and score less: the scanner saw more of one than of another."""
    made = Map.from_cloud(
        np.concatenate([scanned(rooms[0], UTM + k * AWAY, 10 + k) for k in range(3)]), voxel_size=GRID
    )
    assert made.locate(scan[0]).status == "ambiguous"

    monkeypatch.setattr(locate, "judge", lambda *_: Judgement("ok", (), 0.99))  # whatever the scores say
    found = made.locate(scan[0])
    assert found.status == "ambiguous"
    assert ANOTHER_STANDS in found.result.reasons


def test_where_one_place_fits_plainly_only_windows_of_rivals_are_looked_into(house, scan, monkeypatch):
    looked = []

    def motions(self, window, count, *, _made=Query.motions, **how):
        if not how.get("mutual"):  # those are sought for copies of the place
            looked.append(window.votes)
        return _made(self, window, count, **how)

    monkeypatch.setattr(Query, "motions", motions)
    assert house.locate(scan[0]).ok
    assert 1 <= len(looked) < expert().locating.first_windows[0]
    looked.clear()
    assert house.locate(scan[0], k=30).ok  # more places are asked for: all windows are looked into
    assert len(looked) >= expert().locating.first_windows[0]


def test_a_scan_of_another_building_is_not_ok_and_is_sought_on_a_coarser_grid_too(rooms, scan):
    made = Map.empty().with_cloud(scanned(rooms[1], UTM, 2))
    made.describe(GRID / 2)
    assert not made.locate(scan[0]).ok
    assert made.voxel_sizes[0] == pytest.approx(GRID / 2)
    assert made.voxel_sizes[-1] > 1.3 * GRID / 2


def test_the_last_look_on_the_finest_grid_has_the_last_word(house, scan, monkeypatch):
    """It has seen the answers before it; how sure it is does not count."""
    sizes = []

    def doubtful(self, found, _made=Search.decide):
        best, ranked = _made(self, found)
        sizes.append(self.level.voxel_size)
        judgement = Judgement("low_confidence", (), 0.9 / len(sizes))
        return replace(
            best, sure=False, stood=True, decision=replace(best.decision, judgement=judgement)
        ), ranked

    monkeypatch.setattr(Search, "decide", doubtful)
    made = Map(house._voxels)
    made.describe(2 * GRID)
    found = made.locate(scan[0])
    assert sizes[-1] < min(sizes[:-1])
    assert found.result.voxel_size == sizes[-1]
    assert shift(found.T_map_scan, scan[1]) < 0.05


def test_a_place_that_is_given_is_looked_at_and_not_trusted(house, scan):
    points, true = scan
    assert house.locate(points, near=true[:3, 3], within=1.0).ok
    elsewhere = house.locate(points, near=true[:3, 3] + AWAY, within=1.0)
    assert shift(elsewhere.T_map_scan, true) < 0.05
    assert any("the place that was given is not the answer" in reason for reason in elsewhere.result.reasons)


# ---- making and keeping --------------------------------------------------------------------------------


def test_a_map_read_again_answers_the_same(house, scan, tmp_path):
    path = tmp_path / "house.map"
    house.save(path)
    again = Map.open(path, voxel_size=GRID).locate(scan[0])
    direct = house.locate(scan[0])
    np.testing.assert_array_equal(again.T_map_scan, direct.T_map_scan)
    assert (again.status, again.result.confidence) == (direct.status, direct.result.confidence)
    with pytest.raises(OutputError, match="exists"):
        house.save(path)


def test_a_room_added_later_is_found(rooms, scan, house):
    first, other = rooms
    made = Map.from_cloud(scanned(other, UTM + AWAY, 2), voxel_size=GRID).with_cloud(scanned(first, UTM, 1))
    assert len(made.sources) == 2
    assert made.num_points == house.num_points
    found = made.locate(scan[0])
    assert found.ok
    assert shift(found.T_map_scan, scan[1]) < 0.05
    assert made.with_cloud(scanned(first, UTM, 1)) is made  # it is in already


def test_a_scan_is_added_by_its_pose_with_what_its_sensor_saw(rooms):
    points, true = view(rooms[0], UTM, 9)
    made = Map.empty(voxel_size=GRID).with_cloud(points, T_map_cloud=true, sensor=np.zeros(3))
    towards = made._voxels.towards / np.linalg.norm(made._voxels.towards, axis=1, keepdims=True)
    expected = true[:3, 3] - made._voxels.origin - made._voxels.points
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert np.median(np.einsum("ij,ij->i", towards, expected)) > 0.999
    np.testing.assert_allclose(made._voxels.sensors + made._voxels.origin, true[None, :3, 3])


# ---- what cannot be ------------------------------------------------------------------------------------


def test_bad_input_is_refused_with_what_to_do(house, scan, tmp_path):
    with pytest.raises(InputError, match="belong together"):
        house.locate(scan[0], near=(0, 0, 0))
    with pytest.raises(InputError, match="three finite numbers"):
        house.locate(scan[0], near=(0, np.nan, 0), within=1.0)
    with pytest.raises(InputError, match="k is 0"):
        house.locate(scan[0], k=0)
    with pytest.raises(EmptyCloudError, match="add a cloud first"):
        Map.empty().locate(scan[0])
    with pytest.raises(MissingFileError, match="geomoe3d index"):
        Map.open(tmp_path / "none.map")
    whole = tmp_path / "whole.map"
    house.save(whole)
    for number, content in enumerate((b"nothing of the kind", b"", whole.read_bytes()[:5000])):
        broken = tmp_path / f"broken{number}.map"
        broken.write_bytes(content)
        with pytest.raises(FormatError, match="no map of geomoe3d, or it is damaged or cut short") as error:
            Map.open(broken)
        assert "pickle" not in str(error.value)  # nobody is told to load it unsafely


def test_a_changed_file_is_damaged(tmp_path):
    points = np.random.default_rng(0).uniform(0, 1, (500, 3)) * (4, 4, 0)
    made = Map.empty(voxel_size=0.5).with_cloud(points)
    path = tmp_path / "plane.map"
    made.save(path)
    content = dict(np.load(path))
    content["sums"][0, 0] += 1.0
    with path.open("wb") as handle:
        np.savez(handle, **content)
    with pytest.raises(FormatError, match="does not match its hash"):
        Map.open(path)


def test_a_map_of_another_descriptor_is_described_anew(house, scan, tmp_path, monkeypatch):
    path = tmp_path / "house.map"
    house.save(path)
    monkeypatch.setattr(store, "_descriptor", lambda: "another")
    again = Map.open(path, voxel_size=GRID)
    assert again.voxel_sizes == ()
    assert again.num_points == house.num_points
    found = again.locate(scan[0])
    assert found.ok
    assert again.voxel_sizes == house.voxel_sizes


def test_units_and_sizes_that_cannot_be_fail_with_the_reason(house, scan):
    larger = house.locate(1000.0 * scan[0])
    assert larger.status == "failed"
    assert "seems to be in millimetres" in larger.result.reasons[0]
    assert np.isnan(larger.T_map_scan).all()
    smaller = house.locate(0.004 * scan[0])
    assert smaller.status == "failed"
    assert "too coarse" in smaller.result.reasons[0]
    neither = house.locate(300.0 * scan[0])
    assert "larger than the map" in neither.result.reasons[0]


@pytest.mark.parametrize("times", [1 / 0.3048, 0.3048])
def test_a_scan_in_feet_is_never_ok_and_the_units_are_named(house, scan, times):
    found = house.locate(times * scan[0])
    assert not found.ok
    assert re.match(r"units differ: .*'scan' (seems to be )?in (feet|metres)", found.result.reasons[0])


def test_where_the_sensor_stood_may_be_given_and_is_then_believed(house, scan):
    points, true = scan
    moved = make_transform(np.eye(3), np.array([-40.0, 70.0, 5.0]))
    found = house.locate(points + moved[:3, 3], sensor=moved[:3, 3])
    assert found.ok
    assert shift(found.T_map_scan @ moved, true) < 0.05
    with pytest.raises(InputError, match="sensor of the scan"):
        house.locate(points, sensor=(1, 2))
    others = [], []
    for sensor, normals in zip((None, "none"), others, strict=True):

        def begun(self, *given, _made=Finder._begun, normals=normals):
            search = _made(self, *given)
            normals.append(search.scan.normals)
            return search

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Finder, "_begun", begun)
            house.locate(points, sensor=sensor)
    assert (others[0][0] != others[1][0]).any()  # turned to the sensor, and to the middle


@pytest.mark.parametrize("times", [1000.0, 0.001])
def test_a_cloud_in_another_unit_is_not_added(house, building, times):
    with pytest.raises(InputError, match="bring both to one unit"):
        house.with_cloud(UTM + times * (building - UTM))


def test_a_map_is_described_on_coarser_grids_too_so_that_any_scan_finds_one(building):
    made = Map.from_cloud(building)
    np.testing.assert_allclose(np.divide(made.voxel_sizes, made.voxel_sizes[0]), (1, 2), rtol=0.1)
    assert 4 * made.voxel_sizes[0] > made._voxels.edge_for(expert().maps.least_described)


def test_a_cloud_too_thin_for_the_grid_is_named_and_where_nothing_is_found_both_are(scan):
    thin = np.array([[0.0, 0, 0], [1, 0, 0], [0, 50, 0]])
    with pytest.raises(EmptyCloudError, match="'thin' fills only 2 voxels"):
        geomoe3d.register(geomoe3d.load_points(thin, name="thin"), scan[0])
    line = np.outer(np.linspace(-5, 5, 5000), [1.0, 2.0, 3.0])
    world = Map.empty().with_cloud(geomoe3d.load_points(line, name="line"))
    found = world.locate(geomoe3d.load_points(scan[0][::20], name="room"))
    assert found.status == "failed"
    assert found.result.reasons == ("no place was found in 'line' at which 'room' could lie",)
    assert np.isnan(found.T_map_scan).all()


# ---- register ------------------------------------------------------------------------------------------


def test_register_seeks_the_small_cloud_in_the_large_one_whichever_comes_first(building, scan):
    points, true = scan
    config = load_config(None, ["expert.maps.larger_grid=1.2"])  # two rooms are not many
    back = geomoe3d.register(building, points, config=config)
    assert back.ok
    assert "places" in back.seconds
    assert shift(back.inverse().T_target_source, true) < 0.05
    assert back.source.num_input == len(building)
    assert back.num_inliers == back.inliers.sum() > 0


def test_far_from_the_origin_no_millimetre_is_lost(rooms, building, scan):
    """At national grid coordinates, and in a part of the map that lies 20 km from its first cloud."""
    points, true = scan
    at_home = Map.from_cloud(building - UTM, voxel_size=GRID).locate(points)
    far = np.array([20_000.0, 0.0, 0.0])
    two_towns = Map.empty(voxel_size=GRID).with_cloud(building).with_cloud(scanned(rooms[0], UTM + far, 1))
    found = two_towns.locate(points, near=true[:3, 3] + far, within=3.0)
    assert found.ok
    for T, moved in ((found.T_map_scan, far), (at_home.T_map_scan, -UTM)):
        assert np.linalg.norm(T[:3, 3] - moved - true[:3, 3]) < 0.005
        np.testing.assert_allclose(T[:3, :3], true[:3, :3], atol=0.005)
