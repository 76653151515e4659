"""Clouds too large for memory, read in pieces: LAS and LAZ as they stream, all else at once."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from geomoe3d.clouds.formats.las import read_pieces
from geomoe3d.clouds.io import load_points
from geomoe3d.errors import EmptyCloudError
from geomoe3d.geometry.columns import finite_rows
from geomoe3d.runtime.files import file_hash
from geomoe3d.types import FloatArray

_STREAMED = (".las", ".laz")


@dataclass(frozen=True)
class Pieces:
    """A cloud to be read.

    Attributes:
        name: what to call it.
        sha256: of the file, or of the points of a cloud in memory.
        points: gives its finite points (n, 3) in file coordinates, piece by piece.
        sensor: (3,) where the file says that its one sensor stood, file coordinates, or None.
        origin: (3,) of the local coordinates of a cloud that was read at once, else None.
    """

    name: str
    sha256: str
    points: Callable[[], Iterator[FloatArray]]
    sensor: FloatArray | None = None
    origin: FloatArray | None = None


def pieces(cloud: Any, size: int) -> Pieces:
    """What `load_points` takes, in pieces of at most so many points.

    Raises:
        InputError, FormatError, EmptyCloudError: as `load_points`; of a streamed file while it is read.
    """
    if (
        isinstance(cloud, (str, os.PathLike))
        and Path(cloud).suffix.lower() in _STREAMED
        and Path(cloud).is_file()
    ):
        path = Path(cloud)
        return Pieces(path.name, file_hash(path), lambda: _finite(path, size))
    loaded = load_points(cloud)
    if isinstance(cloud, (str, os.PathLike)):
        digest = file_hash(Path(cloud))
    else:
        digest = hashlib.sha256(loaded.points.tobytes() + loaded.origin.tobytes()).hexdigest()

    def parts() -> Iterator[FloatArray]:
        for start in range(0, len(loaded), size):
            yield loaded.points[start : start + size] + loaded.origin

    return Pieces(loaded.name, digest, parts, loaded.sensor, loaded.origin)


def _finite(path: Path, size: int) -> Iterator[FloatArray]:
    some = False
    for points in read_pieces(path, size):
        points = points[finite_rows(points)]
        some |= bool(len(points))
        if len(points):
            yield points
    if not some:
        raise EmptyCloudError(f"'{path}' holds no finite points")
