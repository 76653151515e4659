"""Writing clouds and moved sources: checked before work begins, complete or not at all.

The last step of the pipeline. Files are written beside their final name and moved there when they are whole;
nothing is replaced unasked. Memory is the cloud and one chunk; text formats write about 0.3 million rows per
second.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike

from geomoe3d.clouds.formats import arrays, las, meshes, pcd, ply, text
from geomoe3d.clouds.formats.objects import points_array
from geomoe3d.clouds.formats.raw import RawCloud
from geomoe3d.clouds.loading import describe, finite_part, is_sampled, read_raw, unknown_suffix
from geomoe3d.clouds.recentre import choose_origin
from geomoe3d.errors import FormatError, InputError, NonFiniteError
from geomoe3d.runtime.files import check_output, write_atomically
from geomoe3d.types import FloatArray

_CLOUD_WRITERS: dict[str, Callable[[BinaryIO, RawCloud], None]] = {
    ".ply": ply.write_ply,
    ".pcd": pcd.write_pcd,
    ".xyz": lambda handle, cloud: text.write_text(handle, cloud, ".xyz"),
    ".txt": lambda handle, cloud: text.write_text(handle, cloud, ".txt"),
    ".csv": lambda handle, cloud: text.write_text(handle, cloud, ".csv"),
    ".npy": arrays.write_npy,
    ".npz": arrays.write_npz,
    ".las": lambda handle, cloud: las.write_las(handle, cloud, compressed=False),
    ".laz": lambda handle, cloud: las.write_las(handle, cloud, compressed=True),
}
_MESH_WRITERS: dict[str, Callable[[BinaryIO, RawCloud], None]] = {
    ".ply": ply.write_ply,
    ".obj": meshes.write_obj,
    ".off": meshes.write_off,
    ".stl": meshes.write_stl,
}
_LACKING = {  # what a format cannot hold
    ".npy": ("normals", "colors"),
    ".obj": ("normals",),
    ".off": ("normals", "colors"),
    ".stl": ("colors",),  # its normals are those of the triangles
}
WRITABLE_SUFFIXES = tuple(_CLOUD_WRITERS)
WRITABLE_MESH_SUFFIXES = (*_MESH_WRITERS, ".glb")


def check_cloud_output(path: str | os.PathLike[str], force: bool, suffixes: tuple[str, ...]) -> Path:
    """Find out before work begins whether a cloud can be written there and under this suffix.

    Args:
        path: the file to be written.
        force: an existing file may be replaced.
        suffixes: allowed suffixes, lower case with dot; case does not matter in ``path``.

    Returns:
        The path, links followed.

    Raises:
        FormatError: another suffix; the message lists ``suffixes``.
        OutputError: as `geomoe3d.runtime.files.check_output`.
    """
    if Path(path).suffix.lower() not in suffixes:
        raise FormatError(unknown_suffix(Path(path), suffixes, "writable"))
    return check_output(path, force=force)


def _write(path: Path, fill: Callable[[BinaryIO], None], force: bool) -> None:
    """Let ``fill`` write a binary file that takes the name ``path`` only when it is whole."""

    def write(temporary: Path) -> None:
        with temporary.open("wb") as handle:
            fill(handle)

    write_atomically(path, write, force=force)


def save_points(
    path: str | os.PathLike[str],
    points: ArrayLike,
    *,
    normals: ArrayLike | None = None,
    colors: ArrayLike | None = None,
    force: bool = False,
) -> None:
    """Write points in file coordinates; the suffix decides the format.

    PLY (binary), NPY, NPZ, XYZ, TXT and CSV return every coordinate bit for bit. PCD holds floats where
    those move no coordinate by more than 1e-6 of the cloud's spread, and every digit elsewhere (`write_pcd`
    says why). LAS and LAZ round to a grid of a power of ten, at most 1e-8 of the extent: half of 1e-7 for a
    cloud of 100 units. Colours are kept to half of 1/255 by PLY and PCD, to half of 1/65535 by LAS (half of
    1/255 when all are nearly black), exactly by text and NPZ.

    Args:
        path: .ply, .pcd, .xyz, .txt, .csv, .npy, .npz, .las or .laz.
        points: (N, 3) finite, N >= 1.
        normals: (N, 3) finite or None.
        colors: (N, 3) in [0, 1] or None.
        force: replace an existing file.

    Raises:
        InputError: an array of another shape or type, or colours beyond [0, 1]; EmptyCloudError for no
            points, NonFiniteError for NaN or infinities.
        FormatError: an unknown suffix, or normals or colours for NPY, which cannot name them.
        OutputError: as `check_cloud_output`, or the disk refuses.
    """
    path = check_cloud_output(path, force, WRITABLE_SUFFIXES)
    cloud = RawCloud(
        points_array(points),
        None if normals is None else points_array(normals, "the normals"),
        None if colors is None else points_array(colors, "the colours"),
    )
    for what, extra in (("points", cloud.points), ("normals", cloud.normals), ("colours", cloud.colors)):
        if extra is None:
            continue
        if len(extra) != len(cloud.points):
            raise InputError(f"there are {len(cloud.points)} points but {len(extra)} {what}")
        bad = int(np.count_nonzero(~np.isfinite(extra).all(axis=1)))
        if bad:
            raise NonFiniteError(f"{bad} of {len(extra)} {what} hold NaN or infinities; remove them first")
    if cloud.colors is not None and (cloud.colors.min() < 0 or cloud.colors.max() > 1):
        raise InputError(
            f"colours must lie in [0, 1], found {cloud.colors.min():g} to {cloud.colors.max():g}; divide "
            "8 bit colours by 255"
        )
    if path.suffix.lower() == ".npy" and (normals is not None or colors is not None):
        raise FormatError(f"'{path}': NPY holds points only; choose .npz or .ply for normals and colours")
    _write(path, lambda handle: _CLOUD_WRITERS[path.suffix.lower()](handle, cloud), force)


def save_aligned(
    path: str | os.PathLike[str], source: Any, T_target_source: ArrayLike, *, force: bool = False
) -> tuple[str, ...]:
    """Write the source at full resolution in the target's file coordinates: p_target = R p_source + t.

    All finite points are moved, with their normals (turned) and colours; other attributes of the file are
    not carried over, NPY holds the points only, and what is lost is returned by name. A mesh written to PLY,
    OBJ, OFF, STL or GLB stays a mesh: its triangles are moved, GLB keeps materials, PLY normals and colours,
    OBJ colours. A mesh written to another suffix becomes the points that `load_points` takes from it.

    Args:
        path: a suffix of `save_points`, or for meshes .obj, .off, .stl or .glb.
        source: anything `load_points` takes.
        T_target_source: (4, 4) rigid motion in file coordinates.
        force: replace an existing file, which may be the source itself.

    Returns:
        Names of what the source says of its points and the written file does not.

    Raises:
        InputError: no rigid motion, or a source that cannot be used (as `load_points`).
        FormatError: a suffix that cannot be written, or a mesh suffix for a cloud.
        OutputError: as `check_cloud_output`, or the disk refuses.
    """
    T = _rigid(T_target_source)
    both = tuple(dict.fromkeys(WRITABLE_SUFFIXES + WRITABLE_MESH_SUFFIXES))
    path = check_cloud_output(path, force, both)
    suffix = path.suffix.lower()
    what = describe(source)
    raw, _ = finite_part(read_raw(source), what)
    as_mesh = raw.faces is not None and suffix in WRITABLE_MESH_SUFFIXES
    if not as_mesh and suffix not in WRITABLE_SUFFIXES:
        raise FormatError(
            f"'{path}': {suffix} holds meshes, but {what} is a cloud; writable: "
            + ", ".join(WRITABLE_SUFFIXES)
        )
    if not as_mesh and is_sampled(source, raw):
        raw = RawCloud(meshes.sample_surface(raw, 100_000, 0, what))

    def fill(handle: BinaryIO) -> None:
        if as_mesh and suffix == ".glb":
            meshes.write_glb(handle, meshes.scene_of(source, raw), T)
        elif as_mesh:
            _MESH_WRITERS[suffix](handle, _moved(raw, T))
        else:
            cloud = _moved(raw, T)
            _CLOUD_WRITERS[suffix](handle, RawCloud(cloud.points, cloud.normals, cloud.colors))

    _write(path, fill, force)
    if as_mesh and suffix == ".glb":
        return ()
    lacking = [name for name in _LACKING.get(suffix, ()) if getattr(raw, name) is not None]
    return (*raw.unread, *lacking)


def _moved(raw: RawCloud, T: FloatArray) -> RawCloud:
    """R p + t, computed about the cloud's own origin so that far coordinates keep their last digits."""
    R, t = T[:3, :3], T[:3, 3]
    origin = choose_origin(raw.points)
    points = (raw.points - origin) @ R.T + (R @ origin + t)
    return RawCloud(points, None if raw.normals is None else raw.normals @ R.T, raw.colors, raw.faces)


def _rigid(T: ArrayLike) -> FloatArray:
    try:
        matrix = np.asarray(T, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"T_target_source is no matrix of numbers: {type(T).__name__}") from None
    if matrix.shape != (4, 4):
        raise InputError(f"T_target_source has shape {matrix.shape}, expected (4, 4)")
    if not np.isfinite(matrix).all():
        raise InputError("T_target_source holds NaN or infinities: there is no transform to apply")
    error = float(np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max())
    bottom = np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max()
    if error > 1e-4 or bottom > 1e-9 or np.linalg.det(matrix[:3, :3]) < 0:
        raise InputError(
            f"T_target_source is no rigid motion: |R R^T - I| is {error:.3g} (limit 1e-4), the determinant "
            f"{np.linalg.det(matrix[:3, :3]):.3g} (expected 1), the last row {matrix[3].tolist()}"
        )
    return matrix
