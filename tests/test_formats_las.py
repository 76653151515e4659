"""LAS and LAZ files: of laspy, nearly black, cut short, with a wrong count."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from cloud_files import UTM, cloud, fails, small_cloud

from geomoe3d.clouds.io import load_points, save_points


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
    fails(path, "says 150000 points", "holds 100;" if suffix == ".las" else "holds 1 chunks")
    path.write_bytes(whole[:107] + struct.pack("<I", 60) + whole[111:])  # PDAL reads so many too
    np.testing.assert_allclose(load_points(path).file_points, small_cloud()[:60], atol=1e-6)
    path.write_bytes(b"hello world" * 100)
    fails(path, "no LAS file")
