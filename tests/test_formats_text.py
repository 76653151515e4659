"""Text files of points: dialects, headers, and garbage with its line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cloud_files import fails

from geomoe3d.clouds.io import load_points
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
    ],
)
@pytest.mark.parametrize("suffix", [".xyz", ".txt", ".csv"])
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
        ("1,5 2,5 3,5\n", ["line 1"]),
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
