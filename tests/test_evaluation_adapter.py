"""A user's function as a method: what it is given, what it may return, and where it is found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from method_pairs import correspondences, lands, pair_of

from geomoe3d.errors import GeoMoE3DError, InputError
from geomoe3d.evaluation.methods import make_method
from geomoe3d.evaluation.records import MethodInput

HORN = """
import numpy as np

def register(source, target):
    a, b = source - source.mean(0), target - target.mean(0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = Vt.T @ np.diag([1, 1, np.linalg.det(Vt.T @ U.T)]) @ U.T
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, target.mean(0) - R @ source.mean(0)
    source += 1e6   # a careless function must not spoil what the next method is given
    return T

MOTION = 7
"""


def write(folder: Path, text: str, name: str = "mine.py") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_function_of_a_file_lands_and_cannot_spoil_its_input(tmp_path):
    method = make_method(f"{write(tmp_path, HORN)}:register")
    rows = correspondences(1.0)
    kept = rows.copy()
    assert lands(method(pair_of(rows)).T_target_source)
    assert np.array_equal(rows, kept)
    assert method.absent() is None
    assert method.inputs == {"clouds", "correspondences"}


def test_example_of_the_documentation_runs(tmp_path):
    from geomoe3d.evaluation import adapter

    lines = adapter.__doc__.split("::\n", 1)[1].split("\nOn the", 1)[0]
    path = write(tmp_path, "\n".join(line[4:] for line in lines.splitlines()))
    assert lands(make_method(f"{path}:register")(pair_of(correspondences(1.0))).T_target_source)


def test_function_on_clouds_gets_two_sizes(tmp_path):
    path = write(tmp_path, "def sizes(a, b):\n    raise ValueError(f'{a.shape} {b.shape}')\n")
    given = MethodInput("x/0-1", source=np.zeros((5, 3)), target=np.ones((7, 3)))
    with pytest.raises(GeoMoE3DError, match=r"x/0-1.*ValueError: \(5, 3\) \(7, 3\) \(mine.py, line 2\)"):
        make_method(f"{path}:sizes")(given)


def test_function_gets_the_keywords_it_names(tmp_path):
    text = (
        "def f(a, b, *, seed, inlier_threshold, other=1):\n"
        "    raise RuntimeError(f'{seed} {inlier_threshold} {other}')\n"
    )
    with pytest.raises(InputError, match=r"RuntimeError: 9 0\.1 1"):
        make_method(f"{write(tmp_path, text)}:f")(pair_of(correspondences(), seed=9))


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("return np.eye(3)", r"ndarray of shape \(3, 3\)"),
        ("return 'right'", "returned str"),
        ("return (np.eye(3), np.zeros(3))", "returned tuple"),
        ("return 2 * np.eye(4)", "no rigid transform|last row"),
        ("return np.diag([1.1, 1.1, 1.1, 1])", "no rigid transform"),
        ("return np.diag([1, 1, -1, 1])", "mirrors"),
        ("return np.diag([1, 1, 1, 2])", "last row"),
        ("return 1 / 0", "ZeroDivisionError"),
        ("import sys; sys.exit(3)", "SystemExit"),
    ],
)
def test_nonsense_is_an_error_of_its_pair(tmp_path, body, message):
    path = write(tmp_path, f"import numpy as np\ndef f(a, b):\n    {body}\n")
    with pytest.raises(GeoMoE3DError, match=message) as caught:
        make_method(f"{path}:f")(pair_of(correspondences()))
    assert "room/0-1" in str(caught.value)


@pytest.mark.parametrize("value", ["None", "np.full((4, 4), np.nan)", "np.full((4, 4), np.inf)"])
def test_functions_may_give_up(tmp_path, value):
    path = write(tmp_path, f"import numpy as np\ndef f(a, b):\n    return {value}\n")
    assert make_method(f"{path}:f")(pair_of(correspondences())).T_target_source is None


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("registr", "did you mean 'register'"),
        ("MOTION", "not a function"),
        ("", "names no function"),
    ],
)
def test_functions_that_are_not_there(tmp_path, function, message):
    with pytest.raises(InputError, match=message):
        make_method(f"{write(tmp_path, HORN)}:{function}")


def test_files_and_modules_that_are_not_there(tmp_path):
    with pytest.raises(InputError, match="no file"):
        make_method(f"{tmp_path}/none.py:f")
    with pytest.raises(InputError, match="no_such_package"):
        make_method("no_such_package.module:f")
    broken = write(tmp_path, "import a_library_that_is_not_there\n", "broken.py")
    with pytest.raises(InputError, match="a_library_that_is_not_there"):
        make_method(f"{broken}:f")
    assert lands(
        make_method(f"{write(tmp_path, HORN)}:register")(pair_of(correspondences(1.0))).T_target_source
    )


def test_function_of_a_package(tmp_path, monkeypatch):
    write(tmp_path, HORN, "some_package_of_mine.py")
    monkeypatch.syspath_prepend(tmp_path)
    method = make_method("some_package_of_mine:register")
    assert lands(method(pair_of(correspondences(1.0))).T_target_source)
    assert len(method.identity()["source_sha256"]) == 64


def test_a_file_finds_its_neighbours(tmp_path):
    write(tmp_path, "VALUE = None\n", "neighbour_of_a_method.py")
    text = "def f(a, b):\n    import neighbour_of_a_method\n    return neighbour_of_a_method.VALUE\n"
    assert make_method(f"{write(tmp_path, text)}:f")(pair_of(correspondences())).T_target_source is None


def test_identity_of_a_function_follows_its_file(tmp_path):
    spec = f"{write(tmp_path, HORN)}:register"
    first = make_method(spec).identity()
    assert make_method(spec).identity() == first
    write(tmp_path, HORN + "\n")
    assert make_method(spec).identity() != first
