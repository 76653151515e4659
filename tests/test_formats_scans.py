"""What scanners and their datasets write: KITTI and nuScenes, PTX, VTK's legacy files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cloud_files import UTM, fails, rigid, small_cloud

from geomoe3d.clouds.io import load_points, save_aligned
from geomoe3d.clouds.loading import read_raw
from geomoe3d.geometry.se3 import transform_points


@pytest.mark.parametrize("num", [100, 101])
@pytest.mark.parametrize("name", ["000000.bin", "sweep.pcd.bin"])
def test_sweeps_of_kitti_and_nuscenes(tmp_path: Path, num: int, name: str) -> None:
    rng = np.random.default_rng(0)
    sweep = np.column_stack([small_cloud(num), rng.uniform(0, 1, num)]).astype("<f4")
    (tmp_path / name).write_bytes(sweep.tobytes())
    cloud = read_raw(tmp_path / name)
    assert np.array_equal(cloud.points, sweep[:, :3]) and np.array_equal(
        cloud.fields["intensity"], sweep[:, 3]
    )
    rows = np.column_stack([sweep[:, :3], rng.integers(0, 256, num), np.arange(num) % 32]).astype("<f4")
    (tmp_path / name).write_bytes(rows.tobytes())
    cloud = read_raw(tmp_path / name)
    assert np.array_equal(cloud.points, rows[:, :3]) and list(cloud.fields) == ["intensity", "ring"]
    assert np.array_equal(cloud.fields["ring"], np.arange(num) % 32)


def test_other_bin_files(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"CCB2" + bytes(400))
    fails(path, "CloudCompare's own BIN")
    path.write_bytes(small_cloud().astype("<f8").tobytes()[:-3])
    fails(path, "neither rows of 4 floats")
    path.write_bytes(np.full((100, 4), 1e20, "<f4").tobytes())
    fails(path, "neither rows of 4 floats")
    path.write_bytes(np.ones((100, 4), "<f4").tobytes())
    fails(path, "as well rows of 4 floats")


def ptx(points: np.ndarray, T: np.ndarray, extra: str) -> str:
    """One scan of 5 columns; [p 1] M, so the matrix is written on its side."""
    rows = ["5", str(len(points) // 5), *(" ".join(map(repr, row)) for row in T[:3, [3, 0, 1, 2]].T.tolist())]
    rows += [" ".join(map(repr, row)) for row in T.T.tolist()]
    return "\n".join([*rows, *(f"{x!r} {y!r} {z!r} {extra}" for x, y, z in points.tolist())]) + "\n"


def test_ptx_scans_are_placed_by_their_poses(tmp_path: Path) -> None:
    first, second = small_cloud(50), small_cloud(30, 1)
    first[[3, 17]] = 0.0
    first[5, 1:] = 0.0  # on an axis, not missing
    first[6] = [1e-4, 0.0, 0.0]
    T = [rigid(1), rigid(2, tuple(UTM))]
    text = [ptx(first, T[0], "0.25 255 0 51"), ptx(second, T[1], "0 0 0 0")]
    (tmp_path / "a.ptx").write_text("".join(text))
    cloud = load_points(tmp_path / "a.ptx")
    kept = np.delete(first, [3, 17], axis=0)
    expected = np.concatenate([transform_points(T[0], kept), transform_points(T[1], second)])
    np.testing.assert_allclose(cloud.file_points, expected, rtol=0, atol=1e-8)
    assert cloud.num_non_finite == 2
    raw = read_raw(tmp_path / "a.ptx")
    assert np.array_equal(raw.fields["intensity"], np.repeat([0.25, 0.0], [50, 30]))
    np.testing.assert_allclose(raw.colors[[0, 79]], [[1, 0, 0.2], [0, 0, 0]])
    assert cloud.sensor is None  # two of them
    (tmp_path / "b.ptx").write_text(text[1])
    np.testing.assert_array_equal(load_points(tmp_path / "b.ptx").sensor, UTM)
    (tmp_path / "b.ptx").write_text(text[0] + ptx(second, T[1], "0.5"))
    assert "colours or intensity of some scans" in read_raw(tmp_path / "b.ptx").unread
    (tmp_path / "a.ptx").write_text(text[0] + "\n".join(text[1].splitlines()[:20]))
    fails(tmp_path / "a.ptx", "says 30 points", "holds 10")
    (tmp_path / "a.ptx").write_text(text[0][:40])
    fails(tmp_path / "a.ptx", "a.ptx")
    (tmp_path / "a.ptx").write_text("1 2 3\n4 5 6\n")
    fails(tmp_path / "a.ptx", "'1 2 3'")


@pytest.mark.parametrize("mode", ["ASCII", "BINARY"])
@pytest.mark.parametrize("version", ["3.0", "5.1"])
def test_vtk_points_with_their_data(tmp_path: Path, mode: str, version: str) -> None:
    points, num = small_cloud(40), 40
    values = {"intensity": np.linspace(0, 1, num), "ring": np.arange(num) % 16}
    colors = np.random.default_rng(0).integers(0, 256, (num, 3))

    def block(kind: str, array: np.ndarray) -> bytes:
        if mode == "BINARY":
            return np.asarray(array, dtype=">" + kind).tobytes() + b"\n"
        flat = np.ravel(array).tolist()
        return "".join(" ".join(map(repr, flat[k : k + 9])) + "\n" for k in range(0, len(flat), 9)).encode()

    out = f"# vtk DataFile Version {version}\nvtk output\n{mode}\nDATASET POLYDATA\n".encode()
    out += f"POINTS {num} double\n".encode()
    out += block("f8", points)
    if version == "5.1":
        out += b"METADATA\nINFORMATION 1\nNAME L2_NORM_RANGE LOCATION vtkDataArray\nDATA 2 0 1\n\n"
        out += b"VERTICES 2 40\nOFFSETS vtktypeint64\n" + block("i8", [0, 40])
        out += b"CONNECTIVITY vtktypeint64\n" + block("i8", np.arange(40))
    else:
        out += b"VERTICES 1 41\n" + block("i4", [40, *range(40)])
    out += b"POINT_DATA 40\nSCALARS intensity float\nLOOKUP_TABLE default\n" + block(
        "f4", values["intensity"]
    )
    out += b"NORMALS Normals float\n" + block("f4", np.tile([0, 0, 1], (num, 1)))
    out += b"FIELD FieldData 2\nring 1 40 int\n" + block("i4", values["ring"])
    out += b"RGB 3 40 unsigned_char\n" + block("u1", colors)
    (tmp_path / "a.vtk").write_bytes(out)
    cloud = read_raw(tmp_path / "a.vtk")
    assert np.array_equal(cloud.points, points) and cloud.unread == () and cloud.faces is None
    np.testing.assert_allclose(cloud.fields["intensity"], values["intensity"], atol=1e-7)
    assert np.array_equal(cloud.fields["ring"], values["ring"])
    assert np.array_equal(cloud.normals, np.tile([0, 0, 1.0], (num, 1)))
    np.testing.assert_allclose(cloud.colors, colors / 255)
    (tmp_path / "a.vtk").write_bytes(out[:700])
    fails(tmp_path / "a.vtk", "says 120 values of POINTS")


SQUARE = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n2 0 0\n"  # and a fifth point


def vtk(folder: Path, dataset: str, cells: str, version: str = "3.0") -> Path:
    text = f"# vtk DataFile Version {version}\nx\nASCII\nDATASET {dataset}\nPOINTS 5 float\n{SQUARE}{cells}"
    (folder / "a.vtk").write_text(text)
    return folder / "a.vtk"


@pytest.mark.parametrize(
    ("dataset", "cells", "faces", "unread"),
    [
        ("POLYDATA", "POLYGONS 2 9\n4 0 1 2 3\n3 1 4 2\n", [[0, 1, 2], [0, 2, 3], [1, 4, 2]], ()),
        ("POLYDATA", "POLYGONS 2 8\n3 0 1 2\n3 0 2 3\n", [[0, 1, 2], [0, 2, 3]], ()),
        ("POLYDATA", "TRIANGLE_STRIPS 1 5\n4 0 1 3 2\n", [[0, 1, 3], [3, 1, 2]], ()),
        ("POLYDATA", "LINES 1 3\n2 0 1\n", None, ("lines",)),
        ("POLYDATA", "VERTICES 2 4\n1 0\n1 3\n", None, ("vertices",)),
        (
            "UNSTRUCTURED_GRID",
            "CELLS 4 17\n3 0 1 2\n4 0 1 2 4\n4 0 1 2 3\n2 0 1\nCELL_TYPES 4\n5\n10\n9\n3\n",
            [[0, 1, 2], [0, 1, 2], [0, 2, 3]],
            ("cells that are no faces",),
        ),
        ("STRUCTURED_GRID\nDIMENSIONS 5 1 1", "", None, ("grid of 5 x 1 x 1",)),
    ],
)
def test_flat_cells_of_vtk_are_faces_and_others_are_named(
    tmp_path: Path, dataset: str, cells: str, faces: list[list[int]] | None, unread: tuple[str, ...]
) -> None:
    cloud = read_raw(vtk(tmp_path, dataset, cells))
    assert cloud.unread == unread
    assert (cloud.faces is None) if faces is None else (sorted(cloud.faces.tolist()) == sorted(faces))
    if faces is not None:
        assert len(load_points(tmp_path / "a.vtk", mesh_points=500)) == 500
        lost = save_aligned(tmp_path / "a.ply", tmp_path / "a.vtk", rigid())
        assert lost == unread and np.array_equal(read_raw(tmp_path / "a.ply").faces, cloud.faces)


def test_cells_of_vtk_that_do_not_add_up(tmp_path: Path) -> None:
    offsets = "POLYGONS 3 6\nOFFSETS vtktypeint64\n0 3 6\nCONNECTIVITY vtktypeint64\n0 1 2 0 2 3\n"
    assert np.array_equal(read_raw(vtk(tmp_path, "POLYDATA", offsets, "5.1")).faces, [[0, 1, 2], [0, 2, 3]])
    fails(vtk(tmp_path, "POLYDATA", offsets.replace("0 3 6", "0 9 6"), "5.1"), "out of order")
    fails(vtk(tmp_path, "POLYDATA", "POLYGONS 1 4\n3 0 1 9\n"), "beyond the 5")
    fails(vtk(tmp_path, "POLYDATA", "POLYGONS 2 8\n3 0 1 2\n7 0 2 3\n"), "do not come to the 8")
    fails(vtk(tmp_path, "UNSTRUCTURED_GRID", "CELLS 1 4\n3 0 1 2\n"), "0")


def test_other_vtk_files(tmp_path: Path) -> None:
    (tmp_path / "a.vtk").write_text('<VTKFile type="PolyData">')
    fails(tmp_path / "a.vtk", "no legacy VTK file", ".vtp")
    (tmp_path / "a.vtk").write_text("# vtk DataFile Version 3.0\nx\nASCII\nDATASET STRUCTURED_POINTS\n")
    fails(tmp_path / "a.vtk", "no POINTS")
    (tmp_path / "a.vtp").write_text("<VTKFile>")
    fails(tmp_path / "a.vtp", "VTK's XML", ".vtk")
