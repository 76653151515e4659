"""``geomoe3d evaluate`` as a user types it: reports, comparisons, and bad input that is named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from geomoe3d.cli.errors import run
from geomoe3d.cli.evaluate import command as evaluate_group
from geomoe3d.cli.main import geomoe3d
from geomoe3d.clouds.io import save_points
from geomoe3d.data.threedmatch import write_gt_log
from geomoe3d.evaluation.config import RULES
from geomoe3d.evaluation.predict import MethodSpec, PredictReport
from geomoe3d.geometry.se3 import inverse, make_transform, transform_points

OWN = """
import numpy as np

def right(source, target):
    centre, other = source.mean(0), target.mean(0)
    U, _, Vt = np.linalg.svd((source - centre).T @ (target - other))
    R = Vt.T @ np.diag([1, 1, np.linalg.det(Vt.T @ U.T)]) @ U.T
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, other - R @ centre
    return T

def silent(source, target):
    return None

def broken(source, target):
    raise ValueError("no idea")
"""


def evaluate(*words: object) -> int:
    return run(geomoe3d, "geomoe3d", ["evaluate", *map(str, words)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three copies of one cloud, moved: every method that sees all points can be right."""
    room = tmp_path_factory.mktemp("posed") / "posed" / "room"
    room.mkdir(parents=True)
    x, y = np.random.default_rng(0).uniform(-1.2, 1.2, (2, 3000))
    points = np.column_stack([x, y, 2 + 0.25 * np.sin(3 * x) * np.cos(4 * y)])
    poses = [make_transform(np.eye(3), np.array([0.1 * k, 0.0, 0.05 * k])) for k in range(3)]
    for k, pose in enumerate(poses):
        save_points(room / f"cloud_bin_{k}.ply", transform_points(inverse(pose), points))
    pairs = [(0, 1), (0, 2), (1, 2)]
    write_gt_log(room / "gt.log", [(i, j, inverse(poses[i]) @ poses[j]) for i, j in pairs], 3)
    return room.parent


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("own") / "mine.py"
    path.write_text(OWN)
    return path


@pytest.fixture(scope="module")
def study(folder: Path, own: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("study")
    for name in ("right", "silent"):
        words = ["predict", out, "--method", f"{own}:{name}", "--label", name, "--benchmark", folder]
        assert evaluate(*words, "--track", "clouds") == 0
    return out


def test_scores_of_known_methods(study: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert evaluate("score", study, "--report", tmp_path / "r.json", "--report", tmp_path / "r.md") == 0
    out = capsys.readouterr().out
    assert "right" in out
    assert "silent" in out
    runs = {found["info"]["label"]: found for found in json.loads((tmp_path / "r.json").read_text())["runs"]}
    assert runs["right"]["measures"]["recall_15"]["value"] == 100
    assert runs["silent"]["measures"]["recall_15"]["value"] == 0
    assert runs["right"]["info"]["command"].startswith("geomoe3d evaluate predict ")
    assert "100.0" in (tmp_path / "r.md").read_text()


def test_reports_are_not_overwritten(study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = tmp_path / "r.md"
    report.write_text("mine")
    assert evaluate("score", study, "--report", report) == 2
    assert "exists" in capsys.readouterr().err
    assert report.read_text() == "mine"
    assert evaluate("score", study, "--report", report, "--force", "--quiet") == 0
    assert "# Evaluation" in report.read_text()


def test_compare(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate("compare", study / "right.clouds.posed", study / "silent.clouds.posed") == 0
    out = capsys.readouterr().out
    assert " ".join(out.split()).count("only right right 3 ") == 1
    assert "McNemar" in out
    assert "\nonly right right:\n  room/cloud_bin_0--cloud_bin_1\n" in out
    for name in ("commit", "hardware", "seed", "command"):
        assert f"\n{name}: " in out
    assert evaluate("compare", study, study / "silent.clouds.posed") == 2
    assert "holds 2 runs" in capsys.readouterr().err


def test_run_writes_the_three_reports(folder: Path, own: Path, tmp_path: Path) -> None:
    words = ["run", tmp_path / "out", "--method", f"{own}:right", "--benchmark", folder]
    for _ in range(2):  # the second time it only scores
        assert evaluate(*words) == 0
    for name in ("report.html", "report.md", "report.json"):
        assert (tmp_path / "out" / name).stat().st_size > 1000


def test_an_error_of_a_method_fails_its_pairs_alone(
    folder: Path, own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert evaluate("run", tmp_path, "--method", f"{own}:broken", "--benchmark", folder) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "ended with an error on 3 of 3 pairs" in out
    assert "raised ValueError: no idea (mine.py, line 16)" in out


def test_a_wrong_second_benchmark_is_told_before_the_first_is_done(
    folder: Path, own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--method", f"{own}:right", "--benchmark", folder, "--benchmark", "4DMatch"]
    assert evaluate("predict", tmp_path / "out", *words) == 2
    assert "no benchmark '4DMatch'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_a_relative_folder_gave_is_scored_from_elsewhere(
    folder: Path, own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder.parent)
    assert evaluate("predict", tmp_path, "--method", f"{own}:right", "--benchmark", folder.name) == 0
    monkeypatch.chdir(tmp_path)
    assert evaluate("score", tmp_path, "--quiet") == 0


def test_methods_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate("methods") == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert {"geomoe3d", "consensus", "spectral", "kiss-matcher", "open3d-ransac-50k"} <= set(lines)
    assert "clouds, correspondences" in lines["geomoe3d"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--method", "konsensus"], "did you mean 'consensus'"),
        (["--method", "consensus"], "gives clouds"),
        (["--method", "geomoe3d", "--track", "2k"], "no track '2k'"),
        (["--method", "geomoe3d", "--every", "0"], "at least 1"),
        (["--method", "geomoe3d", "--workers", "0"], "at least 1"),
        (["--method", "geomoe3d", "--benchmark", "unrelated", "--unrelated", "0"], "at least 1 unrelated"),
        (["--method", "geomoe3d", "--set", "voxel=1"], "voxel_size"),
        (["--method", "kiss-matcher", "--set", "voxel_size=1"], "not among those given"),
        (["--method", "geomoe3d", "--method", "kiss-matcher", "--label", "x"], "names one run"),
        (["--method", "nothing.py:f"], "nothing.py"),
        (["--method", "geomoe3d", "--benchmark", "4DMatch"], "no benchmark '4DMatch'"),
    ],
)
def test_bad_input_is_named(
    words: list[str], said: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = words if "--benchmark" in words else [*words, "--benchmark", str(folder)]
    assert evaluate("predict", tmp_path / "out", *given) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.glob("out/*/predictions.jsonl"))


def test_the_number_of_unrelated_pairs_is_that_of_the_benchmark() -> None:
    """The command has a figure of its own, so that help comes without loading the evaluation."""
    for name in ("predict", "run"):
        (option,) = (o for o in evaluate_group.commands[name].params if o.name == "num_unrelated")
        assert option.default == RULES.num_unrelated


def test_nothing_to_score_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate("score", tmp_path) == 2
    assert "holds no predictions" in capsys.readouterr().err
    assert evaluate("score", tmp_path, "--report", tmp_path / "r.pdf") == 2
    assert ".html" in capsys.readouterr().err


def test_parts_are_named_as_where_pairs_are_registered(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[tuple[str, ...]] = []

    def spy(study: str, specs: list[MethodSpec], *_: object, **__: object) -> PredictReport:
        asked.extend(spec.assignments for spec in specs)
        return PredictReport((), made=1, kept=0, absent={})

    monkeypatch.setattr("geomoe3d.evaluation.predict.predict", spy)
    words = ["--benchmark", str(folder), "--method", "geomoe3d"]
    named = ["--filter", "spectral", "--scorer", "surfaces"]
    assert evaluate("predict", tmp_path / "out", *words, "--set", "filter.name=none", *named) == 0
    assert asked == [("filter.name=none", "filter.name=spectral", "scoring.scorers=[surfaces]")]
    assert evaluate("predict", tmp_path / "out", *words, "--descriptor", "fpfj") == 2
    assert "did you mean 'fpfh'" in capsys.readouterr().err
