"""Sets of generated fragments: read by everything, reproducible, resumed after a kill, never mixed."""

from __future__ import annotations

import errno
import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from generated_rooms import TINY, write_models

from geomoe3d.cli.errors import run
from geomoe3d.cli.main import geomoe3d
from geomoe3d.data import synthesize as module
from geomoe3d.data.check import check_folder
from geomoe3d.data.collection import load_fragment, open_collection
from geomoe3d.data.rooms.models import open_library
from geomoe3d.data.rooms.sensor import SensorSettings
from geomoe3d.data.settings import SynthesisSettings
from geomoe3d.data.synthesize import Job, make_scene, scene_name, synthesize
from geomoe3d.errors import ConfigError, FormatError, InputError, OutputError
from geomoe3d.geometry.se3 import inverse, transform_points


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("set") / "one"
    synthesize(folder, 2, seed=3, settings=TINY)
    return folder


def test_set_is_read_by_everything_that_reads_posed_fragments(made: Path) -> None:
    collection = open_collection(made)
    assert collection.layout == "posed"
    assert check_folder(made).usable
    for pair in collection.pairs[:3]:
        poses = np.loadtxt(pair.source.parent / "poses.txt").reshape(-1, 4, 4)
        i, j = (int(path.stem.rsplit("_", 1)[1]) for path in (pair.source, pair.target))
        assert np.allclose(pair.T_target_source, inverse(poses[j]) @ poses[i], atol=1e-12)
        # And the truth fits the clouds: most source points that overlap are close to the target.
        source, target = (load_fragment(path).file_points for path in (pair.source, pair.target))
        from scipy.spatial import cKDTree

        distance = cKDTree(target).query(transform_points(pair.T_target_source, source))[0]
        assert np.mean(distance < 0.0375) == pytest.approx(pair.overlap, abs=0.01)


@pytest.mark.slow
def test_same_seed_same_bytes_on_any_number_of_workers(made: Path, tmp_path: Path) -> None:
    synthesize(tmp_path / "two", 2, seed=3, workers=2, settings=TINY)
    assert files_of(tmp_path / "two") == files_of(made)
    synthesize(tmp_path / "other", 1, seed=4, settings=TINY)
    first = Path(scene_name(0)) / "cloud_bin_0.ply"
    assert (tmp_path / "other" / first).read_bytes() != (made / first).read_bytes()


def test_larger_set_contains_the_smaller_one(made: Path, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    assert synthesize(folder, 1, seed=3, settings=TINY).made == 1
    report = synthesize(folder, 2, seed=3, settings=TINY)
    assert (report.made, report.kept) == (1, 1)
    assert files_of(folder) == files_of(made)
    assert synthesize(folder, 2, seed=3, settings=TINY).made == 0


_KILLED = """
import os, signal, sys
from geomoe3d.data import synthesize as module
from geomoe3d.data.settings import SynthesisSettings
real = module.write_gt_log
def deadly(path, *arguments, **named):
    if "00001" in str(path):
        os.kill(os.getpid(), signal.SIGKILL)
    real(path, *arguments, **named)
module.write_gt_log = deadly
module.synthesize(sys.argv[1], 2, seed=3, settings=SynthesisSettings.model_validate_json(sys.argv[2]))
"""


@pytest.mark.slow
def test_resume_after_sigkill_in_the_middle_of_a_scene(made: Path, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    command = [sys.executable, "-c", _KILLED, str(folder), TINY.model_dump_json()]
    root = str(Path(__file__).parents[1])
    ended = subprocess.run(command, capture_output=True, timeout=120, check=False, cwd=root)
    assert ended.returncode == -signal.SIGKILL, ended.stderr.decode()
    left = sorted(p.name for p in folder.iterdir())
    assert left == [f".writing-{scene_name(1)}", "manifest.json", scene_name(0)]
    report = synthesize(folder, 2, seed=3, settings=TINY)
    assert (report.made, report.kept) == (1, 1)
    assert files_of(folder) == files_of(made)


def test_other_settings_or_material_are_refused_by_name(made: Path) -> None:
    with pytest.raises(InputError, match=r"seed \(3 there, 5 now\)"):
        synthesize(made, 2, seed=5, settings=TINY)
    changed = TINY.model_copy(update={"sensor": SensorSettings(far=3.0)})
    with pytest.raises(InputError, match=r"settings\.sensor\.far \(4\.5 there, 3\.0 now\)"):
        synthesize(made, 2, seed=3, settings=changed)


def test_full_disk_leaves_nothing_half_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import geomoe3d.clouds.io as io

    real, calls = io.save_points, []

    def full(path: Path, *arguments: object, **named: object) -> None:
        calls.append(path)
        if len(calls) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(path, *arguments, **named)

    monkeypatch.setattr(io, "save_points", full)
    with pytest.raises(OutputError, match="No space left"):
        synthesize(tmp_path / "set", 1, seed=3, settings=TINY)
    assert [p.name for p in (tmp_path / "set").iterdir()] == ["manifest.json"]
    monkeypatch.undo()
    assert synthesize(tmp_path / "set", 1, seed=3, settings=TINY).made == 1


def test_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(OutputError, match=r"manifest\.json"):
        synthesize(tmp_path, 1, settings=TINY)
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "manifest.json").write_text("{broken")
    with pytest.raises(InputError, match="damaged"):
        synthesize(tmp_path / "set", 1, settings=TINY)


# ---- models and meshes ---------------------------------------------------------------------------


@pytest.mark.slow
def test_unreadable_models_are_named_and_passed_over(tmp_path: Path) -> None:
    write_models(tmp_path / "models")
    settings = TINY.model_copy(update={"shares": TINY.shares.model_copy(update={"models": 1.0})})
    report = synthesize(
        tmp_path / "set", 3, seed=1, settings=settings, model_folders=[str(tmp_path / "models")]
    )
    assert report.made == 3
    assert {scene.kind for scene in report.scenes} == {"models"}
    text = " ".join(report.unreadable)
    assert "table.obj" in text or "wardrobe.glb" in text
    stored = json.loads((tmp_path / "set" / scene_name(0) / "scene.json").read_text())
    assert stored["kind"] == "models"


def test_missing_material(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a folder"):
        synthesize(tmp_path / "set", 1, settings=TINY, model_folders=[str(tmp_path / "absent")])
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no usable model"):
        open_library([tmp_path / "empty"])
    with pytest.raises(InputError, match="does not exist"):
        synthesize(tmp_path / "set", 1, settings=TINY, meshes=[str(tmp_path / "absent.ply")])
    (tmp_path / "broken.ply").write_text("ply\nbroken")
    with pytest.raises(FormatError, match=r"broken\.ply' cannot be read"):
        synthesize(tmp_path / "set", 1, settings=TINY, meshes=[str(tmp_path / "broken.ply")])
    assert not (tmp_path / "set").exists()  # not bound to a file that has to change


# ---- command -------------------------------------------------------------------------------------


def test_command_writes_report_and_contact_sheet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from PIL import Image

    out = tmp_path / "set"
    settings = ["fragments_per_scene=2", "frames_per_fragment=2", "fusion_voxel=0.03", "min_points=500"]
    arguments = ["data", "synthesize", str(out), "--scenes", "1", "--seed", "2"]
    arguments += [word for setting in settings for word in ("--set", setting)]
    assert run(geomoe3d, "geomoe3d", arguments) == 0
    text = capsys.readouterr().out
    assert "scenes: 1" in text
    assert (out / "report.md").read_text() == text
    with Image.open(out / "contact.png") as picture:
        assert picture.width > 500
    assert run(geomoe3d, "geomoe3d", arguments) == 0
    assert run(geomoe3d, "geomoe3d", [*arguments, "--set", "sensor.farr=3"]) == 2
    assert "sensor.far" in capsys.readouterr().err
    assert run(geomoe3d, "geomoe3d", [*arguments, "min_points=9"]) == 2
    assert "--set min_points=9" in capsys.readouterr().err


def test_settings_are_checked() -> None:
    with pytest.raises((ConfigError, ValueError), match="clutter"):
        SynthesisSettings(clutter=(5.0, 1.0))


def test_job_can_be_sent_to_a_worker(tmp_path: Path) -> None:
    import pickle

    job = Job(str(tmp_path), 0, TINY)
    assert pickle.loads(pickle.dumps(job)) == job
    assert make_scene.__module__ == module.__name__
