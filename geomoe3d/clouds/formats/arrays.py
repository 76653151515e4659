"""NPY and NPZ files. Pickled content is never loaded; reading takes the array and its float64 copy."""

from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from geomoe3d.clouds.formats.raw import RawCloud, cloud_of, columns_by_name, scale_colors, split_columns
from geomoe3d.clouds.formats.registry import reader, writer
from geomoe3d.errors import FormatError, InputError, plain_reason
from geomoe3d.runtime.words import counted, shape_in_words
from geomoe3d.types import FloatArray

_POINT_KEYS = (
    *("points", "xyz", "pcd", "pos", "position", "positions", "coords", "coordinates", "coord"),
    *("vertices", "pts", "pc", "cloud", "pointcloud", "point_cloud"),
)
_NORMAL_KEYS = ("normals", "normal", "nrm")
_COLOR_KEYS = ("colors", "color", "colours", "colour", "rgb")
_PICKLED = (
    "holds pickled Python objects, which are not loaded; save the coordinates as a plain array of floats"
)

_TOO_LARGE = "describes more numbers than memory holds: its header is wrong, or the machine too small"


@reader(".npy")
def read_npy(path: Path) -> RawCloud:
    """(N, C) numbers by the rule of `split_columns`, or anything else that `table_cloud` takes. Raises
    FormatError: no NPY file, truncated, pickled, or of another shape or type."""
    try:
        with path.open("rb") as handle:
            array = np.load(handle, allow_pickle=False)
            place = handle.tell()
    except OSError:
        raise
    except MemoryError:
        raise FormatError(f"'{path}' {_TOO_LARGE}") from None
    except Exception as error:  # numpy's header parser has many ways to refuse
        raise FormatError(f"'{path}' {_numpy_reason(error)}") from None
    if not isinstance(array, np.ndarray):
        array.close()
        raise FormatError(f"'{path}' is an NPZ archive; rename it to .npz")
    if place != path.stat().st_size:
        raise FormatError(
            f"'{path}' is {path.stat().st_size} bytes long, its header describes {place}; its header is wrong"
        )
    return table_cloud(array, f"'{path}'")


@reader(".npz")
def read_npz(path: Path) -> RawCloud:
    """Points under a usual key (points, xyz, pcd, pos ...) or as the only array, with normals and colors.

    Other arrays (N,) of numbers are fields.

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
            others = {key: archive[key] for key in archive.files if key not in wanted}
    except (FormatError, OSError):
        raise
    except MemoryError:
        raise FormatError(f"'{path}' {_TOO_LARGE}") from None
    except Exception as error:  # zipfile and zlib have many ways to refuse
        raise FormatError(f"'{path}' {_numpy_reason(error)}") from None
    points, normals, colors = arrays
    assert points is not None
    cloud = table_cloud(points, f"'{path}' key '{wanted[0]}'")
    fields = dict(cloud.fields)
    unread = list(cloud.unread)
    for key, values in others.items():
        if values.shape == (len(cloud.points),) and values.dtype.kind in "fiu" and key not in fields:
            fields[key] = values
        else:
            unread.append(key)
    for key, extra in zip(wanted[1:], (normals, colors), strict=True):
        if extra is not None and (extra.shape != (len(cloud.points), 3) or extra.dtype.kind not in "fiu"):
            raise FormatError(
                f"'{path}' key '{key}' holds {shape_in_words(extra.shape)}, expected a row of three numbers for each "
                f"of {counted(len(cloud.points), 'point')}"
            )
    return RawCloud(
        cloud.points,
        cloud.normals if normals is None else np.asarray(normals, dtype=np.float64),
        cloud.colors if colors is None else scale_colors(colors),
        fields=fields,
        unread=tuple(unread),
    )


_KINDS = {
    **dict.fromkeys("US", "text"),
    **{"O": "Python objects", "b": "true and false", "c": "complex numbers", "M": "dates", "m": "times"},
}
_KEY_GROUPS = (_POINT_KEYS, _NORMAL_KEYS, _COLOR_KEYS)


def _numpy_reason(error: BaseException) -> str:
    text = str(error)
    if "pickle" in text.lower() and "Object arrays" in text:
        return _PICKLED
    if isinstance(error, zipfile.BadZipFile):
        return f"is no NPZ archive or truncated ({text})"
    return f"is no numpy file or truncated ({plain_reason(error)})"


def table_cloud(
    array: NDArray[Any], what: str, columns: bool = True, error: type[InputError] = FormatError
) -> RawCloud:
    """An array as a cloud: (N, 3), organised (H, W, 3), or structured with fields x, y, z.

    Args:
        array: of a file, or given in memory.
        what: its name in messages.
        columns: whether (N, C) with more columns is taken too, by the rule of `split_columns`.
        error: what is raised.

    Raises:
        InputError: another shape or type; also (3, N), which is more likely a cloud that lies on its side.
    """
    if array.dtype.names is not None:
        return _structured(array.ravel(), what, error)
    if array.dtype.kind not in "fiu":
        found = _KINDS.get(array.dtype.kind, "no numbers") if columns else array.dtype
        raise error(
            f"{what} holds {found}, expected floats or integers"
            + (
                ""
                if columns
                else "; convert with numpy.asarray(points, dtype=float) if they are real numbers"
            )
        )
    grid: tuple[str, ...] = ()
    if array.ndim == 3 and array.shape[2] == 3:
        grid = (f"grid of {array.shape[1]} x {array.shape[0]}",)
        array = array.reshape(-1, 3)
    fits = array.ndim == 2 and (array.shape[1] == 3 or (columns and array.shape[1] > 3))
    if not fits or (array.shape[0] == 3 and array.shape[1] > 3):
        if columns:  # of a file, whose user need not know Python
            found = f"{what} holds {shape_in_words(array.shape)}"
            wanted = "a row for each point with three columns, x y z (more columns may follow)"
        else:
            found, wanted = f"{what} has shape {array.shape}", "(N, 3) or (H, W, 3)"
        raise error(f"{found}, expected {wanted}{_shape_hint(array)}")
    table: FloatArray = np.array(array, dtype=np.float64, order="C")
    if array.shape[1] == 3:
        return RawCloud(table, unread=grid)
    cloud = split_columns(table, None, what, "as fields of a structured array: id, x, y, z")
    return replace(cloud, fields={name: column.astype(array.dtype) for name, column in cloud.fields.items()})


def _shape_hint(array: NDArray[Any]) -> str:
    if array.shape == (3,):
        return "; a single point is a table of one row: points[None]"
    if array.ndim == 2 and array.shape[0] == 3:
        return "; if each column is a point, exchange rows and columns (in Python points.T)"
    if array.ndim == 2 and array.shape[1] > 3:
        return (
            "; pass points[:, :3] for the coordinates alone, or an .npz file or a geomoe3d.types.PointCloud "
            "to keep normals and colours"
        )
    return ""


def _structured(rows: NDArray[Any], what: str, error: type[InputError]) -> RawCloud:
    """Columns by the names of fields; a field of three numbers such as xyz or normal counts as three."""
    names: list[str] = []
    columns: list[NDArray[Any]] = []
    unread: list[str] = []
    triples = {
        **dict.fromkeys(_POINT_KEYS, ("x", "y", "z")),
        **dict.fromkeys(_NORMAL_KEYS, ("nx", "ny", "nz")),
        **dict.fromkeys(_COLOR_KEYS, ("red", "green", "blue")),
    }
    for name in rows.dtype.names or ():
        values = rows[name]
        if values.dtype.kind in "fiu" and values.shape[1:] == (3,) and name.lower() in triples:
            names += triples[name.lower()]
            columns += list(values.T)
        elif values.dtype.kind in "fiu" and values.ndim == 1:
            names.append(name)
            columns.append(values)
        else:
            unread.append(name)
    if "points" not in columns_by_name(names):
        raise error(f"{what} has the fields {', '.join(rows.dtype.names or ())}; x, y and z are needed")
    return cloud_of(names, columns, unread=tuple(unread))


@writer(".npy")
def write_npy(handle: BinaryIO, cloud: RawCloud) -> tuple[str, ...]:
    """The coordinates alone, float64: NPY has no place to name normals, colours and fields."""
    np.save(handle, cloud.points, allow_pickle=False)
    return (*(name for name in ("normals", "colors") if getattr(cloud, name) is not None), *cloud.fields)


@writer(".npz")
def write_npz(handle: BinaryIO, cloud: RawCloud) -> tuple[str, ...]:
    """Arrays points, normals, colors (float64) and the fields by their names, uncompressed."""
    arrays = {"points": cloud.points, "normals": cloud.normals, "colors": cloud.colors}
    named = {key: array for key, array in arrays.items() if array is not None}
    kept = {key: values for key, values in cloud.fields.items() if key not in (*arrays, "file")}
    np.savez(handle, **named, **kept)  # type: ignore[arg-type]
    return tuple(key for key in cloud.fields if key not in kept)
