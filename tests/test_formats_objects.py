"""Things in memory as clouds: arrays of every type, tensors, objects of Open3D and trimesh, and others."""

from __future__ import annotations

import numpy as np
import pytest
from cloud_files import assert_on_box, cloud, fails, rigid, unit_vectors

from geomoe3d.clouds.io import load_points
from geomoe3d.errors import EmptyCloudError, InputError
from geomoe3d.geometry.se3 import transform_points


@pytest.mark.parametrize(
    "kind", [np.float16, np.float32, np.float64, np.longdouble, np.int16, np.uint8, np.int64]
)
def test_every_real_type_becomes_float64(kind: type) -> None:
    points = np.arange(30).reshape(10, 3).astype(kind)
    loaded = load_points(points)
    assert loaded.points.dtype == np.float64
    assert np.array_equal(loaded.file_points, points)


def test_the_cloud_shares_no_memory_with_the_array() -> None:
    points = cloud()
    loaded = load_points(points)
    kept = loaded.points.copy()
    points[:] = 7.0
    assert np.array_equal(loaded.points, kept)


@pytest.mark.parametrize("order", ["C", "F"])
def test_lists_fortran_order_and_strides(order: str) -> None:
    points = np.asarray(cloud(), order=order)
    assert np.array_equal(load_points(points[::2]).points, cloud()[::2])
    assert np.array_equal(load_points(points.tolist()).points, cloud())
    assert load_points(points).points.flags.c_contiguous


def test_masked_arrays_lose_their_masked_rows() -> None:
    points = np.ma.MaskedArray(cloud(), mask=np.zeros((200, 3), dtype=bool))
    points.mask[3, 1] = True
    loaded = load_points(points)
    assert loaded.num_non_finite == 1
    assert np.array_equal(loaded.points, np.delete(cloud(), 3, axis=0))


def test_torch_tensors() -> None:
    torch = pytest.importorskip("torch")
    points = cloud()
    for tensor in (
        torch.tensor(points, requires_grad=True),
        torch.tensor(points).float(),
        torch.tensor(points).bfloat16(),
        torch.arange(30).reshape(10, 3),
    ):
        loaded = load_points(tensor)
        assert np.array_equal(loaded.points, tensor.detach().double().numpy())


def test_open3d_objects() -> None:
    o3d = pytest.importorskip("open3d")
    points, normals, colors = cloud(), unit_vectors(200), np.random.default_rng(0).random((200, 3))
    legacy = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    legacy.normals = o3d.utility.Vector3dVector(normals * 3.0)
    legacy.colors = o3d.utility.Vector3dVector(colors)
    tensor = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    tensor.point.colors = o3d.core.Tensor((colors * 255).astype(np.uint8))
    first, second = load_points(legacy), load_points(tensor)
    assert np.array_equal(first.points, points) and np.array_equal(second.points, points)
    np.testing.assert_allclose(first.normals, normals, atol=1e-15)
    assert np.array_equal(first.colors, colors)
    np.testing.assert_allclose(second.colors, colors, atol=1 / 255)
    box = o3d.geometry.TriangleMesh.create_box(1.0, 1.0, 1.0)
    for mesh in (box, o3d.t.geometry.TriangleMesh.from_legacy(box)):
        assert_on_box(load_points(mesh, mesh_points=500).points - 0.5, 500)


def test_trimesh_objects() -> None:
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(), transform=rigid())
    back = np.linalg.inv(rigid())
    assert_on_box(transform_points(back, load_points(scene, mesh_points=400).file_points), 400)
    assert_on_box(load_points(trimesh.creation.box(), mesh_points=300).points, 300)
    assert np.array_equal(load_points(trimesh.PointCloud(cloud())).points, cloud())


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
