"""What every reader returns and every writer takes, and the rules that all formats share.

Here live the meaning of column names, the rule for unnamed columns, the scaling of colours and the chunked
reading of fixed-size binary rows. Everything is numpy; a read of N rows holds the result plus one chunk.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from geomoe3d.errors import FormatError
from geomoe3d.types import FloatArray, IntArray

CHUNK_BYTES = 1 << 24

_ALIASES = {
    "x": ("x",),
    "y": ("y",),
    "z": ("z",),
    "nx": ("nx", "normal_x", "normalx", "n_x"),
    "ny": ("ny", "normal_y", "normaly", "n_y"),
    "nz": ("nz", "normal_z", "normalz", "n_z"),
    "red": ("red", "r", "rf", "diffuse_red"),
    "green": ("green", "g", "gf", "diffuse_green"),
    "blue": ("blue", "b", "bf", "diffuse_blue"),
}
_GROUPS = {"points": ("x", "y", "z"), "normals": ("nx", "ny", "nz"), "colors": ("red", "green", "blue")}


@dataclass(frozen=True)
class RawCloud:
    """A file's content in file coordinates, before anything is dropped or recentred.

    Attributes:
        points: (N, 3) file coordinates; may hold NaN and infinities.
        normals: (N, 3) as stored, any length, or None.
        colors: (N, 3) in [0, 1], or None.
        faces: (M, 3) triangles as rows of ``points``, or None for a cloud.
        unread: names of what else the file says of its points, such as intensity.
    """

    points: FloatArray
    normals: FloatArray | None = None
    colors: FloatArray | None = None
    faces: IntArray | None = None
    unread: tuple[str, ...] = ()

    def take(self, rows: NDArray[np.bool_]) -> RawCloud:
        """The points of a mask with their normals and colours; faces are given up."""
        return RawCloud(
            self.points[rows],
            None if self.normals is None else self.normals[rows],
            None if self.colors is None else self.colors[rows],
            unread=self.unread,
        )


def columns_by_name(names: Sequence[str]) -> dict[str, list[int]]:
    """Columns of ``points``, ``normals`` and ``colors`` among names such as x, Normal_X, R or "X [m]".

    Case and units in brackets do not count; of equal names the first counts. A group that is not
    complete is left out.
    """
    plain = [re.sub(r"[\[(].*", "", name).strip().strip("\"'").lower() for name in names]
    found: dict[str, list[int]] = {}
    for group, members in _GROUPS.items():
        columns = [next((plain.index(a) for a in _ALIASES[m] if a in plain), -1) for m in members]
        if min(columns) >= 0:
            found[group] = columns
    return found


def unread_names(names: Sequence[str], groups: Mapping[str, Sequence[int]]) -> tuple[str, ...]:
    """Names of the columns that are in no group."""
    read = {column for columns in groups.values() for column in columns}
    return tuple(name for column, name in enumerate(names) if column not in read)


def split_columns(table: FloatArray, names: Sequence[str] | None) -> RawCloud:
    """Columns of a text table or an array file, by name or, without names, by this rule.

    The first three are x, y, z. Of exactly six (or nine) columns, each further triple is taken as normals
    when at least 99 % of its rows are of length 1 within 0.01, else as colours when all its values lie in
    [0, 255]; a triple that is neither, a second one of the same kind, and all columns of other counts
    are ignored.
    """
    if names is not None:
        groups = columns_by_name(names)
    else:
        groups = {"points": [0, 1, 2]}
        if table.shape[1] in (6, 9):
            for first in range(3, table.shape[1], 3):
                role = _guess_role(table[:, first : first + 3])
                if role is not None:
                    groups.setdefault(role, [first, first + 1, first + 2])
    points = table if table.shape[1] == 3 else np.ascontiguousarray(table[:, groups["points"]])
    normals = table[:, groups["normals"]] if "normals" in groups else None
    colors = scale_colors(table[:, groups["colors"]]) if "colors" in groups else None
    named = names if names is not None else [f"column {k + 1}" for k in range(table.shape[1])]
    return RawCloud(points, normals, colors, unread=unread_names(named, groups))


def _guess_role(triple: FloatArray) -> str | None:
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(triple[np.isfinite(triple).all(axis=1)], axis=1)
    if len(lengths) and np.mean(np.abs(lengths - 1.0) <= 0.01) >= 0.99:
        return "normals"
    if len(triple) and np.nanmin(triple, initial=0.0) >= 0 and np.nanmax(triple, initial=0.0) <= 255:
        return "colors"
    return None


def scale_colors(values: NDArray[Any], stored: str | None = None) -> FloatArray | None:
    """Colours (N, 3) in [0, 1] from whatever a file stores.

    8 bit integers are divided by 255. Otherwise the largest value decides: up to 1 (floats only) they are
    fractions already, up to 255 they are divided by 255, up to 65535 by 65535. Negative, non-finite or
    larger values are no colours: None.

    Args:
        values: (N, 3) numbers.
        stored: numpy name of the type the file declares, where it is not that of ``values``.
    """
    kind = np.dtype(stored) if stored is not None else values.dtype
    if not len(values):
        return None
    low, high = float(values.min()), float(values.max())
    if not (low >= 0 and high <= 65535):
        return None
    if kind == np.uint8:
        limit = 255.0
    elif kind.kind == "f" and high <= 1.001:  # fractions, with a little rounding allowed
        limit = 1.0
    else:
        limit = 255.0 if high <= 255 else 65535.0
    colors: FloatArray = np.clip(np.asarray(values, dtype=np.float64) / limit, 0.0, 1.0)
    return colors


def read_columns(
    handle: BinaryIO, dtype: np.dtype[Any], count: int, groups: Mapping[str, Sequence[int]]
) -> dict[str, NDArray[Any]]:
    """Read ``count`` fixed-size rows chunk by chunk and keep only the wanted fields.

    Args:
        handle: file at the first row; must hold ``count`` rows (the caller has checked the size).
        dtype: the row; fields are addressed by position.
        groups: for each name the fields that become the columns of its array.

    Returns:
        (count, number of fields) per group: float64 for points and normals, the stored type otherwise.
    """
    fields = dtype.names or ()
    out: dict[str, NDArray[Any]] = {}
    for group, columns in groups.items():
        stored = np.result_type(*(dtype[fields[column]] for column in columns)).newbyteorder("=")
        kind = np.dtype(np.float64) if group in ("points", "normals") else stored
        out[group] = np.empty((count, len(columns)), dtype=kind)
    rows = max(1, CHUNK_BYTES // dtype.itemsize)
    for start in range(0, count, rows):
        block = np.fromfile(handle, dtype=dtype, count=min(rows, count - start))
        with np.errstate(invalid="ignore"):  # signalling NaNs are dropped later
            for group, columns in groups.items():
                for k, column in enumerate(columns):
                    out[group][start : start + len(block), k] = block[fields[column]]
    return out


def chunks(num_rows: int, row_bytes: int) -> Iterator[slice]:
    """Slices that cover ``num_rows`` in pieces of about `CHUNK_BYTES`."""
    rows = max(1, CHUNK_BYTES // row_bytes)
    for start in range(0, num_rows, rows):
        yield slice(start, min(start + rows, num_rows))


def header_count(text: str, path: Path, what: str) -> int:
    """A count from a header.

    Raises:
        FormatError: the text is no whole number, negative or beyond any file.
    """
    try:
        count = int(text)
    except ValueError:
        count = -1
    if not 0 <= count < 1 << 40:
        raise FormatError(f"'{path}': the header's {what} '{text}' is no usable count")
    return count
