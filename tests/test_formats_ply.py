"""PLY files: every order and type, other elements, polygons; headers that lie, files cut short."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from cloud_files import UTM, assert_on_box, cloud, fails, ply, small_cloud, unit_vectors

from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.loading import read_raw
from geomoe3d.errors import EmptyCloudError

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


# --- truncated files and lying headers -----------------------------------------------------------------


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
        ("property double x", "property list uchar double x", "only: y, z"),
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


@pytest.mark.parametrize("fmt", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("ragged", [False, True])
def test_lists_of_vertices_are_stepped_over(tmp_path: Path, fmt: str, ragged: bool) -> None:
    """As photogrammetry writes them: which cameras see a point, and how well."""
    points, views = small_cloud(300), np.random.default_rng(0).integers(0, 5 if ragged else 1, 300)
    header = f"ply\nformat {fmt} 1.0\nelement vertex 300\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz")
    header += "property list uchar uint view_indices\nproperty uchar level\nproperty list int float weights\n"
    header += "element face 2\nproperty list uchar int vertex_indices\nproperty float quality\nend_header\n"
    order = ">" if "big" in fmt else "<"
    rows = []
    for k, (p, n) in enumerate(zip(points, views.tolist(), strict=True)):
        if fmt == "ascii":
            numbers = [*map(repr, p.tolist()), n, *range(n), k % 7, n, *([0.5] * n)]
            rows.append(" ".join(map(str, numbers)).encode() + b"\n")
        else:
            rows.append(struct.pack(f"{order}3dB{n}IBi{n}f", *p, n, *range(n), k % 7, n, *([0.5] * n)))
    faces = b"3 0 1 2 0.5\n4 3 4 5 6 1.5\n"
    if fmt != "ascii":
        faces = struct.pack(f"{order}B3ifB4if", 3, 0, 1, 2, 0.5, 4, 3, 4, 5, 6, 1.5)
    (tmp_path / "a.ply").write_bytes(header.encode() + b"".join(rows) + faces)
    cloud = read_raw(tmp_path / "a.ply")
    assert np.array_equal(cloud.points, points)
    assert np.array_equal(cloud.faces, [[0, 1, 2], [3, 4, 5], [3, 5, 6]])
    assert (
        np.array_equal(cloud.fields["level"], np.arange(300) % 7) and cloud.fields["level"].dtype == np.uint8
    )
    assert cloud.unread == ("view_indices", "weights", "face quality")
    (tmp_path / "a.ply").write_bytes(header.encode() + b"".join(rows[:200]))
    fails(tmp_path / "a.ply", "says 300 rows of 'vertex'", "holds 200;")


@pytest.mark.parametrize("fmt", ["ascii", "binary_little_endian"])
def test_a_cloud_may_declare_no_faces(tmp_path: Path, fmt: str) -> None:
    more = b"element face 0\nproperty list uchar int vertex_indices\nproperty uchar flag\nend_header\n"
    (tmp_path / "a.ply").write_bytes(ply(50, 50, fmt).replace(b"end_header\n", more))
    assert read_raw(tmp_path / "a.ply").faces is None
    assert np.array_equal(load_points(tmp_path / "a.ply").file_points, small_cloud(50))


def test_ascii_values_may_run_over_lines(tmp_path: Path) -> None:
    words = ply(50, 50).decode().split("end_header\n")
    (tmp_path / "a.ply").write_text(words[0] + "end_header\n" + "\n".join(words[1].split()) + "\n")
    assert np.array_equal(load_points(tmp_path / "a.ply").file_points, small_cloud(50))


def test_equal_names_of_properties(tmp_path: Path) -> None:
    text = ply(2, 0).decode().replace("property double z\n", "property double z\nproperty float z\n")
    (tmp_path / "a.ply").write_text(text + "1 2 3 4\n5 6 7 8\n")
    cloud = read_raw(tmp_path / "a.ply")
    assert np.array_equal(cloud.points, [[1, 2, 3], [5, 6, 7]]) and np.array_equal(cloud.fields["z"], [4, 8])
