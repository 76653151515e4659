"""Clouds too large for memory, read in pieces: LAS, LAZ and binary PLY as they stream, E57 scan by scan; all else at
once."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from geomoe3d.clouds.formats.e57 import read_e57, read_scans
from geomoe3d.clouds.formats.las import read_las, read_pieces
from geomoe3d.clouds.formats.ply import read_ply, read_ply_pieces
from geomoe3d.clouds.formats.registry import READERS, Reader, take_inherited
from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.viewpoint import may_have_seen
from geomoe3d.errors import EmptyCloudError
from geomoe3d.geometry.columns import finite_rows
from geomoe3d.runtime.files import file_hash
from geomoe3d.types import FloatArray

Piece = tuple[FloatArray, FloatArray | None]
"""Finite points (n, 3) and where the one sensor that saw them stood, or None; file coordinates."""


@dataclass(frozen=True)
class Pieces:
    """A cloud to be read.

    Attributes:
        name: what to call it.
        sha256: of the file, or of the points of a cloud in memory.
        points: it piece by piece, once; nothing is read before it is asked.
        path: absolute, of its file; empty where there is none.
        origin: (3,) of the local coordinates of a cloud that was read at once, else None.
    """

    name: str
    sha256: str
    points: Iterator[Piece]
    path: str = ""
    origin: FloatArray | None = None

    def some_place(self) -> FloatArray:
        """(3,) mean of the first piece, file coordinates; spends that piece. Raises as the reading does."""
        place: FloatArray = next(self.points)[0].mean(axis=0)
        return place


def pieces(cloud: Any, size: int) -> Pieces:
    """What `load_points` takes, in pieces of at most so many points.

    Raises:
        InputError, FormatError, EmptyCloudError: as `load_points`; of a streamed file while it is read.
    """
    path = Path(cloud) if isinstance(cloud, (str, os.PathLike)) else None
    if path is not None and path.is_file() and path.stat().st_size:  # an empty file is named as one below
        take_inherited()
        stream = _STREAMED.get(READERS.get(path.suffix.lower()))
        streamed = None if stream is None else stream(path, size)
        if streamed is not None:
            return Pieces(path.name, file_hash(path), _finite(path, streamed), str(path.resolve()))
    loaded = load_points(cloud)
    if path is not None:
        digest = file_hash(path)
    else:
        digest = hashlib.sha256(loaded.points.tobytes() + loaded.origin.tobytes()).hexdigest()

    def parts() -> Iterator[Piece]:
        for start in range(0, len(loaded), size):
            yield loaded.points[start : start + size] + loaded.origin, loaded.sensor

    return Pieces(loaded.name, digest, parts(), "" if path is None else str(path.resolve()), loaded.origin)


def _laser_pieces(path: Path, size: int) -> Iterator[Piece]:
    return ((points, None) for points in read_pieces(path, size))


def _scan_pieces(path: Path, size: int) -> Iterator[Piece]:
    for scan in read_scans(path):
        points, sensor = scan.points[finite_rows(scan.points)], scan.sensor
        if sensor is not None and not (len(points) and may_have_seen(points, sensor)):
            sensor = None
        for start in range(0, len(points), size):
            yield points[start : start + size], sensor


def _ply_pieces(path: Path, size: int) -> Iterator[Piece] | None:
    found = read_ply_pieces(path, size)
    return None if found is None else ((points, None) for points in found)


_STREAMED: dict[Reader | None, Callable[[Path, int], Iterator[Piece] | None]] = {
    read_las: _laser_pieces,
    read_e57: _scan_pieces,
    read_ply: _ply_pieces,
}
"""In place of a reader of ours, never of a user's own for the same suffix; None: the file has to be read at once."""


def _finite(path: Path, given: Iterator[Piece]) -> Iterator[Piece]:
    some = False
    for points, sensor in given:
        points = points[finite_rows(points)]
        some |= bool(len(points))
        if len(points):
            yield points, sensor
    if not some:
        raise EmptyCloudError(f"'{path}' holds no finite points")
