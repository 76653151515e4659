"""PLY: ascii and binary of both byte orders, every scalar type, lists, faces; doubles stay doubles.

Own code because the usual readers return made-up rows for a truncated file, print to the terminal, or walk
lists in Python row by row. The header's counts are held against the file's size. The numbers of an ascii file
are parsed into doubles and then read like a binary file of nothing but doubles.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from geomoe3d.clouds.formats.raw import (
    RawCloud,
    chunks,
    cloud_of,
    columns_by_name,
    header_count,
    storable_fields,
    wrong_count,
)
from geomoe3d.clouds.formats.registry import reader, writer
from geomoe3d.clouds.formats.text import parse_numbers
from geomoe3d.errors import FormatError
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray, IntArray

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


_INDICES = ("vertex_indices", "vertex_index")
_Bytes = NDArray[np.uint8]


@dataclass
class _Element:
    """One element of the header; a property is (name, type, type of its length or None)."""

    name: str
    count: int
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)

    def stored_as(self, kind: str) -> _Element:
        """The same with every value of one type, as `parse_numbers` gives those of an ascii file."""
        return _Element(self.name, self.count, [(n, kind, t and kind) for n, _, t in self.properties])


@reader(".ply")
def read_ply(path: Path) -> RawCloud:
    """Vertices with all their numbers, and the faces (polygons cut into triangle fans) if there are any.
    Raises FormatError: no PLY, an unknown header line, or counts that the file's content does not bear
    out."""
    with path.open("rb") as handle:
        order, elements, num_lines = _read_header(handle, path)
        names = [element.name for element in elements]
        if "vertex" not in names:
            raise FormatError(f"'{path}' has no element 'vertex', only: {', '.join(names) or 'nothing'}")
        vertex = elements[names.index("vertex")]
        scalars = [name for name, _, length in vertex.properties if length is None]
        if "points" not in columns_by_name(scalars):
            raise FormatError(
                f"'{path}': the vertices have no properties x, y, z, only: {', '.join(scalars) or 'none'}"
            )
        body: _Bytes
        if order == "=":
            body = parse_numbers(path, handle.read(), num_lines).view(np.uint8)
        else:
            body = np.fromfile(handle, dtype=np.uint8)
    columns: list[NDArray[Any]] = []
    faces: IntArray | None = None
    unread = [name for name, _, length in vertex.properties if length is not None]
    place = 0
    for element in elements:
        stored = element.stored_as("f8") if order == "=" else element
        rows, place = _read_rows(body, place, order, stored, path, element is elements[-1])
        if element is vertex:
            for k, (_, kind, length) in enumerate(element.properties):
                if length is None:
                    columns.append(_declared(rows.scalars(k), kind))
        elif element.name == "face":
            for k, (name, _, length) in enumerate(element.properties):
                if length is not None and name in _INDICES:
                    faces = _fans(rows.polygons(k))
                else:
                    unread.append(f"face {name}")
        elif element.count:
            unread.append(f"element {element.name}")
    rest = body[place:]
    if order == "=" and len(rest):
        raise FormatError(
            f"'{path}' holds {counted(len(rest) // 8, 'number')} more than its header describes"
        )
    if rest[:64].tobytes().strip(b"\0\r\n\t "):
        raise FormatError(
            f"'{path}' holds {counted(len(body), 'byte')} behind its header, its header describes {place}; the counts "
            "in it are wrong"
        )
    return cloud_of(scalars, columns, faces=_checked_faces(faces, vertex.count, path), unread=tuple(unread))


def read_ply_pieces(path: Path, size: int) -> Iterator[FloatArray] | None:
    """The coordinates (n, 3) of a binary file of vertices alone, at most ``size`` at a time; None: any other PLY, which
    has to be read at once. Raises FormatError: as `read_ply`, before anything is read."""
    with path.open("rb") as handle:
        order, elements, _ = _read_header(handle, path)
        begin = handle.tell()
    held = [element for element in elements if element.count and element.properties]
    lists = any(length is not None for element in held for _, _, length in element.properties)
    names = [name for name, _, _ in held[0].properties] if held else []
    if order == "=" or lists or [e.name for e in held] != ["vertex"] or not {"x", "y", "z"} <= set(names):
        return None
    (vertex,) = held
    row = np.dtype([(f"{k}", order + kind) for k, (_, kind, _) in enumerate(vertex.properties)])
    rows = (path.stat().st_size - begin) // row.itemsize
    if rows != vertex.count:
        raise wrong_count(path, vertex.count, rows, "rows of 'vertex'")
    axes = [f"{names.index(axis)}" for axis in "xyz"]

    def parts() -> Iterator[FloatArray]:
        for start in range(0, vertex.count, size):
            some = np.fromfile(
                path, row, min(size, vertex.count - start), offset=begin + start * row.itemsize
            )
            yield np.column_stack([some[axis].astype(np.float64) for axis in axes])

    return parts()


def _declared(column: NDArray[Any], kind: str) -> NDArray[Any]:
    """A column in the type that the header says, where that holds it; ascii keeps all printed digits."""
    if column.dtype.kind + str(column.dtype.itemsize) == kind:
        return column
    with np.errstate(all="ignore"):
        declared = column.astype(kind)
    return declared if np.array_equal(declared, column, equal_nan=True) else column


def _read_header(handle: BinaryIO, path: Path) -> tuple[str, list[_Element], int]:
    """Byte order, elements and number of lines."""
    if handle.readline(80).strip() != b"ply":
        raise FormatError(f"'{path}' is no PLY file: its first line is not 'ply'")
    order = ""
    elements: list[_Element] = []
    for number in range(2, 10_000):
        line = handle.readline(10_000)
        words = line.decode("latin-1").split()
        if not line:
            break
        match words:
            case [] | ["comment", *_] | ["obj_info", *_]:
                continue
            case ["format", kind, _] if kind in _ORDERS:
                order = _ORDERS[kind]
            case ["element", name, count]:
                elements.append(_Element(name, header_count(count, path, f"count of '{name}'")))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= _TYPES.keys():
                elements[-1].properties.append((name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append((name, _TYPES[kind], None))
            case ["end_header"] if order:
                return order, elements, number
            case _:
                raise FormatError(f"'{path}': cannot read the header line '{' '.join(words)[:80]}'")
    raise FormatError(f"'{path}': the header does not end; the file is truncated or no PLY")


class _Rows:
    """Rows of equal layout, as a structured array with the fields of `_layout`."""

    def __init__(self, table: NDArray[Any]) -> None:
        self._table = table

    def scalars(self, k: int) -> NDArray[Any]:
        """The values (rows,) of property ``k``."""
        return self._table[f"{k}"]

    def polygons(self, k: int) -> list[tuple[IntArray, IntArray]]:
        """The lists of property ``k`` by their length: which rows, and their values (rows, length)."""
        return [(np.arange(len(self._table)), _whole(self._table[f"{k}"]))]


class _RaggedRows(_Rows):
    """Rows whose lists differ in length: where each property of each row begins."""

    def __init__(self, body: _Bytes, starts: list[IntArray], order: str, element: _Element) -> None:
        self._body, self._starts, self._order, self._element = body, starts, order, element

    def scalars(self, k: int) -> NDArray[Any]:
        return self._take(self._starts[k], self._element.properties[k][1], 1)[:, 0]

    def polygons(self, k: int) -> list[tuple[IntArray, IntArray]]:
        _, kind, head = self._element.properties[k]
        assert head is not None
        lengths = self._take(self._starts[k], head, 1)[:, 0].astype(np.int64)
        found = []
        for length in np.unique(lengths):
            rows = np.flatnonzero(lengths == length)
            begin = self._starts[k][rows] + np.dtype(head).itemsize
            found.append((rows, _whole(self._take(begin, kind, int(length)))))
        return found

    def _take(self, begin: IntArray, kind: str, count: int) -> NDArray[Any]:
        width = count * np.dtype(kind).itemsize
        block: NDArray[Any] = self._body[begin[:, None] + np.arange(width)]
        return block.view(self._order + kind) if width else np.empty((len(begin), 0))


def _read_rows(
    body: _Bytes, place: int, order: str, element: _Element, path: Path, last: bool
) -> tuple[_Rows, int]:
    """The rows of an element that begin at byte ``place``, and the byte behind them. Raises FormatError: the
    body holds fewer rows, or, behind the last element without lists, more."""
    what = f"rows of '{element.name}'"
    has_lists = any(length is not None for _, _, length in element.properties)
    if not (element.count and element.properties):
        none = [(f"{k}", kind, (0,) * bool(head)) for k, (_, kind, head) in enumerate(element.properties)]
        return _Rows(np.empty(0, none)), place
    layout = _layout(body, place, order, element)
    if layout is None:
        raise wrong_count(path, element.count, 0, what)
    size = layout.itemsize
    held = (len(body) - place) // size
    if not has_lists and (held < element.count or (last and held > element.count)):
        raise wrong_count(path, element.count, held, what)
    if held >= element.count:
        table = np.frombuffer(body, layout, element.count, place)
        lengths = [name for name in layout.names or () if name.startswith("#")]
        if all((table[name] == table[name][:1]).all() for name in lengths):
            return _Rows(table), place + element.count * size
    return _walk(body, place, order, element, path)


def _layout(body: _Bytes, place: int, order: str, element: _Element) -> np.dtype[Any] | None:
    """The type of the row at ``place``, a field per property, '#' before that of its list's length.

    None where the body does not hold the lengths of the row's lists.
    """
    fields: list[Any] = []
    size = 0
    for k, (_, kind, head) in enumerate(element.properties):
        if head is not None:
            if place + size + np.dtype(head).itemsize > len(body):
                return None
            length = float(np.ndarray((), order + head, body, place + size))
            if not 0 <= length <= len(body):
                return None
            fields += [(f"#{k}", order + head), (f"{k}", order + kind, (int(length),))]
            size += np.dtype(head).itemsize + int(length) * np.dtype(kind).itemsize
        else:
            fields.append((f"{k}", order + kind))
            size += np.dtype(kind).itemsize
    return np.dtype(fields) if size < 1 << 31 else None


def _walk(body: _Bytes, place: int, order: str, element: _Element, path: Path) -> tuple[_Rows, int]:
    """Step through rows whose lists differ in length, the one way to find where each begins."""
    steps = []  # per property: bytes of a scalar, or the reader of a length and the bytes of an item
    for _, kind, head in element.properties:
        unpack = struct.Struct(order + np.dtype(head).char).unpack_from if head is not None else None
        steps.append((unpack, np.dtype(head).itemsize if head is not None else 0, np.dtype(kind).itemsize))
    view = body.tobytes()
    starts: list[list[int]] = [[] for _ in steps]
    for row in range(element.count):
        try:
            for begin, (unpack, head_size, item) in zip(starts, steps, strict=True):
                begin.append(place)
                length = 1 if unpack is None else int(unpack(view, place)[0])
                if length < 0:
                    raise ValueError
                place += head_size + length * item
            if place > len(body):
                raise ValueError
        except (struct.error, ValueError, OverflowError):  # also a length that is no number
            raise wrong_count(path, element.count, row, f"rows of '{element.name}'") from None
    return _RaggedRows(body, [np.array(s, dtype=np.int64) for s in starts], order, element), place


def _whole(values: NDArray[Any]) -> IntArray:
    """Indices as integers; what is none becomes -1, which no vertex has."""
    with np.errstate(invalid="ignore"):
        whole = values.astype(np.int64)
    return np.where(whole == values, whole, -1)


def _fans(polygons: list[tuple[IntArray, IntArray]]) -> IntArray:
    """Triangles (M, 3) of polygons, in the order of their rows."""
    rows, triangles = [np.empty(0, np.int64)], [np.empty((0, 3), np.int64)]
    for which, corners in polygons:
        for k in range(1, corners.shape[1] - 1):
            rows.append(which)
            triangles.append(corners[:, [0, k, k + 1]])
    order = np.argsort(np.concatenate(rows), kind="stable")
    found: IntArray = np.concatenate(triangles)[order]
    return found


def _checked_faces(faces: IntArray | None, num_points: int, path: Path) -> IntArray | None:
    if faces is None or not len(faces):
        return None
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= num_points:
        raise FormatError(
            f"'{path}': a face names vertex {low if low < 0 else high}, the file holds "
            f"{counted(num_points, 'vertex', 'vertices')}"
        )
    return faces


@writer(".ply")
@writer(".ply", mesh=True)
def write_ply(handle: BinaryIO, cloud: RawCloud, single: bool = False, note: str = "") -> tuple[str, ...]:
    """Binary little-endian PLY: 8 bit colours, fields in their own types, triangles if there are any.

    Args:
        handle: the file.
        cloud: what to write.
        single: coordinates and normals as floats instead of doubles; Point Cloud Library and small_gicp take
            no doubles, and show an empty cloud.
        note: one more line of comment.
    """
    rows = [(axis, "f4" if single else "f8") for axis in "xyz"]
    if cloud.normals is not None:
        rows += [(axis, "f4" if single else "f8") for axis in ("nx", "ny", "nz")]
    if cloud.colors is not None:
        rows += [(color, "u1") for color in ("red", "green", "blue")]
    kept, lost = storable_fields(cloud, _WRITTEN, {name for name, _ in rows})
    held = {"flags": "i4"} | ({"intensity": "f4"} if cloud.colors is not None else {})
    for (
        name,
        values,
    ) in kept.items():  # MeshLab hides points by flags, and paints intensity over colours: no doubles
        kind = values.dtype.str[1:]
        rows.append((name, "f8" if held.get(name) == kind else kind))
    header = ["ply", "format binary_little_endian 1.0", "comment written by geomoe3d"]
    header += [f"comment {note}"] * bool(note)
    header.append(f"element vertex {len(cloud.points)}")
    header += [f"property {_WRITTEN[kind]} {name}" for name, kind in rows]
    if cloud.faces is not None:
        header += [f"element face {len(cloud.faces)}", "property list uchar int vertex_indices"]
    handle.write(("\n".join([*header, "end_header"]) + "\n").encode())
    dtype = np.dtype([(name, "<" + kind) for name, kind in rows])
    for part in chunks(len(cloud.points), dtype.itemsize):
        block = np.empty(part.stop - part.start, dtype=dtype)
        for name, values in chain(_write_columns(cloud, part), ((n, v[part]) for n, v in kept.items())):
            block[name] = values
        handle.write(block.tobytes())
    if cloud.faces is not None:
        triangles = np.empty(len(cloud.faces), dtype=np.dtype([("n", "u1"), ("v", "<i4", (3,))]))
        triangles["n"] = 3
        triangles["v"] = cloud.faces
        handle.write(triangles.tobytes())
    return lost


_WRITTEN = {
    **{"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"},
    **{"f4": "float", "f8": "double"},
}


def _write_columns(cloud: RawCloud, part: slice) -> Iterator[tuple[str, Any]]:
    for k, axis in enumerate("xyz"):
        yield axis, cloud.points[part, k]
    if cloud.normals is not None:
        for k, axis in enumerate(("nx", "ny", "nz")):
            yield axis, cloud.normals[part, k]
    if cloud.colors is not None:
        for k, color in enumerate(("red", "green", "blue")):
            yield color, np.rint(cloud.colors[part, k] * 255.0)
