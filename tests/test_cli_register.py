"""``geomoe3d register``: what goes to stdout and what to files, and outputs that are checked first."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import TRUTH, call, make_result

from geomoe3d.cli.summary import matrix_text, summary
from geomoe3d.decision.scale import Scale
from geomoe3d.errors import OutputError
from geomoe3d.geometry.se3 import inverse, transform_points
from geomoe3d.result import RegistrationResult
from geomoe3d.types import Alternative

# ---- the answer ----------------------------------------------------------------------------------


@pytest.mark.parametrize("status", ["low_confidence", "ambiguous", "failed"])
def test_every_status_but_ok_ends_with_3_and_still_gives_the_transform(
    status, scan_files, fake_registrar, capsys
):
    fake_registrar.answer = make_result(status=status, reasons=("The clouds share too little.",))
    assert call("register", *scan_files) == 3
    printed = capsys.readouterr().out
    assert printed.startswith(status.replace("_", " ") + ": ")
    assert "The clouds share too little." in printed
    assert matrix_text(TRUTH) in printed
    assert ("\nnext: look at it" in printed) == (status != "failed")


def test_where_the_scale_differs_the_next_step_is_to_estimate_it(scan_files, fake_registrar, capsys):
    reason = Scale(1.1, 0.004).sentence("a", "b")
    fake_registrar.answer = make_result(status="low_confidence", reasons=("Little is shared.", reason))
    assert call("register", *scan_files) == 3
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("next: have the ratio of the lengths estimated") and "--estimate-scale" in last


def test_summary_tells_everything_and_is_plain_where_nobody_sees_colours(scan_files, fake_registrar, capsys):
    other = Alternative(np.eye(4), 0.83, 92.1, 1.25)
    fake_registrar.answer = make_result(alternative=other, reasons=("Mostly one plane.",))
    assert call("register", *scan_files) == 0
    printed = capsys.readouterr()
    assert "\x1b" not in printed.out
    assert printed.err == ""  # no progress where nobody looks
    first = printed.out.splitlines()[0]
    assert first == "ok: the transform is reliable (confidence 0.97)"
    for part in (
        "Mostly one plane.",
        "56 % of the source",
        "1,234 of 4,321 correspondences within 0.11",
        "0.055 (chosen from the clouds",
        "source.xyz: 81,234 points in, 4,900 voxel points used; "
        "dropped 12 points with NaN or infinite coordinates, 7 duplicates, 3 isolated voxels",
        "target.xyz: 71,000 points in, 4,100 voxel points used; nothing dropped",
        "runner-up   83 % of the score, differs by 92.1 deg and 1.25",
        "load 0.25, match 1.50, total 1.75",
        "maps SOURCE (source.xyz) into TARGET (target.xyz): p_target = R p_source + t",
        "583394.123456789",
        "-5283100.987654321",
    ):
        assert part in printed.out
    assert "\x1b[" in summary(fake_registrar.answer)  # the terminal's share


def test_a_runner_up_above_the_answer_is_told_as_a_multiple():
    result = make_result(alternative=Alternative(np.eye(4), 2.44, 92.1, 1.25))
    assert "runner-up   2.44 times the score, differs by 92.1 deg" in summary(result)


def test_matrix_on_screen_is_exact_enough_at_national_grid_coordinates():
    rows = [[float(cell) for cell in line.split()] for line in matrix_text(TRUTH).splitlines()]
    point = np.array([[5e6, -6e6, 1000.0]])
    np.testing.assert_allclose(
        transform_points(np.array(rows), point), transform_points(TRUTH, point), atol=2e-8
    )


def test_no_transform_is_said_and_not_written(tmp_path, scan_files, fake_registrar, capsys):
    fake_registrar.answer = make_result(
        status="failed",
        T_target_source=np.full((4, 4), np.nan),
        reasons=("No hypothesis.",),
        confidence=0.0,
        voxel_size=np.nan,
        inlier_threshold=np.nan,
    )
    outputs = [tmp_path / name for name in ("T.txt", "T2.npy", "moved.ply", "T.json")]
    code = call(
        *("register", *scan_files, "--output", outputs[0], "--aligned", outputs[2], "--inverse"),
    )
    printed = capsys.readouterr()
    assert code == 3
    assert "no transform was found" in printed.out
    assert "nan" not in printed.out
    assert "T.txt" in printed.err and "moved.ply" in printed.err
    assert call("register", *scan_files, "--output", outputs[1], "--quiet") == 3
    printed = capsys.readouterr()
    assert printed.out == ""
    assert sum(line.startswith("failed: ") for line in printed.err.splitlines()) == 1
    assert call("register", *scan_files, "--output", outputs[3], "--json") == 3
    assert [path.exists() for path in outputs] == [False, False, False, True]
    assert json.loads(outputs[3].read_text())["T_target_source"][0][0] is None
    assert json.loads(capsys.readouterr().out)["status"] == "failed"


def test_json_is_all_that_stdout_gets_whatever_the_libraries_print(scan_files, fake_registrar, capfd):
    fake_registrar.noise = "[Open3D WARNING] something\n"
    assert call("register", *scan_files, "--json") == 0
    printed = capfd.readouterr()
    assert RegistrationResult.from_json(printed.out).to_json() == fake_registrar.answer.to_json()
    np.testing.assert_array_equal(json.loads(printed.out)["T_target_source"], TRUTH)
    assert printed.err.count(fake_registrar.noise) == 2


def test_quiet_prints_the_matrix_alone(scan_files, fake_registrar, capsys):
    assert call("register", *scan_files, "--quiet") == 0
    printed = capsys.readouterr()
    np.testing.assert_array_equal(np.loadtxt(printed.out.splitlines()), TRUTH)
    assert printed.err == ""


@pytest.mark.parametrize("suffix", [".txt", ".npy", ".json", ".TXT"])
def test_files_keep_every_bit(suffix, tmp_path, scan_files, fake_registrar, capsys):
    path = tmp_path / f"T{suffix}"
    assert call("register", *scan_files, "--output", path) == 0
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


def test_inverse_is_printed_and_written_and_says_so(tmp_path, scan_files, fake_registrar, capsys):
    path = tmp_path / "T.txt"
    assert call("register", *scan_files, "--output", path, "--inverse") == 0
    printed = capsys.readouterr().out
    np.testing.assert_array_equal(np.loadtxt(path), inverse(TRUTH))
    sentence = "maps TARGET (target.xyz) into SOURCE (source.xyz): p_source = R p_target + t"
    assert sentence in path.read_text() and sentence in printed
    assert matrix_text(inverse(TRUTH)) in printed
    # The lines about the clouds keep the names that the command line gave them.
    assert re.search(r"^source +source\.xyz", printed, re.MULTILINE)


def test_aligned_cloud_is_the_source_moved_into_the_target_also_with_inverse(
    tmp_path, scan_files, fake_registrar
):
    from geomoe3d.clouds.io import load_points

    path = tmp_path / "moved.ply"
    assert call("register", *scan_files, "--aligned", path, "--inverse") == 0
    expected = transform_points(TRUTH, np.loadtxt(scan_files[0]))
    np.testing.assert_allclose(load_points(path).file_points, expected, rtol=0, atol=2e-9)


def test_picture_and_page_are_written(tmp_path, scan_files, fake_registrar):
    picture, page = tmp_path / "p.png", tmp_path / "p.html"
    assert call("register", *scan_files, "--picture", picture, "--page", page) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "<html" in page.read_text()
    assert len(fake_registrar.asked) == 1  # registered once, shown twice


# ---- outputs are checked first -------------------------------------------------------------------


@pytest.mark.parametrize("option", ["--output", "--aligned", "--picture", "--page"])
def test_unusable_outputs_are_refused_before_the_work_begins(
    option, tmp_path, scan_files, fake_registrar, capsys
):
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
        assert call("register", *scan_files, option, path) == 2
        message = capsys.readouterr().err
        assert path.name in message and hint in message
    assert fake_registrar.asked == []
    assert existing.read_text() == "mine"
    assert call("register", *scan_files, option, existing, "--force") == 0
    assert existing.read_bytes() != b"mine"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_the_right_to_write_is_refused(tmp_path, scan_files, fake_registrar, capsys):
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    assert call("register", *scan_files, "--output", locked / "T.txt") == 2
    assert "locked" in capsys.readouterr().err
    assert fake_registrar.asked == []


def test_a_disk_that_refuses_ends_with_2(scan_files, fake_registrar, capsys):
    if not Path("/proc").is_dir():
        pytest.skip("no /proc here, a folder into which nobody can write")
    assert call("register", *scan_files, "--output", "/proc/T.txt") == 2
    assert "/proc/T.txt" in capsys.readouterr().err


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere there is always a screen")
def test_show_without_a_screen_is_refused_before_the_work_begins(
    scan_files, fake_registrar, monkeypatch, capsys
):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert call("register", *scan_files, "--show") == 2
    assert "no display" in capsys.readouterr().err
    assert fake_registrar.asked == []


def test_an_input_is_never_an_output_nor_two_outputs_one_file(tmp_path, scan_files, fake_registrar, capsys):
    before = Path(scan_files[0]).read_bytes()
    assert call("register", *scan_files, "--aligned", scan_files[0], "--force") == 2
    assert "is also an input" in capsys.readouterr().err
    alias = tmp_path / "alias.xyz"
    alias.symlink_to(scan_files[1])
    assert call("register", *scan_files, "--aligned", alias, "--force") == 2
    same = tmp_path / "same.txt"
    assert call("register", *scan_files, "--output", same, "--aligned", f"{tmp_path}/./same.txt") == 2
    assert "is also --output" in capsys.readouterr().err
    assert fake_registrar.asked == []
    assert Path(scan_files[0]).read_bytes() == before


def test_the_answer_is_printed_even_if_it_cannot_be_written(
    tmp_path, scan_files, fake_registrar, monkeypatch, capsys
):
    import geomoe3d.clouds.transform_files as transform_files

    def full(*arguments, **options):
        raise OutputError("no space left")

    monkeypatch.setattr(transform_files, "write_text", full)
    assert call("register", *scan_files, "--output", tmp_path / "T.txt") == 2
    printed = capsys.readouterr()
    assert matrix_text(TRUTH) in printed.out
    assert "no space left" in printed.err


def test_a_first_guess_of_a_file_is_handed_on(tmp_path, scan_files, fake_registrar):
    np.savetxt(tmp_path / "T.txt", TRUTH)
    assert call("register", *scan_files, "--initial", str(tmp_path / "T.txt")) == 0
    np.testing.assert_array_equal(fake_registrar.initial, TRUTH)
    assert call("register", *scan_files) == 0
    assert fake_registrar.initial is None


def test_a_first_guess_that_is_not_there_is_named(tmp_path, scan_files, fake_registrar, capsys):
    assert call("register", *scan_files, "--initial", str(tmp_path / "T.txt")) == 2
    message = capsys.readouterr().err
    assert "T.txt" in message and "No such file" in message


def test_weights_for_a_filter_that_takes_none_are_refused(scan_files, fake_registrar, capsys):
    assert call("register", *scan_files, "--filter", "spectral", "--weights", "a.safetensors") == 2
    assert (
        "weights 'a.safetensors' are given, but the filter 'spectral' takes none" in capsys.readouterr().err
    )
