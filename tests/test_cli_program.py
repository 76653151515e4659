"""The real program on the sample pair: its answer, its progress, unusable inputs, a reader that goes away."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys

import numpy as np
import pytest
from command_line import ROOT, call

from geomoe3d.data.sample import write_sample_pair
from geomoe3d.geometry.se3 import rotation_error_deg, translation_error
from geomoe3d.result import RegistrationResult


def program(*arguments, **options):
    headless = {name: value for name, value in os.environ.items() if name != "DISPLAY"}
    return subprocess.run(
        [sys.executable, "-m", "geomoe3d.cli.main", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env=headless | {"PYTHONPATH": str(ROOT)},
        **options,
    )


def test_a_reader_that_goes_away_gives_no_traceback():
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "geomoe3d.cli.main", "config"],
            cwd=ROOT,
            stdout=writing,
            stderr=subprocess.PIPE,
            text=True,
            timeout=60,
            check=False,
        )
    finally:
        os.close(writing)
    assert done.stderr == ""
    assert done.returncode == 141


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    return write_sample_pair(tmp_path_factory.mktemp("pair of scans"))  # a path with spaces


def test_the_sample_pair_end_to_end(pair, tmp_path):
    names = ("T.txt", "T.json", "aligned.ply", "picture.png", "page.html")
    T_txt, T_json, aligned, picture, page = (tmp_path / name for name in names)
    done = program(
        *("register", pair.source, pair.target, "--json", "--output", T_txt, "--aligned", aligned),
        *("--picture", picture, "--page", page),
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    result = RegistrationResult.from_json(done.stdout)
    truth = np.loadtxt(pair.truth)
    assert result.ok
    assert rotation_error_deg(result.T_target_source, truth) < 0.5
    assert translation_error(result.T_target_source, truth) < 0.02
    np.testing.assert_array_equal(np.loadtxt(T_txt), result.T_target_source)
    from geomoe3d.clouds.io import load_points

    source, moved = load_points(pair.source), load_points(aligned)
    np.testing.assert_allclose(moved.file_points, result.apply(source.file_points), atol=1e-9)
    np.testing.assert_allclose(moved.colors, source.colors, atol=1 / 255)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert len(page.read_text()) > 10_000
    again = program("register", pair.source, pair.target, "--output", T_json, cwd=tmp_path)
    assert again.returncode == 0
    assert "maps SOURCE (source.ply) into TARGET (target.ply)" in again.stdout
    first, second = json.loads(done.stdout), json.loads(T_json.read_text())
    assert first.pop("seconds") and second.pop("seconds")
    assert first == second  # the same answer, to the last bit


@pytest.mark.parametrize(
    ("name", "content", "hint"),
    [
        ("nothing.ply", None, "nothing.ply"),
        ("folder", "a folder", "folder"),
        ("scan.docx", b"text", ".docx"),
        ("empty.ply", b"", "empty.ply"),
        ("empty.xyz", b"", "empty.xyz"),
        ("broken.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n", "broken.ply"),
        ("words.xyz", b"this is no cloud\n", "words.xyz"),
        ("nan.xyz", b"nan nan nan\n" * 9, "nan.xyz"),
        ("two.xyz", b"0 0 0\n1 1 1\n", "two.xyz"),
    ],
)
def test_unusable_inputs_end_with_2_and_their_name(name, content, hint, pair, tmp_path, capsys):
    path = tmp_path / name
    if content == "a folder":
        path.mkdir()
    elif content is not None:
        path.write_bytes(content)
    for arguments in ((path, pair.target), (pair.target, path)):
        assert call("register", *arguments, "--set", "preparation.voxel_points=500") == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert hint in printed.err
        assert "Traceback" not in printed.err and "internal error" not in printed.err


def test_progress_is_shown_on_a_terminal_and_never_in_stdout(pair):
    """stderr is a terminal, stdout a pipe: the stages appear on the one and not on the other."""
    try:
        controller, terminal = pty.openpty()
    except OSError as error:
        pytest.skip(f"no pseudo terminal to be had here: {error}")
    arguments = ["register", pair.source, pair.target, "--quiet"]
    seen = {}
    for quiet in (True, False):
        process = subprocess.Popen(
            [sys.executable, "-m", "geomoe3d.cli.main", *arguments[: None if quiet else -1]],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=terminal,
            env=os.environ | {"TERM": "xterm-256color"},
        )
        out = process.communicate(timeout=300)[0].decode()
        assert process.returncode == 0
        os.set_blocking(controller, False)
        shown = b""
        while True:
            try:
                shown += os.read(controller, 65536)
            except BlockingIOError:
                break
        assert "\x1b" not in out
        seen[quiet] = shown.decode()
    os.close(controller)
    os.close(terminal)
    assert seen[True] == ""
    assert "match" in seen[False] and "features" in seen[False]
