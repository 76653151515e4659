"""From a path, an array or a library's object to a recentred `PointCloud`.

The first step of the pipeline. Reading is O(N); a PLY of N points peaks at about twice the float64 array.
"""

from __future__ import annotations

import difflib
import gzip
import os
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.clouds.formats import (  # noqa: F401  each registers its readers and writers
    arrays,
    e57,
    gltf,
    las,
    lidar_bin,
    meshes,
    objects,
    pcd,
    ply,
    ptx,
    text,
    vtk,
)
from geomoe3d.clouds.formats.others import MEANT
from geomoe3d.clouds.formats.raw import RawCloud
from geomoe3d.clouds.formats.registry import READERS, take_inherited
from geomoe3d.clouds.recentre import choose_origin
from geomoe3d.config import expert
from geomoe3d.errors import (
    EmptyCloudError,
    ForbiddenFileError,
    FormatError,
    InputError,
    MissingFileError,
    NonFiniteError,
)
from geomoe3d.geometry.columns import finite_rows
from geomoe3d.runtime.home import ensure_home
from geomoe3d.runtime.threads import each
from geomoe3d.types import FloatArray, PointCloud

READABLE_SUFFIXES = tuple(READERS)


def load_points(
    data: Any, *, seed: int = 0, mesh_points: int = 100_000, name: str | None = None
) -> PointCloud:
    """The finite points of ``data`` in local coordinates, file coordinate = points + origin.

    Formats, by suffix in any case: PLY, PCD, XYZ/TXT/ASC/CSV, PTS, PTX, NPY, NPZ, VTK, the BIN of KITTI and
    nuScenes, the meshes OBJ, STL, OFF, GLB and GLTF, LAS/LAZ/COPC (extra ``geomoe3d[las]``) and E57 (extra
    ``geomoe3d[e57]``), each also behind .gz. Columns of text and of NPY files without names follow
    `formats.raw.split_columns`. The registry (`formats.registry`) takes readers of your own.

    Meshes are sampled evenly over their surface, without normals and colours. The exception is a PLY or VTK
    file with faces and at least 50 000 vertices: that is a dense reconstruction, whose vertices are the cloud.

    The origin follows `recentre.choose_origin`. Normals are brought to length 1; if any is zero or not
    finite all are dropped. Colours are in [0, 1].

    Args:
        data: a path (str or Path); an array-like of shape (N, 3), floats or integers of any size; a torch
            tensor; an Open3D PointCloud or TriangleMesh (legacy or tensor); a trimesh mesh, cloud or scene;
            or a PointCloud, whose origin is kept: as it is, if its points are finite float64 in one piece of
            memory, else a copy that is.
        seed: decides the points sampled on a mesh.
        mesh_points: points sampled on a mesh, at least 1.
        name: what to call the cloud in messages; None takes the file name, or "cloud" for data in memory.

    Returns:
        A cloud of at least one point that shares no memory with ``data`` (a given PointCloud excepted).

    Raises:
        InputError: no such file, a directory, not readable, an array of another shape or type, a mesh
            without area, or a coordinate beyond 1e12, where float64 no longer resolves fine detail.
        FormatError: an unknown suffix, or a file that is malformed, truncated or belies its header.
        EmptyCloudError: no points.
        NonFiniteError: every point has a NaN or infinite coordinate.
        DependencyError: the format's optional library is not installed.
    """
    if isinstance(data, PointCloud):
        return _checked(data if name is None else replace(data, name=name))
    if mesh_points < 1:
        raise InputError(f"mesh_points is {mesh_points}, expected at least 1")
    raw = read_raw(data)
    label = name if name is not None else Path(data).name if _is_path(data) else "cloud"
    what = describe(data) if name is None or _is_path(data) else f"'{name}'"
    cloud, num_non_finite = finite_part(raw, what)
    if is_sampled(data, cloud):
        cloud = RawCloud(meshes.sample_surface(cloud, mesh_points, seed, what))
    origin = choose_origin(cloud.points)
    points = cloud.points - origin if origin.any() else cloud.points
    return PointCloud(
        points=points,
        origin=origin,
        normals=None if cloud.normals is None else _unit(cloud.normals),
        colors=cloud.colors,
        name=label,
        num_non_finite=num_non_finite,
        notes=tuple(f"'{label}': {note}" for note in raw.notes),
        sensor=raw.sensor,
    )


def _checked(cloud: PointCloud) -> PointCloud:
    """The cloud itself, or a copy with what all that follows relies on: finite float64 rows without gaps.
    Raises InputError, EmptyCloudError, NonFiniteError: as `load_points`."""
    what, points = f"'{cloud.name}'", cloud.points
    whole = isinstance(points, np.ndarray) and points.dtype == np.float64 and points.flags.c_contiguous
    if not (whole and points.ndim == 2 and points.shape[1] == 3):
        points = objects.raw_from_object(points).points
    for name, values in (("normals", cloud.normals), ("colors", cloud.colors)):
        if values is not None and np.shape(values) != points.shape:
            raise InputError(f"{what}: {name} have shape {np.shape(values)}, expected {points.shape}")
    raw, num_non_finite = finite_part(RawCloud(points, cloud.normals, cloud.colors), what)
    if raw.points is cloud.points:
        return cloud
    num_non_finite += cloud.num_non_finite
    return replace(
        cloud, points=raw.points, normals=raw.normals, colors=raw.colors, num_non_finite=num_non_finite
    )


def load_both(source: Any, target: Any, seed: int) -> tuple[PointCloud, PointCloud]:
    """Both clouds of a pair as `load_points` gives them, with its errors; side by side what is in memory, since not all
    that reads files can be called by two threads."""

    def load(data: Any, role: str) -> PointCloud:
        return load_points(
            data, seed=seed, name=None if _is_path(data) or isinstance(data, PointCloud) else role
        )

    both = (source, "source"), (target, "target")
    if any(_is_path(data) for data, _ in both):
        return load(*both[0]), load(*both[1])
    first, second = each(lambda one: load(*one), both)
    return first, second


def describe(data: Any) -> str:
    """What to call given data in messages."""
    return f"'{os.fspath(data)}'" if _is_path(data) else "the cloud"


def is_sampled(data: Any, raw: RawCloud) -> bool:
    """Whether a mesh gives sampled surface points (True) or, as a cloud or a dense PLY or VTK, its vertices."""
    if raw.faces is None:
        return False
    is_scan = _is_path(data) and Path(str(data).lower().removesuffix(".gz")).suffix in (".ply", ".vtk")
    return not (is_scan and len(raw.points) >= expert().loading.dense_mesh)


def read_raw(data: Any) -> RawCloud:
    """Everything `load_points` accepts, in file coordinates, nothing dropped, meshes with their faces. Raises
    InputError, FormatError, EmptyCloudError, DependencyError: as `load_points`."""
    if isinstance(data, PointCloud):
        return RawCloud(data.file_points, data.normals, data.colors, sensor=data.sensor)
    if not _is_path(data):
        return objects.raw_from_object(data)
    if not os.fspath(data):
        raise InputError("an empty name is given for a cloud; give the path of a file")
    path = Path(data)
    take_inherited()
    try:
        if path.is_dir():
            raise InputError(f"'{path}' is a folder; give one file of it (`geomoe3d multiway` takes folders)")
        size = path.stat().st_size
        inner = path.with_suffix("") if path.suffix.lower() == ".gz" else path
        reader = READERS.get(inner.suffix.lower())
        if reader is None:
            raise FormatError(unknown_suffix(inner, tuple(READERS), "readable"))
        if size == 0:
            raise EmptyCloudError(f"'{path}' is an empty file (0 bytes)")
        with np.errstate(all="ignore"):  # files hold all kinds of numbers; what is not finite is dropped
            if inner is not path:
                with _unpacked(path) as plain:
                    return _raw(reader(plain))
            return _raw(reader(path))
    except FileNotFoundError as error:
        if error.filename is not None and Path(error.filename) != path:
            raise FormatError(f"'{path}' refers to a missing file '{error.filename}'") from None
        here = "" if path.is_absolute() else f" (folder now: {Path.cwd()})"
        raise MissingFileError(f"there is no file '{path}'; check the path{here}") from None
    except PermissionError:
        raise ForbiddenFileError(
            f"'{path}' may not be read: permission denied; check its owner and mode"
        ) from None
    except OSError as error:
        raise InputError(f"'{path}' cannot be read: {error.strerror or error}") from None


def _raw(read: Any) -> RawCloud:
    """What a reader gives, of the package or of a user's own."""
    return read if isinstance(read, RawCloud) else objects.raw_from_object(read)


@contextmanager
def _unpacked(path: Path) -> Iterator[Path]:
    """A temporary copy of a gzip file's content, under its name without .gz; messages name the file itself.
    Raises FormatError: no gzip file, damaged, or unpacking to more than 200 times its size."""
    ensure_home()
    try:
        tempfile.gettempdir()
    except FileNotFoundError:
        raise InputError(f"'{path}' cannot be unpacked: no folder for temporary files; set TMPDIR") from None
    with tempfile.TemporaryDirectory(prefix="geomoe3d-") as folder:
        plain = Path(folder, path.with_suffix("").name)
        try:
            with gzip.open(path) as packed, plain.open("wb") as out:
                while block := packed.read(1 << 20):
                    out.write(block)
                    if out.tell() > max(200 * path.stat().st_size, 1 << 24):
                        raise FormatError(
                            f"'{path}' unpacks to more than 200 times its size; unpack it first"
                        )
            yield plain
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            raise FormatError(f"'{path}' is no gzip file or damaged: {error}") from None
        except InputError as error:
            raise type(error)(str(error).replace(str(plain), str(path))) from None


def _is_path(data: Any) -> bool:
    return isinstance(data, (str, os.PathLike))


def unknown_suffix(path: Path, known: tuple[str, ...], verb: str) -> str:
    """A message that says what such a file is, or names a suffix of nearly the same letters, and all that are known."""
    suffix = path.suffix.lower()
    listed = f"{verb}: {', '.join(known)}"
    if not suffix:
        return f"'{path}' has no suffix to tell its format; {listed}"
    meant = next((what for what, suffixes in MEANT.items() if suffix in suffixes), None)
    if verb == "writable" and suffix in READERS:
        return f"'{path}': {suffix} is read here, but not written; {listed}"
    if meant is not None and verb == "readable":
        return f"'{path}' is {meant}; {listed}"
    close = [
        one
        for one in known
        if sorted(one) == sorted(suffix) or suffix.startswith(one) or one.startswith(suffix)
    ]
    close = close or difflib.get_close_matches(suffix, known, n=1, cutoff=0.86)
    nearest = f"did you mean {close[0]}? " if close else ""
    return f"'{path}' has the unknown suffix '{path.suffix}'; {nearest}{listed}"


def finite_part(raw: RawCloud, what: str) -> tuple[RawCloud, int]:
    """A cloud or mesh without the points that hold NaN or infinities, and their number.

    Raises:
        EmptyCloudError: no points at all.
        NonFiniteError: no finite point.
        InputError: a finite coordinate beyond `expert.loading.most_coordinate`.
    """
    num_points = len(raw.points)
    if not num_points:
        raise EmptyCloudError(f"{what} holds 0 points; at least 1 is needed")
    finite = finite_rows(raw.points)
    num_non_finite = num_points - int(np.count_nonzero(finite))
    if num_non_finite == num_points:
        raise NonFiniteError(f"{what}: all {num_points} points have a NaN or infinite coordinate")
    if num_non_finite:
        raw = raw.take(finite) if raw.faces is None else meshes.without_vertices(raw, finite)
    largest = max(float(raw.points.max()), -float(raw.points.min()))
    limit = expert().loading.most_coordinate
    if largest > limit:
        row = int(np.argmax(np.abs(raw.points).max(axis=1) > limit))
        raise InputError(
            f"{what}: finite point {row} is at {raw.points[row].tolist()}, beyond the limit of "
            f"{limit:g}; remove such points (they often stand for missing measurements) or use a "
            "larger unit"
        )
    return raw, num_non_finite


def without_missing(cloud: PointCloud) -> PointCloud:
    """A cloud without its points at exactly (0, 0, 0) in the file, where there is more than one and others are left.

    They stand for missing measurements, are counted with the non-finite points and named in the notes; one such
    point may be a point.
    """
    missing = (cloud.points == -cloud.origin).all(axis=1)
    count = int(np.count_nonzero(missing))
    if count < 2 or count == len(cloud):
        return cloud
    kept = ~missing
    note = f"'{cloud.name}': {count:,} points at exactly (0, 0, 0) stand for missing measurements and were left out"
    return replace(
        cloud,
        points=cloud.points[kept],
        normals=None if cloud.normals is None else cloud.normals[kept],
        colors=None if cloud.colors is None else cloud.colors[kept],
        num_non_finite=cloud.num_non_finite + count,
        notes=(*cloud.notes, note),
    )


def _unit(normals: FloatArray) -> FloatArray | None:
    """Normals of length 1, or None if one has no direction."""
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(normals, axis=1)
    if not (np.isfinite(lengths).all() and (lengths > 1e-12).all()):
        return None
    unit: FloatArray = normals / lengths[:, None]
    return unit
