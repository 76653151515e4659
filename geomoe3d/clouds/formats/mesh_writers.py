"""Meshes as files: OBJ, OFF, STL and GLB, written anew, and OBJ with its points moved and all else as it was."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from geomoe3d.clouds.formats.meshes import load_scene, num_faces, placed
from geomoe3d.clouds.formats.raw import RawCloud
from geomoe3d.clouds.formats.registry import writer
from geomoe3d.clouds.formats.text import write_rows
from geomoe3d.clouds.recentre import choose_origin, fits_single_precision
from geomoe3d.errors import FormatError
from geomoe3d.geometry.se3 import make_transform, scale_of
from geomoe3d.types import FloatArray


def _lost(mesh: RawCloud, *names: str) -> tuple[str, ...]:
    """Which of normals and colours there are to lose, and the fields."""
    return (*(name for name in names if getattr(mesh, name) is not None), *mesh.fields)


@writer(".obj", mesh=True)
def write_obj(handle: BinaryIO, mesh: RawCloud) -> tuple[str, ...]:
    """Wavefront OBJ: vertices in full precision, with colours behind the coordinates, and triangles."""
    parts = [mesh.points] if mesh.colors is None else [mesh.points, mesh.colors]
    write_rows(handle, parts, prefix="v ")
    _write_faces(handle, mesh, "f ", 1)
    return _lost(mesh, "normals")


def moved_obj(path: Path, T: FloatArray, to: Path) -> bytes:
    """A Wavefront OBJ with its vertices and normals under a motion (4, 4) and every other line as it is.

    Args:
        path: the file.
        T: p_target = R p_source + t, R with its scale.
        to: where it will be written; the names of material files are made relative to that.

    Raises:
        FormatError: a vertex or a normal is no row of numbers.
    """
    lines = path.read_text(encoding="latin-1").split("\n")
    for word in ("v", "vn"):
        rows = [k for k, line in enumerate(lines) if line.split(None, 1)[:1] == [word]]
        words = [lines[k].split() for k in rows]
        try:
            values = np.array([w[1:4] for w in words], dtype=np.float64).reshape(-1, 3)
        except ValueError:
            raise FormatError(f"'{path}': a line that begins with '{word}' is not three numbers") from None
        if not len(values):
            continue
        moved = move_points(values, T) if word == "v" else values @ (T[:3, :3] / scale_of(T)).T
        for k, row, rest in zip(rows, moved.tolist(), words, strict=True):
            lines[k] = " ".join([word, *map(repr, row), *rest[4:]])
    for k, line in enumerate(lines):
        if line.startswith("mtllib "):
            library = path.resolve().parent / line[7:].strip()
            lines[k] = f"mtllib {Path(os.path.relpath(library, to.resolve().parent)).as_posix()}"
    return "\n".join(lines).encode("latin-1", errors="replace")


def move_points(points: FloatArray, T: FloatArray) -> FloatArray:
    """R p + t, computed about the cloud's own origin so that far coordinates keep their last digits."""
    R, t = T[:3, :3], T[:3, 3]
    finite = points[np.isfinite(points).all(axis=1)]
    origin = choose_origin(finite) if len(finite) else np.zeros(3)
    moved: FloatArray = (points - origin) @ R.T + (R @ origin + t)
    return moved


@writer(".off", mesh=True)
def write_off(handle: BinaryIO, mesh: RawCloud) -> tuple[str, ...]:
    """OFF: vertices in full precision and triangles, no colours."""
    handle.write(f"OFF\n{len(mesh.points)} {num_faces(mesh)} 0\n".encode("ascii"))
    write_rows(handle, [mesh.points])
    _write_faces(handle, mesh, "3 ", 0)
    return _lost(mesh, "normals", "colors")


def _write_faces(handle: BinaryIO, mesh: RawCloud, prefix: str, first: int) -> None:
    assert mesh.faces is not None
    lines = [f"{prefix}{a} {b} {c}\n" for a, b, c in (mesh.faces + first).tolist()]
    handle.write("".join(lines).encode("ascii"))


@writer(".stl", mesh=True)
def write_stl(handle: BinaryIO, mesh: RawCloud) -> tuple[str, ...]:
    """STL: binary where single precision suffices, else ASCII with every digit; no colours."""
    assert mesh.faces is not None
    corners = mesh.points[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    if not fits_single_precision(mesh.points):
        handle.write(b"solid geomoe3d\n")
        for normal, corner in zip(normals.tolist(), corners.tolist(), strict=True):
            lines = [f"facet normal {normal[0]:.6g} {normal[1]:.6g} {normal[2]:.6g}", "outer loop"]
            lines += [f"vertex {x!r} {y!r} {z!r}" for x, y, z in corner]
            handle.write(("\n".join([*lines, "endloop", "endfacet"]) + "\n").encode("ascii"))
        handle.write(b"endsolid geomoe3d\n")
        return _lost(mesh, "normals", "colors")
    rows = np.zeros(
        len(corners), dtype=np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("tag", "<u2")])
    )
    rows["normal"], rows["corners"] = normals, corners
    handle.write(b"geomoe3d".ljust(80) + struct.pack("<I", len(rows)) + rows.tobytes())
    return _lost(mesh, "normals", "colors")


def write_glb(handle: BinaryIO, geometry: Any, T: FloatArray) -> None:
    """GLB of a trimesh object or scene moved by T (4, 4), with its materials.

    GLB vertices are single precision, so each part is centred and its place goes into the node's matrix,
    which is text with all digits.
    """
    import trimesh

    scene: Any = trimesh.Scene()
    for item, place in placed(geometry):
        part = item.copy()
        center = choose_origin(np.asarray(part.vertices, dtype=np.float64))
        part.vertices = np.asarray(part.vertices) - center
        scene.add_geometry(part, transform=T @ place @ make_transform(np.eye(3), center))
    handle.write(scene.export(file_type="glb"))


def scene_of(source: Any, mesh: RawCloud) -> Any:
    """A trimesh object of the source: the file or object itself where trimesh knows it, for its materials."""
    import trimesh

    if isinstance(source, (str, os.PathLike)):
        if Path(source).suffix.lower() != ".ply":
            return load_scene(Path(source))
    elif isinstance(source, trimesh.parent.Geometry):
        return source
    colors = None if mesh.colors is None else np.rint(mesh.colors * 255.0).astype(np.uint8)
    return trimesh.Trimesh(mesh.points, mesh.faces, vertex_colors=colors, process=False)
