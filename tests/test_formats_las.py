"""LAS and LAZ files: of laspy, nearly black, cut short, with a wrong count."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from cloud_files import UTM, cloud, fails, small_cloud

from geomoe3d.clouds.io import load_points, save_points
from geomoe3d.clouds.loading import read_raw


def test_las_stores_nearly_black_colors_unambiguously(tmp_path: Path) -> None:
    colors = np.full((5, 3), 0.003)  # 197 of 65535, which a reader would take for 8 bit
    save_points(tmp_path / "a.las", cloud(5), colors=colors)
    np.testing.assert_allclose(load_points(tmp_path / "a.las").colors, colors, atol=0.5 / 255)


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


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_truncated_and_lying_las(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("laspy")
    path = tmp_path / f"a{suffix}"
    save_points(path, small_cloud())
    whole = path.read_bytes()
    for cut in (1, 300, len(whole) - 250, len(whole) - 20):
        path.write_bytes(whole[:-cut])
        fails(path, path.name)
    path.write_bytes(whole[:-300])
    fails(path, "says 100 points", "holds")
    path.write_bytes(whole[:107] + struct.pack("<I", 150_000) + whole[111:])
    fails(path, "says 150000 points", "holds 100;" if suffix == ".las" else "holds 1 chunk of")
    path.write_bytes(whole[:107] + struct.pack("<I", 60) + whole[111:])  # PDAL reads so many too
    cloud = load_points(path)
    np.testing.assert_allclose(cloud.file_points, small_cloud()[:60], atol=1e-6)
    held = "the header says 60 points, the file holds 100; the rest is left out"
    assert [held in note for note in cloud.notes] == ([True] if suffix == ".las" else [])
    path.write_bytes(b"hello world" * 100)
    fails(path, "no LAS file")


def test_copc_is_the_laz_that_it_is(tmp_path: Path) -> None:
    """Chunks of different size, one per octree node, and records before and behind the points."""
    laspy, lazrs = pytest.importorskip("laspy"), pytest.importorskip("lazrs")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.001] * 3, UTM
    las = laspy.LasData(header)
    las.X, las.Y, las.Z = np.random.default_rng(0).integers(-(10**6), 10**6, (300, 3)).T
    las.intensity = np.arange(1, 301)
    las.write(tmp_path / "plain.las")
    plain = (tmp_path / "plain.las").read_bytes()
    rows = plain[struct.unpack("<I", plain[96:100])[0] :]
    record = lazrs.LazVlr.new_for_compression(6, 0, True)
    vlrs = b"".join(
        struct.pack("<H16sHH32s", 0, user, number, len(data), b"") + data
        for user, number, data in (
            (b"copc", 1, bytes(160)),
            (b"laszip encoded", 22204, record.record_data()),
        )
    )
    first = 375 + len(vlrs)
    with (tmp_path / "a.copc.laz").open("w+b") as handle:
        handle.write(bytes(first))
        packer = lazrs.LasZipCompressor(handle, record)
        for begin, end in ((0, 50), (50, 110), (110, 300)):
            packer.compress_many(np.frombuffer(rows[30 * begin : 30 * end], np.uint8))
            packer.finish_current_chunk()
        packer.done()
        handle.seek(0, 2)
        behind = handle.tell()
        handle.write(struct.pack("<H16sHQ32s", 0, b"copc", 1000, 32, b"") + bytes(32))
        head = bytearray(plain[:375])
        head[96:100], head[100:104] = struct.pack("<I", first), struct.pack("<I", 2)
        head[104] |= 128
        head[235:247] = struct.pack("<QI", behind, 1)
        handle.seek(0)
        handle.write(bytes(head) + vlrs)
    cloud = read_raw(tmp_path / "a.copc.laz")
    np.testing.assert_array_equal(cloud.points, read_raw(tmp_path / "plain.las").points)
    np.testing.assert_array_equal(cloud.fields["intensity"], np.arange(1, 301))


def test_a_damaged_size_of_chunks_takes_no_memory(tmp_path: Path) -> None:
    pytest.importorskip("laspy")
    save_points(tmp_path / "a.laz", small_cloud())
    whole = (tmp_path / "a.laz").read_bytes()
    place = whole.index(b"laszip encoded") - 2 + 54 + 12
    assert whole[place : place + 4] == struct.pack("<I", 50_000)
    (tmp_path / "a.laz").write_bytes(whole[:place] + struct.pack("<I", 9_421_648) + whole[place + 4 :])
    fails(tmp_path / "a.laz", "9421648 points per chunk and 100 in all")
