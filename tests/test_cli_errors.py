"""From exceptions to exit codes: a message for each, a traceback on demand."""

from __future__ import annotations

import re

import numpy as np
import pytest
from command_line import call

from geomoe3d.errors import CheckpointError, ConfigError, DependencyError, EmptyCloudError, OutputError


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (EmptyCloudError("source.xyz holds 2 points; 3 are needed"), 2),
        (ConfigError("no such filter"), 2),
        (DependencyError("pip install this"), 2),
        (CheckpointError("not the same network"), 2),
        (OutputError("cannot write"), 2),
        (RuntimeError("index 5 is out of bounds"), 1),
        (KeyError("gone"), 1),
        (OSError(5, "Input/output error"), 1),
        (MemoryError(), 1),
        (KeyboardInterrupt(), 130),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else str(value),
)
def test_exceptions_become_a_message_and_a_code(error, code, scan_files, fake_registrar, capsys):
    fake_registrar.answer = error
    assert call("register", *scan_files) == code
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "Traceback" not in printed.err
    expected = {1: "fault of geomoe3d", 2: f"error: {error}", 130: "interrupted"}[code]
    assert expected in printed.err
    if code == 1:
        assert "--traceback" in printed.err


def test_traceback_on_demand(scan_files, fake_registrar, monkeypatch, capsys):
    fake_registrar.answer = RuntimeError("broken")
    assert call("register", *scan_files, "--traceback") == 1
    assert "Traceback" in capsys.readouterr().err
    monkeypatch.setenv("GEOMOE3D_TRACEBACK", "1")
    assert call("register", *scan_files) == 1
    assert "Traceback" in capsys.readouterr().err
    monkeypatch.setenv("GEOMOE3D_TRACEBACK", "0")
    assert call("register", *scan_files) == 1
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("index a.ply map", "write 'geomoe3d index a.ply map.map'"),
        (
            "index house.map a.ply b.ply",
            "comes last, behind its clouds; write 'geomoe3d index a.ply b.ply house.map'",
        ),
        ("index a.ply there.ply", "'there.ply' is there; write 'geomoe3d index a.ply there.ply NAME.map'"),
        ("locate house.map a.ply", "comes last, behind the scans; write 'geomoe3d locate a.ply house.map'"),
        ("locate one.map two.map", "'one.map' and 'two.map' are maps: give one map, behind the scans"),
        ("batch out there.csv", "the folder for the results last; write 'geomoe3d batch there.csv out'"),
        (
            "batch a.ply b.ply",
            "'a.ply' is a cloud, not a table of pairs; .* write 'geomoe3d register a.ply b.ply'",
        ),
        (
            "register house.map there.ply",
            "a map of `geomoe3d index`, in which `geomoe3d locate SCAN MAP` finds scans",
        ),
    ],
)
def test_arguments_in_the_wrong_order_end_in_the_line_to_type(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("there.ply", "there.csv", "house.map"):
        (tmp_path / name).write_text("x")
    assert call(*words.split()) == 2
    assert re.search(said, " ".join(capsys.readouterr().err.split()))


def test_a_guess_beside_an_unknown_scale_names_both_options(tmp_path, capsys):
    for name in ("a.npy", "b.npy"):
        np.save(tmp_path / name, np.random.default_rng(0).uniform(size=(100, 3)))
    (tmp_path / "T.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    both = tmp_path / "a.npy", tmp_path / "b.npy"
    assert call("register", *both, "--initial", tmp_path / "T.txt", "--estimate-scale") == 2
    said = capsys.readouterr().err
    assert "--initial" in said and "and --estimate-scale" in said and "Leave --initial out" in said
    (tmp_path / "T.txt").write_text("0 -2 0 0\n2 0 0 0\n0 0 2 0\n0 0 0 1\n")
    assert call("register", *both, "--initial", tmp_path / "T.txt") == 2
    assert (
        "no rigid transform: it holds a scale of 2; divide the first three numbers" in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--voxel-size", "10cm", "--voxel-size = '10cm': it must be a number"),
        ("--voxel-size", "-1", "--voxel-size = -1: it must be greater than 0"),
        ("--seed", "x", "--seed = 'x': it must be a whole number"),
        ("--set", "voxel_size=10cm", "configuration: 'voxel_size' = '10cm': it must be a number"),
    ],
)
def test_a_value_that_cannot_be_is_told_by_the_name_under_which_it_was_given(
    option, value, said, scan_files, capsys
):
    assert call("register", *scan_files, option, value) == 2
    assert said in capsys.readouterr().err
