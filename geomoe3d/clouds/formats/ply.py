"""PLY: ascii and binary of both byte orders, every scalar type, faces; doubles stay doubles.

Own code because the usual readers return made-up rows for a truncated file or print to the terminal. The
header's counts are held against the file's size before anything is read; reading is chunked.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from geomoe3d.clouds.formats.raw import (
    RawCloud,
    chunks,
    columns_by_name,
    header_count,
    read_columns,
    scale_colors,
    unread_names,
)
from geomoe3d.clouds.formats.text import DataLines, parse_table
from geomoe3d.errors import FormatError
from geomoe3d.types import IntArray

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


@dataclass
class _Element:
    """One element of the header; a property is (name, type, type of its length or None)."""

    name: str
    count: int
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        return any(length is not None for _, _, length in self.properties)

    def dtype(self, order: str) -> np.dtype[Any]:
        return np.dtype([(f"f{k}", order + kind) for k, (_, kind, _) in enumerate(self.properties)])


def read_ply(path: Path) -> RawCloud:
    """Vertices with normals and colours, and the faces (polygons cut into triangle fans) if there are any.

    Raises:
        FormatError: no PLY, an unknown header line, or counts that the file's content does not bear out.
    """
    with path.open("rb") as handle:
        order, elements, num_lines = _read_header(handle, path)
        names = [element.name for element in elements]
        if "vertex" not in names:
            raise FormatError(f"'{path}' has no element 'vertex', only: {', '.join(names) or 'nothing'}")
        vertex = elements[names.index("vertex")]
        groups = columns_by_name([name for name, _, _ in vertex.properties])
        if "points" not in groups:
            found = ", ".join(name for name, _, _ in vertex.properties) or "none"
            raise FormatError(f"'{path}': the vertices have no properties x, y, z, only: {found}")
        if vertex.has_lists:
            raise FormatError(f"'{path}': vertices with list properties are not supported")
        unread = unread_names([name for name, _, _ in vertex.properties], groups)
        if order == "=":
            with io.TextIOWrapper(handle, encoding="latin-1") as text:
                cloud = _read_ascii(DataLines(text, num_lines), path, elements, groups)
        else:
            cloud = _read_binary(handle, path, order, elements, groups)
    return replace(cloud, unread=unread)


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


def _read_ascii(
    lines: DataLines, path: Path, elements: list[_Element], groups: dict[str, list[int]]
) -> RawCloud:
    cloud = RawCloud(np.empty((0, 3)))
    faces: IntArray | None = None
    for element in elements:
        lines.begin(element.count)
        try:
            if element.name == "vertex":
                cloud = _ascii_vertices(lines, path, element, groups)
            elif element.name == "face" and _index_property(element) is not None:
                faces = _ascii_faces(lines, path, element)
            else:
                for _ in lines:
                    pass
        except FormatError:
            broken = lines.taken
            lines.begin(1)
            if next(lines, None) is None:  # the last line of the file is cut off: the counts say it better
                raise _wrong_count(path, element, broken - 1) from None
            raise
        if lines.taken < element.count:
            raise _wrong_count(path, element, lines.taken)
    lines.begin(1 << 60)
    extra = sum(1 for _ in lines)
    if extra:
        raise _wrong_count(path, elements[-1], elements[-1].count + extra)
    return replace(cloud, faces=_checked_faces(faces, len(cloud.points), path))


def _wrong_count(path: Path, element: _Element, held: int) -> FormatError:
    return FormatError(
        f"'{path}': the header says {element.count} rows of '{element.name}', the file holds {held}; "
        f"{'it is truncated or ' if held < element.count else ''}its header is wrong"
    )


def _ascii_vertices(
    lines: DataLines, path: Path, element: _Element, groups: dict[str, list[int]]
) -> RawCloud:
    table = parse_table(path, lines, None, len(element.properties))
    normals = table[:, groups["normals"]] if "normals" in groups else None
    colors = None
    if "colors" in groups:
        colors = scale_colors(table[:, groups["colors"]], element.properties[groups["colors"][0]][1])
    return RawCloud(np.ascontiguousarray(table[:, groups["points"]]), normals, colors)


def _index_property(element: _Element) -> int | None:
    """Position of the list of vertex indices."""
    for k, (name, _, length) in enumerate(element.properties):
        if length is not None and name in ("vertex_indices", "vertex_index"):
            return k
    return None


def _ascii_faces(lines: DataLines, path: Path, element: _Element) -> IntArray:
    triangles: list[list[int]] = []
    wanted = _index_property(element)
    for line in lines:
        words = line.split()
        place = 0
        try:
            for k, (_, _, length) in enumerate(element.properties):
                size = 0 if length is None else int(words[place])
                if k == wanted:
                    polygon = [int(word) for word in words[place + 1 : place + 1 + size]]
                    triangles += [[polygon[0], polygon[j], polygon[j + 1]] for j in range(1, size - 1)]
                place += 1 + size
            if place != len(words):
                raise IndexError
        except (ValueError, IndexError):
            raise FormatError(f"{lines.where(path)} is no row of element 'face'") from None
    return np.array(triangles, dtype=np.int64).reshape(-1, 3)


def _read_binary(
    handle: BinaryIO, path: Path, order: str, elements: list[_Element], groups: dict[str, list[int]]
) -> RawCloud:
    place = handle.tell()
    size = path.stat().st_size
    columns: dict[str, Any] = {}
    faces: IntArray | None = None
    for element in elements:
        if element.has_lists:
            place, triangles = _walk_lists(path, place, size, order, element)
            faces = triangles if element.name == "face" else faces
            continue
        dtype = element.dtype(order)
        held = (size - place) // dtype.itemsize if dtype.itemsize else element.count
        last = element is elements[-1]
        if held < element.count or (last and held > element.count):
            raise _wrong_count(path, element, held)
        if element.name == "vertex":
            handle.seek(place)
            columns = read_columns(handle, dtype, element.count, groups)
        place += element.count * dtype.itemsize
    handle.seek(place)
    if handle.read(64).strip(b"\0\r\n\t "):
        raise FormatError(
            f"'{path}' is {size} bytes long, its header describes {place}; the counts in its header are wrong"
        )
    colors = scale_colors(columns["colors"]) if "colors" in columns else None
    points = columns["points"]
    faces = _checked_faces(faces, len(points), path)
    return RawCloud(points, columns.get("normals"), colors, faces)


def _walk_lists(path: Path, place: int, size: int, order: str, element: _Element) -> tuple[int, IntArray]:
    """Step over rows that hold lists and collect their triangles; returns the byte behind the last row.

    Rows of equal layout (nearly always all of them) are taken many at a time.
    """
    data = np.memmap(path, dtype=np.uint8, mode="r") if element.count else np.empty(0, np.uint8)
    wanted = _index_property(element)
    found: list[IntArray] = []
    done, window = 0, 1
    while done < element.count:
        layout, stride = _row_layout(data, place, order, element)
        rows = min(window, element.count - done, (size - place) // stride if stride else element.count)
        if rows < 1:
            raise _wrong_count(path, element, done)
        same = np.ones(rows, dtype=np.bool_)
        for offset, kind, length, _ in layout:
            same &= np.ndarray((rows,), order + kind, data, place + offset, (stride,)) == length
        rows = rows if same.all() else int(np.argmin(same))
        if wanted is not None:
            lists = [k for k, (_, _, length) in enumerate(element.properties) if length is not None]
            offset, kind, length, item = layout[lists.index(wanted)]
            start = place + offset + np.dtype(kind).itemsize
            width = np.dtype(item).itemsize
            polygons = np.ndarray((rows, length), order + item, data, start, (stride, width)).astype(np.int64)
            found += [polygons[:, [0, j, j + 1]] for j in range(1, length - 1)]
        done += rows
        place += rows * stride
        window = window * 2 if same.all() else 1
    return place, np.concatenate(found) if found else np.empty((0, 3), dtype=np.int64)


def _row_layout(
    data: np.ndarray[Any, np.dtype[np.uint8]], place: int, order: str, element: _Element
) -> tuple[list[tuple[int, str, int, str]], int]:
    """Lists of the row at ``place`` as (offset, type of the length, length, type of an item), and its size.

    A row that the file does not hold completely gets a size beyond the file's end.
    """
    layout = []
    offset = 0
    for _, kind, length_kind in element.properties:
        width = np.dtype(kind).itemsize
        if length_kind is None:
            offset += width
            continue
        head = np.dtype(length_kind).itemsize
        if place + offset + head > len(data):
            return [], len(data) + 1
        length = int(np.ndarray((), order + length_kind, data, place + offset))
        if length < 0:
            return [], len(data) + 1
        layout.append((offset, length_kind, length, kind))
        offset += head + length * width
    return layout, offset


def _checked_faces(faces: IntArray | None, num_points: int, path: Path) -> IntArray | None:
    if faces is None or not len(faces):
        return None
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= num_points:
        raise FormatError(
            f"'{path}': a face names vertex {low if low < 0 else high}, the file holds {num_points} vertices"
        )
    return faces


def write_ply(handle: BinaryIO, cloud: RawCloud) -> None:
    """Binary little-endian PLY: double coordinates and normals, 8 bit colours, triangles if there are any."""
    rows: list[tuple[str, str]] = [(axis, "<f8") for axis in "xyz"]
    if cloud.normals is not None:
        rows += [(axis, "<f8") for axis in ("nx", "ny", "nz")]
    if cloud.colors is not None:
        rows += [(color, "u1") for color in ("red", "green", "blue")]
    header = ["ply", "format binary_little_endian 1.0", "comment written by geomoe3d"]
    header.append(f"element vertex {len(cloud.points)}")
    header += [f"property {'uchar' if kind == 'u1' else 'double'} {name}" for name, kind in rows]
    if cloud.faces is not None:
        header += [f"element face {len(cloud.faces)}", "property list uchar int vertex_indices"]
    handle.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
    dtype = np.dtype(rows)
    for part in chunks(len(cloud.points), dtype.itemsize):
        block = np.empty(part.stop - part.start, dtype=dtype)
        for name, values in _write_columns(cloud, part):
            block[name] = values
        handle.write(block.tobytes())
    if cloud.faces is not None:
        triangles = np.empty(len(cloud.faces), dtype=np.dtype([("n", "u1"), ("v", "<i4", (3,))]))
        triangles["n"] = 3
        triangles["v"] = cloud.faces
        handle.write(triangles.tobytes())


def _write_columns(cloud: RawCloud, part: slice) -> Iterator[tuple[str, Any]]:
    for k, axis in enumerate("xyz"):
        yield axis, cloud.points[part, k]
    if cloud.normals is not None:
        for k, axis in enumerate(("nx", "ny", "nz")):
            yield axis, cloud.normals[part, k]
    if cloud.colors is not None:
        for k, color in enumerate(("red", "green", "blue")):
            yield color, np.rint(cloud.colors[part, k] * 255.0)
