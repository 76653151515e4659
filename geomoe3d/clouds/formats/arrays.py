"""NPY and NPZ files. Pickled content is never loaded; reading takes the array and its float64 copy."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from geomoe3d.clouds.formats.raw import RawCloud, scale_colors, split_columns
from geomoe3d.errors import FormatError
from geomoe3d.types import FloatArray

_POINT_KEYS = (
    *("points", "xyz", "pcd", "pos", "position", "positions", "coords", "coordinates", "coord"),
    *("vertices", "pts", "pc", "cloud", "pointcloud", "point_cloud"),
)
_NORMAL_KEYS = ("normals", "normal", "nrm")
_COLOR_KEYS = ("colors", "color", "colours", "colour", "rgb")
_PICKLED = "holds pickled Python objects, which are not loaded; save a plain float array of shape (N, 3)"


def read_npy(path: Path) -> RawCloud:
    """(N, 3) numbers, or (N, 6) and (N, 9) by the rule of `split_columns`.

    Raises:
        FormatError: no NPY file, truncated, pickled, or of another shape or type.
    """
    try:
        with path.open("rb") as handle:
            array = np.load(handle, allow_pickle=False)
            place = handle.tell()
    except (MemoryError, OSError):
        raise
    except Exception as error:  # numpy's header parser has many ways to refuse
        raise FormatError(f"'{path}' {_numpy_reason(error)}") from None
    if not isinstance(array, np.ndarray):
        array.close()
        raise FormatError(f"'{path}' is an NPZ archive; rename it to .npz")
    if place != path.stat().st_size:
        raise FormatError(
            f"'{path}' is {path.stat().st_size} bytes long, its header describes {place}; its header is wrong"
        )
    return split_columns(_table(array, f"'{path}'"), None)


def read_npz(path: Path) -> RawCloud:
    """Points under a usual key (points, xyz, pcd, pos ...) or as the only array, with normals and colors.

    Raises:
        FormatError: no NPZ file, truncated, pickled, no points (the message lists the keys), or normals or
            colours of another shape.
    """
    try:
        with path.open("rb") as handle:
            if handle.read(6) == np.lib.format.MAGIC_PREFIX:
                raise FormatError(f"'{path}' is a single NPY array; rename it to .npy")
        with path.open("rb") as handle, np.load(handle, allow_pickle=False) as archive:
            keys = {key.lower(): key for key in reversed(archive.files)}
            wanted = [next((keys[k] for k in names if k in keys), None) for names in _KEY_GROUPS]
            if wanted[0] is None and len(archive.files) == 1:
                wanted[0] = archive.files[0]
            if wanted[0] is None:
                raise FormatError(
                    f"'{path}' has no points; keys found: {', '.join(archive.files) or 'none'}; "
                    f"keys known: {', '.join(_POINT_KEYS)}"
                )
            arrays = [None if key is None else archive[key] for key in wanted]
            unread = tuple(key for key in archive.files if key not in wanted)
    except (FormatError, MemoryError, OSError):
        raise
    except Exception as error:  # zipfile and zlib have many ways to refuse
        raise FormatError(f"'{path}' {_numpy_reason(error)}") from None
    points, normals, colors = arrays
    assert points is not None
    cloud = split_columns(_table(points, f"'{path}' key '{wanted[0]}'"), None)
    for key, extra in zip(wanted[1:], (normals, colors), strict=True):
        if extra is not None and (extra.shape != (len(cloud.points), 3) or extra.dtype.kind not in "fiu"):
            raise FormatError(
                f"'{path}' key '{key}' has shape {extra.shape} and type {extra.dtype}, "
                f"expected numbers of shape ({len(cloud.points)}, 3)"
            )
    return RawCloud(
        cloud.points,
        cloud.normals if normals is None else np.asarray(normals, dtype=np.float64),
        cloud.colors if colors is None else scale_colors(colors),
        unread=(*cloud.unread, *unread),
    )


_KEY_GROUPS = (_POINT_KEYS, _NORMAL_KEYS, _COLOR_KEYS)


def _numpy_reason(error: BaseException) -> str:
    text = str(error)
    if "pickle" in text.lower() and "Object arrays" in text:
        return _PICKLED
    if isinstance(error, zipfile.BadZipFile):
        return f"is no NPZ archive or truncated ({text})"
    return f"is no numpy file or truncated ({text})"


def _table(array: NDArray[Any], what: str) -> FloatArray:
    """Numbers (N, C >= 3) of a file as float64."""
    if array.dtype.kind not in "fiu":
        raise FormatError(f"{what} holds {array.dtype}, expected floats or integers")
    if array.ndim != 2 or array.shape[1] < 3:
        raise FormatError(f"{what} has shape {array.shape}, expected (N, 3), (N, 6) or (N, 9)")
    return np.ascontiguousarray(array, dtype=np.float64)


def write_npy(handle: BinaryIO, cloud: RawCloud) -> None:
    """The coordinates alone, float64: NPY has no place to name normals and colours."""
    np.save(handle, cloud.points, allow_pickle=False)


def write_npz(handle: BinaryIO, cloud: RawCloud) -> None:
    """Float64 arrays points, normals and colors, uncompressed."""
    arrays = {"points": cloud.points, "normals": cloud.normals, "colors": cloud.colors}
    np.savez(handle, **{key: array for key, array in arrays.items() if array is not None})  # type: ignore[arg-type]
