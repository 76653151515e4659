"""NPY and NPZ files: names of their arrays, other shapes and types, pickles that are not loaded."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cloud_files import cloud, fails, small_cloud

from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.loading import read_raw
from geomoe3d.errors import FormatError, InputError


@pytest.mark.parametrize("key", ["points", "xyz", "pcd", "pos", "XYZ", "arr_0", "whatever"])
def test_npz_keys(tmp_path: Path, key: str) -> None:
    np.savez_compressed(tmp_path / "a.npz", **{key: cloud()})
    assert np.array_equal(load_points(tmp_path / "a.npz").points, cloud())


class Trap:
    """Unpickling it leaves a mark."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return Path.touch, (self.mark,)


def test_pickles_are_not_loaded(tmp_path: Path) -> None:
    trap = np.array([Trap(tmp_path / "mark")] * 3, dtype=object)
    np.save(tmp_path / "a.npy", trap, allow_pickle=True)
    np.savez(tmp_path / "a.npz", points=trap)
    (tmp_path / "b.npy").write_bytes(pickle.dumps(trap))
    for name in ("a.npy", "a.npz", "b.npy"):
        fails(tmp_path / name, "pickled")
    assert not (tmp_path / "mark").exists()


@pytest.mark.parametrize(
    ("array", "said"),
    [
        (np.zeros(9), "holds 9 numbers, expected a row for each point with three columns, x y z"),
        (np.zeros((3, 2)), "holds 3 rows of 2 numbers, expected a row for each point"),
        (np.zeros((2, 3, 4)), "holds a block of 2 x 3 x 4 numbers"),
        (np.zeros((5, 3), complex), "holds complex numbers, expected floats or integers"),
        (np.array([["a", "b", "c"]]), "holds text, expected floats or integers"),
    ],
)
def test_numpy_files_of_other_shapes_and_types(tmp_path: Path, array: np.ndarray, said: str) -> None:
    np.save(tmp_path / "a.npy", array)
    np.savez(tmp_path / "a.npz", points=array)
    for name in ("a.npy", "a.npz"):
        assert said in fails(tmp_path / name)


def test_npz_without_points_lists_its_keys(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", intrinsics=np.eye(3), depth=np.zeros((4, 4)))
    fails(tmp_path / "a.npz", "keys found: intrinsics, depth", "points", "xyz")
    np.savez(tmp_path / "a.npz", points=small_cloud(5), normals=small_cloud(4))
    fails(
        tmp_path / "a.npz",
        "normals",
        "holds 4 rows of 3 numbers, expected a row of three numbers for each of 5 points",
    )
    np.savez(tmp_path / "a.npz", **{})
    fails(tmp_path / "a.npz", "keys found: none")


def test_truncated_and_misnamed_numpy_files(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", small_cloud())
    np.savez(tmp_path / "a.npz", points=small_cloud())
    for name in ("a.npy", "a.npz"):
        whole = (tmp_path / name).read_bytes()
        other = tmp_path / ("b.npz" if name.endswith("y") else "b.npy")
        other.write_bytes(whole)
        fails(other, "rename it to")
        for keep in (4, 100, len(whole) // 2, len(whole) - 1):
            (tmp_path / name).write_bytes(whole[:keep])
            fails(tmp_path / name, name)
    np.save(tmp_path / "a.npy", small_cloud())
    (tmp_path / "a.npy").write_bytes((tmp_path / "a.npy").read_bytes().replace(b"(100, 3)", b"(60,  3)"))
    fails(tmp_path / "a.npy", 128 + 2400, 128 + 60 * 24)


@pytest.mark.parametrize("shape", [(3, 100), (3, 4)])
def test_a_cloud_on_its_side_is_refused_as_in_memory(tmp_path: Path, shape: tuple[int, int]) -> None:
    np.save(tmp_path / "a.npy", np.ones(shape))
    np.savez(tmp_path / "a.npz", points=np.ones(shape))
    for data, error in (("a.npy", FormatError), ("a.npz", FormatError), (None, InputError)):
        given = np.ones(shape) if data is None else tmp_path / data
        said = (
            str(shape)
            if data is None
            else f"holds 3 rows of {shape[1]} numbers, expected a row for each point"
        )
        fails(given, said, "exchange rows and columns (in Python points.T)", error=error)


def test_organised_and_structured_arrays(tmp_path: Path) -> None:
    points = small_cloud(20)
    rows = np.zeros(20, [("intensity", "u2"), ("X", "f8"), ("Y", "f8"), ("Z", "f8"), ("tag", "S3")])
    rows["X"], rows["Y"], rows["Z"] = points.T
    rows["intensity"] = np.arange(20)
    triples = np.zeros((4, 5), [("xyz", "f8", 3), ("normal", "f4", 3), ("rgb", "u1", 3), ("t", "f8")])
    triples["xyz"], triples["normal"], triples["rgb"] = points.reshape(4, 5, 3), [0, 0, 1], [255, 0, 51]
    for name, array in (("grid", points.reshape(4, 5, 3)), ("rows", rows), ("triples", triples)):
        np.save(tmp_path / f"{name}.npy", array)
        for data in (tmp_path / f"{name}.npy", array):
            assert np.array_equal(read_raw(data).points, points)
    assert read_raw(tmp_path / "grid.npy").unread == ("grid of 5 x 4",)
    cloud = read_raw(rows)
    assert np.array_equal(cloud.fields["intensity"], np.arange(20)) and cloud.unread == ("tag",)
    cloud = load_points(triples)
    assert np.array_equal(cloud.normals, np.tile([0, 0, 1.0], (20, 1)))
    np.testing.assert_allclose(cloud.colors, np.tile([1, 0, 0.2], (20, 1)))
    fails(np.zeros(5, [("a", "f8")]), "fields a", error=InputError)


def test_columns_without_names_keep_their_type(tmp_path: Path) -> None:
    """x y z intensity ring time, as lidar users have it."""
    table = np.column_stack([small_cloud(50), np.arange(50) % 7, np.arange(50) % 3, np.linspace(0, 0.1, 50)])
    np.save(tmp_path / "a.npy", table.astype(np.float32))
    cloud = read_raw(tmp_path / "a.npy")
    assert cloud.colors is None and cloud.normals is None
    for k in (4, 5, 6):
        assert cloud.fields[f"column_{k}"].dtype == np.float32
        assert np.array_equal(cloud.fields[f"column_{k}"], table[:, k - 1].astype(np.float32))


def test_arrays_beside_the_points_are_fields(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", points=small_cloud(5), ring=np.arange(5), K=np.eye(3))
    cloud = read_raw(tmp_path / "a.npz")
    assert np.array_equal(cloud.fields["ring"], np.arange(5)) and cloud.unread == ("K",)
