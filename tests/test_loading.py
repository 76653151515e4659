"""Loading clouds: names, rows that are not finite, and whatever cannot be loaded said clearly."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from cloud_files import MANY, cloud, fails, pcd, ply, small_cloud, unit_vectors
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from geomoe3d.clouds.io import READABLE_SUFFIXES, WRITABLE_SUFFIXES, check_aligned, load_points, save_points
from geomoe3d.errors import (
    DependencyError,
    EmptyCloudError,
    ForbiddenFileError,
    GeoMoE3DError,
    InputError,
    MissingFileError,
    NonFiniteError,
)
from geomoe3d.types import PointCloud

# --- loaded clouds -------------------------------------------------------------------------------------


def test_a_loaded_cloud_is_returned_as_it_is() -> None:
    given_cloud = load_points(cloud(), name="a")
    assert load_points(given_cloud) is given_cloud
    renamed = load_points(given_cloud, name="b")
    assert renamed.name == "b" and renamed.points is given_cloud.points


def test_a_cloud_made_by_hand_is_brought_into_form() -> None:
    points = cloud(50)
    points[3, 1] = np.nan
    normals = unit_vectors(50)
    made = load_points(PointCloud(points.astype(np.float32)[::-1], normals=normals, origin=np.ones(3)))
    assert made.points.dtype == np.float64 and made.points.flags.c_contiguous
    assert len(made.points) == len(made.normals) == 49
    assert made.num_non_finite == 1
    np.testing.assert_array_equal(made.origin, np.ones(3))
    np.testing.assert_array_equal(made.points, np.delete(points.astype(np.float32)[::-1], 46, axis=0))
    with pytest.raises(NonFiniteError, match="'cloud': all 4 points"):
        load_points(PointCloud(np.full((4, 3), np.nan)))
    with pytest.raises(InputError, match="normals have shape"):
        load_points(PointCloud(cloud(50), normals=normals[:7]))
    with pytest.raises(InputError, match="shape"):
        load_points(PointCloud(cloud(50)[:, :2]))


def test_names(tmp_path: Path) -> None:
    save_points(tmp_path / "scan.PLY", cloud())
    assert load_points(tmp_path / "scan.PLY").name == "scan.PLY"
    assert load_points(str(tmp_path / "scan.PLY"), name="left").name == "left"
    assert load_points(cloud()).name == "cloud"


@MANY
@given(rows=st.sets(st.integers(0, 49), max_size=49), bad=st.sampled_from([np.nan, np.inf, -np.inf]))
def test_non_finite_rows_are_dropped_with_their_attributes(
    tmp_path: Path, rows: set[int], bad: float
) -> None:
    points, normals = cloud(50), unit_vectors(50)
    broken = points.copy()
    broken[list(rows), [row % 3 for row in rows]] = bad
    np.savez(tmp_path / "a.npz", points=broken, normals=normals, colors=np.linspace(0, 1, 150).reshape(50, 3))
    kept = np.setdiff1d(np.arange(50), list(rows))
    loaded = load_points(tmp_path / "a.npz")
    assert loaded.num_non_finite == len(rows)
    np.testing.assert_allclose(loaded.file_points, points[kept], atol=1e-12)
    np.testing.assert_allclose(loaded.normals, normals[kept], atol=1e-15)
    np.testing.assert_allclose(loaded.colors, np.linspace(0, 1, 150).reshape(50, 3)[kept])


@pytest.mark.parametrize("bad", [0.0, np.nan, np.inf])
def test_one_bad_normal_drops_all_normals(tmp_path: Path, bad: float) -> None:
    normals = unit_vectors(50)
    normals[7] = bad
    np.savez(tmp_path / "a.npz", points=cloud(50), normals=normals)
    assert load_points(tmp_path / "a.npz").normals is None


# --- paths ---------------------------------------------------------------------------------------------


def test_missing_file_and_directory(tmp_path: Path) -> None:
    fails(tmp_path / "none.ply", "there is no file", "none.ply", error=MissingFileError)
    fails(str(tmp_path), "is a folder; give one file", error=InputError)
    fails("", "an empty name is given for a cloud", error=InputError)
    (tmp_path / "folder.ply").mkdir()
    fails(tmp_path / "folder.ply", "is a folder; give one file", error=InputError)


@pytest.mark.parametrize(("name", "nearest"), [("a.plly", ".ply"), ("a.lza", ".laz"), ("a.npzz", ".npz")])
def test_unknown_suffix_names_the_nearest(tmp_path: Path, name: str, nearest: str) -> None:
    (tmp_path / name).write_text("1 2 3")
    fails(tmp_path / name, f"did you mean {nearest}?", *READABLE_SUFFIXES)


@pytest.mark.parametrize("name", ["noend", "a.mp4", "a.plx.gz"])
def test_other_suffixes_list_all(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("1 2 3")
    fails(tmp_path / name, *READABLE_SUFFIXES)


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("a.zip", "unpack"),
        ("a.rcp", "E57"),
        ("a.pcap", "recording"),
        ("a.fbx", "OBJ"),
        ("a.pkl", "pickled"),
        ("a.dat", "rename it to .txt"),
        ("a.xyzrgb", "rename it to .txt"),
        ("a.xlsx", "CSV"),
        ("a.copc", "end with .laz"),
        ("a.splat", "PLY"),
        ("a.doc", "document"),
        ("a.PCL", "save it as .pcd"),
    ],
)
def test_unknown_suffixes_by_what_they_are(tmp_path: Path, name: str, meant: str) -> None:
    (tmp_path / name).write_text("1 2 3")
    message = fails(tmp_path / name, meant, *READABLE_SUFFIXES)
    assert "did you mean" not in message


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
    fails(path, "permission denied", error=ForbiddenFileError)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_unreadable_mode(tmp_path: Path) -> None:
    save_points(tmp_path / "a.ply", small_cloud())
    (tmp_path / "a.ply").chmod(0)
    fails(tmp_path / "a.ply", "permission denied", error=ForbiddenFileError)


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
    points = small_cloud()
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
    points = small_cloud()
    points[41, 2] = -1e13
    for data in write_each(tmp_path, points):
        fails(data, "point 41", "1e+12", error=InputError)
    for data in write_each(tmp_path, small_cloud() + 1e9):
        assert np.abs(load_points(data).points).max() < 100


# --- damaged files of every kind -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """One small valid file of every readable format."""
    folder = tmp_path_factory.mktemp("samples")
    trimesh = pytest.importorskip("trimesh")
    normals = small_cloud(30, 1) / np.linalg.norm(small_cloud(30, 1), axis=1, keepdims=True)
    for suffix in WRITABLE_SUFFIXES:
        extras = {} if suffix == ".npy" else {"normals": normals, "colors": np.full((30, 3), 0.5)}
        save_points(folder / f"a{suffix}", small_cloud(30), **extras)
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
    wanted = "pye57" if suffix == ".e57" else "'laspy[lazrs]'"
    fails(tmp_path / f"a{suffix}", f"pip install {wanted}", error=DependencyError)
    for save in (
        lambda path: save_points(path, small_cloud()),
        lambda path: check_aligned(path, small_cloud()),
    ):
        with pytest.raises(DependencyError, match=re.escape(wanted)):
            save(tmp_path / f"new{suffix}")
        assert not (tmp_path / f"new{suffix}").exists()
