"""Bad input and output: every one is an error of ours that says what is wrong, and nothing is lost."""

from __future__ import annotations

import os
import pickle
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from geomoe3d.clouds.io import (
    READABLE_SUFFIXES,
    WRITABLE_SUFFIXES,
    check_output,
    load_points,
    save_aligned,
    save_points,
)
from geomoe3d.errors import (
    DependencyError,
    EmptyCloudError,
    FormatError,
    GeoMoE3DError,
    InputError,
    NonFiniteError,
    OutputError,
)


def cloud(num: int = 100, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(num, 3)) * 10.0


def fails(path: object, *words: object, error: type[Exception] = FormatError) -> str:
    """Loading raises exactly this class, and the message holds every one of the words."""
    with pytest.raises(error) as caught:
        load_points(path)
    assert type(caught.value) is error
    for word in words:
        assert str(word) in str(caught.value)
    return str(caught.value)


# --- paths ---------------------------------------------------------------------------------------------


def test_missing_file_and_directory(tmp_path: Path) -> None:
    fails(tmp_path / "none.ply", "there is no file", "none.ply", error=InputError)
    fails(str(tmp_path), "is a directory", error=InputError)
    (tmp_path / "folder.ply").mkdir()
    fails(tmp_path / "folder.ply", "is a directory", error=InputError)


@pytest.mark.parametrize(("name", "nearest"), [("a.plly", ".ply"), ("a.lasz", ".laz"), ("a.npzz", ".npz")])
def test_unknown_suffix_names_the_nearest(tmp_path: Path, name: str, nearest: str) -> None:
    (tmp_path / name).write_text("1 2 3")
    fails(tmp_path / name, f"did you mean {nearest}?", *READABLE_SUFFIXES)


@pytest.mark.parametrize("name", ["noend", "a.mp4", "a.ply.gz"])
def test_other_suffixes_list_all(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("1 2 3")
    fails(tmp_path / name, *READABLE_SUFFIXES)


@pytest.mark.parametrize("suffix", READABLE_SUFFIXES)
def test_empty_files(tmp_path: Path, suffix: str) -> None:
    (tmp_path / f"a{suffix}").write_bytes(b"")
    fails(tmp_path / f"a{suffix}", "0 bytes", error=EmptyCloudError)


@pytest.mark.parametrize("suffix", [".ply", ".xyz", ".npy", ".npz", ".obj", ".pcd", ".las", ".e57"])
def test_unreadable_file(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also as root, whom no mode stops: opening is refused in place of the kernel."""
    import builtins
    import io

    pytest.importorskip({".obj": "trimesh", ".las": "laspy", ".e57": "pye57"}.get(suffix, "numpy"))
    path = tmp_path / f"a{suffix}"
    path.write_text("1 2 3")
    real = io.open

    def refuse(file: object, *args: object, **kwargs: object) -> object:
        if str(file) == str(path):
            raise PermissionError(13, "Permission denied", str(path))
        return real(file, *args, **kwargs)  # type: ignore[call-overload]

    monkeypatch.setattr(io, "open", refuse)
    monkeypatch.setattr(builtins, "open", refuse)
    monkeypatch.setattr(Path, "open", refuse)  # Python 3.10 bound io.open when pathlib was imported
    fails(path, "permission denied", error=InputError)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_unreadable_mode(tmp_path: Path) -> None:
    save_points(tmp_path / "a.ply", cloud())
    (tmp_path / "a.ply").chmod(0)
    fails(tmp_path / "a.ply", "permission denied", error=InputError)


# --- truncated files and lying headers -----------------------------------------------------------------


def ply(count: int, rows: int, fmt: str = "ascii") -> bytes:
    header = f"ply\nformat {fmt} 1.0\nelement vertex {count}\n"
    header += "property double x\nproperty double y\nproperty double z\nend_header\n"
    points = cloud(rows)
    if fmt == "ascii":
        return header.encode() + "".join(f"{x} {y} {z}\n" for x, y, z in points).encode()
    return header.encode() + points.astype("<f8" if "little" in fmt else ">f8").tobytes()


@pytest.mark.parametrize("fmt", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize(("said", "held"), [(150, 100), (60, 100), (10**11, 100), (1, 0)])
def test_ply_count_that_is_not_there(tmp_path: Path, fmt: str, said: int, held: int) -> None:
    (tmp_path / "a.ply").write_bytes(ply(said, held, fmt))
    fails(tmp_path / "a.ply", f"says {said} ", f"holds {held};")


@pytest.mark.parametrize("fmt", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("cut", [1, 20, 700])
def test_truncated_ply(tmp_path: Path, fmt: str, cut: int) -> None:
    whole = ply(100, 100, fmt)
    if fmt == "ascii" and cut == 1:
        pytest.skip("only the last newline is gone")
    (tmp_path / "a.ply").write_bytes(whole[:-cut])
    message = fails(tmp_path / "a.ply", "says 100 ", "truncated")
    held = int(message.split("holds ")[1].split(";")[0])
    body = whole[:-cut].split(b"end_header\n", 1)[1]
    if fmt == "ascii":
        assert held - body.count(b"\n") in (0, 1), "a last line cut in its last number still counts"
    else:
        assert held == len(body) // 24


@pytest.mark.parametrize("cut", [1, 3, 30])
def test_ply_truncated_in_its_faces(tmp_path: Path, cut: int) -> None:
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.icosphere(1).export(tmp_path / "a.ply")
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-cut])
    fails(tmp_path / "a.ply", "says 80 rows of 'face'", f"holds {80 - -(-cut // 13)};")


def test_ply_with_a_rest_behind_its_end(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(ply(100, 100, "binary_little_endian") + b"\n")
    assert len(load_points(tmp_path / "a.ply")) == 100, "a newline does no harm"
    (tmp_path / "a.ply").write_bytes(ply(100, 100, "binary_little_endian") + b"12345")
    fails(tmp_path / "a.ply", "header describes")


def test_ply_face_of_a_missing_vertex(tmp_path: Path) -> None:
    text = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    text += (
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 {}\n"
    )
    for index in (3, -1):
        (tmp_path / "a.ply").write_text(text.format(index))
        fails(tmp_path / "a.ply", f"vertex {index}", "3 vertices")
    (tmp_path / "a.ply").write_text(text.format(2))
    assert len(load_points(tmp_path / "a.ply", mesh_points=9)) == 9


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("ply\n", "plx\n", "first line"),
        ("ascii", "utf8", "format utf8"),
        ("element vertex 3", "element point 3", "no element 'vertex', only: point"),
        ("element vertex 3", "element vertex -3", "'-3'"),
        ("element vertex 3", "element vertex many", "'many'"),
        ("property double x", "property double a", "only: a, y, z"),
        ("property double x", "property quad x", "property quad x"),
        ("property double x", "property list uchar double x", "list properties"),
        ("end_header", "", "header line"),
    ],
)
def test_malformed_ply_headers(tmp_path: Path, old: str, new: str, word: str) -> None:
    (tmp_path / "a.ply").write_bytes(ply(3, 3).replace(old.encode(), new.encode(), 1))
    fails(tmp_path / "a.ply", word)


def test_ply_header_without_end_or_points(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(ply(3, 3).split(b"end_header")[0])
    fails(tmp_path / "a.ply", "does not end")
    for fmt in ("ascii", "binary_little_endian"):
        (tmp_path / "a.ply").write_bytes(ply(0, 0, fmt))
        fails(tmp_path / "a.ply", "0 points", error=EmptyCloudError)


def test_ply_garbage_names_the_line(tmp_path: Path) -> None:
    lines = ply(5, 5).decode().splitlines()
    lines[8] = "1 two 3"
    (tmp_path / "a.ply").write_text("\n".join(lines))
    fails(tmp_path / "a.ply", "line 9", "1 two 3")


def pcd(count: int, rows: int, data: str) -> bytes:
    header = "VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\n"
    header += f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA {data}\n"
    points = cloud(rows)
    if data == "ascii":
        return header.encode() + "".join(f"{x} {y} {z}\n" for x, y, z in points).encode()
    body = points.tobytes()
    if data == "binary_compressed":  # literal runs of 32 bytes
        plain = points.T.tobytes()
        body = b"".join(
            bytes([len(plain[k : k + 32]) - 1]) + plain[k : k + 32] for k in range(0, len(plain), 32)
        )
        body = struct.pack("<II", len(body), len(plain)) + body
    return header.encode() + body


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize(("said", "held"), [(150, 100), (60, 100)])
def test_pcd_count_that_is_not_there(tmp_path: Path, data: str, said: int, held: int) -> None:
    (tmp_path / "a.pcd").write_bytes(pcd(held, held, data))
    assert np.array_equal(load_points(tmp_path / "a.pcd").points, cloud(held)) or data == "ascii"
    (tmp_path / "a.pcd").write_bytes(pcd(said, held, data))
    fails(tmp_path / "a.pcd", f"says {said} points", f"holds {held};")


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_truncated_pcd(tmp_path: Path, data: str) -> None:
    (tmp_path / "a.pcd").write_bytes(pcd(100, 100, data)[:-700])
    message = fails(tmp_path / "a.pcd", "holds")
    assert data == "binary_compressed" or "says 100 points" in message


def test_damaged_pcd_is_quiet(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    whole = bytearray(pcd(100, 100, "binary_compressed"))
    whole[-2000:] = b"\xff" * 2000
    (tmp_path / "a.pcd").write_bytes(whole)
    fails(tmp_path / "a.pcd", "0 of 100 points")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("FIELDS x y z", "FIELDS a y z", "only: a y z"),
        ("FIELDS x y z", "", "lacks FIELDS"),
        ("SIZE 8 8 8", "SIZE 8 8", "must agree"),
        ("SIZE 8 8 8", "SIZE 8 8 3", "F3"),
        ("DATA ascii", "DATA zip", "'zip'"),
        ("WIDTH 5", "WIDTH 4", "WIDTH x HEIGHT is 4"),
        ("COUNT 1 1 1", "COUNT 1 1 2", "COUNT 1"),
        ("POINTS 5", "POINTS x", "'x'"),
    ],
)
def test_malformed_pcd_headers(tmp_path: Path, old: str, new: str, word: str) -> None:
    (tmp_path / "a.pcd").write_bytes(pcd(5, 5, "ascii").replace(old.encode(), new.encode(), 1))
    fails(tmp_path / "a.pcd", word)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_truncated_and_lying_las(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("laspy")
    path = tmp_path / f"a{suffix}"
    save_points(path, cloud())
    whole = path.read_bytes()
    for cut in (1, 300, len(whole) - 250, len(whole) - 20):
        path.write_bytes(whole[:-cut])
        fails(path, path.name)
    path.write_bytes(whole[:-300])
    fails(path, "says 100 points", "holds")
    for said in (150_000, 60) if suffix == ".las" else (150_000,):
        path.write_bytes(whole[:107] + struct.pack("<I", said) + whole[111:])
        fails(path, f"says {said} points", "holds 100;" if suffix == ".las" else "holds 1 chunks")
    path.write_bytes(b"hello world" * 100)
    fails(path, "no LAS file")


def test_truncated_e57(tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    path = tmp_path / "a.e57"
    with pye57.E57(str(path), mode="w") as file:
        data = {f"cartesian{axis}": cloud()[:, k].copy() for k, axis in enumerate("XYZ")}
        file.write_scan_raw(data, rotation=np.array([1.0, 0, 0, 0]), translation=np.zeros(3))
    whole = path.read_bytes()
    path.write_bytes(whole[:-1000])
    fails(path, len(whole), len(whole) - 1000)
    damaged = bytearray(whole)
    damaged[1500] ^= 255
    path.write_bytes(damaged)
    fails(path, "damaged")
    path.write_bytes(b"hello world" * 100)
    fails(path, "no E57 file")
    assert path.exists()


@pytest.mark.parametrize("suffix", [".stl", ".off", ".glb"])
def test_truncated_meshes(tmp_path: Path, suffix: str) -> None:
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / f"a{suffix}"
    trimesh.creation.icosphere(1).export(path)
    whole = path.read_bytes()
    for share in (0.02, 0.5, 0.97):
        path.write_bytes(whole[: int(len(whole) * share)])
        fails(path, path.name)
    path.write_bytes(whole[: len(whole) // 2])
    said = {".stl": 80, ".off": 42 + 80, ".glb": len(whole)}[suffix]
    fails(path, said, "truncated")


def test_truncated_ascii_stl_and_obj_faces(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box().export(tmp_path / "a.stl", file_type="stl_ascii")
    (tmp_path / "a.stl").write_text((tmp_path / "a.stl").read_text()[:-60])
    fails(tmp_path / "a.stl", "endsolid")
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nf 1 2 3\n")
    fails(tmp_path / "a.obj", "a.obj")


def test_mesh_without_area(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    fails(tmp_path / "a.obj", "area 0", error=InputError)


# --- text ----------------------------------------------------------------------------------------------


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


# --- numpy files ---------------------------------------------------------------------------------------


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
    np.savez(tmp_path / "a.npz", points=cloud(5), normals=cloud(4))
    fails(tmp_path / "a.npz", "normals", "(4, 3)", "(5, 3)")
    np.savez(tmp_path / "a.npz", **{})
    fails(tmp_path / "a.npz", "keys found: none")


def test_truncated_and_misnamed_numpy_files(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", cloud())
    np.savez(tmp_path / "a.npz", points=cloud())
    for name in ("a.npy", "a.npz"):
        whole = (tmp_path / name).read_bytes()
        other = tmp_path / ("b.npz" if name.endswith("y") else "b.npy")
        other.write_bytes(whole)
        fails(other, "rename it to")
        for keep in (4, 100, len(whole) // 2, len(whole) - 1):
            (tmp_path / name).write_bytes(whole[:keep])
            fails(tmp_path / name, name)
    np.save(tmp_path / "a.npy", cloud())
    (tmp_path / "a.npy").write_bytes((tmp_path / "a.npy").read_bytes().replace(b"(100, 3)", b"(60,  3)"))
    fails(tmp_path / "a.npy", 128 + 2400, 128 + 60 * 24)


# --- values --------------------------------------------------------------------------------------------


def write_each(folder: Path, points: np.ndarray) -> list[object]:
    np.save(folder / "a.npy", points)
    np.savetxt(folder / "a.xyz", points)
    (folder / "a.ply").write_bytes(ply(len(points), 0, "binary_little_endian") + points.tobytes())
    (folder / "a.pcd").write_bytes(pcd(len(points), 0, "binary") + points.tobytes())
    return [points, points.tolist(), *(folder / f"a{suffix}" for suffix in (".npy", ".xyz", ".ply", ".pcd"))]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("row", [0, 57, 99])
def test_non_finite_rows_are_counted(tmp_path: Path, bad: float, row: int) -> None:
    points = cloud()
    points[row, row % 3] = bad
    for data in write_each(tmp_path, points):
        loaded = load_points(data)
        assert loaded.num_non_finite == 1
        np.testing.assert_allclose(loaded.file_points, np.delete(points, row, axis=0), rtol=1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_all_non_finite(tmp_path: Path, bad: float) -> None:
    for data in write_each(tmp_path, np.full((7, 3), bad)):
        fails(data, "all 7 points", error=NonFiniteError)


def test_coordinates_beyond_double_precision(tmp_path: Path) -> None:
    points = cloud()
    points[41, 2] = -1e13
    for data in write_each(tmp_path, points):
        fails(data, "point 41", "1e+12", error=InputError)
    for data in write_each(tmp_path, cloud() + 1e9):
        assert np.abs(load_points(data).points).max() < 100


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (np.zeros((5, 6)), ["(5, 6)", "points[:, :3]", ".npz"]),
        (np.zeros((3, 50)), ["(3, 50)", "points.T"]),
        (np.zeros(3), ["(3,)", "points[None]"]),
        (np.zeros(12), ["(12,)"]),
        (np.zeros((5, 2)), ["(5, 2)"]),
        (np.zeros((5, 3, 1)), ["(5, 3, 1)"]),
        (np.zeros((5, 3), complex), ["complex128"]),
        (np.zeros((5, 3), bool), ["bool"]),
        (np.array([[1, 2, None]], dtype=object), ["object"]),
        ([["a", "b", "c"]], ["<U1"]),
        ([[1, 2, 3], [4, 5]], ["(N, 3)"]),
        ({"points": 1}, ["dict", "pass a path"]),
        (None, ["NoneType"]),
        (7, ["int"]),
    ],
)
def test_other_things_in_memory(data: object, words: list[str]) -> None:
    fails(data, *words, error=InputError)


def test_empty_and_odd_objects() -> None:
    for data in ([], np.zeros((0, 3)), np.zeros((0, 3), int)):
        fails(data, "empty", error=EmptyCloudError)
    o3d, torch, trimesh = (pytest.importorskip(name) for name in ("open3d", "torch", "trimesh"))
    for data in (
        o3d.geometry.PointCloud(),
        o3d.t.geometry.PointCloud(),
        o3d.geometry.TriangleMesh(),
        o3d.t.geometry.TriangleMesh(),
        torch.zeros(0, 3),
        trimesh.Scene(),
        trimesh.Trimesh(),
    ):
        fails(data, error=EmptyCloudError)
    for data in (
        o3d.geometry.LineSet(),
        torch.zeros(4, 3, dtype=torch.complex64),
        torch.zeros(4, 2),
        torch.float32,
    ):
        fails(data, error=InputError)
    with pytest.raises(InputError, match="mesh_points is 0"):
        load_points(trimesh.creation.box(), mesh_points=0)


# --- damaged files of every kind -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """One small valid file of every readable format."""
    folder = tmp_path_factory.mktemp("samples")
    trimesh = pytest.importorskip("trimesh")
    normals = cloud(30, 1) / np.linalg.norm(cloud(30, 1), axis=1, keepdims=True)
    for suffix in WRITABLE_SUFFIXES:
        extras = {} if suffix == ".npy" else {"normals": normals, "colors": np.full((30, 3), 0.5)}
        save_points(folder / f"a{suffix}", cloud(30), **extras)
    for suffix in (".obj", ".stl", ".off", ".glb"):
        trimesh.creation.box().export(folder / f"a{suffix}")
    trimesh.creation.box().export(folder / "mesh.ply")
    (folder / "lzf.pcd").write_bytes(pcd(30, 30, "binary_compressed"))
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damage_never_escapes_as_another_error(
    tmp_path: Path, samples: dict[str, bytes], data: st.DataObject
) -> None:
    name = data.draw(st.sampled_from(sorted(samples)))
    damaged = bytearray(samples[name])
    if data.draw(st.booleans()):
        damaged = damaged[: data.draw(st.integers(1, len(damaged) - 1))]
    reach = data.draw(st.sampled_from([min(300, len(damaged)), len(damaged)]))
    for place in data.draw(st.lists(st.integers(0, reach - 1), max_size=4)):
        damaged[place] = data.draw(st.integers(0, 255))
    path = tmp_path / name
    path.write_bytes(damaged)
    try:
        loaded = load_points(path, mesh_points=20)
    except GeoMoE3DError as error:
        assert name in str(error)
    else:
        assert len(loaded) and np.isfinite(loaded.points).all()


# --- missing extras ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("module", "suffix"), [("laspy", ".las"), ("laspy", ".laz"), ("pye57", ".e57")])
def test_missing_extras_name_the_command(
    tmp_path: Path, module: str, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / f"a{suffix}").write_bytes(b"x")
    extra = "e57" if suffix == ".e57" else "las"
    fails(tmp_path / f"a{suffix}", f"pip install 'geomoe3d[{extra}]'", error=DependencyError)
    if extra == "las":
        with pytest.raises(DependencyError, match="geomoe3d\\[las\\]"):
            save_points(tmp_path / f"new{suffix}", cloud())
        assert not (tmp_path / f"new{suffix}").exists()


# --- output --------------------------------------------------------------------------------------------


def test_an_existing_file_is_kept_without_force(tmp_path: Path) -> None:
    path = tmp_path / "a.xyz"
    path.write_text("precious")
    for save in (
        lambda: save_points(path, cloud()),
        lambda: save_aligned(path, cloud(), np.eye(4)),
        lambda: check_output(path, False, WRITABLE_SUFFIXES),
    ):
        with pytest.raises(OutputError, match=r"--force \(force=True"):
            save()
        assert path.read_text() == "precious"
    save_points(path, cloud(), force=True)
    assert np.array_equal(load_points(path).points, cloud())


@pytest.mark.parametrize("suffix", WRITABLE_SUFFIXES)
def test_a_failed_write_leaves_the_old_file_and_no_rest(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from geomoe3d.clouds import saving

    path = tmp_path / f"a{suffix}"
    path.write_text("precious")
    real = saving._CLOUD_WRITERS[suffix]

    def full_disk(handle, cloud) -> None:
        real(handle, cloud)
        raise OSError(28, "No space left on device")

    monkeypatch.setitem(saving._CLOUD_WRITERS, suffix, full_disk)
    with pytest.raises(OutputError, match="No space left"):
        save_points(path, cloud(), force=True)
    assert path.read_text() == "precious"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_appears_meanwhile_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from geomoe3d.clouds import saving

    path = tmp_path / "a.npy"
    monkeypatch.setitem(saving._CLOUD_WRITERS, ".npy", lambda handle, cloud: path.write_text("precious"))
    with pytest.raises(OutputError, match="exists"):
        save_points(path, cloud())
    assert path.read_text() == "precious"
    assert list(tmp_path.iterdir()) == [path]


def test_links_are_followed_and_modes_are_ordinary(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    save_points(tmp_path / "folder" / "real.npy", cloud())
    plain = tmp_path / "plain"
    plain.touch()
    assert (tmp_path / "folder" / "real.npy").stat().st_mode == plain.stat().st_mode
    (tmp_path / "link.npy").symlink_to(tmp_path / "folder" / "real.npy")
    save_points(tmp_path / "link.npy", cloud() * 2, force=True)
    assert (tmp_path / "link.npy").is_symlink()
    assert np.array_equal(np.load(tmp_path / "folder" / "real.npy"), cloud() * 2)


def test_output_places_that_do_not_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert check_output(str(tmp_path / "a.PLY"), False, WRITABLE_SUFFIXES) == tmp_path / "a.PLY"
    (tmp_path / "folder.ply").mkdir()
    for path, error, word in (
        (tmp_path / "none" / "a.ply", OutputError, "no folder"),
        (tmp_path / "folder.ply", OutputError, "is a directory"),
        (tmp_path / "a.plyy", FormatError, "did you mean .ply?"),
        (tmp_path / "a.e57", FormatError, ", ".join(WRITABLE_SUFFIXES)),
        (tmp_path / "a", FormatError, "no suffix"),
    ):
        for call in (
            lambda p: check_output(p, True, WRITABLE_SUFFIXES),
            lambda p: save_points(p, cloud()),
            lambda p: save_aligned(p, cloud(), np.eye(4)),
        ):
            with pytest.raises(error, match=word.replace("?", r"\?").replace(".", r"\.")[:60]):
                call(path)
    with pytest.raises(OutputError, match="too long"):
        check_output(tmp_path / ("a" * 300 + ".ply"), True, WRITABLE_SUFFIXES)
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)
    with pytest.raises(OutputError, match="may not be written"):
        check_output(tmp_path / "a.ply", True, WRITABLE_SUFFIXES)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_unwritable_and_unsearchable_folders(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for mode in (0o500, 0):
        (tmp_path / "folder").chmod(mode)
        with pytest.raises(OutputError, match=r"may not be written|[Pp]ermission denied"):
            save_points(tmp_path / "folder" / "a.ply", cloud())
    (tmp_path / "folder").chmod(0o700)


@pytest.mark.parametrize(
    ("points", "extras", "error", "word"),
    [
        (np.zeros((0, 3)), {}, EmptyCloudError, "empty"),
        (np.full((3, 3), np.nan), {}, NonFiniteError, "3 of 3 points"),
        (np.zeros((3, 2)), {}, InputError, r"\(3, 2\)"),
        (np.zeros((3, 3)), {"normals": np.zeros((2, 3))}, InputError, "3 points but 2 normals"),
        (np.zeros((3, 3)), {"colors": np.full((3, 3), 200.0)}, InputError, "divide"),
        (np.zeros((3, 3)), {"colors": np.full((3, 3), np.inf)}, NonFiniteError, "colours"),
    ],
)
def test_points_that_cannot_be_saved(
    tmp_path: Path, points: np.ndarray, extras: dict[str, np.ndarray], error: type[Exception], word: str
) -> None:
    with pytest.raises(error, match=word):
        save_points(tmp_path / "a.ply", points, **extras)
    assert not list(tmp_path.iterdir())


def test_npy_refuses_what_it_cannot_name(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"\.npz"):
        save_points(tmp_path / "a.npy", cloud(), normals=cloud())


@pytest.mark.parametrize(
    "T",
    [
        np.eye(3),
        np.diag([2.0, 2, 2, 1]),
        np.diag([1.0, 1, -1, 1]),
        np.full((4, 4), np.nan),
        np.eye(4) * 2,
        "identity",
    ],
)
def test_save_aligned_wants_a_rigid_motion(tmp_path: Path, T: object) -> None:
    with pytest.raises(InputError, match="T_target_source"):
        save_aligned(tmp_path / "a.ply", cloud(), T)
    assert not list(tmp_path.iterdir())


def test_save_aligned_refuses_a_mesh_of_a_cloud(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="holds meshes") as caught:
        save_aligned(tmp_path / "a.obj", cloud(), np.eye(4))
    assert all(suffix in str(caught.value) for suffix in WRITABLE_SUFFIXES)
    with pytest.raises(NonFiniteError):
        save_aligned(tmp_path / "a.ply", np.full((3, 3), np.nan), np.eye(4))
    with pytest.raises(InputError, match="no file"):
        save_aligned(tmp_path / "a.ply", tmp_path / "none.ply", np.eye(4))
    assert not list(tmp_path.iterdir())
