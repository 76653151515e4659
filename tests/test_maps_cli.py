"""`geomoe3d index` and `locate` in the shell: what is written, printed and refused."""

from __future__ import annotations

import itertools
import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
from generated_buildings import AWAY, GRID, UTM, scanned, shift

from geomoe3d import Map
from geomoe3d.cli import index, locate
from geomoe3d.cli.errors import ExitCode, run
from geomoe3d.cli.main import geomoe3d as program
from geomoe3d.errors import EmptyCloudError
from geomoe3d.result import Status


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
    said = capfd.readouterr()
    assert "2 clouds (1 new)" in said.out
    assert (
        said.err.count(
            "in one coordinate system and one unit; scans in coordinates of their own need --poses"
        )
        == 1
    )
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
    assert ask("locate", "scan.npy", *words[:-1]) == ExitCode.OK
    assert "next" not in capfd.readouterr().out
    assert ask("locate", "feet.npy", *words[:-1]) == ExitCode.NOT_SURE
    alone = capfd.readouterr().out.splitlines()
    status = alone[0].split(":")[0]
    assert alone[-2:] == ["", f"next: {locate._NEXT[status.replace(' ', '_')]}"]
    assert ask("locate", "scan.npy", "feet.npy", *words[:-1]) == ExitCode.NOT_SURE
    assert capfd.readouterr().out.splitlines()[-1].startswith(f"next ({status}): ")
    assert ask("locate", "feet.npy", *words[:-1], "--json") == ExitCode.NOT_SURE
    assert json.loads(capfd.readouterr().out)["scan"] == "feet"


def test_every_status_that_is_not_ok_has_its_next_step():
    assert set(locate._NEXT) == {*get_args(Status)} - {"ok"}


def test_lengths_are_printed_with_the_unit_that_is_named(house, scan, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    house.save("house.map")
    np.save("scan.npy", scan[0])
    assert ask("locate", "scan.npy", "house.map", "--voxel-size", GRID, "--unit", "m") == ExitCode.OK
    assert f"{GRID:g} m" in capfd.readouterr().out


def test_a_grid_finer_than_what_a_map_keeps_is_told(rooms, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    np.save("room.npy", scanned(rooms[0], UTM, 1))
    assert ask("index", "room.npy", "fine.map", "--voxel-size", "1e-6") == ExitCode.OK
    told = capfd.readouterr()
    (kept,) = Map.open("fine.map").voxel_sizes
    assert kept > 1e-3
    said = f"note: the map keeps no points closer than {kept:.4g}, so it is described on that grid, not on one of 1e-06"
    assert said in told.err
    assert ask("index", "room.npy", "usual.map", "--voxel-size", GRID) == ExitCode.OK
    assert "note" not in capfd.readouterr().err


def test_what_is_no_map_is_never_overwritten(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    cloud = np.random.default_rng(0).uniform(0, 1, (500, 3))
    for name in ("one.npy", "two.npy"):
        np.save(name, cloud)
    assert ask("index", "one.npy", "two.npy", "--fresh") == ExitCode.BAD_INPUT
    assert "ends in .map, but 'two.npy' is there; write" in capfd.readouterr().err
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


def test_a_folder_in_the_place_of_a_map_is_told_to_be_indexed(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    Path("my scans").mkdir()
    np.save("scan.npy", np.zeros((5, 3)))
    assert ask("locate", "scan.npy", "my scans") == ExitCode.BAD_INPUT
    assert "geomoe3d index 'my scans' NAME.map" in capfd.readouterr().err


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
    few = np.random.default_rng(0).uniform(0, 2 * GRID, (10, 3))
    np.save("scans/c.npy", few)
    (tmp_path / "scans/d.ply").touch()
    assert (
        ask("locate", "scans", "house.map", "--voxel-size", GRID, "--output", "poses.tum")
        == ExitCode.BAD_INPUT
    )
    told = capfd.readouterr()
    assert "1 of 4 ok" in told.out
    assert "scans per second" in told.out
    assert "b: " in told.err
    assert "of 10 points remain" in told.err
    assert "at least 3 are needed" in told.err
    assert "d.ply' is an empty file (0 bytes)" in told.err
    assert "warning" not in told.err
    lines = (tmp_path / "poses.tum").read_text().splitlines()
    pose = [line.split() for line in lines if line[0] != "#"]
    assert len(pose) == 1
    assert pose[0][0] == "0"
    assert lines[-3:] == ["# 1 b: unusable", "# 2 c: unusable", "# 3 d: unusable"]


@pytest.mark.parametrize("name", ["empty.ply", "empty.las", "empty.e57", "empty.npy"])
def test_an_empty_file_is_named_as_one_also_by_index(tmp_path, monkeypatch, capfd, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).touch()
    assert ask("index", name, "out.map") == ExitCode.BAD_INPUT
    assert f"{name}' is an empty file (0 bytes)" in capfd.readouterr().err


@pytest.mark.parametrize(
    "scan",
    [np.outer(np.arange(3.0), [1, 0, 0]), np.random.default_rng(0).uniform(0, 3, (10, 3))],
    ids=["three points of a line", "ten at random"],
)
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_scan_of_too_few_points_for_the_search_is_refused(building, scan):
    world = Map.from_cloud(building, voxel_size=2.0 if len(scan) > 3 else 1.0)
    with pytest.raises(
        EmptyCloudError, match=r"'scan': [12] of \d+ points remain .* at least 3 are needed; give a"
    ):
        world.locate(scan)


# ---- a map that is indexed again -----------------------------------------------------------------------


@pytest.fixture
def two_clouds(tmp_path, monkeypatch):
    """Files one.npy and two.npy, and their poses in poses.tum; both are in all.map."""
    monkeypatch.chdir(tmp_path)
    for number, name in enumerate(("one.npy", "two.npy")):
        np.save(name, np.random.default_rng(number).uniform(0, 3, (3000, 3)))
    poses(0.0)
    return tmp_path


def poses(x):
    """Write poses.tum: both clouds are shifted, the second by ``x`` more."""
    Path("poses.tum").write_text(f"0 5 0 0 0 0 0 1\n1 {5 + x} 0 0 0 0 0 1\n")


def middle(path):
    """(3,) mean of the voxels, file coordinates."""
    held = Map.open(path)._voxels
    return held.points.mean(0) + held.origin


def test_a_changed_file_is_read_anew_where_all_of_the_map_is_given_and_else_refused(two_clouds, capfd):
    assert ask("index", "one.npy", "two.npy", "all.map") == ExitCode.OK
    before = Path("all.map").read_bytes()
    np.save("two.npy", np.random.default_rng(5).uniform(0, 3, (4000, 3)))
    capfd.readouterr()
    assert ask("index", "two.npy", "all.map") == ExitCode.BAD_INPUT
    said = capfd.readouterr().err
    assert "'two.npy' has changed since it was read into the map" in said
    assert "--fresh" in said
    assert Path("all.map").read_bytes() == before
    assert ask("index", "one.npy", "two.npy", "all.map") == ExitCode.OK
    told = capfd.readouterr()
    assert "all clouds were read anew" in told.err
    assert [source.num_points for source in Map.open("all.map").sources] == [3000, 4000]
    assert ask("index", "one.npy", "two.npy", "all.map") == ExitCode.OK
    told = capfd.readouterr()
    assert "anew" not in told.err
    assert "(0 new)" in told.out


def test_new_poses_of_known_clouds_move_them_and_missing_ones_are_refused(two_clouds, capfd):
    words = ("index", "one.npy", "two.npy", "all.map")
    assert ask(*words, "--poses", "poses.tum") == ExitCode.OK
    assert middle("all.map")[0] == pytest.approx(6.5, abs=0.1)
    poses(4.0)
    assert ask(*words, "--poses", "poses.tum") == ExitCode.OK
    assert (
        "'two.npy' is in the map already, at a pose shifted by 4 and turned by 0 deg"
        in capfd.readouterr().err
    )
    assert middle("all.map")[0] == pytest.approx(8.5, abs=0.1)
    assert ask(*words) == ExitCode.BAD_INPUT
    assert (
        "'one.npy' is in the map already, at a pose shifted by 5 and turned by 0 deg"
        in capfd.readouterr().err
    )
    assert middle("all.map")[0] == pytest.approx(8.5, abs=0.1)


def test_a_cloud_of_the_same_name_is_added_and_told_of(two_clouds, capfd):
    assert ask("index", "one.npy", "all.map") == ExitCode.OK
    Path("other").mkdir()
    Path("two.npy").rename("other/one.npy")
    assert ask("index", "other/one.npy", "all.map") == ExitCode.OK
    assert "the map held another 'one.npy' already" in capfd.readouterr().err
    assert len(Map.open("all.map").sources) == 2


def test_what_can_be_no_map_is_named(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    clouds = {
        "five": (rng.uniform(0, 1, (5, 3)), "'five.npy' fills only"),
        "flat": (rng.uniform(0, 5, (20000, 3)) * (1, 1, 0), "'flat.npy' is flat"),
        "line": (np.outer(np.linspace(-5, 5, 5000), [1.0, 2, 3]), "'line.npy' lie on one straight line"),
    }
    for name, (points, said) in clouds.items():
        np.save(f"{name}.npy", points)
        assert ask("index", f"{name}.npy", f"{name}.map") == ExitCode.BAD_INPUT
        assert said in capfd.readouterr().err
        assert not Path(f"{name}.map").exists()


@pytest.mark.parametrize("more", [(), ("--fresh",)])
def test_a_map_that_is_made_anew_takes_the_place_of_the_old_one_only_when_complete(
    two_clouds, monkeypatch, capfd, more
):
    minutes = itertools.count(0.0, 61.0)
    monkeypatch.setattr(index, "time", SimpleNamespace(monotonic=lambda: next(minutes)))
    words = ("index", "one.npy", "two.npy", "all.map")
    assert ask(*words) == ExitCode.OK
    before = Path("all.map").read_bytes()
    whole = Path("two.npy").read_bytes()
    np.save("one.npy", np.random.default_rng(5).uniform(0, 3, (4000, 3)))
    Path("two.npy").write_bytes(whole[:100])
    assert ask(*words, *more) == ExitCode.BAD_INPUT
    assert "two.npy" in capfd.readouterr().err
    assert Path("all.map").read_bytes() == before
    # Where there was no map, what was read is kept, and the next call goes on.
    Path("all.map").unlink()
    assert ask(*words, *more) == ExitCode.BAD_INPUT
    assert [source.name for source in Map.open("all.map").sources] == ["one.npy"]
    Path("two.npy").write_bytes(whole)
    capfd.readouterr()
    assert ask(*words) == ExitCode.OK
    assert "2 clouds (1 new)" in capfd.readouterr().out


def test_files_of_equal_content_with_different_poses_are_both_named(two_clouds, capfd):
    shutil.copy("one.npy", "two.npy")
    words = ("index", "one.npy", "two.npy", "all.map", "--fresh")
    assert ask(*words) == ExitCode.OK
    poses(4.0)
    capfd.readouterr()
    assert ask(*words, "--poses", "poses.tum") == ExitCode.BAD_INPUT
    said = capfd.readouterr().err
    assert "'two.npy' has the same content as 'one.npy', which is in the map already" in said
    assert "shifted by 4 and turned by 0 deg against it; leave one of the two out" in said
