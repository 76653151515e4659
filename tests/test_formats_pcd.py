"""PCD files: of Open3D and in the style of PCL; headers that lie, files cut short."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from cloud_files import UTM, cloud, fails, pcd, small_cloud, unit_vectors

from geomoe3d.clouds.io import load_points, save_points
from geomoe3d.clouds.loading import read_raw
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.registration import Registrar


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


# --- truncated files and lying headers -----------------------------------------------------------------


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize(("said", "held"), [(150, 100), (60, 100)])
def test_pcd_count_that_is_not_there(tmp_path: Path, data: str, said: int, held: int) -> None:
    (tmp_path / "a.pcd").write_bytes(pcd(held, held, data))
    assert np.array_equal(load_points(tmp_path / "a.pcd").points, small_cloud(held)) or data == "ascii"
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
    fails(tmp_path / "a.pcd", "compressed part is damaged")
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


@pytest.mark.parametrize("rows", [60, 5000])
def test_all_modes_give_the_same_cloud(tmp_path: Path, rows: int) -> None:
    """Also where the compressed form repeats itself, and with fields of any width and of several values."""
    points = np.round(small_cloud(rows), 1).astype("<f4")
    ring, time = np.arange(rows, dtype="<u2") % 64, np.linspace(0, 0.1, rows)
    rgb = np.full(rows, 0x00FF8040, "<u4")
    histogram = np.ones((rows, 3), "<f4")
    head = "VERSION 0.7\nFIELDS x y z _ ring time rgb fpfh\nSIZE 4 4 4 1 2 8 4 4\nTYPE F F F U U F U F\n"
    head += f"COUNT 1 1 1 4 1 1 1 3\nWIDTH {rows // 10}\nHEIGHT 10\nVIEWPOINT 1 0 0 1 0 0 0\nDATA "
    columns = [*points.T, np.zeros((rows, 4), "u1"), ring, time, rgb, histogram]
    table = np.column_stack([column.reshape(rows, -1).astype(float) for column in columns])
    text = "\n".join(" ".join(f"{value:.17g}" for value in row) for row in table)
    (tmp_path / "ascii.pcd").write_text(f"{head}ascii\n{text}\n")
    types = "f4, f4, f4, 4u1, u2, f8, u4, 3f4"
    body = np.empty(rows, types)
    for k, column in enumerate(columns):
        body[f"f{k}"] = column
    (tmp_path / "binary.pcd").write_bytes(f"{head}binary\n".encode() + body.tobytes())
    plain = b"".join(np.ascontiguousarray(column).tobytes() for column in columns)
    packed = lzf(plain)
    assert len(packed) < 0.7 * len(plain)
    sizes = struct.pack("<II", len(packed), len(plain))
    (tmp_path / "lzf.pcd").write_bytes(f"{head}binary_compressed\n".encode() + sizes + packed)
    for name in ("ascii", "binary", "lzf"):
        cloud = read_raw(tmp_path / f"{name}.pcd")
        np.testing.assert_allclose(cloud.points, points, atol=1e-6)
        np.testing.assert_array_equal(cloud.fields["ring"], ring)
        np.testing.assert_array_equal(cloud.fields["time"], time)
        assert set(cloud.fields) == {"ring", "time"} and cloud.fields["ring"].dtype == np.uint16
        np.testing.assert_allclose(cloud.colors, np.tile([1, 128 / 255, 64 / 255], (rows, 1)))
        pose = "sensor pose (VIEWPOINT 1 0 0 1 0 0 0)"
        (note,) = load_points(tmp_path / f"{name}.pcd").notes
        assert note.startswith(f"'{name}.pcd': {pose} is not applied")
        assert cloud.unread == ("fpfh", pose, f"grid of {rows // 10} x 10")
        np.testing.assert_array_equal(cloud.sensor, [1, 0, 0])


@pytest.mark.parametrize(
    "viewpoint",
    ["0 0 0 1 0 0 0", "0 0 0 0.6 0.8 0 0", "nan 0 0 1 0 0 0", "1 2 3", "1 2 3 0 0 0 0", "a b c 1 0 0 0"],
)
def test_a_viewpoint_that_says_nothing_of_the_place(tmp_path: Path, viewpoint: str) -> None:
    (tmp_path / "a.pcd").write_bytes(pcd(9, 9, "ascii").replace(b"0 0 0 1 0 0 0", viewpoint.encode()))
    assert load_points(tmp_path / "a.pcd").sensor is None


def test_the_sensors_place_makes_georeferenced_scans_as_good_as_those_about_the_sensor(
    tmp_path: Path,
) -> None:
    source, target, _ = make_sample_pair()
    save_points(tmp_path / "source.ply", source.file_points)
    save_points(tmp_path / "target.ply", target.file_points)
    for name, shift, scan in (("source", UTM, source), ("target", UTM + 100.0, target)):
        save_points(tmp_path / f"{name}.pcd", scan.file_points + shift)
        text = (tmp_path / f"{name}.pcd").read_bytes()
        place = " ".join(map(repr, shift.tolist()))
        (tmp_path / f"{name}.pcd").write_bytes(
            text.replace(b"VIEWPOINT 0 0 0", f"VIEWPOINT {place}".encode())
        )
    known = Registrar().explain(tmp_path / "source.ply", tmp_path / "target.ply").result
    found = Registrar().explain(tmp_path / "source.pcd", tmp_path / "target.pcd")
    places = [
        place + scan.origin
        for place, scan in zip(found.correspondences.viewpoints, (found.source, found.target), strict=True)
    ]
    np.testing.assert_array_equal(places, [UTM, UTM + 100.0])
    T = found.result.T_target_source
    np.testing.assert_allclose(T[:3, :3], known.T_target_source[:3, :3], atol=0.01)
    np.testing.assert_allclose(
        T[:3, :3] @ UTM + T[:3, 3], known.T_target_source[:3, 3] + UTM + 100.0, atol=0.02
    )


def lzf(plain: bytes) -> bytes:
    """A simple packer: what was seen in the last 8 KB is referred to, also where it runs into itself."""
    out, literal, place = bytearray(), bytearray(), 0
    seen: dict[bytes, int] = {}

    def flush() -> None:
        for k in range(0, len(literal), 32):
            out.append(len(literal[k : k + 32]) - 1)
            out.extend(literal[k : k + 32])
        literal.clear()

    while place < len(plain):
        key = plain[place : place + 3]
        back = place - seen.get(key, place)
        seen[key] = place
        if len(key) < 3 or not 0 < back <= 8192:
            literal.append(plain[place])
            place += 1
            continue
        length = 3
        while (
            length < 264
            and place + length < len(plain)
            and plain[place + length - back] == plain[place + length]
        ):
            length += 1
        flush()
        code = min(length - 2, 7)
        out.append(code << 5 | (back - 1) >> 8)
        if code == 7:
            out.append(length - 9)
        out.append((back - 1) & 255)
        place += length
    flush()
    return bytes(out)
