"""Writing clouds and moved sources: checked before work begins, complete or not at all.

The last step of the pipeline. Files are written beside their final name and moved there when they are whole;
nothing is replaced unasked. Memory is the cloud and one chunk; text formats write about 0.3 million rows per
second.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomoe3d.clouds.formats import e57, gltf, las, mesh_writers, meshes
from geomoe3d.clouds.formats.objects import points_array
from geomoe3d.clouds.formats.raw import RawCloud
from geomoe3d.clouds.formats.registry import CLOUD_WRITERS, MESH_WRITERS, take_inherited
from geomoe3d.clouds.loading import describe, finite_part, is_sampled, load_points, read_raw, unknown_suffix
from geomoe3d.clouds.recentre import choose_origin, fits_single_precision
from geomoe3d.clouds.vectors import turned
from geomoe3d.errors import FormatError, InputError, NonFiniteError
from geomoe3d.geometry.se3 import scale_of
from geomoe3d.runtime.files import check_output, write_atomically
from geomoe3d.runtime.threads import usable_threads
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray

WRITABLE_SUFFIXES = tuple(CLOUD_WRITERS)
WRITABLE_MESH_SUFFIXES = (*MESH_WRITERS, ".glb")


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


def _write(path: Path, fill: Callable[[BinaryIO], object], force: bool) -> None:
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
        path: .ply, .pcd, .xyz, .txt, .asc, .csv, .npy, .npz, .las, .laz or .e57.
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
    take_inherited()
    path = check_cloud_output(path, force, tuple(CLOUD_WRITERS))
    cloud = RawCloud(
        points_array(points),
        None if normals is None else points_array(normals, "the normals"),
        None if colors is None else points_array(colors, "the colours"),
    )
    for what, extra in (("points", cloud.points), ("normals", cloud.normals), ("colours", cloud.colors)):
        if extra is None:
            continue
        if len(extra) != len(cloud.points):
            raise InputError(f"there are {counted(len(cloud.points), 'point')} but {len(extra)} {what}")
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
    _write(path, lambda handle: CLOUD_WRITERS[path.suffix.lower()](handle, cloud), force)


def check_aligned(
    path: str | os.PathLike[str],
    source: Any,
    *,
    precision: str = "auto",
    distances: bool = False,
    force: bool = False,
) -> Path:
    """Find out before work begins whether `save_aligned` could write ``path``, as far as that can be known.

    A source is looked into only where ``path`` can hold nothing but a mesh.

    Raises:
        FormatError: a suffix that cannot be written, a mesh suffix for a cloud, a precision that the format
            does not know, or distances where it has no place for them.
        DependencyError: what the format needs is not installed.
        OutputError, InputError: as `save_aligned`.
    """
    take_inherited()
    both = tuple(dict.fromkeys((*CLOUD_WRITERS, *MESH_WRITERS, ".glb")))
    path = check_cloud_output(path, force, both)
    suffix = path.suffix.lower()
    if precision not in PRECISIONS:
        raise FormatError(f"unknown precision '{precision}'; known: {', '.join(PRECISIONS)}")
    if precision != "auto" and suffix not in _WITH_PRECISION:
        raise FormatError(
            f"'{path}': a precision can be chosen for {', '.join(_WITH_PRECISION)}; "
            f"{suffix} keeps what it can by itself"
        )
    if distances and suffix not in _WITH_FIELDS:
        raise FormatError(
            f"'{path}': {suffix} has no place for a distance at each point; use one of {', '.join(_WITH_FIELDS)}"
        )
    if suffix in (".las", ".laz"):
        las.require_laspy(suffix == ".laz")
    if suffix == ".e57":
        e57.require_pye57()
    if suffix not in CLOUD_WRITERS and read_raw(source).faces is None:
        raise FormatError(
            f"'{path}': {suffix} holds meshes, but {describe(source)} is a cloud; writable: "
            + ", ".join(CLOUD_WRITERS)
        )
    return path


def save_aligned(
    path: str | os.PathLike[str],
    source: Any,
    T_target_source: ArrayLike,
    *,
    precision: str = "auto",
    target: Any = None,
    scale: float = 1.0,
    force: bool = False,
    remark: Callable[[str], None] = lambda sentence: None,
) -> tuple[str, ...]:
    """Write the source at full resolution in the target's file coordinates: p_target = R p_source + t.

    All finite points are moved, with their normals (turned), colours and fields, as far as the format holds
    them; what is lost is returned by name. Fields that are directions by their names, such as vx, vy, vz, are
    turned too (`vectors.turned`); others that depend on the axes are returned by name as kept, not turned. Where
    more than one point lies at exactly (0, 0, 0), those mark missing measurements and stay there.

    A mesh written to PLY, OBJ, OFF, STL or GLB stays a mesh: its triangles are moved. OBJ to OBJ and GLB or GLTF
    to GLB keep everything else as it is in the file; other meshes written to GLB keep their materials. A mesh
    written to another suffix becomes the points that `load_points` takes from it.

    Args:
        path: a suffix of `save_points`, or for meshes .obj, .off, .stl or .glb.
        source: anything `load_points` takes.
        T_target_source: (4, 4) in file coordinates: a rigid motion, or a similarity with the given scale.
        precision: of coordinates in PLY and PCD. "auto" writes floats, which every program reads, where they
            move nothing by more than 1e-6 of the spread, and all digits elsewhere; "double" always writes all
            digits; "single" always writes floats, of coordinates far from zero minus an origin, which is
            stated in the header.
        target: anything `load_points` takes: each point gets a field ``distance`` to the nearest point of it at
            full resolution (NaN where (0, 0, 0) marks a missing measurement); None writes no such field.
        scale: of the similarity, 1 for a rigid motion; lengths of directions such as velocities are kept.
        force: replace an existing file, which may be the source itself.
        remark: called with sentences on how the file can be read.

    Returns:
        Names of what the source says of its points and the written file does not.

    Raises:
        InputError: no rigid transform, or a source that cannot be used (as `load_points`).
        FormatError: as `check_aligned`.
        OutputError: as `check_cloud_output`, or the disk refuses.
    """
    with np.errstate(all="ignore"):  # normals and fields may be any numbers
        return _save_aligned(
            path, source, _checked_motion(T_target_source, scale), precision, target, force, remark
        )


def _save_aligned(
    path: str | os.PathLike[str],
    source: Any,
    T: FloatArray,
    precision: str,
    target: Any,
    force: bool,
    remark: Callable[[str], None],
) -> tuple[str, ...]:
    path = check_aligned(path, source, precision=precision, distances=target is not None, force=force)
    suffix = path.suffix.lower()
    file = Path(source) if isinstance(source, (str, os.PathLike)) else None
    kind = "" if file is None else file.suffix.lower()
    if (file is not None and suffix == ".obj" and kind == ".obj") or (
        file is not None and suffix == ".glb" and kind in (".glb", ".gltf")
    ):
        read_raw(file)  # refuses what is damaged
        whole = gltf.moved_glb(file, T) if suffix == ".glb" else mesh_writers.moved_obj(file, T, path)
        _write(path, lambda handle: handle.write(whole), force)
        if suffix == ".obj" and b"mtllib" in whole and file.resolve().parent != path.resolve().parent:
            remark(f"{path} takes its materials from {file.resolve().parent}; move them along with it")
        return ()
    what = describe(source)
    raw, _ = finite_part(read_raw(source), what)
    as_mesh = raw.faces is not None and suffix in (*MESH_WRITERS, ".glb")
    lost = list(raw.unread)
    if not as_mesh and raw.faces is not None:
        sampled = is_sampled(source, raw)
        lost += [*(n for n in ("normals", "colors") if getattr(raw, n) is not None), *raw.fields] * sampled
        lost.append("faces")
        raw = RawCloud(meshes.sample_surface(raw, 100_000, 0, what)) if sampled else replace(raw, faces=None)
    if as_mesh and suffix == ".glb":
        _write(
            path, lambda handle: mesh_writers.write_glb(handle, mesh_writers.scene_of(source, raw), T), force
        )
        kept = ("texture coordinates", "materials")
        return tuple(
            n for n in (*lost, *(["normals"] * (raw.normals is not None)), *raw.fields) if n not in kept
        )
    moved, stayed = _moved(raw, T)
    lost += [f"{', '.join(stayed)} (kept, not turned)"] * bool(stayed)
    if target is not None:
        fields = {name: values for name, values in moved.fields.items() if name.lower() != DISTANCE}
        lost += [name for name in moved.fields if name not in fields]
        moved = replace(moved, fields={**fields, DISTANCE: _distances(moved.points, target)})
    write = (MESH_WRITERS if as_mesh else CLOUD_WRITERS)[suffix]
    if suffix in _WITH_PRECISION:
        single = precision == "single" or (precision == "auto" and fits_single_precision(moved.points))
        origin = choose_origin(moved.points) if precision == "single" else np.zeros(3)
        note = ""
        if origin.any():
            note = "origin " + " ".join(f"{value:.17g}" for value in origin)
            moved = replace(moved, points=moved.points - origin)
            remark(f"{path} holds floats about the {note}, which was taken off every point")
        elif not single:
            remark(_WITH_PRECISION[suffix].format(path=path))
        write = partial(write, single=single, note=note)
    if suffix == ".xyz" and (moved.normals is not None or moved.colors is not None or moved.fields):
        remark(
            f"{path} begins with a header, which MeshLab takes for a point, or shows none; PLY, ASC and E57 suit it"
        )
    _write(path, lambda handle: lost.extend(write(handle, moved)), force)
    return tuple(dict.fromkeys(lost))


DISTANCE = "distance"
_WITH_FIELDS = (".ply", ".pcd", ".las", ".laz", ".xyz", ".txt", ".asc", ".csv", ".npz")
PRECISIONS = ("auto", "double", "single")
_WITH_PRECISION = {  # and who cannot read all digits
    ".ply": "{path} holds doubles: the Point Cloud Library and small_gicp read them as an empty cloud "
    "(--aligned-precision single writes floats)",
    ".pcd": "{path} holds all digits as text: the Point Cloud Library and programs built on it round them to "
    "floats (--aligned-precision single writes floats about an origin)",
}


def _moved(raw: RawCloud, T: FloatArray) -> tuple[RawCloud, tuple[str, ...]]:
    """Points moved, normals and other directions turned; and the fields that would have to be turned and are not.

    (0, 0, 0) stays where it marks missing measurements.
    """
    points = mesh_writers.move_points(raw.points, T)
    at_zero = ~raw.points.any(axis=1)
    if raw.faces is None and np.count_nonzero(at_zero) > 1:
        points[at_zero] = 0.0
    R = T[:3, :3] / scale_of(T)
    fields, stayed = turned(raw.fields, R)
    normals = None if raw.normals is None else raw.normals @ R.T
    return replace(raw, points=points, normals=normals, fields=fields), stayed


def _distances(points: FloatArray, target: Any) -> NDArray[np.float32]:
    """(N,) distance of each point (N, 3), file coordinates, to the nearest of a target at full resolution; NaN for
    (0, 0, 0), which marks missing measurements where more than one point lies there."""
    from scipy.spatial import cKDTree

    cloud = load_points(target)
    tree = cKDTree(cloud.points, balanced_tree=False, compact_nodes=False)
    distances = np.asarray(tree.query(points - cloud.origin, workers=usable_threads())[0]).astype(np.float32)
    missing = ~points.any(axis=1)
    if np.count_nonzero(missing) > 1:
        distances[missing] = np.nan
    return distances


def _checked_motion(T: ArrayLike, scale: float) -> FloatArray:
    try:
        matrix = np.asarray(T, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"T_target_source is no matrix of numbers: {type(T).__name__}") from None
    if matrix.shape != (4, 4):
        raise InputError(f"T_target_source has shape {matrix.shape}, expected (4, 4)")
    if not np.isfinite(matrix).all():
        raise InputError("T_target_source holds NaN or infinities: there is no transform to apply")
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"the scale of a similarity is positive, found {scale}")
    R = matrix[:3, :3] / scale
    error = float(np.abs(R @ R.T - np.eye(3)).max())
    bottom = np.abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max()
    if error > 1e-4 or bottom > 1e-9 or np.linalg.det(R) < 0:
        what = "rigid transform" if scale == 1.0 else f"similarity of scale {scale:.6g}"
        raise InputError(
            f"T_target_source is no {what}: |R R^T - I| is {error:.3g} (limit 1e-4), the determinant "
            f"{np.linalg.det(R):.3g} (expected 1), the last row {matrix[3].tolist()}"
        )
    return matrix
