"""Velocities and other directions among the fields of a cloud: turned, or named where they are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cloud_files import rigid, small_cloud, unit_vectors

from geomoe3d.clouds.io import save_aligned
from geomoe3d.clouds.loading import read_raw
from geomoe3d.clouds.vectors import turned

R = rigid()[:3, :3]
NUM = 20


def fields(*names: str, kind: type = np.float32) -> dict[str, np.ndarray]:
    values = np.random.default_rng(len(names)).normal(size=(len(names), NUM)).astype(kind)
    return dict(zip(names, values, strict=True))


@pytest.mark.parametrize(
    "names",
    ["vx vy vz", "velocity_x velocity_y velocity_z", "Velocity:0 Velocity:1 Velocity:2",
     "scalar_Nx scalar_Ny scalar_Nz",
     "vx_comp vy_comp vz_comp", "principal_curvature_x principal_curvature_y principal_curvature_z",
     "rel_vel_X rel_vel_Y rel_vel_Z", "normals_0 normals_1 normals_2"],
)  # fmt: skip
def test_directions_are_turned(names: str) -> None:
    had = {"ring": np.arange(NUM), **fields(*names.split())}
    has, stayed = turned(had, R)
    assert stayed == () and list(has) == list(had) and has["ring"] is had["ring"]
    expected = np.stack([had[name] for name in names.split()], axis=1) @ R.T
    for k, name in enumerate(names.split()):
        assert has[name].dtype == np.float32
        np.testing.assert_allclose(has[name], expected[:, k], atol=1e-6)


@pytest.mark.parametrize(
    "names",
    ["vx vy", "vx_comp vy_comp", "x_origin y_origin z_origin", "qx qy qz", "rot_0 rot_1 rot_2 rot_3", "azimuth",
     "f_rest_0 f_rest_44", "sensor_x sensor_y sensor_z"],
)  # fmt: skip
def test_what_is_not_known_to_be_a_direction_is_named(names: str) -> None:
    had = fields(*names.split())
    has, stayed = turned(had, R)
    assert stayed == tuple(names.split())
    assert all(has[name] is had[name] for name in had)


@pytest.mark.parametrize(
    "names",
    ["intensity ring time", "index y_score", "scalar_field", "column_4 column_5 column_6", "max min", "label_0 label_1",
     "return_number number_of_returns", "nir", "f_dc_0 f_dc_1 f_dc_2", "scale_0 scale_1 scale_2", "gps_time"],
)  # fmt: skip
def test_other_fields_are_left_alone(names: str) -> None:
    had = fields(*names.split())
    has, stayed = turned(had, R)
    assert stayed == () and all(has[name] is had[name] for name in had)


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".txt", ".csv", ".npz", ".las"])
def test_an_aligned_cloud_has_its_velocities_turned(tmp_path: Path, suffix: str) -> None:
    v, own = unit_vectors(NUM), small_cloud(NUM, 5)
    held = {
        **dict(zip(("vx", "vy", "vz"), v.T, strict=True)),
        **dict(zip(("sx0", "sy0", "sz0"), own.T, strict=True)),
    }
    np.savez(tmp_path / "a.npz", points=small_cloud(NUM), intensity=np.arange(NUM), **held)
    lost = save_aligned(tmp_path / f"b{suffix}", tmp_path / "a.npz", rigid())
    assert lost == ("sx0, sy0, sz0 (kept, not turned)",)
    found = read_raw(tmp_path / f"b{suffix}").fields
    np.testing.assert_allclose(np.stack([found[f"v{axis}"] for axis in "xyz"], axis=1), v @ R.T, atol=1e-12)
    np.testing.assert_array_equal(found["sx0"], own[:, 0])
    np.testing.assert_array_equal(found["intensity"], np.arange(NUM))


def test_vectors_of_vtk(tmp_path: Path) -> None:
    text = "# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\nPOINTS 2 double\n1 2 3\n4 5 6\nPOINT_DATA 2\n"
    (tmp_path / "a.vtk").write_text(text + "VECTORS velocity double\n1 0 0\n0 1 0\n")
    assert save_aligned(tmp_path / "a.ply", tmp_path / "a.vtk", rigid()) == ()
    found = read_raw(tmp_path / "a.ply").fields
    np.testing.assert_allclose([found[f"velocity_{axis}"] for axis in "xyz"], R[:, :2], atol=1e-15)
