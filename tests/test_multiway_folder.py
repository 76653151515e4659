"""The folder of a model: what is not its own is refused, or stays."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_scans import SETTINGS, everything

from geomoe3d import register_scans
from geomoe3d.clouds.io import save_points
from geomoe3d.config import load_config
from geomoe3d.errors import InputError

CONFIG = load_config(None, SETTINGS)


pytestmark = pytest.mark.usefixtures("own_cache")


def test_the_cache_of_the_command_must_be_a_folder(scanned_room, tmp_path):
    scans = scanned_room[0]
    words = [sys.executable, "-m", "geomoe3d", "multiway", str(scans), str(tmp_path / "o")]
    done = subprocess.run(
        [*words, "--cache", str(scans / "scan_9.ply")],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        cwd=Path(__file__).parents[1],
    )
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: '{scans / 'scan_9.ply'}' is a file; the cache of features is a")
    assert not (tmp_path / "o").exists()


def test_a_folder_that_holds_something_of_the_users_is_refused(scanned_room, tmp_path):
    scans, _ = scanned_room
    out = tmp_path / "out"
    out.mkdir()
    kept = [out / "group1.ply", out / "groups.csv"]
    for path in kept:
        path.write_text("mine")
    with pytest.raises(InputError, match=r"group1\.ply' is not of a model"):
        register_scans([scans], out, config=CONFIG)
    with pytest.raises(InputError, match="is a file"):
        register_scans([scans], kept[1], config=CONFIG)
    for inputs in (scans, [scans], [scans / "scan_0.npy", scans / "scan_9.ply"]):
        with pytest.raises(InputError, match="taken for a scan"):
            register_scans(inputs, scans, config=CONFIG)
    assert sorted(out.iterdir()) == kept
    assert all(path.read_text() == "mine" for path in kept)


@pytest.mark.parametrize("fresh", [False, True])
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("poses.json", '{"format": "of another program", "poses": []}'),
        ("poses.json", "[1, 2]"),
        ("poses.json", '{"format": "geomoe3d sc'),
        ("page.html", "<html>mine</html>"),
        ("pairs/results.jsonl", "mine"),
        ("pairs/run.json", "{}"),
    ],
)
def test_files_of_other_programs_are_refused(scanned_room, tmp_path, name, text, fresh):
    folder, _ = scanned_room
    out = tmp_path / "out"
    (out / name).parent.mkdir(parents=True)
    (out / name).write_text(text)
    if name == "poses.json":
        (out / "group2.ply").write_text("mine")
    before = everything(out)
    with pytest.raises(InputError, match=rf"{name}' (is not of|does not describe) a (model|batch) of geomoe"):
        register_scans([folder / "scan_0.npy", folder / "scan_1.npy"], out, config=CONFIG, fresh=fresh)
    assert everything(out) == before


def test_a_folder_of_other_scans_is_refused_and_one_of_notes_is_not(scanned_room, tmp_path):
    folder, _ = scanned_room
    scans = [folder / "scan_0.npy", folder / "scan_1.npy"]
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "table.csv").write_text("a,b\n1,x\n")
    (tmp_path / "page.html").write_text("<html>mine</html>")
    np.save(tmp_path / "row.npy", np.arange(7))
    register_scans(scans, tmp_path, config=CONFIG, page=False)
    assert (tmp_path / "page.html").read_text() == "<html>mine</html>"
    for name in ("other.npy", "other.txt", "other.ply"):
        if name == "other.ply":
            (tmp_path / name).write_text("ply\n")
        else:
            save_points(tmp_path / name, np.random.default_rng(0).normal(size=(50, 3)))
        before = everything(tmp_path)
        with pytest.raises(InputError, match=rf"{name}'\): the merged cloud would be taken for a scan"):
            register_scans(scans, tmp_path, config=CONFIG, page=False, fresh=True)
        assert everything(tmp_path) == before
        (tmp_path / name).unlink()


def test_files_of_the_users_beside_a_model_stay(scanned_room, tmp_path):
    scans = [scanned_room[0] / f"scan_{k}.npy" for k in (0, 1)]
    (tmp_path / "grouping.txt").write_text("mine")
    register_scans(scans, tmp_path, config=CONFIG, page=False)
    (tmp_path / "group7.ply").write_bytes((tmp_path / "group1.ply").read_bytes())  # of a larger model before
    register_scans(scans, tmp_path, config=CONFIG, page=False)
    assert (tmp_path / "grouping.txt").read_text() == "mine"
    assert (tmp_path / "group1.ply").is_file()
    assert not (tmp_path / "group7.ply").exists()
