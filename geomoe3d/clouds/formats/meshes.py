"""Meshes: OBJ, STL and OFF through trimesh, and surface sampling.

Sampling M points on F faces is O(F + M log F). Counts that STL and OFF state are held against the file
first; OBJ states none, so a truncated OBJ can only be noticed when a face names a missing vertex.
"""

from __future__ import annotations

import io
import logging
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.clouds.formats.raw import RawCloud, scale_colors
from geomoe3d.clouds.formats.registry import reader
from geomoe3d.clouds.recentre import choose_origin
from geomoe3d.errors import EmptyCloudError, FormatError, GeoMoE3DError, InputError, plain_reason
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.runtime.words import counted, shape_in_words
from geomoe3d.types import BoolArray, FloatArray, IntArray


def load_scene(path: Path) -> Any:
    """What trimesh makes of a mesh file: a mesh, a cloud or a scene. Raises FormatError: trimesh refuses the
    file, or a stated count or length is not borne out."""
    suffix = path.suffix.lower()
    size = _stl_size(path) if suffix == ".stl" else None
    if suffix == ".off":
        _check_off(path)
    import trimesh

    with _as_format_errors(path):
        if size is not None:  # trimesh refuses bytes behind the faces, which CAD programs leave
            return trimesh.load(io.BytesIO(path.read_bytes()[:size]), file_type="stl", process=False)
        return trimesh.load(str(path), process=False)


@contextmanager
def _as_format_errors(path: Path) -> Iterator[None]:
    """Turn whatever trimesh's loaders let through into `FormatError`, and keep its log off the terminal."""
    log = logging.getLogger("trimesh")
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        with np.errstate(all="ignore"):
            yield
    except (GeoMoE3DError, MemoryError, PermissionError):
        raise
    except Exception as error:
        kind = path.suffix[1:].upper()
        raise FormatError(f"'{path}' cannot be read as {kind}: {plain_reason(error)}") from None
    finally:
        log.setLevel(level)


_OBJ_WORDS = {
    "vt": "texture coordinates",
    "vn": "normals",
    "usemtl": "materials",
    "l": "lines",
    "colors": "colors",
}
_OFF_LETTERS = {"ST": "texture coordinates", "C": "colors", "N": "normals"}


@reader(".obj", ".stl", ".off")
def read_mesh(path: Path) -> RawCloud:
    """All geometry of a mesh file in one frame. Raises FormatError: as `load_scene`; EmptyCloudError: no geometry."""
    scene = load_scene(path)
    with _as_format_errors(path):
        mesh = flatten(scene, f"'{path}'")
        said = {".obj": _said_by_obj, ".off": _said_by_off, ".stl": _said_by_stl}[path.suffix.lower()](path)
    held = ("colors",) if mesh.colors is not None else ()
    return replace(
        mesh, unread=tuple(dict.fromkeys(name for name in (*said, *mesh.unread) if name not in held))
    )


def _said_by_obj(path: Path) -> list[str]:
    """What an OBJ says beside positions and faces."""
    with path.open(encoding="latin-1") as handle:
        rows = (line.split(None, 7) for line in handle if line.strip())
        words = {"colors" if row[0] == "v" and len(row) >= 7 else row[0] for row in rows}
    return [name for word, name in _OBJ_WORDS.items() if word in words]


def _said_by_off(path: Path) -> list[str]:
    """What an OFF says beside positions and faces: by the letters of its first line, and behind its faces."""
    with path.open(encoding="latin-1") as handle:
        rows = (line.partition("#")[0].split() for line in handle)
        rows = (row for row in rows if row)
        first = next(rows)
        counts = first[1:] if len(first) > 1 else next(rows)
        faces = islice(rows, int(counts[0]), int(counts[0]) + int(counts[1]))
        painted = any(len(row) > 1 + int(float(row[0])) for row in faces)
    kind = first[0].upper().removesuffix("OFF")
    said = [name for letters, name in _OFF_LETTERS.items() if letters in kind]
    return [*said, *(["face colors"] if painted else [])]


def _said_by_stl(path: Path) -> list[str]:
    """What a binary STL says of its faces beside their corners."""
    size = _stl_size(path)
    if size is None:
        return []
    rows = np.frombuffer(path.read_bytes()[84:size], np.uint8).reshape(-1, 50)
    return ["face attributes"] if rows[:, 48:].any() else []


def _stl_size(path: Path) -> int | None:
    """Bytes of a binary STL up to its last face; None for ASCII."""
    size = path.stat().st_size
    with path.open("rb") as handle:
        head = handle.read(84)
        said = struct.unpack("<I", head[80:84])[0] if len(head) == 84 else -1
        if head.lstrip().startswith(b"solid") and size != 84 + 50 * said:
            handle.seek(max(0, size - 200))
            if b"endsolid" not in handle.read():
                raise FormatError(f"'{path}' is truncated: an ASCII STL ends with 'endsolid'")
            return None
    held = max(0, size - 84) // 50
    if said < 0 or held < said:
        raise FormatError(
            f"'{path}': the header says {counted(max(said, 0), 'face')}, the file holds {held}; "
            "it is truncated or no STL"
        )
    return 84 + 50 * int(said)


def _check_off(path: Path) -> None:
    with path.open(encoding="latin-1") as handle:
        words = (line.partition("#")[0].split() for line in handle)
        rows = [row for row in words if row]
    if not rows or not rows[0][0].upper().endswith("OFF"):
        raise FormatError(f"'{path}' is no OFF file: its first line is not 'OFF'")
    counts = rows[0][1:] if len(rows[0]) > 1 else rows[1] if len(rows) > 1 else []
    first = 1 if len(rows[0]) > 1 else 2
    if len(counts) < 2 or not all(count.isdigit() for count in counts[:2]):
        raise FormatError(f"'{path}': the OFF header states no counts of vertices and faces")
    said, held = int(counts[0]) + int(counts[1]), len(rows) - first
    if said > held:
        raise FormatError(
            f"'{path}': the header says {counted(int(counts[0]), 'vertex', 'vertices')} and "
            f"{counted(int(counts[1]), 'face')}, that is {counted(said, 'line')}; "
            f"the file holds {held}; it is truncated or its header is wrong"
        )


def flatten(geometry: Any, what: str = "the trimesh object") -> RawCloud:
    """Vertices and triangles of a trimesh mesh, cloud or scene in one frame.

    Parts without faces count only where no part has any.

    Raises:
        EmptyCloudError: the object holds neither a mesh nor points.
        FormatError: a face names a missing vertex.
    """
    parts = []
    unread: list[str] = []
    for item, T in placed(geometry):
        vertices = np.array(item.vertices, dtype=np.float64)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise FormatError(
                f"{what}: the vertices are {shape_in_words(vertices.shape)}, expected x, y, z of each"
            )
        if not np.array_equal(T, np.eye(4)):  # keeps unmoved vertices exact
            vertices = transform_points(T, vertices)
        faces = (
            np.asarray(item.faces, dtype=np.int64) if hasattr(item, "faces") else np.empty((0, 3), np.int64)
        )
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise FormatError(
                f"{what}: a face names vertex {faces.max()}, there are {counted(len(vertices), 'vertex', 'vertices')}"
            )
        parts.append(RawCloud(vertices, None, _vertex_colors(item), faces))
        kind = str(getattr(item.visual, "kind", None))
        unread += {"texture": ["texture coordinates", "materials"], "face": ["face colors"]}.get(kind, [])
    if not sum(len(part.points) for part in parts):
        raise EmptyCloudError(f"{what} holds 0 points: no mesh and no point cloud")
    if any(num_faces(part) for part in parts):
        unread += ["points without faces"] if not all(num_faces(part) for part in parts) else []
        parts = [part for part in parts if num_faces(part)]
    starts = np.cumsum([0] + [len(part.points) for part in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    colors = [part.colors for part in parts if part.colors is not None]
    unread += ["colors of some parts"] if 0 < len(colors) < len(parts) else []
    return RawCloud(
        np.concatenate([part.points for part in parts]),
        colors=np.concatenate(colors) if len(colors) == len(parts) else None,
        faces=faces if len(faces) else None,
        unread=tuple(dict.fromkeys(unread)),
    )


def num_faces(part: RawCloud) -> int:
    """Triangles of a mesh; none where it is a cloud."""
    return 0 if part.faces is None else len(part.faces)


def placed(geometry: Any) -> list[tuple[Any, FloatArray]]:
    """Each part that has vertices, with the affine (4, 4) that places it: p_file = A p_part + t."""
    if not hasattr(geometry, "graph"):
        return [(geometry, np.eye(4))] if hasattr(geometry, "vertices") else []
    placed = []
    for node in geometry.graph.nodes_geometry:
        T, name = geometry.graph[node]
        item = geometry.geometry[name]
        if hasattr(item, "faces") or type(item).__name__ == "PointCloud":
            placed.append((item, np.asarray(T, dtype=np.float64)))
    return placed


def _vertex_colors(item: Any) -> FloatArray | None:
    if getattr(item.visual, "kind", None) != "vertex":
        return None
    colors = np.asarray(item.visual.vertex_colors)
    return scale_colors(colors[:, :3]) if colors.ndim == 2 and len(colors) == len(item.vertices) else None


def without_vertices(mesh: RawCloud, kept: BoolArray) -> RawCloud:
    """The vertices of a mask, and the faces of which every corner is kept; None where no face is left."""
    assert mesh.faces is not None
    rows = np.cumsum(kept) - 1
    faces: IntArray = rows[mesh.faces[kept[mesh.faces].all(axis=1)]]
    return replace(mesh.take(kept), faces=faces if len(faces) else None)


def sample_surface(mesh: RawCloud, num_points: int, seed: int, what: str) -> FloatArray:
    """Points (num_points, 3) spread evenly over the area of a finite mesh, the same for the same seed. Raises
    InputError: the surface has no area."""
    import trimesh

    origin = choose_origin(mesh.points)  # areas of small triangles far from zero would drown in rounding
    body = trimesh.Trimesh(mesh.points - origin, mesh.faces, process=False)
    if not body.area > 0:
        raise InputError(
            f"{what}: all {counted(num_faces(mesh), 'face')} of the mesh are degenerate (area 0)"
        )
    points = trimesh.sample.sample_surface(body, num_points, seed=seed)[0]
    return np.asarray(points, dtype=np.float64) + origin
