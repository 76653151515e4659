"""Saving clouds and moved sources: everything is moved, nothing is lost, bad places are refused."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from cloud_files import UTM, cloud, rigid, small_cloud, unit_vectors

from geomoe3d.clouds.io import (
    WRITABLE_MESH_SUFFIXES,
    WRITABLE_SUFFIXES,
    check_cloud_output,
    load_points,
    save_aligned,
    save_points,
)
from geomoe3d.errors import EmptyCloudError, FormatError, InputError, NonFiniteError, OutputError
from geomoe3d.geometry.se3 import make_transform, transform_points

# --- moved sources -------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", WRITABLE_SUFFIXES)
def test_save_aligned_moves_everything(tmp_path: Path, suffix: str) -> None:
    points, normals = cloud(center=UTM), unit_vectors(200)
    colors = np.random.default_rng(0).integers(1, 256, (200, 3)) / 255
    points[5] = np.nan
    np.savez(tmp_path / "source.npz", points=points, normals=normals, colors=colors)
    T = rigid()
    T[:3, 3] += UTM - T[:3, :3] @ UTM
    save_aligned(tmp_path / f"moved{suffix}", tmp_path / "source.npz", T)
    moved = load_points(tmp_path / f"moved{suffix}")
    kept = np.arange(200) != 5
    exact = (points[kept] - UTM) @ T[:3, :3].T + (T[:3, :3] @ UTM + T[:3, 3])
    np.testing.assert_allclose(
        moved.file_points, exact, rtol=0, atol=1e-6 if suffix in (".las", ".laz") else 1e-8
    )
    assert moved.num_non_finite == 0
    if suffix != ".npy":
        np.testing.assert_allclose(moved.normals, normals[kept] @ T[:3, :3].T, atol=1e-6)
        np.testing.assert_allclose(moved.colors, colors[kept], atol=1e-6)


@pytest.mark.parametrize("kind", ["ascii", "binary", "csv", "pcd", "las"])
def test_what_is_not_carried_over_is_named(tmp_path: Path, kind: str) -> None:
    points = np.round(cloud(20), 6)
    rows = "\n".join(f"{x} {y} {z} 7 2" for x, y, z in points)
    header = "ply\nformat {} 1.0\nelement vertex 20\n" + "".join(
        f"property double {name}\n" for name in ("x", "y", "z", "intensity", "label")
    )
    path = tmp_path / f"a.{kind if kind in ('csv', 'pcd', 'las') else 'ply'}"
    if kind == "ascii":
        path.write_text(header.format("ascii") + "end_header\n" + rows + "\n")
    elif kind == "binary":
        values = np.column_stack([points, np.full((20, 2), 7.0)]).astype("<f8")
        path.write_bytes(header.format("binary_little_endian").encode() + b"end_header\n" + values.tobytes())
    elif kind == "csv":
        path.write_text("x,y,z,intensity,label\n" + rows.replace(" ", ",") + "\n")
    elif kind == "pcd":
        head = "VERSION .7\nFIELDS x y z intensity label\nSIZE 8 8 8 8 8\nTYPE F F F F F\nCOUNT 1 1 1 1 1\n"
        path.write_text(head + "WIDTH 20\nHEIGHT 1\nPOINTS 20\nDATA ascii\n" + rows + "\n")
    else:
        laspy = pytest.importorskip("laspy")
        save_points(path, points)
        held = laspy.read(path)
        held.intensity[:] = 7
        held.write(path)
    expected = ("intensity",) if kind == "las" else ("intensity", "label")
    assert save_aligned(tmp_path / "b.npy", path, np.eye(4)) == expected
    save_points(tmp_path / "c.ply", points, normals=unit_vectors(20))
    assert save_aligned(tmp_path / "d.ply", tmp_path / "c.ply", np.eye(4)) == ()
    assert save_aligned(tmp_path / "d.npy", tmp_path / "c.ply", np.eye(4)) == ("normals",)
    np.savez(tmp_path / "e.npz", points=points, K=np.eye(3))
    assert save_aligned(tmp_path / "f.ply", tmp_path / "e.npz", np.eye(4)) == ("K",)


@pytest.mark.parametrize("source_suffix", [".obj", ".stl", ".ply", ".glb"])
@pytest.mark.parametrize("suffix", WRITABLE_MESH_SUFFIXES)
@pytest.mark.parametrize("center", [np.zeros(3), UTM], ids=["near", "far"])
def test_a_moved_mesh_stays_a_mesh(
    tmp_path: Path, source_suffix: str, suffix: str, center: np.ndarray
) -> None:
    trimesh = pytest.importorskip("trimesh")
    from geomoe3d.clouds.loading import read_raw

    box = trimesh.creation.box()
    source = tmp_path / f"box{source_suffix}"
    save_aligned(source, box, make_transform(np.eye(3), center))
    T = rigid()
    T[:3, 3] -= T[:3, :3] @ center
    save_aligned(tmp_path / f"moved{suffix}", source, T)
    raw = read_raw(tmp_path / f"moved{suffix}")
    assert raw.faces is not None and len(raw.faces) == 12
    corners = transform_points(rigid(), np.asarray(box.vertices)[box.faces])
    found = raw.points[raw.faces]
    order = [np.lexsort(np.round(c.mean(axis=1), 3).T) for c in (corners, found)]
    np.testing.assert_allclose(found[order[1]].mean(axis=1), corners[order[0]].mean(axis=1), atol=1e-6)


def test_glb_keeps_its_material(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    box = trimesh.creation.box()
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[10, 200, 30, 255], name="paint")
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    trimesh.Scene(box).export(tmp_path / "a.glb")
    save_aligned(tmp_path / "b.glb", tmp_path / "a.glb", rigid())
    (moved,) = trimesh.load(tmp_path / "b.glb").geometry.values()
    assert moved.visual.material.name == "paint"
    assert list(moved.visual.material.baseColorFactor[:3]) == [10, 200, 30]


def test_a_mesh_saved_as_a_cloud_is_the_cloud_that_is_loaded(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box().export(tmp_path / "a.obj")
    save_aligned(tmp_path / "b.npy", tmp_path / "a.obj", rigid())
    expected = transform_points(rigid(), load_points(tmp_path / "a.obj").file_points)
    np.testing.assert_allclose(load_points(tmp_path / "b.npy").file_points, expected, atol=1e-12)


def test_save_aligned_takes_arrays_and_loaded_clouds_and_may_replace_its_source(tmp_path: Path) -> None:
    points = cloud(center=UTM)
    for source in (points, load_points(points)):
        save_aligned(tmp_path / "a.npy", source, rigid(), force=True)
        expected = (points - UTM) @ rigid()[:3, :3].T + rigid()[:3, :3] @ UTM + rigid()[:3, 3]
        np.testing.assert_allclose(np.load(tmp_path / "a.npy"), expected, rtol=0, atol=1e-8)
    save_aligned(tmp_path / "a.npy", tmp_path / "a.npy", np.linalg.inv(rigid()), force=True)
    np.testing.assert_allclose(np.load(tmp_path / "a.npy"), points, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    "T",
    [
        np.eye(3),
        np.diag([2.0, 2, 2, 1]),
        np.diag([1.0, 1, -1, 1]),
        np.full((4, 4), np.nan),
        np.eye(4) * 2,
        "identity",
    ],
)
def test_save_aligned_wants_a_rigid_motion(tmp_path: Path, T: object) -> None:
    with pytest.raises(InputError, match="T_target_source"):
        save_aligned(tmp_path / "a.ply", small_cloud(), T)
    assert not list(tmp_path.iterdir())


def test_save_aligned_refuses_a_mesh_of_a_cloud(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="holds meshes") as caught:
        save_aligned(tmp_path / "a.obj", small_cloud(), np.eye(4))
    assert all(suffix in str(caught.value) for suffix in WRITABLE_SUFFIXES)
    with pytest.raises(NonFiniteError):
        save_aligned(tmp_path / "a.ply", np.full((3, 3), np.nan), np.eye(4))
    with pytest.raises(InputError, match="no file"):
        save_aligned(tmp_path / "a.ply", tmp_path / "none.ply", np.eye(4))
    assert not list(tmp_path.iterdir())


# --- output --------------------------------------------------------------------------------------------


def test_an_existing_file_is_kept_without_force(tmp_path: Path) -> None:
    path = tmp_path / "a.xyz"
    path.write_text("precious")
    for save in (
        lambda: save_points(path, small_cloud()),
        lambda: save_aligned(path, small_cloud(), np.eye(4)),
        lambda: check_cloud_output(path, False, WRITABLE_SUFFIXES),
    ):
        with pytest.raises(OutputError, match=r"--force \(force=True"):
            save()
        assert path.read_text() == "precious"
    save_points(path, small_cloud(), force=True)
    assert np.array_equal(load_points(path).points, small_cloud())


@pytest.mark.parametrize("suffix", WRITABLE_SUFFIXES)
def test_a_failed_write_leaves_the_old_file_and_no_rest(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from geomoe3d.clouds import saving

    path = tmp_path / f"a{suffix}"
    path.write_text("precious")
    real = saving.CLOUD_WRITERS[suffix]

    def full_disk(handle, cloud) -> None:
        real(handle, cloud)
        raise OSError(28, "No space left on device")

    monkeypatch.setitem(saving.CLOUD_WRITERS, suffix, full_disk)
    with pytest.raises(OutputError, match="No space left"):
        save_points(path, small_cloud(), force=True)
    assert path.read_text() == "precious"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_appears_meanwhile_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from geomoe3d.clouds import saving

    path = tmp_path / "a.npy"
    monkeypatch.setitem(saving.CLOUD_WRITERS, ".npy", lambda handle, cloud: path.write_text("precious"))
    with pytest.raises(OutputError, match="exists"):
        save_points(path, small_cloud())
    assert path.read_text() == "precious"
    assert list(tmp_path.iterdir()) == [path]


def test_links_are_followed_and_modes_are_ordinary(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    save_points(tmp_path / "folder" / "real.npy", small_cloud())
    plain = tmp_path / "plain"
    plain.touch()
    assert (tmp_path / "folder" / "real.npy").stat().st_mode == plain.stat().st_mode
    (tmp_path / "link.npy").symlink_to(tmp_path / "folder" / "real.npy")
    save_points(tmp_path / "link.npy", small_cloud() * 2, force=True)
    assert (tmp_path / "link.npy").is_symlink()
    assert np.array_equal(np.load(tmp_path / "folder" / "real.npy"), small_cloud() * 2)


def test_output_places_that_do_not_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert check_cloud_output(str(tmp_path / "a.PLY"), False, WRITABLE_SUFFIXES) == tmp_path / "a.PLY"
    (tmp_path / "folder.ply").mkdir()
    for path, error, word in (
        (tmp_path / "none" / "a.ply", OutputError, "does not exist"),
        (tmp_path / "folder.ply", OutputError, "it is a folder"),
        (tmp_path / "a.plyy", FormatError, "did you mean .ply?"),
        (tmp_path / "a.pts", FormatError, ".pts is read here, but not written"),
        (tmp_path / "a.e58", FormatError, ", ".join(WRITABLE_SUFFIXES)),
        (tmp_path / "a", FormatError, "no suffix"),
    ):
        for call in (
            lambda p: check_cloud_output(p, True, WRITABLE_SUFFIXES),
            lambda p: save_points(p, small_cloud()),
            lambda p: save_aligned(p, small_cloud(), np.eye(4)),
        ):
            with pytest.raises(error, match=word.replace("?", r"\?").replace(".", r"\.")[:60]):
                call(path)
    (tmp_path / "loop.ply").symlink_to(tmp_path / "loop.ply")
    with pytest.raises(OutputError, match="loop"):
        check_cloud_output(tmp_path / "loop.ply", True, WRITABLE_SUFFIXES)
    with pytest.raises(OutputError, match="too long"):
        check_cloud_output(tmp_path / ("a" * 300 + ".ply"), True, WRITABLE_SUFFIXES)
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)
    with pytest.raises(OutputError, match="no right to write"):
        check_cloud_output(tmp_path / "a.ply", True, WRITABLE_SUFFIXES)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_unwritable_and_unsearchable_folders(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for mode in (0o500, 0):
        (tmp_path / "folder").chmod(mode)
        with pytest.raises(OutputError, match=r"may not be written|[Pp]ermission denied"):
            save_points(tmp_path / "folder" / "a.ply", small_cloud())
    (tmp_path / "folder").chmod(0o700)


@pytest.mark.parametrize(
    ("points", "extras", "error", "word"),
    [
        (np.zeros((0, 3)), {}, EmptyCloudError, "empty"),
        (np.full((3, 3), np.nan), {}, NonFiniteError, "3 of 3 points"),
        (np.zeros((3, 2)), {}, InputError, r"\(3, 2\)"),
        (np.zeros((3, 3)), {"normals": np.zeros((2, 3))}, InputError, "3 points but 2 normals"),
        (np.zeros((3, 3)), {"colors": np.full((3, 3), 200.0)}, InputError, "divide"),
        (np.zeros((3, 3)), {"colors": np.full((3, 3), np.inf)}, NonFiniteError, "colours"),
    ],
)
def test_points_that_cannot_be_saved(
    tmp_path: Path, points: np.ndarray, extras: dict[str, np.ndarray], error: type[Exception], word: str
) -> None:
    with pytest.raises(error, match=word):
        save_points(tmp_path / "a.ply", points, **extras)
    assert not list(tmp_path.iterdir())


def test_npy_refuses_what_it_cannot_name(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"\.npz"):
        save_points(tmp_path / "a.npy", small_cloud(), normals=small_cloud())


def test_a_moved_obj_keeps_its_texture(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    from PIL import Image

    (tmp_path / "in").mkdir()
    (tmp_path / "out").mkdir()
    Image.new("RGB", (2, 2), (10, 200, 30)).save(tmp_path / "in" / "t.png")
    (tmp_path / "in" / "a.mtl").write_text("newmtl paint\nmap_Kd t.png\n")
    body = "v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 2 0 1 0 0\nvt 0 0\nvt 1 0\nvt 0 1\nvn 0 0 1\n"
    text = f"# by hand\nmtllib a.mtl\no thing\n{body}usemtl paint\nf 1/1/1 2/2/1 3/3/1\n"
    (tmp_path / "in" / "a.obj").write_text(text)
    notes: list[str] = []
    for folder in ("in", "out"):
        source = tmp_path / "in" / "a.obj"
        assert save_aligned(tmp_path / folder / "b.obj", source, rigid(), remark=notes.append) == ()
    assert len(notes) == 1 and "materials" in notes[0] and str(tmp_path / "in") in notes[0]
    assert "mtllib ../in/a.mtl\n" in (tmp_path / "out" / "b.obj").read_text()
    lines = (tmp_path / "in" / "b.obj").read_text().splitlines()
    assert lines[1] == "mtllib a.mtl"
    assert lines[2] == "o thing" and lines[-2:] == ["usemtl paint", "f 1/1/1 2/2/1 3/3/1"]
    np.testing.assert_allclose(np.array(lines[9].split()[1:], float), rigid()[:3, 2], atol=1e-15)
    assert lines[3].split()[4:] == ["1", "0", "0"]
    found = trimesh.load(tmp_path / "in" / "b.obj", process=False)
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0]])
    np.testing.assert_allclose(found.vertices, transform_points(rigid(), corners), atol=1e-12)
    assert found.visual.material.image.convert("RGB").getpixel((0, 0)) == (10, 200, 30)
    lost = save_aligned(tmp_path / "c.ply", tmp_path / "in" / "a.obj", rigid())
    assert lost == ("texture coordinates", "normals", "materials", "colors")
