"""Columns of a file by their values: scales of colours, normals and colours without names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cloud_files import cloud, unit_vectors

from geomoe3d.clouds.io import load_points
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
