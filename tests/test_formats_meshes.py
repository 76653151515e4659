"""Mesh files: sampled evenly, by area, under the transforms of their scene; files cut short."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from cloud_files import UTM, assert_on_box, fails, rigid

from geomoe3d.clouds.io import load_points, save_aligned
from geomoe3d.clouds.loading import read_raw
from geomoe3d.errors import FormatError, InputError
from geomoe3d.geometry.se3 import transform_points


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".off", ".glb"])
def test_mesh_files_are_sampled_evenly_and_seeded(tmp_path: Path, suffix: str) -> None:
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box().export(tmp_path / f"box{suffix}")
    path = (tmp_path / f"box{suffix}").rename(tmp_path / f"box{suffix.upper()}")
    first = load_points(path, mesh_points=2000)
    assert_on_box(first.points, 2000)
    assert np.array_equal(first.points, load_points(path, mesh_points=2000).points)
    assert not np.array_equal(first.points, load_points(path, mesh_points=2000, seed=1).points)
    assert len(load_points(path)) == 100_000


def test_gltf_with_its_buffers(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    for name, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(trimesh.creation.box())).items():
        (tmp_path / name).write_bytes(content)
    assert_on_box(load_points(tmp_path / "model.gltf", mesh_points=500).points, 500)
    next(tmp_path.glob("*.bin")).unlink()
    with pytest.raises(FormatError, match=r"model\.gltf"):
        load_points(tmp_path / "model.gltf")


def test_sampling_is_area_weighted(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [10, 0, 0], [13, 0, 0], [10, 3, 0]]
    trimesh.Trimesh(vertices, [[0, 1, 2], [3, 4, 5]], process=False).export(tmp_path / "a.obj")
    points = load_points(tmp_path / "a.obj", mesh_points=10_000).file_points
    assert abs(np.mean(points[:, 0] > 5) - 0.9) < 0.015


def test_scene_graph_transforms_are_applied(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(), node_name="a", geom_name="box")
    for k, T in enumerate((rigid(1), rigid(2, (50.0, 0.0, 0.0)))):
        scene.graph.update(frame_to=f"b{k}", matrix=T, geometry="box")
    scene.graph.update(frame_to="a", matrix=rigid(4, (-80.0, 0.0, 0.0)), geometry="box")
    scene.export(tmp_path / "a.glb")
    points = load_points(tmp_path / "a.glb", mesh_points=6000).file_points
    for T in (rigid(1), rigid(2, (50.0, 0.0, 0.0)), rigid(4, (-80.0, 0.0, 0.0))):
        local = transform_points(np.linalg.inv(T), points)
        own = np.abs(local).max(axis=1) < 2
        assert abs(own.mean() - 1 / 3) < 0.03
        assert_on_box(local[own], int(own.sum()))


def test_far_meshes_are_sampled_like_near_ones(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box()
    near = load_points(box, mesh_points=100).file_points
    box.apply_translation(UTM)
    np.testing.assert_allclose(load_points(box, mesh_points=100).file_points - UTM, near, atol=1e-8)


def test_obj_of_points_alone_is_a_cloud(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 2 0.5\n")
    assert np.array_equal(load_points(tmp_path / "a.obj").file_points, [[0, 0, 0], [1, 0, 0], [0, 2, 0.5]])


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


def test_stl_with_bytes_behind_its_faces(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box().export(tmp_path / "a.stl")
    (tmp_path / "a.stl").write_bytes((tmp_path / "a.stl").read_bytes() + b"made by a CAD program" * 5)
    assert_on_box(load_points(tmp_path / "a.stl", mesh_points=400).points, 400)
    solid = b"solid" + (tmp_path / "a.stl").read_bytes()[5:]  # binary all the same
    (tmp_path / "a.stl").write_bytes(solid[: 84 + 12 * 50])
    assert_on_box(load_points(tmp_path / "a.stl", mesh_points=400).points, 400)


CORNERS = ("0 0 0", "1 0 0", "0 1 0")


@pytest.mark.parametrize(
    ("name", "text", "unread"),
    [
        ("a.off", "OFF\n3 1 0\n{0}\n{1}\n{2}\n3 0 1 2\n", ()),
        ("a.off", "COFF\n3 1 0\n{0} 9 9 9 9\n{1} 9 9 9 9\n{2} 9 9 9 9\n3 0 1 2\n", ("colors",)),
        ("a.off", "NOFF\n3 1 0\n{0} 0 0 1\n{1} 0 0 1\n{2} 0 0 1\n3 0 1 2\n", ("normals",)),
        ("a.off", "OFF\n3 1 0\n{0}\n{1}\n{2}\n3 0 1 2 255 0 0\n", ("face colors",)),
        ("a.obj", "v {0} 1 0 0\nv {1} 1 0 0\nv {2} 1 0 0\nf 1 2 3\n", ()),  # which are read
        (
            "a.obj",
            "v {0} 1 0 0\nv {1} 1 0 0\nv {2} 1 0 0\nvt 0 0\nf 1/1 2/1 3/1\n",
            ("texture coordinates", "colors", "materials"),
        ),
    ],
)
def test_what_a_mesh_says_and_is_not_read_is_named(
    tmp_path: Path, name: str, text: str, unread: tuple[str, ...]
) -> None:
    (tmp_path / name).write_text(text.format(*CORNERS))
    found = read_raw(tmp_path / name)
    assert found.unread == unread and len(found.points) == 3
    assert save_aligned(tmp_path / "b.stl", tmp_path / name, np.eye(4))[: len(unread)] == unread


@pytest.mark.parametrize(("attribute", "unread"), [(0, ()), (0x801F, ("face attributes",))])
def test_attributes_of_stl_faces_are_named(tmp_path: Path, attribute: int, unread: tuple[str, ...]) -> None:
    face = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, attribute)
    (tmp_path / "a.stl").write_bytes(bytes(80) + struct.pack("<I", 1) + face)
    assert read_raw(tmp_path / "a.stl").unread == unread
