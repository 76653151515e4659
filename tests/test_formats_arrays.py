"""NPY and NPZ files: names of their arrays, other shapes and types, pickles that are not loaded."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cloud_files import cloud, fails, small_cloud

from geomoe3d.clouds.io import load_points


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
    "array",
    [
        np.zeros(9),
        np.zeros((3, 2)),
        np.zeros((2, 3, 3)),
        np.zeros((5, 3), complex),
        np.array([["a", "b", "c"]]),
    ],
)
def test_numpy_files_of_other_shapes_and_types(tmp_path: Path, array: np.ndarray) -> None:
    np.save(tmp_path / "a.npy", array)
    np.savez(tmp_path / "a.npz", points=array)
    for name in ("a.npy", "a.npz"):
        message = fails(tmp_path / name)
        assert str(array.shape) in message or str(array.dtype) in message


def test_npz_without_points_lists_its_keys(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", intrinsics=np.eye(3), depth=np.zeros((4, 4)))
    fails(tmp_path / "a.npz", "keys found: intrinsics, depth", "points", "xyz")
    np.savez(tmp_path / "a.npz", points=small_cloud(5), normals=small_cloud(4))
    fails(tmp_path / "a.npz", "normals", "(4, 3)", "(5, 3)")
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
