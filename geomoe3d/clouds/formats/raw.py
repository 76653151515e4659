"""What every reader returns and every writer takes, and the rules that all formats share.

Here live the meaning of column names, the rule for unnamed columns and the scaling of colours. A reader hands
over named columns in the types of its file; `cloud_of` makes points, normals, colours and fields of them.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomoe3d.errors import FormatError
from geomoe3d.geometry.columns import in_cache
from geomoe3d.types import FloatArray, IntArray

_ALIASES = {
    **{
        axis: (axis, f"points:{k}", f"points_m_xyz:{k}", f"cartesian{axis}", f"coord_{axis}", other)
        for k, (axis, other) in enumerate(zip("xyz", ("easting", "northing", "elevation"), strict=True))
    },
    **{
        f"n{axis}": (f"n{axis}", f"normal_{axis}", f"normal{axis}", f"n_{axis}", f"normals:{k}")
        for k, axis in enumerate("xyz")
    },
    **{c: (c, c[0], f"{c[0]}f", f"diffuse_{c}", f"color{c}") for c in ("red", "green", "blue")},
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
        fields: whatever other numbers (N,) the file holds for each point, such as intensity, by name and in
            the type of the file.
        unread: names of what else the file says and nothing here holds.
        notes: sentences on what was not taken as it stands, which its user should know.
        sensor: (3,) where the file says that the one sensor stood, or None.
    """

    points: FloatArray
    normals: FloatArray | None = None
    colors: FloatArray | None = None
    faces: IntArray | None = None
    fields: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    unread: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    sensor: FloatArray | None = None

    def take(self, rows: NDArray[np.bool_]) -> RawCloud:
        """The points of a mask with all that belongs to them; faces are given up."""
        return RawCloud(
            self.points[rows],
            None if self.normals is None else self.normals[rows],
            None if self.colors is None else self.colors[rows],
            fields={name: values[rows] for name, values in self.fields.items()},
            unread=self.unread,
            notes=self.notes,
            sensor=self.sensor,
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


_KIND = {"points": np.float64, "normals": np.float64}  # colours stay as they are: their type says their scale


def cloud_of(
    names: Sequence[str],
    columns: Sequence[NDArray[Any]],
    *,
    faces: IntArray | None = None,
    unread: tuple[str, ...] = (),
) -> RawCloud:
    """A cloud of named columns (N,), among them x, y and z; what has no role becomes a field.

    Colours that `scale_colors` cannot make sense of are fields too. Of columns with equal names the first
    counts, the others are named as unread.
    """
    groups = columns_by_name(names)
    with np.errstate(invalid="ignore"):  # signalling NaNs are dropped later
        parts = {
            group: _side_by_side([columns[k] for k in chosen], _KIND.get(group))
            for group, chosen in groups.items()
        }
    colors = scale_colors(parts["colors"]) if "colors" in parts else None
    if "colors" in groups and colors is None:
        del groups["colors"]
    used = {k for chosen in groups.values() for k in chosen}
    names = [name.strip().strip("\"'") or f"column_{k}" for k, name in enumerate(names, 1)]
    fields: dict[str, NDArray[Any]] = {}
    for k, (name, column) in enumerate(zip(names, columns, strict=True)):
        if k not in used and name in fields:
            unread = (*unread, f"{name} (column {k + 1})")
        elif k not in used:
            fields[name] = np.ascontiguousarray(column, dtype=column.dtype.newbyteorder("="))
    return RawCloud(
        parts["points"],
        parts.get("normals"),
        colors,
        faces,
        fields,
        unread,
    )


def _side_by_side(columns: Sequence[NDArray[Any]], kind: Any) -> NDArray[Any]:
    """Columns (N,) as (N, C), of a given type or that of all."""
    table: NDArray[Any] = np.empty((len(columns[0]), len(columns)), dtype=kind or np.result_type(*columns))
    for rows in in_cache(len(table)):
        for k, column in enumerate(columns):
            table[rows, k] = column[rows]
    return table


def split_columns(
    table: FloatArray,
    names: Sequence[str] | None,
    what: str,
    naming: str = "in a first line such as 'id x y z'",
) -> RawCloud:
    """Columns of a text table or an array file, by name or, without names, by this rule.

    The first three are x, y, z. Of exactly six (or nine) columns, the first further triple of which at least
    99 % of the rows are of length 1 within 0.01 is taken as normals, unless it holds only zeros and ones.
    All others are fields: values that could be colours could as well be intensity, ring and time.

    Args:
        table: (N, C) numbers.
        names: of the columns, or None.
        what: the file, in messages.
        naming: how its columns can be named, in messages.

    Raises:
        FormatError: no names, and the first column counts the rows like a point number, or it is a transform.
    """
    if names is None:
        if table.shape == (4, 4) and table[3].tolist() == [0, 0, 0, 1]:
            raise FormatError(f"{what} holds a transform, four rows of four numbers, and no points")
        if _counts_rows(table):
            raise FormatError(
                f"{what}: the first column rises in whole numbers from {table[0, 0]:.0f} to "
                f"{table[-1, 0]:.0f}, as point numbers do, and nothing says what it is; name the columns "
                f"{naming} (or 'x y z ...', if it is x), or remove it"
            )
        names = ["x", "y", "z", *(f"column_{k}" for k in range(4, table.shape[1] + 1))]
        for first in range(3, table.shape[1], 3) if table.shape[1] in (6, 9) else ():
            if _looks_like_normals(table[:, first : first + 3]):
                names[first : first + 3] = ["nx", "ny", "nz"]
                break
    return cloud_of(names, list(table.T))


def _counts_rows(table: FloatArray) -> bool:
    """Whether the first of four or more columns is whole and rises in every row: by one step, or in many."""
    if table.shape[1] < 4 or len(table) < 3:
        return False
    with np.errstate(invalid="ignore"):
        steps = np.diff(table[:, 0])
        whole = np.isfinite(table[:, 0]).all() and (table[:, 0] == np.rint(table[:, 0])).all()
    return bool(whole and steps.min() > 0 and (len(table) >= 10 or steps.min() == steps.max()))


def _looks_like_normals(triple: FloatArray) -> bool:
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(triple[np.isfinite(triple).all(axis=1)], axis=1)
    flags = bool(((triple == 0) | (triple == 1)).all())  # classes, one column each
    return not flags and len(lengths) > 0 and bool(np.mean(np.abs(lengths - 1.0) <= 0.01) >= 0.99)


def scale_colors(values: NDArray[Any]) -> FloatArray | None:
    """Colours (N, 3) in [0, 1] from whatever a file stores.

    8 bit integers are divided by 255. Otherwise the largest value decides: up to 1 (floats only) they are
    fractions already, up to 255 they are divided by 255, up to 65535 by 65535. Negative, non-finite or
    larger values are no colours: None.
    """
    kind = values.dtype
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


def storable_fields(
    cloud: RawCloud, types: Container[str], taken: set[str]
) -> tuple[dict[str, NDArray[Any]], tuple[str, ...]]:
    """The fields of a cloud in types that a format has, and the names of those that it cannot hold.

    Whole numbers too wide for the format become doubles where that changes none. Blanks in names become _.

    Args:
        cloud: its fields are asked about.
        types: what the format can store, such as "f4" or "u2".
        taken: names that are in use already, lower case.
    """
    kept: dict[str, NDArray[Any]] = {}
    lost: list[str] = []
    for name, values in cloud.fields.items():
        plain = re.sub(r"\s+", "_", name)
        if values.dtype.str[1:] not in types:
            wider = values.astype(np.float32 if values.dtype == np.float16 else np.float64)
            values = wider if np.array_equal(wider.astype(values.dtype), values, equal_nan=True) else values
        if values.dtype.str[1:] in types and plain.lower() not in taken:
            kept[plain] = values
            taken.add(plain.lower())
        else:
            lost.append(name)
    return kept, tuple(lost)


def chunks(num_rows: int, row_bytes: int) -> Iterator[slice]:
    """Slices that cover ``num_rows`` in pieces of about 16 MiB."""
    rows = max(1, 2**24 // row_bytes)
    for start in range(0, num_rows, rows):
        yield slice(start, min(start + rows, num_rows))


def header_count(text: str, path: Path, what: str) -> int:
    """A count from a header. Raises FormatError: the text is no whole number, negative or beyond any file."""
    try:
        count = int(text)
    except ValueError:
        count = -1
    if not 0 <= count < 1 << 40:
        raise FormatError(f"'{path}': the header's {what} '{text}' is no usable count")
    return count


def wrong_count(path: Path, said: int, held: int, what: str = "points") -> FormatError:
    """A header's count that the content does not bear out."""
    reason = "it is truncated or its header is wrong" if held < said else "its header is wrong"
    return FormatError(f"'{path}': the header says {said} {what}, the file holds {held}; {reason}")
