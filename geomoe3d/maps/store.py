"""A map as one file: what it is made of, its voxels and its levels, with a hash of all of it.

Levels that another version of the descriptor made are left out when a map is read: it is then described anew when a
scan asks for it. An uncompressed NumPy archive. Some 60 MB for 500,000 voxels with one level; read in a tenth of a
second.
"""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomoe3d.errors import FormatError, InputError, MissingFileError, cannot_read
from geomoe3d.features.learned import LearnedDescriptor
from geomoe3d.geometry.se3 import motions_apart
from geomoe3d.maps.level import Level
from geomoe3d.maps.pieces import Pieces
from geomoe3d.maps.voxels import VoxelSums
from geomoe3d.runtime.files import write_atomically
from geomoe3d.runtime.plain import parse_json
from geomoe3d.types import FloatArray

VERSION = 4
_TINY = 1e-8
"""Poses nearer than that, cloud units and entries of the rotation, are one: rounding goes so far in national grids."""
_LEVEL = tuple(field.name for field in fields(Level) if field.name not in ("voxel_size", "sensors"))
_VOXELS = ("origin", "keys", "sums", "counts", "towards", "sensors")


@dataclass(frozen=True)
class Source:
    """One cloud that a map was made of.

    Attributes:
        name: of its file, or what the caller called it.
        sha256: of the file, or of its points.
        num_points: finite points of it in the map.
        path: absolute, of its file when it was read; empty where there was none, or where the map was written by a
            version that did not keep it.
        T_map_cloud: rows of the (4, 4) by which it was brought into the map, file coordinates; None: as it was.
    """

    name: str
    sha256: str
    num_points: int
    path: str = ""
    T_map_cloud: tuple[tuple[float, ...], ...] | None = None

    def holds(self, read: Pieces, T: FloatArray) -> bool:
        """Whether it is the cloud that is to be read, with a transform (4, 4) into the map.

        Raises:
            StaleMapError: the file has another content by now, or the cloud lies elsewhere.
        """
        again = "index all clouds of the map again (--fresh in the shell), since nothing can be taken out of a map"
        if not self.path and read.path:
            return self.sha256 == read.sha256  # a version that kept no paths kept no transforms either
        if self.sha256 != read.sha256:
            if read.path and self.path == read.path:
                raise StaleMapError(f"'{self.name}' has changed since it was read into the map; {again}")
            return False
        own = np.eye(4) if self.T_map_cloud is None else np.array(self.T_map_cloud)
        if np.array_equal(own, T):
            return True
        # Told where the cloud is: about the zero of grid coordinates a small turn looks like a long way.
        shift, turn = motions_apart(own, T, read.some_place())
        if shift <= _TINY and np.allclose(own[:3, :3], T[:3, :3], rtol=0, atol=_TINY):
            return True
        off = f"shifted by {shift:.3g} and turned by {turn:.3g} deg"
        if self.path == read.path:
            raise StaleMapError(
                f"'{self.name}' is in the map already, at a pose {off}; give the pose it had, or {again}"
            )
        one, other = (read.name, self.name) if read.name != self.name else (read.path, self.path)
        raise StaleMapError(
            f"'{one}' has the same content as '{other}', which is in the map already, but is {off} against it; leave "
            f"one of the two out; if '{other}' was only renamed, {again}"
        )


class StaleMapError(InputError):
    """A cloud of a map has changed, or lies elsewhere."""


def save(
    path: str | os.PathLike[str],
    sources: tuple[Source, ...],
    voxels: VoxelSums,
    levels: tuple[Level, ...],
    *,
    force: bool,
) -> None:
    """Write a map; see `geomoe3d.maps.map.Map.save`."""
    arrays: dict[str, NDArray[Any]] = {name: getattr(voxels, name) for name in _VOXELS}
    for number, level in enumerate(levels):
        arrays |= {f"level{number}_{name}": getattr(level, name) for name in _LEVEL}
    told = {
        "geomoe3d map": VERSION,
        "edge": voxels.edge,
        "descriptor": _descriptor(),
        "levels": [level.voxel_size for level in levels],
        "sources": [asdict(source) for source in sources],
        "sha256": _hash(arrays),
    }

    def write(temporary: Path) -> None:
        with temporary.open("wb") as handle:  # of a name, numpy would make another one
            np.savez(handle, told=np.array(json.dumps(told)), allow_pickle=False, **arrays)

    write_atomically(path, write, force=force)


def load(path: str | os.PathLike[str]) -> tuple[tuple[Source, ...], VoxelSums, tuple[Level, ...]]:
    """Read a map.

    Raises:
        MissingFileError, ForbiddenFileError, InputError: no such file, or it may not be read.
        FormatError: no map, of a later version, or damaged.
    """
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            told = parse_json(str(archive["told"]))
            if told["geomoe3d map"] > VERSION:
                raise FormatError(
                    f"'{path}' was written by a later version of geomoe3d (map version {told['geomoe3d map']}, known "
                    f"is {VERSION}); update geomoe3d, or index it anew with --fresh"
                )
            arrays = {name: archive[name] for name in archive.files if name != "told"}
            voxels = VoxelSums(float(told["edge"]), *(arrays[name] for name in _VOXELS if name in arrays))
            levels = tuple(
                Level(
                    float(size),
                    **{name: arrays[f"level{number}_{name}"] for name in _LEVEL},
                    sensors=voxels.sensors,
                )
                for number, size in enumerate(told["levels"])
                if told.get("descriptor") == _descriptor()
            )
            sources = tuple(Source(**source) for source in told["sources"])
            if _hash(arrays) != told["sha256"]:
                raise FormatError(
                    f"'{path}' is damaged: its content does not match its hash; make it anew: geomoe3d index --fresh "
                    f"CLOUDS {path}"
                )
            return sources, voxels, levels
    except FormatError:
        raise
    except FileNotFoundError:
        raise MissingFileError(f"there is no map '{path}'; make one: geomoe3d index CLOUD {path}") from None
    except (ValueError, KeyError, TypeError, AttributeError, EOFError, zipfile.BadZipFile):
        raise FormatError(
            f"'{path}' is no map of geomoe3d, or it is damaged or cut short; make it anew: geomoe3d index "
            f"--fresh CLOUDS {path}"
        ) from None
    except OSError as error:
        raise cannot_read(error, f"cannot read the map '{path}': {error.strerror or error}") from None


def looks_like_map(path: Path) -> bool:
    """Whether a file begins as a map does; also one that is damaged or cut short further on."""
    with path.open("rb") as handle:
        start = handle.read(64)
    return start.startswith(b"PK") and b"told.npy" in start


def _descriptor() -> str:
    """By whose features levels are described."""
    return LearnedDescriptor().sha256


def _hash(arrays: Mapping[str, NDArray[Any]]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        values = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {values.dtype} {values.shape}".encode())
        digest.update(values.data)
    return digest.hexdigest()
