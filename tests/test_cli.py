"""The command line: exit codes, messages, what goes to stdout and what to files.

Most tests call the verbs in this process with a registrar that answers at once; those at the end start
the real program on the sample pair.
"""

from __future__ import annotations

import json
import os
import pty
import re
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomoe3d import __version__
from geomoe3d.cli.errors import run
from geomoe3d.cli.main import VERBS, geomoe3d, register_main
from geomoe3d.cli.summary import matrix_text, summary
from geomoe3d.config import RegistrationConfig
from geomoe3d.data.sample import write_sample_pair
from geomoe3d.errors import CheckpointError, ConfigError, DependencyError, EmptyCloudError, OutputError
from geomoe3d.filters.base import FilterOutput
from geomoe3d.geometry.se3 import (
    inverse,
    make_transform,
    rotation_error_deg,
    transform_points,
    translation_error,
)
from geomoe3d.result import Alternative, CloudReport, RegistrationResult
from geomoe3d.types import Correspondences, PointCloud

ROOT = Path(__file__).parents[1]
TRUTH = make_transform(
    Rotation.from_euler("xyz", [20.0, -35.0, 110.0], degrees=True).as_matrix(),
    np.array([583394.123456789, -5283100.987654321, 498.0]),
)


def make_result(**changes):
    values = {
        "T_target_source": TRUTH,
        "status": "ok",
        "reasons": (),
        "confidence": 0.9731,
        "overlap": 0.561,
        "evidence": {},
        "num_correspondences": 4321,
        "num_inliers": 1234,
        "inlier_threshold": 0.11,
        "voxel_size": 0.055,
        "alternative": None,
        "information_matrix": np.eye(6),
        "information_center": np.zeros(3),
        "source": CloudReport("source.xyz", 81234, 12, 7, 3, 4900, (0.0, 0.0, 0.0)),
        "target": CloudReport("target.xyz", 71000, 0, 0, 0, 4100, (583000.0, -5283000.0, 0.0)),
        "seconds": {"load": 0.25, "match": 1.5, "total": 1.75},
        "config": RegistrationConfig().model_dump(),
        **changes,
    }
    return RegistrationResult(**values)


class FakeRegistrar:
    """Answers with what the test has put in place, and remembers what it was asked."""

    answer: RegistrationResult | BaseException
    noise = ""
    asked: list

    def __init__(self, config=None):
        self.config = config

    def register(self, source, target, *, progress=None):
        type(self).asked.append((source, target, self.config))
        for stage in ("load", "judge"):
            progress(stage)
        if self.noise:
            print(self.noise)
            os.write(1, self.noise.encode())  # as native code does
        if isinstance(self.answer, BaseException):
            raise self.answer
        return self.answer

    def explain(self, source, target, *, progress=None):
        result = self.register(source, target, progress=progress)
        points = np.random.default_rng(0).normal(size=(50, 3))
        moved = transform_points(TRUTH, points)
        origin = np.round(moved.mean(axis=0))
        return types.SimpleNamespace(
            result=result,
            source=PointCloud(points),
            target=PointCloud(moved - origin, origin=origin),
            correspondences=Correspondences(np.column_stack([points, moved - origin])),
            weighed=FilterOutput(np.ones(50)),
            inliers=np.ones(50, dtype=bool),
        )


@pytest.fixture
def fake(monkeypatch):
    """The registrar of every verb called in this test."""
    registrar = type("Fake", (FakeRegistrar,), {"answer": make_result(), "asked": []})
    module = types.SimpleNamespace(Registrar=registrar)
    monkeypatch.setitem(sys.modules, "geomoe3d.registration", module)
    monkeypatch.delenv("GEOMOE3D_TRACEBACK", raising=False)
    return registrar


@pytest.fixture
def scans(tmp_path):
    """Two tiny files to name on the command line."""
    rng = np.random.default_rng(5)
    paths = []
    for name in ("source.xyz", "target.xyz"):
        np.savetxt(tmp_path / name, rng.normal(size=(40, 3)))
        paths.append(str(tmp_path / name))
    return paths


def call(*arguments):
    return run(geomoe3d, "geomoe3d", [str(argument) for argument in arguments])


# ---- help and names ------------------------------------------------------------------------------


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("option", ["--help", "-h"])
def test_help_of_every_verb(verb, option, capsys):
    assert call(verb, option) == 0
    assert f"Usage: geomoe3d {verb}" in capsys.readouterr().out


def test_help_lists_every_verb_with_its_purpose(capsys):
    assert call("--help") == 0
    text = capsys.readouterr().out
    for verb in VERBS:
        assert re.search(rf"^  {verb} +[A-Z]", text, re.MULTILINE)


def test_version(capsys):
    assert call("--version") == 0
    assert __version__ in capsys.readouterr().out


def test_register_is_a_command_of_its_own(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["register", "--help"])
    with pytest.raises(SystemExit) as stop:
        register_main()
    assert stop.value.code == 0
    alone = capsys.readouterr().out
    assert call("register", "--help") == 0
    assert capsys.readouterr().out.replace("geomoe3d register", "register") == alone


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["regster"], "register"),
        (["register", "a", "b", "--voxelsize", "1"], "--voxel-size"),
        (["register", "a", "b", "--set", "estimator.nmae=ransac"], "estimator.name"),
        (["register", "a", "b", "--set", "voxel_sizes=1"], "voxel_size"),
        (["register", "a", "b", "--estimator", "ransack"], "'ransac'"),
        (["register", "a", "b", "--set", "seed"], "key=value"),
        (["register", "a", "b", "--voxel-size", "0"], "greater than 0"),
        (["register", "a", "b", "--voxel-size", "-1"], "greater than 0"),
        (["register", "a", "b", "--voxel-size", "big"], "voxel_size"),
        (["register", "a", "b", "--seed", "-1"], "seed"),
        (["register", "a", "b", "--voxel-size", "inf"], "finite"),
        (["register", "a", "b", "--config", "/there/is/none.yaml"], "/there/is/none.yaml"),
        (["register", "a"], "TARGET"),
        (["register", "a", "b", "c"], "c"),
        (["qqqq"], "register"),
    ],
)
def test_a_wrong_word_ends_with_2_and_the_right_one(arguments, hint, fake, capsys):
    assert call(*arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert hint in printed.err
    assert "Traceback" not in printed.err
    assert fake.asked == []


# ---- configuration -------------------------------------------------------------------------------


def test_options_reach_the_registrar_and_win_over_set_and_file(tmp_path, scans, fake):
    path = tmp_path / "my.yaml"
    path.write_text("seed: 1\nvoxel_size: 0.5\nmatching: {method: mutual}\n")
    code = call(
        *("register", *scans, "--config", path, "--set", "seed=2", "--set", "estimator.inlier_threshold=3"),
        *("--seed", "3", "--filter", "spectral", "--estimator", "ransac"),
    )
    assert code == 0
    ((source, target, config),) = fake.asked
    assert [source, target] == scans
    assert (config.seed, config.voxel_size, config.matching.method) == (3, 0.5, "mutual")
    assert (config.filter.name, config.estimator.name) == ("spectral", "ransac")
    assert config.estimator.inlier_threshold == 3


def test_config_prints_what_register_reads(tmp_path, scans, fake, capsys):
    assert call("config", "--set", "seed=9") == 0
    text = capsys.readouterr().out
    path = tmp_path / "config.yaml"
    assert call("config", "--set", "seed=9", "--out", path) == 0
    assert path.read_text() == text
    assert call("config", "--out", path) == 2  # it exists
    assert path.read_text() == text
    assert call("register", *scans, "--config", path) == 0
    assert fake.asked[0][2] == RegistrationConfig(seed=9)


# ---- the answer ----------------------------------------------------------------------------------


@pytest.mark.parametrize("status", ["low_confidence", "ambiguous", "failed"])
def test_every_status_but_ok_ends_with_3_and_still_gives_the_transform(status, scans, fake, capsys):
    fake.answer = make_result(status=status, reasons=("The clouds share too little.",))
    assert call("register", *scans) == 3
    printed = capsys.readouterr().out
    assert printed.startswith(status.replace("_", " ") + ": ")
    assert "The clouds share too little." in printed
    assert matrix_text(TRUTH) in printed


def test_summary_tells_everything_and_is_plain_where_nobody_sees_colours(scans, fake, capsys):
    other = Alternative(np.eye(4), 0.83, 92.1, 1.25)
    fake.answer = make_result(alternative=other, reasons=("Mostly one plane.",))
    assert call("register", *scans) == 0
    printed = capsys.readouterr()
    assert "\x1b" not in printed.out
    assert printed.err == ""  # no progress where nobody looks
    first = printed.out.splitlines()[0]
    assert first == "ok: the transform can be relied on (confidence 0.97)"
    for part in (
        "Mostly one plane.",
        "56% of the source lies on the target",
        "1,234 of 4,321 correspondences agree within 0.11",
        "0.055 (chosen from the clouds",
        "source.xyz: 81,234 points in, 4,900 voxel points used; "
        "dropped 12 non-finite, 7 duplicates, 3 isolated voxels",
        "target.xyz: 71,000 points in, 4,100 voxel points used; nothing dropped",
        "scores 0.83 of this one, 92.1 deg and 1.25 away",
        "load 0.25, match 1.50, total 1.75",
        "maps SOURCE (source.xyz) into TARGET (target.xyz): p_target = R p_source + t",
        "583394.123456789",
        "-5283100.987654321",
    ):
        assert part in printed.out
    assert "\x1b[" in summary(fake.answer)  # the terminal's share


def test_matrix_on_screen_is_exact_enough_at_national_grid_coordinates():
    rows = [[float(cell) for cell in line.split()] for line in matrix_text(TRUTH).splitlines()]
    point = np.array([[5e6, -6e6, 1000.0]])
    np.testing.assert_allclose(
        transform_points(np.array(rows), point), transform_points(TRUTH, point), atol=2e-8
    )


def test_no_transform_is_said_and_not_written(tmp_path, scans, fake, capsys):
    fake.answer = make_result(
        status="failed",
        T_target_source=np.full((4, 4), np.nan),
        reasons=("No hypothesis.",),
        confidence=0.0,
        voxel_size=np.nan,
        inlier_threshold=np.nan,
    )
    outputs = [tmp_path / name for name in ("T.txt", "T2.npy", "moved.ply", "T.json")]
    code = call(
        *("register", *scans, "--output", outputs[0], "--aligned", outputs[2], "--inverse"),
    )
    printed = capsys.readouterr()
    assert code == 3
    assert "no transform was found" in printed.out
    assert "nan" not in printed.out
    assert "T.txt" in printed.err and "moved.ply" in printed.err
    assert call("register", *scans, "--output", outputs[1], "--quiet") == 3
    assert capsys.readouterr().out == ""
    assert call("register", *scans, "--output", outputs[3], "--json") == 3
    assert [path.exists() for path in outputs] == [False, False, False, True]
    assert json.loads(outputs[3].read_text())["T_target_source"][0][0] is None
    assert json.loads(capsys.readouterr().out)["status"] == "failed"


def test_json_is_all_that_stdout_gets_whatever_the_libraries_print(scans, fake, capfd):
    fake.noise = "[Open3D WARNING] something\n"
    assert call("register", *scans, "--json") == 0
    printed = capfd.readouterr()
    assert RegistrationResult.from_json(printed.out).to_json() == fake.answer.to_json()
    np.testing.assert_array_equal(json.loads(printed.out)["T_target_source"], TRUTH)
    assert printed.err.count(fake.noise) == 2


def test_quiet_prints_the_matrix_alone(scans, fake, capsys):
    assert call("register", *scans, "--quiet") == 0
    printed = capsys.readouterr()
    np.testing.assert_array_equal(np.loadtxt(printed.out.splitlines()), TRUTH)
    assert printed.err == ""


@pytest.mark.parametrize("suffix", [".txt", ".npy", ".json", ".TXT"])
def test_files_keep_every_bit(suffix, tmp_path, scans, fake, capsys):
    path = tmp_path / f"T{suffix}"
    assert call("register", *scans, "--output", path) == 0
    if suffix.lower() == ".txt":
        found = np.loadtxt(path)
        comments = [line for line in path.read_text().splitlines() if line.startswith("#")]
        assert any("maps SOURCE (source.xyz) into TARGET (target.xyz)" in line for line in comments)
        assert any("status ok" in line for line in comments)
    elif suffix == ".npy":
        found = np.load(path)
        assert found.dtype == np.float64
    else:
        found = RegistrationResult.from_json(path.read_text()).T_target_source
    np.testing.assert_array_equal(found, TRUTH)


def test_inverse_is_printed_and_written_and_says_so(tmp_path, scans, fake, capsys):
    path = tmp_path / "T.txt"
    assert call("register", *scans, "--output", path, "--inverse") == 0
    printed = capsys.readouterr().out
    np.testing.assert_array_equal(np.loadtxt(path), inverse(TRUTH))
    sentence = "maps TARGET (target.xyz) into SOURCE (source.xyz): p_source = R p_target + t"
    assert sentence in path.read_text() and sentence in printed
    assert matrix_text(inverse(TRUTH)) in printed
    # The lines about the clouds keep the names that the command line gave them.
    assert re.search(r"^source +source\.xyz", printed, re.MULTILINE)


def test_aligned_cloud_is_the_source_moved_into_the_target_also_with_inverse(tmp_path, scans, fake):
    from geomoe3d.clouds.io import load_points

    path = tmp_path / "moved.ply"
    assert call("register", *scans, "--aligned", path, "--inverse") == 0
    expected = transform_points(TRUTH, np.loadtxt(scans[0]))
    np.testing.assert_allclose(load_points(path).file_points, expected, rtol=0, atol=2e-9)


def test_picture_and_page_are_written(tmp_path, scans, fake):
    picture, page = tmp_path / "p.png", tmp_path / "p.html"
    assert call("register", *scans, "--picture", picture, "--page", page) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "<html" in page.read_text()
    assert len(fake.asked) == 1  # registered once, shown twice


# ---- outputs are checked first -------------------------------------------------------------------


@pytest.mark.parametrize("option", ["--output", "--aligned", "--picture", "--page"])
def test_unusable_outputs_are_refused_before_the_work_begins(option, tmp_path, scans, fake, capsys):
    suffix = {"--output": ".txt", "--aligned": ".ply", "--picture": ".png", "--page": ".html"}[option]
    existing = tmp_path / f"there{suffix}"
    existing.write_text("mine")
    (tmp_path / f"folder{suffix}").mkdir()
    for path, hint in (
        (existing, "--force"),
        (tmp_path / "missing" / f"x{suffix}", "missing"),
        (tmp_path / "x.docx", suffix),
        (tmp_path / "x", suffix),
        (tmp_path / f"folder{suffix}", "folder"),
    ):
        assert call("register", *scans, option, path) == 2
        message = capsys.readouterr().err
        assert path.name in message and hint in message
    assert fake.asked == []
    assert existing.read_text() == "mine"
    assert call("register", *scans, option, existing, "--force") == 0
    assert existing.read_bytes() != b"mine"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_the_right_to_write_is_refused(tmp_path, scans, fake, capsys):
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    assert call("register", *scans, "--output", locked / "T.txt") == 2
    assert "locked" in capsys.readouterr().err
    assert fake.asked == []


def test_a_disk_that_refuses_ends_with_2(scans, fake, capsys):
    if not Path("/proc").is_dir():
        pytest.skip("no /proc here, a folder into which nobody can write")
    assert call("register", *scans, "--output", "/proc/T.txt") == 2
    assert "/proc/T.txt" in capsys.readouterr().err


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere there is always a screen")
def test_show_without_a_screen_is_refused_before_the_work_begins(scans, fake, monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert call("register", *scans, "--show") == 2
    assert "no display" in capsys.readouterr().err
    assert fake.asked == []


def test_an_input_is_never_an_output_nor_two_outputs_one_file(tmp_path, scans, fake, capsys):
    before = Path(scans[0]).read_bytes()
    assert call("register", *scans, "--aligned", scans[0], "--force") == 2
    assert "is also an input" in capsys.readouterr().err
    alias = tmp_path / "alias.xyz"
    alias.symlink_to(scans[1])
    assert call("register", *scans, "--aligned", alias, "--force") == 2
    same = tmp_path / "same.txt"
    assert call("register", *scans, "--output", same, "--aligned", f"{tmp_path}/./same.txt") == 2
    assert "is also --output" in capsys.readouterr().err
    assert fake.asked == []
    assert Path(scans[0]).read_bytes() == before


def test_the_answer_is_printed_even_if_it_cannot_be_written(tmp_path, scans, fake, monkeypatch, capsys):
    import geomoe3d.transform_files as transform_files

    def full(*arguments, **options):
        raise OutputError("no space left")

    monkeypatch.setattr(transform_files, "write_atomically", full)
    assert call("register", *scans, "--output", tmp_path / "T.txt") == 2
    printed = capsys.readouterr()
    assert matrix_text(TRUTH) in printed.out
    assert "no space left" in printed.err


# ---- from exceptions to exit codes ---------------------------------------------------------------


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
def test_exceptions_become_a_message_and_a_code(error, code, scans, fake, capsys):
    fake.answer = error
    assert call("register", *scans) == code
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "Traceback" not in printed.err
    expected = {1: "fault of geomoe3d", 2: f"error: {error}", 130: "interrupted"}[code]
    assert expected in printed.err
    if code == 1:
        assert "--traceback" in printed.err


def test_traceback_on_demand(scans, fake, monkeypatch, capsys):
    fake.answer = RuntimeError("broken")
    assert call("register", *scans, "--traceback") == 1
    assert "Traceback" in capsys.readouterr().err
    monkeypatch.setenv("GEOMOE3D_TRACEBACK", "1")
    assert call("register", *scans) == 1
    assert "Traceback" in capsys.readouterr().err
    monkeypatch.setenv("GEOMOE3D_TRACEBACK", "0")
    assert call("register", *scans) == 1
    assert "Traceback" not in capsys.readouterr().err


# ---- the real program ----------------------------------------------------------------------------


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


def test_help_answers_within_a_second_and_loads_no_library():
    code = (
        "import sys, time; start = time.perf_counter()\n"
        "from geomoe3d.cli.main import geomoe3d; from geomoe3d.cli.errors import run\n"
        "code = run(geomoe3d, 'geomoe3d', ['--help'])\n"
        "heavy = {'numpy', 'open3d', 'torch', 'matplotlib', 'scipy', 'rich', 'pydantic'} & set(sys.modules)\n"
        "print(code, sorted(heavy), time.perf_counter() - start)"
    )
    seconds = []
    for _ in range(3):
        done = subprocess.run(
            [sys.executable, "-W", "error", "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
        )
        last = done.stdout.splitlines()[-1]
        assert last.startswith("0 [] ")
        seconds.append(float(last.split()[-1]))
    assert min(seconds) < 1.0


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
    assert "match" in seen[False] and "describe" in seen[False]
