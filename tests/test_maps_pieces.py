"""Files of clouds that are read piece by piece into a map: what is read is what reading them at once gives."""

from __future__ import annotations

import re

import numpy as np
import pytest
import trimesh

import geomoe3d
from geomoe3d import Map
from geomoe3d.clouds.formats.e57 import write_scans
from geomoe3d.clouds.formats.raw import RawCloud
from geomoe3d.clouds.formats.registry import READERS
from geomoe3d.clouds.io import load_points, save_points
from geomoe3d.errors import FormatError
from geomoe3d.geometry.se3 import make_transform
from geomoe3d.maps.pieces import pieces
from geomoe3d.maps.store import StaleMapError

UTM = np.array([583394.0, 5283100.0, 498.0])


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_binary_ply_of_points_is_read_in_pieces(tmp_path, order):
    row = np.dtype([("quality", "u1"), ("x", order + "f8"), ("y", order + "f8"), ("z", order + "f4")])
    rows = np.zeros(2500, dtype=row)
    rng = np.random.default_rng(0)
    for axis in "xyz":
        rows[axis] = rng.uniform(-50, 50, 2500)
    rows["x"][7] = np.nan
    kind = {"<": "little", ">": "big"}[order]
    types = zip(("uchar", "double", "double", "float"), row.names, strict=True)
    lines = ["ply", f"format binary_{kind}_endian 1.0", "element vertex 2500"]
    lines += [*(f"property {name} {axis}" for name, axis in types), "element face 0", "end_header"]
    path = tmp_path / "scan.ply"
    path.write_bytes("\n".join(lines).encode() + b"\n" + rows.tobytes())
    read = list(pieces(path, 1000).points)
    assert [len(points) for points, _ in read] == [999, 1000, 500]
    expected = load_points(path).file_points
    np.testing.assert_array_equal(np.vstack([points for points, _ in read]), expected)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(FormatError, match=r"2500.*2499"):
        pieces(path, 1000)


def test_a_ply_with_faces_or_in_text_is_read_at_once_as_elsewhere(tmp_path):
    corners = np.random.default_rng(0).uniform(size=(60, 3))
    text = tmp_path / "text.ply"
    header = (
        "ply\nformat ascii 1.0\nelement vertex 60\nproperty float x\nproperty float y\nproperty float z\n"
    )
    np.savetxt(text, corners, header=header + "end_header", comments="")
    mesh = trimesh.Trimesh(corners, np.arange(60).reshape(20, 3), process=False)
    mesh.export(tmp_path / "mesh.ply")
    for path in (text, tmp_path / "mesh.ply"):
        ((points, _),) = pieces(path, 10**6).points
        np.testing.assert_allclose(points, load_points(path).file_points, atol=1e-9)


@pytest.mark.parametrize("suffix", [".ply", ".las"])
def test_a_reader_of_the_users_own_is_asked_for_a_map_too(tmp_path, monkeypatch, suffix):
    points = np.random.default_rng(0).uniform(size=(60, 3))
    save_points(tmp_path / f"scan{suffix}", points)
    monkeypatch.setitem(READERS, suffix, lambda path: points + 100.0)
    ((read, _),) = pieces(tmp_path / f"scan{suffix}", 1000).points
    np.testing.assert_allclose(read, points + 100.0, atol=1e-9)


@pytest.mark.parametrize(("far", "believed"), [(2.0, True), (500.0, False)])
def test_a_pose_far_from_its_points_is_a_georeference_and_no_sensor(tmp_path, far, believed):
    pytest.importorskip("pye57")
    points = np.random.default_rng(1).uniform(0, 10, (300, 3))
    place = np.array([far, 2.0, 1.5])
    write_scans(
        tmp_path / "merged.e57", [("merged", RawCloud(points - place), make_transform(np.eye(3), place))]
    )
    ((read, sensor),) = pieces(tmp_path / "merged.e57", 1000).points
    np.testing.assert_allclose(read, points, atol=1e-6)
    assert (sensor is not None) == believed


def test_a_laz_is_read_in_pieces(tmp_path):
    pytest.importorskip("laspy")
    points = np.random.default_rng(6).uniform(0, 10, (2500, 3)) + UTM
    geomoe3d.save_points(tmp_path / "cloud.laz", points)
    read = [part for part, sensor in pieces(tmp_path / "cloud.laz", 1000).points]
    assert [len(part) for part in read] == [1000, 1000, 500]
    np.testing.assert_array_equal(
        np.concatenate(read), geomoe3d.load_points(tmp_path / "cloud.laz").file_points
    )


def test_of_an_e57_each_scan_is_read_with_its_sensor(tmp_path):
    pytest.importorskip("pye57")
    rng, stands = np.random.default_rng(6), np.array([[0.0, 0.0, 1.5], [4.0, 1.0, 1.6]])
    seen = [rng.uniform(0, 5, (1500, 3)) * (1, 1, 0.0), rng.uniform(0, 5, (700, 3)) * (1, 0.0, 1)]
    poses = [make_transform(np.eye(3), UTM + stand) for stand in stands]
    scans = [
        (f"scan {k}", RawCloud(part - stand), pose)
        for k, (part, stand, pose) in enumerate(zip(seen, stands, poses, strict=True))
    ]
    write_scans(tmp_path / "house.e57", scans)
    read = list(pieces(tmp_path / "house.e57", 1000).points)
    assert [len(part) for part, _ in read] == [1000, 500, 700]
    for (_, sensor), stand in zip(read, stands[[0, 0, 1]], strict=True):
        np.testing.assert_allclose(sensor, UTM + stand)
    np.testing.assert_allclose(np.concatenate([p for p, _ in read]), np.concatenate(seen) + UTM, atol=1e-6)
    voxels = Map.empty(voxel_size=0.3).with_cloud(tmp_path / "house.e57")._voxels
    floor = voxels.points + voxels.origin - UTM
    floor, towards = floor[:, 2] < 0.05, voxels.towards
    assert (towards[floor, 2] > 0).mean() > 0.9  # the first sensor stood above it


def turned(degrees, about):
    """(4, 4) turn about a vertical axis through a place."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return make_transform(R, about - R @ about)


def test_a_cloud_that_lies_millimetres_elsewhere_is_not_the_same_in_grid_coordinates():
    """Each is told by how far the cloud itself is off, not the zero of its coordinates, 5,000 km away."""
    cloud = np.random.default_rng(0).uniform(-5, 5, (2000, 3)) + UTM
    made = Map.empty().with_cloud(cloud, T_map_cloud=np.eye(4))
    rounded = make_transform(np.eye(3), np.array([0, 1e-9, 0]))
    assert made.with_cloud(cloud, T_map_cloud=rounded) is made
    moved = make_transform(np.eye(3), np.array([0, 0.005, 0]))
    for T, shift, turn in ((moved, 0.005, 0.0), (turned(0.01, cloud.mean(0)), 0.0, 0.01)):
        with pytest.raises(StaleMapError) as refused:
            made.with_cloud(cloud, T_map_cloud=T)
        found = re.search(r"shifted by (\S+) and turned by (\S+) deg", str(refused.value))
        assert [float(word) for word in found.groups()] == pytest.approx([shift, turn], abs=1e-5)
    # As a pose at national coordinates may be, where 5 mm are a billionth of the northing.
    far = Map.empty().with_cloud(cloud - UTM, T_map_cloud=make_transform(np.eye(3), UTM))
    with pytest.raises(StaleMapError, match=r"shifted by 0\.005 and turned by 0 deg"):
        far.with_cloud(cloud - UTM, T_map_cloud=make_transform(np.eye(3), UTM + moved[:3, 3]))
