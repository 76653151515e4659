"""Reading and writing of clouds: round trips, foreign files, recentring, meshes, moved sources."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from geomoe3d.clouds.io import (
    WRITABLE_MESH_SUFFIXES,
    WRITABLE_SUFFIXES,
    load_points,
    save_aligned,
    save_points,
)
from geomoe3d.clouds.recentre import choose_origin
from geomoe3d.errors import FormatError
from geomoe3d.geometry.se3 import make_transform, transform_points
from geomoe3d.types import PointCloud

UTM = np.array([583394.0, 5283100.0, 498.0])
STEP = np.array([5.0, 6.0, 7.0])
MANY = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def cloud(num: int = 200, seed: int = 0, center: np.ndarray | float = 0.0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(num, 3)) * [30.0, 20.0, 5.0] + center


def unit_vectors(num: int, seed: int = 1) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(num, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def rigid(seed: int = 3, translation: tuple[float, float, float] = (3.0, -2.0, 7.5)) -> np.ndarray:
    R = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return make_transform(R * np.sign(np.linalg.det(R)), np.array(translation))


# --- round trips ---------------------------------------------------------------------------------------

finite = st.floats(-1e4, 1e4, allow_nan=False, width=64)
offsets = st.sampled_from([np.zeros(3), UTM, np.array([1e9, -1e9, 0.0])])


@st.composite
def colored_clouds(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    num = draw(st.integers(1, 30))
    points = draw(hnp.arrays(np.float64, (num, 3), elements=finite)) + draw(offsets)
    colors = draw(hnp.arrays(np.float64, (num, 3), elements=st.floats(0, 1)))
    return points, unit_vectors(num, draw(st.integers(0, 99))), colors


@pytest.mark.parametrize("suffix", WRITABLE_SUFFIXES)
@MANY
@given(data=colored_clouds())
def test_round_trip_keeps_points_normals_and_colors(tmp_path: Path, suffix: str, data) -> None:
    points, normals, colors = data
    path = tmp_path / f"cloud{suffix}"
    extras = {} if suffix == ".npy" else {"normals": normals, "colors": colors}
    save_points(path, points, **extras, force=True)
    loaded = load_points(path)
    rounding = 2 * np.spacing(np.abs(points).max())  # of recentring where a coordinate is near zero
    if suffix in (".las", ".laz"):
        rounding += 1e-8 * max(np.ptp(points, axis=0).max(), 1.0)
    if suffix == ".pcd":
        rounding += 1e-6 * np.ptp(points, axis=0).max()
    assert np.abs(loaded.file_points - points).max() <= rounding
    if suffix == ".npy":
        assert loaded.normals is None and loaded.colors is None
        return
    assert loaded.normals is not None
    np.testing.assert_allclose(loaded.normals, normals, atol=1e-7 if suffix == ".pcd" else 1e-15)
    if suffix in (".las", ".laz"):
        if np.rint(colors * 255).any():  # an entirely black LAS is one without colours
            np.testing.assert_allclose(loaded.colors, colors, atol=0.5 / 255 + 1e-12)
    else:
        atol = 0.5 / 255 + 1e-12 if suffix in (".ply", ".pcd") else 0.0
        assert loaded.colors is not None
        np.testing.assert_allclose(loaded.colors, colors, rtol=0, atol=atol)


@pytest.mark.parametrize("suffix", WRITABLE_SUFFIXES)
def test_precision_at_map_coordinates(tmp_path: Path, suffix: str) -> None:
    points = cloud(center=UTM)
    save_points(tmp_path / f"a{suffix}", points)
    loaded = load_points(tmp_path / f"a{suffix}")
    limit = 1e-6 if suffix in (".las", ".laz") else 0.0
    assert np.abs(loaded.file_points - points).max() <= limit
    assert np.abs(loaded.points).max() < 200, "local coordinates are small"


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".xyz"])
def test_open3d_reads_what_is_written_here(tmp_path: Path, suffix: str) -> None:
    o3d = pytest.importorskip("open3d")
    for center, limit in ((UTM, 0.0), (0.0, 1e-5 if suffix == ".pcd" else 0.0)):
        points = cloud(center=center)
        save_points(tmp_path / f"a{suffix}", points, force=True)
        legacy = np.asarray(o3d.io.read_point_cloud(str(tmp_path / f"a{suffix}")).points)
        assert np.abs(legacy - points).max() <= limit


def test_las_stores_nearly_black_colors_unambiguously(tmp_path: Path) -> None:
    colors = np.full((5, 3), 0.003)  # 197 of 65535, which a reader would take for 8 bit
    save_points(tmp_path / "a.las", cloud(5), colors=colors)
    np.testing.assert_allclose(load_points(tmp_path / "a.las").colors, colors, atol=0.5 / 255)


# --- recentring ----------------------------------------------------------------------------------------


@MANY
@given(seed=st.integers(0, 10**6), far=st.booleans(), num=st.integers(1, 60))
def test_row_order_does_not_change_the_origin(seed: int, far: bool, num: int) -> None:
    points = cloud(num, seed, UTM if far else 40.0)
    shuffled = np.random.default_rng(seed).permutation(points)
    assert np.array_equal(choose_origin(points), choose_origin(shuffled))


@MANY
@given(
    grid=hnp.arrays(
        np.int64, st.tuples(st.integers(2, 40), st.just(3)), elements=st.integers(-50_000, 50_000)
    ),
    first=st.tuples(*[st.integers(10**6, 10**7)] * 3),
    second=st.tuples(*[st.integers(-(10**7), -(10**6))] * 3),
)
def test_copies_moved_by_whole_units_have_the_same_local_points(grid, first, second) -> None:
    points = grid / 1024.0  # sums with whole numbers below 2^33 are exact
    a, b = load_points(points + first), load_points(points + second)
    assert a.points.tobytes() == b.points.tobytes()
    assert np.array_equal(a.origin - b.origin, np.subtract(first, second))
    assert np.array_equal(a.file_points, points + first)


def test_origin_is_zero_near_zero_and_whole_units_far_away() -> None:
    near = cloud(center=[100.0, 0.0, 0.0])
    assert not load_points(near).origin.any()
    assert np.array_equal(load_points(near).points, near)
    far = load_points(cloud(center=UTM))
    assert np.array_equal(far.origin, np.floor(np.median(cloud(center=UTM), axis=0) + 0.5))
    assert np.abs(np.median(far.points, axis=0)).max() <= 0.5


def test_stray_points_do_not_move_the_origin_or_hide_the_distance() -> None:
    points = cloud(center=UTM)
    stray = np.concatenate([points, [[0.0, 0.0, 0.0], [9e11, 0.0, 0.0]]])
    assert np.abs(load_points(stray).origin - load_points(points).origin).max() <= 3
    assert load_points(stray).origin.any()


def test_coordinates_of_1e9_keep_their_local_geometry() -> None:
    grid = np.random.default_rng(0).integers(0, 2**12, size=(100, 3)) / 2.0**10  # exact at 1e9
    loaded = load_points(grid + 1e9)
    shift = loaded.points[0] - grid[0]
    assert np.array_equal(loaded.points, grid + shift)


# --- things in memory ----------------------------------------------------------------------------------


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


def test_a_loaded_cloud_is_returned_as_it_is() -> None:
    given_cloud = load_points(cloud(), name="a")
    assert load_points(given_cloud) is given_cloud
    renamed = load_points(given_cloud, name="b")
    assert renamed.name == "b" and renamed.points is given_cloud.points


def test_names(tmp_path: Path) -> None:
    save_points(tmp_path / "scan.PLY", cloud())
    assert load_points(tmp_path / "scan.PLY").name == "scan.PLY"
    assert load_points(str(tmp_path / "scan.PLY"), name="left").name == "left"
    assert load_points(cloud()).name == "cloud"


# --- non-finite rows, normals, colours -----------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("stored", "expected"),
    [
        (np.array([[0, 128, 255]], np.uint8), [0, 128 / 255, 1]),
        (np.array([[0, 1, 1]], np.uint8), [0, 1 / 255, 1 / 255]),
        (np.array([[0, 1, 255]], np.int64), [0, 1 / 255, 1]),
        (np.array([[0, 32768, 65535]], np.uint16), [0, 32768 / 65535, 1]),
        (np.array([[0.0, 0.5, 1.0]]), [0, 0.5, 1]),
        (np.array([[0.0, 127.5, 255.0]]), [0, 0.5, 1]),
        (np.array([[-0.1, 0.5, 1.0]]), None),
        (np.array([[np.nan, 0.5, 1.0]]), None),
        (np.array([[0.0, 0.5, 1e6]]), None),
    ],
)
def test_color_scales(tmp_path: Path, stored: np.ndarray, expected: list[float] | None) -> None:
    np.savez(tmp_path / "a.npz", points=cloud(1), rgb=stored)
    loaded = load_points(tmp_path / "a.npz").colors
    if expected is None:
        assert loaded is None
    else:
        np.testing.assert_allclose(loaded, [expected])


# --- PLY -----------------------------------------------------------------------------------------------

PLY_TYPES = {"float": "f4", "double": "f8", "int": "i4", "short": "i2", "uchar": "u1", "float32": "f4"}


def write_ply(
    path: Path, fmt: str, properties: list[tuple[str, str, np.ndarray]], tail: bytes = b"", more: str = ""
) -> None:
    """A PLY written column by column, as a foreign program might."""
    num = len(properties[0][2])
    header = f"ply\nformat {fmt} 1.0\ncomment made by hand\nobj_info none\nelement vertex {num}\n"
    header += "".join(f"property {kind} {name}\n" for name, kind, _ in properties) + more + "end_header\n"
    if fmt == "ascii":
        lines = zip(*(values.tolist() for _, _, values in properties), strict=True)
        body = "".join(" ".join(repr(v) for v in line) + "\n" for line in lines).encode()
    else:
        order = "<" if "little" in fmt else ">"
        rows = np.empty(num, dtype=[(name, order + PLY_TYPES[kind]) for name, kind, _ in properties])
        for name, _, values in properties:
            rows[name] = values
        body = rows.tobytes()
    path.write_bytes(header.encode() + body + tail)


PLY_FORMATS = ("ascii", "binary_little_endian", "binary_big_endian")


@pytest.mark.parametrize("fmt", PLY_FORMATS)
@pytest.mark.parametrize("kind", ["float", "double", "int"])
def test_ply_of_every_order_and_type(tmp_path: Path, fmt: str, kind: str) -> None:
    points = (cloud(center=UTM) if kind == "double" else np.round(cloud())).astype(PLY_TYPES[kind])
    colors = np.random.default_rng(0).integers(0, 256, (200, 3)).astype(np.uint8)
    columns = [("intensity", "short", np.arange(200)), ("z", kind, points[:, 2])]
    columns += [(name, "uchar", colors[:, k]) for k, name in enumerate(("red", "green", "blue"))]
    columns += [("x", kind, points[:, 0]), ("y", kind, points[:, 1])]
    write_ply(tmp_path / "a.ply", fmt, columns)
    loaded = load_points(tmp_path / "a.ply")
    assert np.array_equal(loaded.file_points, points)
    np.testing.assert_allclose(loaded.colors, colors / 255)


@pytest.mark.parametrize("fmt", PLY_FORMATS)
def test_ply_with_other_elements_around_the_vertices(tmp_path: Path, fmt: str) -> None:
    points = cloud(4)
    columns = [(axis, "double", points[:, k]) for k, axis in enumerate("xyz")]
    more = "element camera 2\nproperty float focal\n"
    tail = b"1.5\n2.5\n"
    if fmt != "ascii":
        tail = np.array([1.5, 2.5], dtype=("<" if "little" in fmt else ">") + "f4").tobytes()
    write_ply(tmp_path / "a.ply", fmt, columns, tail, more)
    assert np.array_equal(load_points(tmp_path / "a.ply").points, points)


def polygons(fmt: str, faces: list[list[int]], texture: bool) -> bytes:
    """Rows of a face element: [flag] list of indices [list of texture coordinates]."""
    if fmt == "ascii":
        lines = [
            " ".join(map(str, [7, len(f), *f] + ([2 * len(f), *[0.5] * (2 * len(f))] if texture else [])))
            for f in faces
        ]
        return ("\n".join(lines) + "\n").encode()
    order = "<" if "little" in fmt else ">"
    out = b""
    for f in faces:
        out += struct.pack(f"{order}BB{len(f)}i", 7, len(f), *f)
        if texture:
            out += struct.pack(f"{order}B{2 * len(f)}f", 2 * len(f), *[0.5] * (2 * len(f)))
    return out


@pytest.mark.parametrize("fmt", PLY_FORMATS)
@pytest.mark.parametrize("texture", [False, True])
def test_ply_mesh_of_mixed_polygons_is_sampled(tmp_path: Path, fmt: str, texture: bool) -> None:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    faces = [
        [0, 1, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5, 1],
        [2, 3, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
        [1, 5, 7, 3],
    ]
    more = "element face 8\nproperty uchar flag\nproperty list uchar int vertex_indices\n"
    more += "property list uchar float texcoord\n" if texture else ""
    columns = [(axis, "double", corners[:, k]) for k, axis in enumerate("xyz")]
    write_ply(tmp_path / "a.ply", fmt, columns, polygons(fmt, faces, texture), more)
    assert_on_box(load_points(tmp_path / "a.ply", mesh_points=3000).points, 3000)


@pytest.mark.parametrize(("num", "sampled"), [(49_999, True), (50_000, False)])
def test_dense_ply_meshes_keep_their_vertices(tmp_path: Path, num: int, sampled: bool) -> None:
    points = cloud(num)
    columns = [(axis, "double", points[:, k]) for k, axis in enumerate("xyz")]
    fmt = "binary_little_endian"
    more = "element face 2\nproperty uchar flag\nproperty list uchar int vertex_indices\n"
    write_ply(tmp_path / "a.ply", fmt, columns, polygons(fmt, [[0, 1, 2], [2, 3, 4]], False), more)
    loaded = load_points(tmp_path / "a.ply", mesh_points=123)
    assert len(loaded) == (123 if sampled else num)
    assert np.array_equal(loaded.points, points) != sampled


def test_ply_of_open3d_and_trimesh(tmp_path: Path) -> None:
    o3d, trimesh = pytest.importorskip("open3d"), pytest.importorskip("trimesh")
    points = cloud(center=UTM)
    legacy = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    legacy.normals = o3d.utility.Vector3dVector(unit_vectors(200))
    for ascii_ in (False, True):
        o3d.io.write_point_cloud(str(tmp_path / "a.ply"), legacy, write_ascii=ascii_)
        loaded = load_points(tmp_path / "a.ply")
        own = np.asarray(o3d.io.read_point_cloud(str(tmp_path / "a.ply")).points)
        assert np.array_equal(loaded.file_points, own)
        assert ascii_ or np.array_equal(own, points), "Open3D's ASCII has 6 digits, its binary all"
        np.testing.assert_allclose(loaded.normals, unit_vectors(200), atol=1e-6)
    for encoding in ("binary", "ascii"):
        trimesh.creation.box().export(tmp_path / "b.ply", encoding=encoding)
        assert_on_box(load_points(tmp_path / "b.ply", mesh_points=200).points, 200)


# --- PCD -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize(
    "options", [{"write_ascii": True}, {}, {"compressed": True}], ids=["ascii", "binary", "lzf"]
)
def test_pcd_of_open3d(tmp_path: Path, kind: type, options: dict[str, bool]) -> None:
    o3d = pytest.importorskip("open3d")
    points = cloud(center=UTM if kind is np.float64 else 0.0).astype(kind)
    colors = np.random.default_rng(0).integers(0, 256, (200, 3)).astype(np.uint8)
    tensor = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    tensor.point.colors = o3d.core.Tensor(colors)
    tensor.point.normals = o3d.core.Tensor(unit_vectors(200).astype(kind))
    o3d.t.io.write_point_cloud(str(tmp_path / "a.pcd"), tensor, **options)
    loaded = load_points(tmp_path / "a.pcd")
    atol = 1e-3 if options.get("write_ascii") else 0.0  # Open3D prints 10 significant digits
    np.testing.assert_allclose(loaded.file_points, points, rtol=0, atol=atol)
    np.testing.assert_allclose(loaded.normals, unit_vectors(200), atol=1e-6)
    np.testing.assert_allclose(loaded.colors, colors / 255)


def test_pcd_in_the_style_of_pcl(tmp_path: Path) -> None:
    """Padding, a field of several numbers, colours in the bits of a float, no COUNT for plain fields."""
    points = cloud().astype(np.float32)
    rows = np.zeros(200, dtype=[("p", "<f4", 3), ("pad", "u1", 4), ("hist", "<f4", 5), ("rgb", "<u4")])
    rows["p"], rows["rgb"] = points, 0x0A141E
    header = "# .PCD v.7\nVERSION .7\nFIELDS x y z _ hist rgb\nSIZE 4 4 4 1 4 4\nTYPE F F F U F F\n"
    header += "COUNT 1 1 1 4 5 1\n"
    header += "WIDTH 20\nHEIGHT 10\nVIEWPOINT 1 2 3 1 0 0 0\nPOINTS 200\nDATA binary\n"
    (tmp_path / "a.pcd").write_bytes(header.encode() + rows.tobytes())
    loaded = load_points(tmp_path / "a.pcd")
    assert np.array_equal(loaded.points, points)
    np.testing.assert_allclose(loaded.colors, np.tile([10 / 255, 20 / 255, 30 / 255], (200, 1)))
    bits = np.array([0x0A141E], np.uint32).view(np.float32)[0]
    text = header.split("WIDTH")[0].replace(" _ hist", "").replace("4 4 4 1 4 4", "4 4 4 4")
    text = text.replace("F F F U F F", "F F F F").replace("COUNT 1 1 1 4 5 1\n", "")
    (tmp_path / "b.pcd").write_text(f"{text}WIDTH 1\nHEIGHT 1\nDATA ascii\n1 2 3 {bits:.9g}\n")
    np.testing.assert_allclose(load_points(tmp_path / "b.pcd").colors, [[10 / 255, 20 / 255, 30 / 255]])


# --- text ----------------------------------------------------------------------------------------------

TRIPLES = "1 2 3", "4.5 -5e-1 6", "7 8 9"


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


@pytest.mark.parametrize("suffix", [".txt", ".npy"])
def test_six_and_nine_columns_without_names(tmp_path: Path, suffix: str) -> None:
    points, normals = cloud(), unit_vectors(200)
    colors = np.random.default_rng(0).integers(0, 256, (200, 3)).astype(float)
    path = tmp_path / f"a{suffix}"

    def load(*parts: np.ndarray) -> PointCloud:
        table = np.concatenate(parts, axis=1)
        np.save(path, table) if suffix == ".npy" else np.savetxt(path, table, fmt="%.17g")
        return load_points(path)

    with_normals, with_colors, with_both = (
        load(points, normals),
        load(points, colors),
        load(points, colors, normals),
    )
    for loaded, has_normals, has_colors in (
        (with_normals, True, False),
        (with_colors, False, True),
        (load(points, colors / 255), False, True),
        (with_both, True, True),
        (load(points, normals, colors), True, True),
        (load(points, normals * 300.0), False, False),
        (load(points, colors + 300.0), False, False),
    ):
        assert np.array_equal(loaded.points, points)
        assert (loaded.normals is not None, loaded.colors is not None) == (has_normals, has_colors)
    np.testing.assert_allclose(with_both.colors, colors / 255)
    np.testing.assert_allclose(with_both.normals, normals, atol=1e-15)


def test_a_header_overrules_the_guess(tmp_path: Path) -> None:
    colors = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])  # of unit length too
    rows = "\n".join(f"1 2 {k} {r} {g} {b}" for k, (r, g, b) in enumerate(colors))
    (tmp_path / "a.txt").write_text("x y z R G B\n" + rows)
    loaded = load_points(tmp_path / "a.txt")
    assert loaded.normals is None
    assert np.array_equal(loaded.colors, colors)


# --- NPZ -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["points", "xyz", "pcd", "pos", "XYZ", "arr_0", "whatever"])
def test_npz_keys(tmp_path: Path, key: str) -> None:
    np.savez_compressed(tmp_path / "a.npz", **{key: cloud()})
    assert np.array_equal(load_points(tmp_path / "a.npz").points, cloud())


# --- meshes --------------------------------------------------------------------------------------------


def assert_on_box(points: np.ndarray, num: int) -> None:
    """All points on the surface of the unit cube about zero, spread evenly over its six faces."""
    assert points.shape == (num, 3)
    assert np.abs(np.abs(points).max(axis=1) - 0.5).max() < 1e-6
    side = np.argmax(np.abs(points), axis=1) * 2 + (
        points[np.arange(num), np.argmax(np.abs(points), axis=1)] > 0
    )
    shares = np.bincount(side, minlength=6) / num
    assert np.abs(shares - 1 / 6).max() < 5 * np.sqrt(1 / 6 * 5 / 6 / num)


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


# --- LAS and E57 ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("scale", [255, 65535])
def test_las_of_laspy(tmp_path: Path, suffix: str, scale: int) -> None:
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = [0.001] * 3, UTM
    las = laspy.LasData(header)
    counts = np.random.default_rng(0).integers(-(10**6), 10**6, (200, 3))
    las.X, las.Y, las.Z = counts.T
    colors = np.random.default_rng(0).integers(0, scale + 1, (200, 3))
    colors[0] = scale
    las.red, las.green, las.blue = colors.T
    las.write(tmp_path / f"a{suffix}")
    loaded = load_points(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(loaded.file_points, counts * 0.001 + UTM, rtol=0, atol=2e-9)
    np.testing.assert_allclose(loaded.colors, colors / scale)
    las.red, las.green, las.blue = np.zeros((3, 200))
    las.write(tmp_path / f"a{suffix}")
    assert load_points(tmp_path / f"a{suffix}").colors is None


def write_e57(
    path: Path, scans: list[dict[str, np.ndarray]], poses: list[tuple[np.ndarray, np.ndarray]]
) -> None:
    """Scans of any supported fields in double precision, colours up to 65535."""
    import pye57
    from pye57 import libe57

    with pye57.E57(str(path), mode="w") as file:
        image = file.image_file
        for data, (quaternion, translation) in zip(scans, poses, strict=True):
            scan = libe57.StructureNode(image)
            scan.set("guid", libe57.StringNode(image, f"{{{len(file.data3d)}}}"))
            pose, rotation, shift = (libe57.StructureNode(image) for _ in range(3))
            for name, value in zip("xyzw", quaternion, strict=True):  # x first: the order must not matter
                rotation.set(name, libe57.FloatNode(image, float(value)))
            for name, value in zip("xyz", translation, strict=True):
                shift.set(name, libe57.FloatNode(image, float(value)))
            scan.set("pose", pose)
            pose.set("rotation", rotation)
            pose.set("translation", shift)
            prototype = libe57.StructureNode(image)
            buffers = libe57.VectorSourceDestBuffer()
            num = len(next(iter(data.values())))
            for name, values in data.items():
                if "color" in name or "State" in name:
                    prototype.set(name, libe57.IntegerNode(image, 0, 0, 65535))
                else:
                    prototype.set(name, libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE, -1e9, 1e9))
                data[name] = np.ascontiguousarray(values, dtype=np.float64)
                buffers.append(libe57.SourceDestBuffer(image, name, data[name], num, True, True))
            points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
            scan.set("points", points)
            file.data3d.append(scan)
            writer = points.writer(buffers)
            writer.write(num)
            writer.close()


def test_e57_scans_are_merged_in_the_global_frame(tmp_path: Path) -> None:
    pytest.importorskip("pye57")
    from scipy.spatial.transform import Rotation

    first, second = cloud(40, 1), cloud(30, 2)
    R = [Rotation.from_rotvec(v) for v in ([0.3, 1.0, -0.4], [2.0, 0.1, 0.5])]
    poses = [(R[0].as_quat(), UTM), (R[1].as_quat(), UTM + STEP)]
    reach = np.linalg.norm(second, axis=1)
    invalid = np.arange(40) % 10 == 3
    colors = np.random.default_rng(0).integers(0, 65536, (70, 3))
    scans: list[dict[str, np.ndarray]] = [
        {f"cartesian{axis}": first[:, k] for k, axis in enumerate("XYZ")}
        | {"cartesianInvalidState": invalid * 2},
        {
            "sphericalRange": reach,
            "sphericalAzimuth": np.arctan2(second[:, 1], second[:, 0]),
            "sphericalElevation": np.arcsin(second[:, 2] / reach),
        },
    ]
    for scan, part in zip(scans, (colors[:40], colors[40:]), strict=True):
        scan.update({f"color{name}": part[:, k] for k, name in enumerate(("Red", "Green", "Blue"))})
    write_e57(tmp_path / "a.e57", scans, poses)
    loaded = load_points(tmp_path / "a.e57")
    expected = np.concatenate([R[0].apply(first[~invalid]) + UTM, R[1].apply(second) + UTM + STEP])
    np.testing.assert_allclose(loaded.file_points, expected, rtol=0, atol=1e-8)
    np.testing.assert_allclose(loaded.colors, np.concatenate([colors[:40][~invalid], colors[40:]]) / 65535)


def test_e57_of_pye57(tmp_path: Path) -> None:
    pye57 = pytest.importorskip("pye57")
    points = cloud(50).astype(np.float32).astype(np.float64)
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        data = {f"cartesian{axis}": points[:, k].copy() for k, axis in enumerate("XYZ")}
        file.write_scan_raw(data, rotation=np.array([1.0, 0, 0, 0]), translation=STEP)
    assert np.array_equal(load_points(tmp_path / "a.e57").file_points, points + STEP)


# --- moved sources -------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", WRITABLE_SUFFIXES)
def test_save_aligned_moves_everything(tmp_path: Path, suffix: str) -> None:
    points, normals = cloud(center=UTM), unit_vectors(200)
    colors = np.random.default_rng(0).integers(1, 256, (200, 3)) / 255
    points[5] = np.nan
    np.savez(tmp_path / "source.npz", points=points, normals=normals, colors=colors)
    T = rigid()
    T[:3, 3] += UTM - T[:3, :3] @ UTM
    save_aligned(tmp_path / f"moved{suffix}", tmp_path / "source.npz", T)
    moved = load_points(tmp_path / f"moved{suffix}")
    kept = np.arange(200) != 5
    exact = (points[kept] - UTM) @ T[:3, :3].T + (T[:3, :3] @ UTM + T[:3, 3])
    np.testing.assert_allclose(
        moved.file_points, exact, rtol=0, atol=1e-6 if suffix in (".las", ".laz") else 1e-8
    )
    assert moved.num_non_finite == 0
    if suffix != ".npy":
        np.testing.assert_allclose(moved.normals, normals[kept] @ T[:3, :3].T, atol=1e-6)
        np.testing.assert_allclose(moved.colors, colors[kept], atol=1e-6)


@pytest.mark.parametrize("source_suffix", [".obj", ".stl", ".ply", ".glb"])
@pytest.mark.parametrize("suffix", WRITABLE_MESH_SUFFIXES)
@pytest.mark.parametrize("center", [np.zeros(3), UTM], ids=["near", "far"])
def test_a_moved_mesh_stays_a_mesh(
    tmp_path: Path, source_suffix: str, suffix: str, center: np.ndarray
) -> None:
    trimesh = pytest.importorskip("trimesh")
    from geomoe3d.clouds.loading import read_raw

    box = trimesh.creation.box()
    source = tmp_path / f"box{source_suffix}"
    save_aligned(source, box, make_transform(np.eye(3), center))
    T = rigid()
    T[:3, 3] -= T[:3, :3] @ center
    save_aligned(tmp_path / f"moved{suffix}", source, T)
    raw = read_raw(tmp_path / f"moved{suffix}")
    assert raw.faces is not None and len(raw.faces) == 12
    corners = transform_points(rigid(), np.asarray(box.vertices)[box.faces])
    found = raw.points[raw.faces]
    order = [np.lexsort(np.round(c.mean(axis=1), 3).T) for c in (corners, found)]
    np.testing.assert_allclose(found[order[1]].mean(axis=1), corners[order[0]].mean(axis=1), atol=1e-6)


def test_glb_keeps_its_material(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box()
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[10, 200, 30, 255], name="paint")
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    trimesh.Scene(box).export(tmp_path / "a.glb")
    save_aligned(tmp_path / "b.glb", tmp_path / "a.glb", rigid())
    (moved,) = trimesh.load(tmp_path / "b.glb").geometry.values()
    assert moved.visual.material.name == "paint"
    assert list(moved.visual.material.baseColorFactor[:3]) == [10, 200, 30]


def test_a_mesh_saved_as_a_cloud_is_the_cloud_that_is_loaded(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box().export(tmp_path / "a.obj")
    save_aligned(tmp_path / "b.npy", tmp_path / "a.obj", rigid())
    expected = transform_points(rigid(), load_points(tmp_path / "a.obj").file_points)
    np.testing.assert_allclose(load_points(tmp_path / "b.npy").file_points, expected, atol=1e-12)


def test_save_aligned_takes_arrays_and_loaded_clouds_and_may_replace_its_source(tmp_path: Path) -> None:
    points = cloud(center=UTM)
    for source in (points, load_points(points)):
        save_aligned(tmp_path / "a.npy", source, rigid(), force=True)
        expected = (points - UTM) @ rigid()[:3, :3].T + rigid()[:3, :3] @ UTM + rigid()[:3, 3]
        np.testing.assert_allclose(np.load(tmp_path / "a.npy"), expected, rtol=0, atol=1e-8)
    save_aligned(tmp_path / "a.npy", tmp_path / "a.npy", np.linalg.inv(rigid()), force=True)
    np.testing.assert_allclose(np.load(tmp_path / "a.npy"), points, rtol=0, atol=1e-7)


# --- house rules ---------------------------------------------------------------------------------------


def test_import_is_light() -> None:
    heavy = ["open3d", "torch", "trimesh", "scipy", "matplotlib", "laspy", "pye57"]
    code = f"import sys, geomoe3d.clouds.io; print([m for m in {heavy} if m in sys.modules])"
    root = str(Path(__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": root},
    )
    assert done.stdout.strip() == "[]" and done.stderr == ""


@pytest.mark.real_data
def test_real_fragments_agree_with_open3d() -> None:
    o3d = pytest.importorskip("open3d")
    data = Path(os.environ.get("GEOMOE3D_DATA", Path(__file__).parents[2] / "shared" / "data"))
    files = sorted((data / "3dmatch-dev" / "fragments").glob("*/cloud_bin_1.ply"))
    if not files:
        pytest.skip(f"no real fragments under {data}; set GEOMOE3D_DATA to the folder that holds 3dmatch-dev")
    for path in files:
        expected = np.asarray(o3d.io.read_point_cloud(str(path)).points)
        assert np.array_equal(load_points(path).file_points, expected)
