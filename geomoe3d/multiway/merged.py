"""The merged cloud of a group, and its scans with their poses in one E57 file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from geomoe3d.clouds.formats.e57 import write_scans
from geomoe3d.clouds.formats.ply import write_ply
from geomoe3d.clouds.formats.raw import RawCloud
from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.voxel_grid import voxel_keys
from geomoe3d.geometry.se3 import shift_frames, transform_points
from geomoe3d.runtime.files import write_atomically
from geomoe3d.types import BoolArray, FloatArray, IntArray


def merge_clouds(
    paths: Sequence[str], numbers: Sequence[int], poses: Sequence[FloatArray], voxel_size: float
) -> RawCloud:
    """Mean points per voxel of all scans, one scan at a time, in the reference's file coordinates.

    Works about the first scan's origin in float64, so that map coordinates lose nothing.

    Args:
        paths: of the scans; the first is the reference.
        numbers: of the scans, for the field ``scan``: that of the scan with most points in the voxel.
        poses: T_reference_scan (4, 4), file coordinates.
        voxel_size: cloud units.

    Returns:
        Points, colours where any scan has them, and the fields ``scan`` and ``num_scans``.
    """
    origin = load_points(paths[0]).origin
    parts: list[FloatArray] = []  # rows: x y z, red green blue (NaN: none), points, scan
    for path, number, T in zip(paths, numbers, poses, strict=True):
        cloud = load_points(path)
        points = transform_points(shift_frames(T, -cloud.origin, -origin), cloud.points)
        colors = np.full((len(points), 3), np.nan) if cloud.colors is None else cloud.colors
        rows = np.column_stack([points, colors, np.ones(len(points)), np.full(len(points), float(number))])
        parts.append(_per_voxel(rows, voxel_size)[0])
    merged, num_scans = _per_voxel(np.concatenate(parts), voxel_size)
    colors = merged[:, 3:6]
    known: BoolArray = np.isfinite(colors).all(axis=1)  # type: ignore[assignment]
    return RawCloud(
        merged[:, :3] + origin,
        # Grey for points without a colour, where others have one.
        colors=np.where(known[:, None], colors, 0.6) if known.any() else None,
        fields={"scan": merged[:, 7].astype(np.int32), "num_scans": num_scans.astype(np.int32)},
    )


def _per_voxel(rows: FloatArray, voxel_size: float) -> tuple[FloatArray, IntArray]:
    """One row per voxel: means of points and colours, sum of the counts, scan of the largest count.

    Points count alike, whichever scan they are of; also returns how many rows each voxel had.
    """
    keys = voxel_keys(rows[:, :3], voxel_size)
    order = np.lexsort((-rows[:, 6], keys))
    keys, rows = keys[order], rows[order]
    starts = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
    counts = np.diff(np.append(starts, len(keys)))
    known: BoolArray = np.isfinite(rows[:, 3:6]).all(axis=1)  # type: ignore[assignment]
    mean = np.add.reduceat(rows[:, :3], starts, axis=0) / counts[:, None]
    with np.errstate(invalid="ignore"):
        colors = np.add.reduceat(np.where(known[:, None], rows[:, 3:6], 0.0), starts, axis=0)
        colors /= np.add.reduceat(known.astype(float), starts)[:, None]
    return np.column_stack([mean, colors, np.add.reduceat(rows[:, 6], starts), rows[starts, 7]]), counts


def write_merged(path: Path, cloud: RawCloud) -> None:
    """As binary PLY with doubles, colours and fields; an older file is replaced.

    Raises:
        OutputError: it cannot be written.
    """

    def write(temporary: Path) -> None:
        with temporary.open("wb") as handle:
            write_ply(handle, cloud)

    write_atomically(path, write, force=True)


def write_e57(path: Path, scans: Sequence[tuple[str, str, FloatArray]]) -> None:
    """All scans of a group in one file, every finite point as given, each scan with its pose; all in doubles.

    Args:
        path: replaced if there.
        scans: name, path and T_reference_scan (4, 4), file coordinates, of each.

    Raises:
        DependencyError: pye57 is not installed.
        OutputError: the file cannot be written.
    """

    def posed() -> Iterator[tuple[str, RawCloud, FloatArray]]:
        for name, source, T in scans:
            cloud = load_points(source)
            local = shift_frames(T, -cloud.origin, np.zeros(3))  # of the points as they are held here
            yield name, RawCloud(cloud.points, cloud.normals, cloud.colors), local

    def write(temporary: Path) -> None:
        write_scans(temporary, posed())

    write_atomically(path, write, force=True)
