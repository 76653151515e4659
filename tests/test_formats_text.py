"""Text files of points: dialects, headers, and garbage with its line."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from cloud_files import fails, small_cloud

from geomoe3d.clouds.formats.raw import RawCloud
from geomoe3d.clouds.formats.text import write_csv
from geomoe3d.clouds.io import load_points, save_aligned, save_points
from geomoe3d.clouds.loading import read_raw
from geomoe3d.errors import EmptyCloudError


@pytest.mark.parametrize(
    "text",
    [
        "1 2 3\n4.5 -5e-1 6\n7 8 9",
        "\n  1\t2   3\r\n4.5 -.5 6\r\n\r\n7 8 9\r\n",
        "1,2,3\n4.5, -0.5, 6\n7,8,9\n",
        "1;2;3\n4,5;-0,5;6\n7;8;9\n",
        "1,2,3,\n4.5,-0.5,6,\n7,8,9,\n",
        "\ufeffx y z\n1 2 3\n4.5 -.5 6\n7 8 9\n",
        "# scanned on x and y days\n//X Y Z\n1 2 3\n# between\n4.5 -.5 6\n// and\n7 8 9\n",
        'id;"Z [m]";Y (m);x\n0;3;2;1\n1;6;-0.5;4.5\n2;9;8;7\n',
        "1 2 3 10\n4.5 -.5 6 20\n7 8 9 30\n",
        "1 2 3 10 99\n4.5 -.5 6 20 99\n7 8 9 30 99\n",
        "1,0 2,0 3,0\n4,5 -0,5 6\n7 8 9\n",
        "X\tY\tZ\n1,0\t2\t3\n4,5\t-,5\t6\n7\t8\t9\n",
        "1.D0 2D+00 .3d1\n 4.5D0 -5.0d-1 6.0D+00\n7 8 9\n",
        "Points_m_XYZ:0,Points_m_XYZ:1,Points_m_XYZ:2,intensity,laser_id\n1,2,3,7,1\n4.5,-.5,6,7,2\n7,8,9,7,3\n",
        '"Points:0","Points:1","Points:2","adjustedtime"\n1,2,3,1e9\n4.5,-.5,6,2e9\n7,8,9,3e9\n',
        "//X Y Z Intensity\n3\n1 2 3 7\n4.5 -.5 6 7\n7 8 9 7\n",
        "3\n1 2 3\n4.5 -.5 6\n7 8 9\n",
        "2\n1 2 3 -99\n4.5 -.5 6 0\n1\n7 8 9 5\n",
        "name;x;y;z;class\nP1;1;2;3;a\nP2;4,5;-0,5;6;b c\nP3;7;8;9;d\n",
        "Easting,Northing,Elevation\n1,2,3\n4.5,-.5,6\n7,8,9\n",
        "1 2 3 -nan(ind)\n4.5 -.5 6 1.#QNAN\n7 8 9 NA\n",
    ],
)
@pytest.mark.parametrize("suffix", [".xyz", ".txt", ".csv", ".asc", ".pts"])
def test_text_dialects(tmp_path: Path, text: str, suffix: str) -> None:
    (tmp_path / f"a{suffix}").write_text(text, encoding="utf-8", newline="")
    loaded = load_points(tmp_path / f"a{suffix}")
    assert np.array_equal(loaded.file_points, [[1, 2, 3], [4.5, -0.5, 6], [7, 8, 9]])
    assert loaded.normals is None and loaded.colors is None


def test_a_header_overrules_the_guess(tmp_path: Path) -> None:
    colors = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])  # of unit length too
    rows = "\n".join(f"1 2 {k} {r} {g} {b}" for k, (r, g, b) in enumerate(colors))
    (tmp_path / "a.txt").write_text("x y z R G B\n" + rows)
    loaded = load_points(tmp_path / "a.txt")
    assert loaded.normals is None
    assert np.array_equal(loaded.colors, colors)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 2 3\n4 5 6\nhello world again\n", ["line 3", "hello world again", "not all numbers"]),
        ("# note\n\n1 2 3\n4 x 6\n", ["line 4", "4 x 6"]),
        ("1 2 3\n4 5\n7 8 9\n", ["line 2", "2 columns, expected 3"]),
        ("1 2 3\n4 5 6 7\n", ["line 2", "4 columns, expected 3"]),
        ("1 2\n3 4\n", ["line 1", "2 columns", "at least 3"]),
        ("hello\n1 2 3\n", ["line 1", "hello", "x, y and z"]),
        ("lat lon h\n1 2 3\n", ["line 1", "lat lon h"]),
        ("x y z i\n1 2 3\n", ["line 2", "header names 4"]),
        ("ncols 3\nnrows 2\n", ["line 1", "ESRI grid"]),
        ("1,2,3\n4,,6\n", ["line 2", "4,,6"]),
        ("\x89PNG\r\n\x1a\n\0\0\0", ["line 1"]),
    ],
)
def test_garbage_in_text_names_the_line(tmp_path: Path, text: str, words: list[str]) -> None:
    (tmp_path / "a.xyz").write_text(text, encoding="latin-1")
    fails(tmp_path / "a.xyz", "a.xyz", *words)


@pytest.mark.parametrize("text", ["\n\n", "# only a remark\n", "x y z\n", "//X Y Z R G B\n"])
def test_text_without_points(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.txt").write_text(text)
    fails(tmp_path / "a.txt", "0 points", error=EmptyCloudError)


def test_pts_columns_are_those_of_leica(tmp_path: Path) -> None:
    (tmp_path / "a.pts").write_text("2\n1 2 3 -1204 255 0 51\n4 5 6 87 0 102 255\n")
    cloud = read_raw(tmp_path / "a.pts")
    assert np.array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    assert np.array_equal(cloud.fields["intensity"], [-1204, 87])
    np.testing.assert_allclose(cloud.colors, [[1, 0, 0.2], [0, 0.4, 1]])
    for suffix in (".pts", ".txt"):
        (tmp_path / f"b{suffix}").write_text("3\n1 2 3 -1204 255 0 51\n4 5 6 87 0 102 255\n")
        fails(tmp_path / f"b{suffix}", "says 3 points", "holds 2", "truncated")


def test_columns_of_words_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,y,z,class,time\n1,2,3,tree,0.5\n4,5,6,road,0.75\n")
    cloud = read_raw(tmp_path / "a.csv")
    assert cloud.unread == ("class",) and np.array_equal(cloud.fields["time"], [0.5, 0.75])


@pytest.mark.parametrize(
    "spelling", ["nan", "-nan(ind)", "nan(snan)", "1.#QNAN0", "-1.#IND", "NaN", "N/A", "null"]
)
def test_spellings_of_nan(tmp_path: Path, spelling: str) -> None:
    (tmp_path / "a.xyz").write_text(f"1 2 3\n4 {spelling} 6\n7 8 9\n")
    assert load_points(tmp_path / "a.xyz").num_non_finite == 1
    header = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {a}\n" for a in "xyz")
    (tmp_path / "a.ply").write_text(f"{header}end_header\n1 2 3\n4 {spelling} 6\n7 8 9\n")
    assert load_points(tmp_path / "a.ply").num_non_finite == 1
    (tmp_path / "b.xyz").write_text("1 2 3\n4 -1.#INF 6\n7 8 9\n")
    assert load_points(tmp_path / "b.xyz").num_non_finite == 1


def test_text_of_windows_in_two_bytes(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("x;y;z\n1,5;2;3\n", encoding="utf-16")
    assert np.array_equal(load_points(tmp_path / "a.txt").file_points, [[1.5, 2, 3]])


@pytest.mark.parametrize("suffix", [".xyz", ".csv", ".ply", ".npy"])
def test_gzip_of_any_format(tmp_path: Path, suffix: str) -> None:
    save_points(tmp_path / f"a{suffix}", small_cloud())
    packed = tmp_path / f"a{suffix}.gz"
    packed.write_bytes(gzip.compress((tmp_path / f"a{suffix}").read_bytes()))
    cloud = load_points(packed)
    assert np.array_equal(cloud.file_points, small_cloud()) and cloud.name == packed.name
    packed.write_bytes(gzip.compress(b"hello\n"))
    fails(packed, f"'{packed}'")
    packed.write_bytes(packed.read_bytes()[:-9])
    fails(packed, "no gzip file or damaged")
    packed.write_bytes(gzip.compress(b"1 2 3\n" * 4_000_000))
    fails(packed, "200 times")


def test_names_in_quotes_are_names(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        '"intensity","Points_m_XYZ:0","Points_m_XYZ:1","Points_m_XYZ:2"\n9,1,2,3\n8,4,5,6\n'
    )
    cloud = read_raw(tmp_path / "a.csv")
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    assert list(cloud.fields) == ["intensity"]
    (tmp_path / "a.csv").write_text('x,y,z,,""\n1,2,3,7,8\n4,5,6,7,8\n')
    assert list(read_raw(tmp_path / "a.csv").fields) == ["column_4", "column_5"]
    assert save_aligned(tmp_path / "a.ply", tmp_path / "a.csv", np.eye(4)) == ()


def test_no_name_of_a_column_is_a_formula(tmp_path: Path) -> None:
    cloud = RawCloud(np.eye(3), fields={"=1+1": np.ones(3), "a-b": np.ones(3)})
    with (tmp_path / "a.csv").open("wb") as handle:
        write_csv(handle, cloud)
    assert (tmp_path / "a.csv").read_text().splitlines()[0] == "X,Y,Z,_1+1,a-b"
