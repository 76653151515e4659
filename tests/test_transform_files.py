"""Transforms as other programs read and write them, each by its own reader where Python has it."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
import yaml
from cloud_files import UTM, rigid
from scipy.spatial.transform import Rotation

from geomoe3d.clouds.correspondence_files import load_correspondences
from geomoe3d.clouds.transform_files import (
    TRANSFORM_FORMATS,
    load_transform,
    save_transform,
    transform_format,
)
from geomoe3d.errors import FormatError, InputError

T = rigid(5, tuple(UTM))
COMMENTS = ["maps SOURCE (a.ply) into TARGET (b.ply)", "status ok"]


def close(found: np.ndarray) -> None:
    np.testing.assert_allclose(found[:3, :3], T[:3, :3], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(found[:, 3], T[:, 3])


def test_complex_numbers_are_no_transform_and_no_correspondences(tmp_path: Path) -> None:
    """Their imaginary parts were dropped, and what was left was taken."""
    np.save(tmp_path / "T.npy", T + 0j)
    with pytest.raises(FormatError, match="holds no transform: complex numbers"):
        load_transform(tmp_path / "T.npy")
    np.save(tmp_path / "rows.npy", np.ones((5, 6)) * 1j)
    with pytest.raises(FormatError, match="complex numbers"):
        load_correspondences(tmp_path / "rows.npy")


@pytest.mark.parametrize("kind", [k for k in TRANSFORM_FORMATS if k != "json"])
@pytest.mark.parametrize("name", ["{kind}:T", "{kind}:T.data", "T.{kind}.txt"])
def test_every_format_is_a_first_guess_again(tmp_path: Path, kind: str, name: str, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    name = name.format(kind=kind)
    save_transform(name, T, COMMENTS)
    path = transform_format(name)[1]
    close(load_transform(path))
    with pytest.raises(InputError, match="expected a finite"):
        save_transform("npy:bad", np.full((4, 4), np.nan), [])


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *(("T.txt", "matrix"), ("T.YAML", "tf"), ("T.tum", "tum"), ("T.kitti", "kitti"), ("T.json", "json")),
        *(("a.pdal.json", "pdal"), ("PDAL:a.json", "pdal"), ("./a:b.txt", "matrix"), ("T.npy", "npy")),
    ],
)
def test_formats_by_name_and_suffix(name: str, kind: str) -> None:
    assert transform_format(name)[0] == kind


@pytest.mark.parametrize("name", ["T.docx", "T", "pdel:T.json", "pdal:", "json5:T"])
def test_unknown_formats_list_the_known(name: str) -> None:
    with pytest.raises(FormatError, match="cannot write"):
        transform_format(name)
    with pytest.raises(FormatError, match="pdal, ros"):
        transform_format("pdel:T.json")


def test_a_matrix_begins_with_its_rows(tmp_path: Path) -> None:
    """CloudCompare takes the first sixteen words, whatever they are."""
    save_transform(tmp_path / "T.txt", T, COMMENTS)
    words = (tmp_path / "T.txt").read_text().split()
    np.testing.assert_array_equal(np.array(words[:16], float).reshape(4, 4), T)
    assert words[16] == "#" and "# status ok" in (tmp_path / "T.txt").read_text()
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "T.txt"), T)


def test_tum_and_kitti_as_evo_reads_them(tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    save_transform(tmp_path / "T.tum", T, COMMENTS)
    save_transform(tmp_path / "T.kitti", T, COMMENTS)
    close(file_interface.read_tum_trajectory_file(tmp_path / "T.tum").poses_se3[0])
    close(file_interface.read_kitti_poses_file(tmp_path / "T.kitti").poses_se3[0])


def test_what_pdal_and_ros_are_given(tmp_path: Path) -> None:
    save_transform(tmp_path / "T.pdal.json", T, COMMENTS)
    (stage,) = json.loads((tmp_path / "T.pdal.json").read_text())["pipeline"]
    assert stage["type"] == "filters.transformation"
    np.testing.assert_array_equal(np.array(stage["matrix"].split(), float), T.ravel())
    save_transform(f"ros:{tmp_path / 'T.sh'}", T, COMMENTS, frames=("map", "scan"))
    words = shlex.split((tmp_path / "T.sh").read_text(), comments=True)
    assert words[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    options = dict(zip(words[4::2], words[5::2], strict=True))
    assert options["--frame-id"] == "map" and options["--child-frame-id"] == "scan"
    np.testing.assert_array_equal([float(options[f"--{axis}"]) for axis in "xyz"], T[:3, 3])
    R = Rotation.from_quat([float(options[f"--q{axis}"]) for axis in "xyzw"]).as_matrix()
    np.testing.assert_allclose(R, T[:3, :3], atol=1e-15)
    tiny = np.eye(4)
    tiny[:3, 3] = [1e-5, 2.0, -3e20]
    save_transform(tmp_path / "T.yaml", tiny, COMMENTS, frames=("map", "scan"))
    message = yaml.safe_load((tmp_path / "T.yaml").read_text())
    assert message["header"]["frame_id"] == "map" and message["child_frame_id"] == "scan"
    assert message["transform"]["translation"] == {"x": 1e-5, "y": 2.0, "z": -3e20}
    assert message["transform"]["rotation"] == {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


def turned() -> tuple[str, ...]:
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    yaw, pitch, roll = Rotation.from_matrix(T[:3, :3]).as_euler("ZYX")
    a, b, c = T[:3, 3]
    place, turn = f"{{x: {a}, y: {b}, z: {c}}}", f"{{w: {w}, x: {x}, y: {y}, z: {z}}}"
    rows, flat = T.tolist(), " ".join(map(str, T.ravel()))
    return (
        f"rosrun tf static_transform_publisher {a} {b} {c} {x} {y} {z} {w} map scan 100",
        f"rosrun tf2_ros static_transform_publisher {a} {b} {c} {yaw} {pitch} {roll} map scan",
        f"ros2 run tf2_ros static_transform_publisher --x {a} --y {b} --z {c} \\\n"
        f" --yaw {yaw} --pitch {pitch} --roll {roll} --frame-id map",
        "transforms:\n- header: {frame_id: map}\n  transform:\n"
        f"    translation: {place}\n    rotation: {turn}\n",
        f"pose:\n  position: {place}\n  orientation: {turn}\n",
        json.dumps(rows),
        json.dumps({"T_target_source": rows}),
        json.dumps({"pipeline": ["a.las", {"type": "filters.transformation", "matrix": flat}, "b.las"]}),
        str(T),
        "\n".join(" ".join(map(str, row)) for row in rows[:3]),
        "// by hand\n" + "\n".join(",".join(map(str, row)) for row in rows),
        flat,
        f"# qw qx qy qz tx ty tz\n{w} {x} {y} {z} {a} {b} {c}",
    )


@pytest.mark.parametrize("number", range(13))
def test_first_guesses_of_other_programs(tmp_path: Path, number: int) -> None:
    with np.printoptions(precision=17):
        (tmp_path / "guess").write_text(turned()[number])
    np.testing.assert_allclose(load_transform(tmp_path / "guess"), T, rtol=1e-15, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("1 2 3 4\n5 6 7 8\n", "2 rows of 4 numbers; expected 4 rows (or 3) of 4"),
        ("hello world", "'hello' is no number"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "2 rows"),
        ("1 0 0 0 5 6 7", "the order is tx ty tz"),
        ("{}", "0 transforms"),
        ('{"pipeline": [{"type": "filters.transformation", "matrix": "1 2 x"}]}', "x"),
        ("transform:\n  translation: {x: 1, y: 2}\n  rotation: {x: 0, y: 0, z: 0, w: 1}\n", "z"),
        ("static_transform_publisher 1 2 3 map scan", "3 numbers"),
        ("# static_transform_publisher", "0 rows"),
        ("", "0 rows"),
        ("\0\0\0\0", "no text"),
        ("[" + "9" * 401 + ", 0]", "too large"),
        ("{" + '"a": {' * 100_000, "nested too deeply"),
        ('{"T": [[1' + "0" * 400 + ", 0, 0, 0]]}", "too large"),
        ("[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[1]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]", "a block of 1 x 1 x"),
    ],
)
def test_what_is_no_transform(tmp_path: Path, text: str, word: str) -> None:
    (tmp_path / "guess.txt").write_text(text)
    with pytest.raises(FormatError) as caught:
        load_transform(tmp_path / "guess.txt")
    assert "guess.txt' holds no transform" in str(caught.value) and word in str(caught.value)
