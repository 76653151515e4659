"""Columns of a file by their values: scales of colours, normals and colours without names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cloud_files import cloud, fails, unit_vectors

from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.loading import read_raw
from geomoe3d.types import PointCloud


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


@pytest.mark.parametrize("suffix", [".txt", ".npy"])
def test_six_and_nine_columns_without_names(tmp_path: Path, suffix: str) -> None:
    points, normals = cloud(), unit_vectors(200)
    colors = np.random.default_rng(0).integers(0, 256, (200, 3)).astype(float)
    path = tmp_path / f"a{suffix}"

    def load(*parts: np.ndarray) -> PointCloud:
        table = np.concatenate(parts, axis=1)
        np.save(path, table) if suffix == ".npy" else np.savetxt(path, table, fmt="%.17g")
        return load_points(path)

    with_normals = load(points, normals)
    with_both = load(points, colors, normals)
    flags = np.eye(3)[np.arange(200) % 3]
    for loaded, has_normals in (
        (with_normals, True),
        (with_both, True),
        (load(points, normals, colors), True),
        (load(points, colors), False),
        (load(points, colors / 255), False),
        (load(points, flags), False),
        (load(points, normals * 300.0), False),
    ):
        assert np.array_equal(loaded.points, points)
        assert (loaded.normals is not None) == has_normals
        assert loaded.colors is None, "what could be colours could be intensity, ring and time"
    np.testing.assert_allclose(with_both.normals, normals, atol=1e-15)
    load(points, np.arange(200.0)[:, None] % 128)
    assert read_raw(path).fields["column_4"][129] == 1


@pytest.mark.parametrize("suffix", [".txt", ".npy"])
@pytest.mark.parametrize("numbers", [np.arange(200.0), 1000 + 10 * np.arange(200.0), np.arange(200.0) ** 2])
def test_a_leading_point_number_is_asked_about(tmp_path: Path, suffix: str, numbers: np.ndarray) -> None:
    path = tmp_path / f"a{suffix}"
    table = np.column_stack([numbers, cloud()])
    np.save(path, table) if suffix == ".npy" else np.savetxt(path, table, fmt="%.17g")
    fails(path, "point numbers", "name the columns", f"to {numbers[-1]:.0f}")
    if suffix == ".txt":
        path.write_text("id x y z\n" + path.read_text())
        np.testing.assert_array_equal(load_points(path).points, cloud())
    profile = np.column_stack([np.arange(200.0), cloud()[:, 1:]])  # three columns are coordinates
    np.save(path, profile) if suffix == ".npy" else np.savetxt(path, profile, fmt="%.17g")
    assert len(load_points(path)) == 200
