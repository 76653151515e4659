"""What is written here, opened by programs and packages it is written for; what they write, read here."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from cloud_files import UTM, absent, cloud, needed, rigid, small_cloud, unit_vectors

from geomoe3d.clouds.formats.e57 import write_scans
from geomoe3d.clouds.formats.raw import RawCloud
from geomoe3d.clouds.io import load_points, save_aligned, save_points
from geomoe3d.clouds.loading import read_raw
from geomoe3d.clouds.transform_files import save_transform
from geomoe3d.geometry.se3 import transform_points

COLORS = np.random.default_rng(2).integers(1, 256, (100, 3)) / 255


def run(*command: str | Path, folder: Path) -> str:
    """The output of a program, which has to be there and to end well."""
    if shutil.which(str(command[0])) is None:
        absent(f"{command[0]} is not installed; scripts/test.sh installs it where there is apt-get")
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    done = subprocess.run(
        [str(word) for word in command],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=120,
        check=True,
    )
    return done.stdout + done.stderr


@pytest.fixture
def moved(tmp_path: Path) -> np.ndarray:
    """Points of which every format has a moved copy in the folder."""
    np.savez(
        tmp_path / "source.npz",
        points=small_cloud(),
        normals=unit_vectors(100),
        colors=COLORS,
        intensity=np.arange(100, dtype=np.float32),
    )
    for suffix in (".ply", ".pcd", ".asc", ".txt", ".csv", ".e57", ".las"):
        save_aligned(tmp_path / f"moved{suffix}", tmp_path / "source.npz", rigid())
    return transform_points(rigid(), small_cloud())


# ---- the Point Cloud Library's programs --------------------------------------------------------------


def test_pcl_takes_every_point_of_an_aligned_ply_and_pcd(tmp_path: Path, moved: np.ndarray) -> None:
    run("pcl_ply2pcd", "moved.ply", "from_ply.pcd", folder=tmp_path)
    for name in ("from_ply.pcd", "moved.pcd"):
        said = run("pcl_voxel_grid", name, "grid.pcd", "-leaf", "0.001,0.001,0.001", folder=tmp_path)
        assert "100 points" in said
        found = read_raw(tmp_path / "grid.pcd")  # which it has compressed
        assert b"binary_compressed" in (tmp_path / "grid.pcd").read_bytes()[:500]
        np.testing.assert_allclose(np.sort(found.points, axis=0), np.sort(moved, axis=0), atol=1e-5)


def test_pcl_takes_a_pcd_and_floats_about_an_origin_far_from_zero(tmp_path: Path) -> None:
    points = cloud(100, center=UTM)
    save_aligned(tmp_path / "all.pcd", points, np.eye(4))
    notes: list[str] = []
    for name in ("single.ply", "single.pcd"):
        save_aligned(tmp_path / name, points, np.eye(4), precision="single", remark=notes.append)
    save_aligned(tmp_path / "double.ply", points, np.eye(4), remark=notes.append)
    said = run("pcl_voxel_grid", "all.pcd", "grid.pcd", "-leaf", "1e6,1e6,1e6", folder=tmp_path)
    assert ": 1 points]" in said
    run("pcl_ply2pcd", "single.ply", "from_ply.pcd", folder=tmp_path)
    origin = np.array(notes[0].split("origin ")[1].split(",")[0].split(), dtype=float)
    for name in ("from_ply.pcd", "single.pcd"):
        run("pcl_voxel_grid", name, "grid.pcd", "-leaf", "0.001,0.001,0.001", folder=tmp_path)
        found = read_raw(tmp_path / "grid.pcd").points + origin
        np.testing.assert_allclose(np.sort(found, axis=0), np.sort(points, axis=0), atol=1e-4)
    assert len(notes) == 3 and "small_gicp" in notes[2]
    assert (
        f"comment {notes[0].split('the ')[1].split(',')[0]}".encode()
        in (tmp_path / "single.ply").read_bytes()
    )


@pytest.mark.parametrize("mode", ["0", "1", "2"])
def test_every_mode_of_pcl_is_read(tmp_path: Path, moved: np.ndarray, mode: str) -> None:
    run("pcl_convert_pcd_ascii_binary", "moved.pcd", "again.pcd", mode, folder=tmp_path)
    found = read_raw(tmp_path / "again.pcd")
    np.testing.assert_allclose(found.points, moved, atol=1e-4)  # its text has 8 digits
    np.testing.assert_allclose(found.colors, COLORS, atol=1e-9)
    np.testing.assert_array_equal(found.fields["intensity"], np.arange(100))


# ---- CloudCompare ------------------------------------------------------------------------------------


def compare(folder: Path, name: str, *words: str | Path) -> np.ndarray:
    """The points that CloudCompare makes of a file, by the text that it writes."""
    run(
        *("CloudCompare", "-SILENT", "-O", name, *words, "-C_EXPORT_FMT", "ASC", "-PREC", "9", "-ADD_HEADER"),
        *("-SAVE_CLOUDS", "FILE", "out.asc"),
        folder=folder,
    )
    return read_raw(folder / "out.asc").points


@pytest.mark.parametrize("name", ["moved.ply", "moved.asc", "moved.txt", "moved.csv"])
def test_cloudcompare_opens_an_aligned_cloud(tmp_path: Path, moved: np.ndarray, name: str) -> None:
    np.testing.assert_allclose(compare(tmp_path, name), moved, atol=1e-5)
    if name.endswith("asc"):
        np.testing.assert_allclose(read_raw(tmp_path / "out.asc").colors, COLORS, atol=1e-6)


def test_cloudcompare_applies_a_transform(tmp_path: Path) -> None:
    save_points(tmp_path / "source.ply", small_cloud())
    save_transform(tmp_path / "T.txt", rigid(), ["maps SOURCE into TARGET", "status ok"])
    found = compare(tmp_path, "source.ply", "-APPLY_TRANS", "T.txt")
    np.testing.assert_allclose(found, transform_points(rigid(), small_cloud()), atol=1e-5)


# ---- Python packages ---------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", ["single", "double"])
def test_plyfile_finds_every_property(tmp_path: Path, moved: np.ndarray, precision: str) -> None:
    plyfile = needed("plyfile")
    save_aligned(tmp_path / "a.ply", tmp_path / "source.npz", rigid(), precision=precision)
    vertex = plyfile.PlyData.read(tmp_path / "a.ply")["vertex"]
    found = np.stack([vertex[axis] for axis in "xyz"], axis=1)
    assert found.dtype == (np.float32 if precision == "single" else np.float64)
    np.testing.assert_allclose(found, moved, atol=1e-5 if precision == "single" else 1e-12)
    np.testing.assert_array_equal(vertex["intensity"], np.arange(100))
    np.testing.assert_array_equal(vertex["red"], np.rint(COLORS[:, 0] * 255))


def test_lists_and_text_of_plyfile_are_read(tmp_path: Path) -> None:
    plyfile = needed("plyfile")
    rows = np.empty(50, [("x", "f8"), ("y", "f8"), ("z", "f8"), ("views", object), ("ring", "u1")])
    rows["x"], rows["y"], rows["z"] = small_cloud(50).T
    rows["ring"] = np.arange(50)
    rows["views"] = [np.arange(k % 4, dtype="i4") for k in range(50)]
    for text, order in ((True, "="), (False, "<")):
        element = plyfile.PlyElement.describe(
            rows, "vertex", len_types={"views": "u1"}, val_types={"views": "i4"}
        )
        plyfile.PlyData([element], text=text, byte_order=order).write(tmp_path / "a.ply")
        found = read_raw(tmp_path / "a.ply")
        np.testing.assert_allclose(found.points, small_cloud(50), rtol=1e-15)
        assert found.unread == ("views",) and np.array_equal(found.fields["ring"], np.arange(50))


def test_small_gicp_and_open3d_find_every_point(tmp_path: Path, moved: np.ndarray) -> None:
    small_gicp, o3d = needed("small_gicp"), needed("open3d")
    np.savez(tmp_path / "floats.npz", points=small_cloud(), intensity=np.arange(100, dtype=np.float32))
    save_aligned(tmp_path / "floats.ply", tmp_path / "floats.npz", rigid())
    found = small_gicp.read_ply(str(tmp_path / "floats.ply"))  # it takes no bytes, so no colours
    np.testing.assert_allclose(found.points()[:, :3], moved, atol=1e-5)
    for name in ("moved.ply", "moved.pcd"):
        for read in (o3d.io.read_point_cloud, o3d.t.io.read_point_cloud):
            opened = read(str(tmp_path / name))
            points = opened.point.positions.numpy() if hasattr(opened, "point") else opened.points
            np.testing.assert_allclose(np.asarray(points), moved, atol=1e-5)


def test_pye57_reads_posed_scans(tmp_path: Path) -> None:
    pye57 = needed("pye57")
    clouds = [
        RawCloud(small_cloud(40, k), unit_vectors(40, k), COLORS[:40], fields={"intensity": np.arange(40.0)})
        for k in range(2)
    ]
    poses = [rigid(1), rigid(2, tuple(UTM))]
    scans = [(f"scan {k}", c, T) for k, (c, T) in enumerate(zip(clouds, poses, strict=True))]
    assert write_scans(tmp_path / "a.e57", scans) == ()
    with pye57.E57(str(tmp_path / "a.e57")) as file:
        assert file.scan_count == 2
        for k in range(2):
            found = file.read_scan(k, intensity=True, colors=True, ignore_missing_fields=True)
            points = np.stack([found[f"cartesian{axis}"] for axis in "XYZ"], axis=1)
            np.testing.assert_allclose(
                points, transform_points(poses[k], clouds[k].points), rtol=0, atol=1e-8
            )
            np.testing.assert_array_equal(found["intensity"], np.arange(40))
            np.testing.assert_array_equal(found["colorRed"], np.rint(COLORS[:40, 0] * 255))
            np.testing.assert_allclose(file.get_header(k).rotation_matrix, poses[k][:3, :3], atol=1e-12)
    together = load_points(tmp_path / "a.e57")
    expected = np.concatenate([transform_points(T, c.points) for c, T in zip(clouds, poses, strict=True)])
    np.testing.assert_allclose(together.file_points, expected, rtol=0, atol=1e-8)
    turned = [c.normals @ T[:3, :3].T for c, T in zip(clouds, poses, strict=True)]
    np.testing.assert_allclose(together.normals, np.concatenate(turned), atol=1e-9)


# ---- MeshLab, through its own package ------------------------------------------------------------------


@pytest.mark.parametrize("precision", ["single", "double"])
def test_meshlab_opens_an_aligned_cloud(tmp_path: Path, moved: np.ndarray, precision: str) -> None:
    pymeshlab = needed("pymeshlab")
    save_aligned(tmp_path / "a.ply", tmp_path / "source.npz", rigid(), precision=precision)
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.load_new_mesh(str(tmp_path / "a.ply"))
    found = meshes.current_mesh()
    np.testing.assert_allclose(found.vertex_matrix(), moved, atol=1e-5 if precision == "single" else 1e-9)
    np.testing.assert_allclose(found.vertex_normal_matrix(), unit_vectors(100) @ rigid()[:3, :3].T, atol=1e-6)
    np.testing.assert_allclose(found.vertex_color_matrix()[:, :3], COLORS, atol=1e-6)
    np.savez(tmp_path / "flags.npz", points=small_cloud(), flags=np.arange(100, dtype=np.int32))
    save_aligned(tmp_path / "flags.ply", tmp_path / "flags.npz", rigid(), precision=precision)
    meshes.load_new_mesh(str(tmp_path / "flags.ply"))
    assert meshes.current_mesh().vertex_number() == 100  # flags would hide half of them


@pytest.mark.parametrize("name", ["moved.asc", "moved.e57", "bare.xyz"])
def test_meshlab_opens_other_clouds(tmp_path: Path, moved: np.ndarray, name: str) -> None:
    pymeshlab = needed("pymeshlab")
    notes: list[str] = []
    save_aligned(tmp_path / "bare.xyz", small_cloud(), rigid(), remark=notes.append)
    assert not notes
    save_aligned(tmp_path / "full.xyz", tmp_path / "source.npz", rigid(), remark=notes.append)
    assert len(notes) == 1 and "MeshLab" in notes[0]
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.load_new_mesh(str(tmp_path / name))
    np.testing.assert_allclose(meshes.current_mesh().vertex_matrix(), moved, atol=1e-6)


@pytest.mark.parametrize("suffix", [".obj", ".off", ".stl", ".ply", ".glb"])
def test_meshlab_opens_an_aligned_mesh(tmp_path: Path, suffix: str) -> None:
    pymeshlab, trimesh = needed("pymeshlab"), needed("trimesh")
    save_aligned(tmp_path / f"a{suffix}", trimesh.creation.box(), rigid())
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.load_new_mesh(str(tmp_path / f"a{suffix}"))
    found = meshes.current_mesh().transformed_vertex_matrix()
    expected = transform_points(rigid(), trimesh.creation.box().vertices)
    np.testing.assert_allclose(
        [found.min(axis=0), found.max(axis=0)], [expected.min(axis=0), expected.max(axis=0)], atol=1e-5
    )


@pytest.mark.parametrize("suffix", [".obj", ".off", ".stl", ".ply", ".glb"])
def test_trimesh_opens_an_aligned_mesh(tmp_path: Path, suffix: str) -> None:
    trimesh = needed("trimesh")
    box = trimesh.creation.box()
    save_aligned(tmp_path / f"a{suffix}", box, rigid())
    found = trimesh.load(tmp_path / f"a{suffix}", force="mesh")
    expected = transform_points(rigid(), box.vertices)
    np.testing.assert_allclose(found.bounds, [expected.min(axis=0), expected.max(axis=0)], atol=1e-5)
    assert abs(found.area - 6) < 1e-5
