"""A map and scans in it: right places with their true poses, twins, strangers, and files."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from generated_buildings import GRID, first_room, other_room, scanned, view

import geomoe3d
from geomoe3d import Map
from geomoe3d.cli.errors import ExitCode, run
from geomoe3d.cli.main import geomoe3d as program
from geomoe3d.config import expert, load_config
from geomoe3d.decision.confidence import Judgement
from geomoe3d.errors import EmptyCloudError, FormatError, InputError, MissingFileError, OutputError
from geomoe3d.geometry.se3 import make_transform
from geomoe3d.maps import locate, store
from geomoe3d.maps.finding import Finder
from geomoe3d.maps.locate import ANOTHER_STANDS, Search
from geomoe3d.maps.places import Query

UTM = np.array([583394.0, 5283100.0, 498.0])
AWAY = np.array([7.0, 1.0, 0.0])


def shift(T, true):
    return float(np.linalg.norm(T[:3, 3] - true[:3, 3]))


@pytest.fixture(scope="module")
def rooms():
    """Two rooms that have nothing in common."""
    return first_room(), other_room(np.random.default_rng(3))


@pytest.fixture(scope="module")
def building(rooms):
    """Both at map coordinates, as one cloud without sensors."""
    first, other = rooms
    return np.concatenate([scanned(first, UTM, 1), scanned(other, UTM + AWAY, 2)])


@pytest.fixture(scope="module")
def house(building):
    return Map.from_cloud(building, voxel_size=GRID)


@pytest.fixture(scope="module")
def scan(rooms):
    return view(rooms[0], UTM, 5)


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

    def motions(self, window, count, *, more=False, _made=Query.motions):
        looked.append(window.votes)
        return _made(self, window, count, more=more)

    monkeypatch.setattr(Query, "motions", motions)
    assert house.locate(scan[0]).ok
    assert 1 <= len(looked) < expert().locating.first_windows
    looked.clear()
    assert house.locate(scan[0], k=30).ok  # more places are asked for: all windows are looked into
    assert len(looked) >= expert().locating.first_windows


def test_a_scan_of_another_building_is_not_ok_and_is_sought_on_a_coarser_grid_too(rooms, scan):
    made = Map.empty().with_cloud(scanned(rooms[1], UTM, 2))
    made.describe(GRID / 2)
    assert not made.locate(scan[0]).ok
    assert made.voxel_sizes[0] == pytest.approx(GRID / 2)
    assert made.voxel_sizes[-1] > 1.3 * GRID / 2


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
    assert re.match(r"units differ: .*'scan' seems to be in (feet|metres)", found.result.reasons[0])


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


# ---- the command line ----------------------------------------------------------------------------------


def ask(*words):
    return run(program, "geomoe3d", [str(word) for word in words])


def test_index_and_locate_in_the_shell(rooms, scan, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    first, other = rooms
    np.save("other.npy", scanned(other, UTM + AWAY, 2))
    np.save("first.npy", scanned(first, UTM, 1))
    np.save("scan.npy", scan[0])
    grid = ("--voxel-size", GRID)
    assert ask("index", "other.npy", "house.map", *grid) == ExitCode.OK
    assert ask("index", "other.npy", "first.npy", "house.map", *grid) == ExitCode.OK
    assert "2 clouds (1 new)" in capfd.readouterr().out
    assert ask("locate", "scan.npy", "house.map", *grid, "--json", "--output", "poses.tum") == ExitCode.OK
    told = json.loads(capfd.readouterr().out)
    assert told["status"] == "ok"
    assert told["scan"] == "scan"
    assert shift(np.array(told["places"][0]["T_map_scan"]), scan[1]) < 0.05
    line = [line for line in (tmp_path / "poses.tum").read_text().splitlines() if line[0] != "#"]
    np.testing.assert_allclose([float(word) for word in line[0].split()[1:4]], scan[1][:3, 3], atol=0.05)
    assert (
        ask("locate", "scan.npy", "house.map", *grid, "--near", "1,2", "--within", "3") == ExitCode.BAD_INPUT
    )
    assert "three numbers" in capfd.readouterr().err
    assert ask("locate", "scan.npy", "nowhere.map") == ExitCode.BAD_INPUT
    assert "there is no map 'nowhere.map'" in capfd.readouterr().err


def test_quietly_one_scan_prints_its_matrix_and_what_is_not_ok_one_line(
    house, scan, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    house.save("house.map")
    np.save("scan.npy", scan[0])
    np.save("feet.npy", scan[0] / 0.3048)
    words = ("house.map", "--voxel-size", GRID, "--quiet")
    assert ask("locate", "scan.npy", *words) == ExitCode.OK
    told = capfd.readouterr()
    assert told.err == ""
    rows = np.array([[float(word) for word in line.split()] for line in told.out.splitlines()])
    assert shift(rows, scan[1]) < 0.05
    assert ask("locate", "scan.npy", "feet.npy", *words) == ExitCode.NOT_SURE
    told = capfd.readouterr()
    assert told.out == ""
    assert told.err.count("\n") == 1
    assert told.err.startswith("feet: ")


def test_lengths_are_printed_with_the_unit_that_is_named(house, scan, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    house.save("house.map")
    np.save("scan.npy", scan[0])
    assert ask("locate", "scan.npy", "house.map", "--voxel-size", GRID, "--unit", "m") == ExitCode.OK
    assert f"{GRID:g} m" in capfd.readouterr().out


def test_what_is_no_map_is_never_overwritten(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    cloud = np.random.default_rng(0).uniform(0, 1, (500, 3))
    for name in ("one.npy", "two.npy"):
        np.save(name, cloud)
    assert ask("index", "one.npy", "two.npy", "--fresh") == ExitCode.BAD_INPUT
    assert "ends in .map, found 'two.npy'" in capfd.readouterr().err
    np.testing.assert_array_equal(np.load("two.npy"), cloud)
    assert ask("locate", "house.map", "one.npy") == ExitCode.BAD_INPUT
    assert "'house.map' is a map" in capfd.readouterr().err
    (tmp_path / "mine.map").write_text("roads and rivers")
    for more in ((), ("--fresh",)):
        assert ask("index", "one.npy", "mine.map", *more) == ExitCode.BAD_INPUT
        assert "no map of geomoe3d" in capfd.readouterr().err
    assert (tmp_path / "mine.map").read_text() == "roads and rivers"


def test_poses_are_never_written_over_a_map_or_a_scan(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    Map.empty().with_cloud(np.random.default_rng(1).uniform(0, 1, (500, 3))).save("house.map")
    np.save("scan.npy", np.random.default_rng(0).uniform(0, 1, (500, 3)))
    np.savetxt("guess.txt", np.eye(4))
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    locate = ("locate", "scan.npy", "house.map", "--initial", "guess.txt", "--force", "--output")
    for output, said in (
        ("house.map", ".tum"),
        ("scan.npy", ".tum"),
        ("poses.json", ".tum"),
        ("guess.txt", "also an input"),
    ):
        assert ask(*locate, output) == ExitCode.BAD_INPUT
        assert said in capfd.readouterr().err
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_cloud_too_thin_for_the_grid_is_named_and_where_nothing_is_found_both_are(scan):
    thin = np.array([[0.0, 0, 0], [1, 0, 0], [0, 50, 0]])
    with pytest.raises(EmptyCloudError, match=r"'thin': \d (of 3 )?points? left"):
        geomoe3d.register(geomoe3d.load_points(thin, name="thin"), scan[0])
    line = np.outer(np.linspace(-5, 5, 5000), [1.0, 2.0, 3.0])
    world = Map.empty().with_cloud(geomoe3d.load_points(line, name="line"))
    found = world.locate(geomoe3d.load_points(scan[0][::20], name="room"))
    assert found.status == "failed"
    assert found.result.reasons == ("no place was found in 'line' at which 'room' could lie",)
    assert np.isnan(found.T_map_scan).all()


def test_an_empty_folder_is_named(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    for words in (("index", "empty", "out.map"), ("locate", "empty", "out.map")):
        assert ask(*words) == ExitCode.BAD_INPUT
        assert "'empty' holds no clouds" in capfd.readouterr().err
    assert not (tmp_path / "out.map").exists()


def test_a_sequence_goes_on_after_a_scan_that_cannot_be_read(house, scan, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    house.save("house.map")
    (tmp_path / "scans").mkdir()
    np.save("scans/a.npy", scan[0])
    np.save("scans/b.npy", np.full((10, 3), np.nan))
    assert (
        ask("locate", "scans", "house.map", "--voxel-size", GRID, "--output", "poses.tum")
        == ExitCode.BAD_INPUT
    )
    told = capfd.readouterr()
    assert "1 of 2 ok" in told.out
    assert "scans per second" in told.out
    assert "b" in told.err
    lines = (tmp_path / "poses.tum").read_text().splitlines()
    pose = [line.split() for line in lines if line[0] != "#"]
    assert len(pose) == 1
    assert pose[0][0] == "0"
    assert "# 1 b: unusable" in lines


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
