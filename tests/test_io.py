"""Clouds through every writable format and back, exact at map coordinates, and as Open3D reads them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cloud_files import MANY, UTM, cloud, unit_vectors
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from geomoe3d.clouds.io import WRITABLE_SUFFIXES, load_points, save_points

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
        atol = 0.5 / 255 + 1e-12 if suffix in (".ply", ".pcd", ".e57") else 0.0
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
