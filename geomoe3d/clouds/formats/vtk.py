"""VTK's legacy files (.vtk), ascii and binary: the points of any dataset with what is said of them, and faces.

Polygons, strips of triangles, and the flat cells of an unstructured grid are triangles. Solid cells and lines are
named as lost; so are vertices, unless they only say that every point is to be seen.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomoe3d.clouds.formats.raw import RawCloud, cloud_of, header_count, wrong_count
from geomoe3d.clouds.formats.registry import reader
from geomoe3d.errors import FormatError
from geomoe3d.types import IntArray

_TYPES = {
    **{"float": "f4", "double": "f8", "char": "i1", "unsigned_char": "u1", "short": "i2"},
    **{"unsigned_short": "u2", "int": "i4", "unsigned_int": "u4", "long": "i8", "unsigned_long": "u8"},
    **{"vtktypeint64": "i8", "vtkidtype": "i8"},
}
_CELLS = ("VERTICES", "LINES", "POLYGONS", "TRIANGLE_STRIPS", "CELLS")
_FLAT_CELLS = {  # by the number of the type; 1 and 2 are points
    5: "triangle",
    6: "strip",
    7: "polygon",
    9: "quadrilateral",
}


class _Body:
    """What follows the first lines: lines of words, and blocks of numbers between them."""

    def __init__(self, path: Path, data: bytes, is_ascii: bool) -> None:
        self.path, self._data, self._ascii, self._place = path, data, is_ascii, 0

    def line(self) -> list[str]:
        """The words of the next line that is not empty; none at the end."""
        while self._place < len(self._data):
            end = self._data.find(b"\n", self._place)
            end = len(self._data) if end < 0 else end
            words = self._data[self._place : min(end, self._place + 1000)].decode("latin-1").split()
            self._place = end + 1
            if words:
                return words
        return []

    def numbers(self, kind: str, count: int, what: str) -> NDArray[Any]:
        """The next ``count`` values of a VTK type."""
        if kind.lower() not in _TYPES:
            raise FormatError(f"'{self.path}': unknown type '{kind}' of {what}; known: {', '.join(_TYPES)}")
        dtype = np.dtype(">" + _TYPES[kind.lower()])
        if not self._ascii:
            held = (len(self._data) - self._place) // dtype.itemsize
            if count > held:
                raise wrong_count(self.path, count, held, f"values of {what}")
            values = np.frombuffer(self._data, dtype, count, self._place)
            self._place += values.nbytes
            return values.astype(dtype.newbyteorder("="))
        words: list[bytes] = []
        while len(words) < count and self._place < len(self._data):
            end = self._data.find(b"\n", self._place)
            end = len(self._data) if end < 0 else end
            words += self._data[self._place : end].split()
            self._place = end + 1
        if len(words) < count:
            raise wrong_count(self.path, count, len(words), f"values of {what}")
        try:
            parsed = np.array(words[:count], dtype="S40").astype(np.float64)
        except ValueError:
            raise FormatError(f"'{self.path}': the values of {what} are not all numbers") from None
        with np.errstate(all="ignore"):
            stored = parsed.astype(dtype.newbyteorder("="))
        return stored if np.array_equal(stored, parsed) else parsed


@reader(".vtk")
def read_vtk(path: Path) -> RawCloud:
    """POINTS of a legacy file, with normals, colours, vectors and scalars of POINT_DATA, and its triangles.
    Raises FormatError: no legacy VTK file, no points, or fewer values than it says."""
    with path.open("rb") as handle:
        if not handle.readline(256).startswith(b"# vtk DataFile"):
            raise FormatError(
                f"'{path}' is no legacy VTK file: it does not start with '# vtk DataFile'; save VTK's XML "
                "files (.vtp, .vtu) as legacy .vtk or as .ply"
            )
        handle.readline(10_000)
        kind = handle.readline(256).strip().upper()
        if kind not in (b"ASCII", b"BINARY"):
            raise FormatError(f"'{path}': its third line is neither ASCII nor BINARY")
        body = _Body(path, handle.read(), kind == b"ASCII")
    points: NDArray[Any] | None = None
    names, columns = ["x", "y", "z"], []
    unread: list[str] = []
    cells: dict[str, _Lists] = {}
    kinds = np.zeros(0, np.int64)
    while words := body.line():
        key = words[0].upper()
        if key == "POINTS" and len(words) >= 3:
            num = header_count(words[1], path, "number of points")
            points = body.numbers(words[2], 3 * num, "POINTS").reshape(-1, 3)
        elif key in _CELLS and len(words) >= 3:
            cells[key] = _read_cells(body, words)
        elif key == "POINT_DATA" and points is not None and len(words) > 1:
            if header_count(words[1], path, "number of point data") != len(points):
                raise wrong_count(path, int(words[1]), len(points), "points with data")
            for name, values in _attributes(body, len(points), unread):
                names.append(name)
                columns.append(values)
        elif key in ("CELL_DATA", "METADATA", "CELL_TYPES"):
            unread += [key.lower()] if key == "CELL_DATA" else []
            if key == "CELL_DATA":
                break
            if key == "CELL_TYPES":
                kinds = body.numbers("int", header_count(words[1], path, "number of cells"), key).astype(
                    np.int64
                )
        elif key == "DIMENSIONS":
            unread.append(f"grid of {' x '.join(words[1:])}"[:60])
        elif key not in ("DATASET", "INFORMATION", "NAME", "DATA", "FIELD"):
            unread.append(f"what follows {words[0][:40]}")
            break
    if points is None:
        raise FormatError(f"'{path}' has no POINTS; other datasets of VTK are grids of values, no clouds")
    faces, others = _faces(path, cells, kinds, len(points))
    return cloud_of(names, [*points.T, *columns], faces=faces, unread=(*others, *unread))


_Lists = tuple[IntArray, IntArray]  # where each cell's points begin, and the points of all


def _read_cells(body: _Body, words: list[str]) -> _Lists:
    first, second = (header_count(word, body.path, words[0]) for word in words[1:3])
    place = body._place
    if (after := body.line())[:1] == ["OFFSETS"]:  # version 5
        begins = body.numbers([*after, ""][1], first, "OFFSETS").astype(np.int64)
        after = body.line()
        return begins, body.numbers((after or [""])[-1], second, "CONNECTIVITY").astype(np.int64)
    body._place = place
    table = body.numbers("int", second, words[0]).astype(np.int64)
    width = second // max(first, 1)
    if first and width > 0 and second == first * width and (table[::width] == width - 1).all():
        return np.arange(first + 1) * (width - 1), table.reshape(first, width)[:, 1:].ravel()
    places, points, at = [0], [], 0
    for _ in range(first):
        length = int(table[at]) if at < second else -1
        if not 0 <= length < second - at:
            raise FormatError(
                f"'{body.path}': the lengths of {words[0]} do not come to the {second} that it says"
            )
        points.append(table[at + 1 : at + 1 + length])
        places.append(places[-1] + length)
        at += 1 + length
    return np.array(places), np.concatenate(points) if points else np.zeros(0, np.int64)


def _faces(
    path: Path, cells: dict[str, _Lists], kinds: IntArray, num_points: int
) -> tuple[IntArray | None, list[str]]:
    """Triangles (M, 3) of all flat cells, or None, and names of the other cells. Raises FormatError: a cell
    names a point that there is not, or the cells are more or fewer than their types."""
    found: list[IntArray] = []
    others: list[str] = []
    for key, (begins, points) in cells.items():
        if len(points) and (points.min() < 0 or points.max() >= num_points):
            raise FormatError(f"'{path}': {key} name points beyond the {num_points} that the file holds")
        if (np.diff(begins) < 0).any() or (len(begins) and not 0 <= begins[0] <= begins[-1] <= len(points)):
            raise FormatError(f"'{path}': the offsets of {key} are out of order")
        of = {"POLYGONS": 7, "TRIANGLE_STRIPS": 6, "VERTICES": 1}.get(key, 0)
        num_cells = max(len(begins) - 1, 0)
        types = kinds if key == "CELLS" else np.full(num_cells, of)
        if len(types) != num_cells:
            raise wrong_count(path, num_cells, len(types), "types of cells")
        lengths = np.diff(begins)
        for kind, length in np.unique(np.stack([types, lengths]), axis=1).T.tolist() if num_cells else ():
            if kind not in _FLAT_CELLS or length < 3:
                continue
            rows = begins[:-1][(types == kind) & (lengths == length)]
            first = np.arange(length - 2)
            odd = first % 2  # every second triangle of a strip runs the other way round
            strip = (first + odd, first + 1 - odd, first + 2)
            corners = strip if _FLAT_CELLS[kind] == "strip" else (0 * first, first + 1, first + 2)
            found.append(points[(rows[:, None, None] + np.stack(corners, axis=1)).reshape(-1, 3)])
        plain = np.isin(types, (1, 2))
        rest = ~np.isin(types, (*_FLAT_CELLS, 1, 2))
        if rest.any():
            others.append("lines" if key == "LINES" else "cells that are no faces")
        if plain.any() and len(np.unique(points[np.repeat(plain, lengths)])) < num_points and not found:
            others.append("vertices")
    return (np.concatenate(found) if found else None), others


def _attributes(body: _Body, count: int, unread: list[str]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Columns (count,) by name, until something else begins."""
    while words := body.line():
        key = words[0].upper()
        if key == "SCALARS" and len(words) >= 3:
            width = int(words[3]) if len(words) > 3 and words[3].isdigit() else 1
            body.line()  # LOOKUP_TABLE
            yield from _named(words[1], body.numbers(words[2], count * width, words[1]), width)
        elif key == "NORMALS" and len(words) >= 3:
            yield from _named("normals", body.numbers(words[2], count * 3, key), 3, ("nx", "ny", "nz"))
        elif key == "VECTORS" and len(words) >= 3:
            axes = tuple(f"{words[1]}_{axis}" for axis in "xyz")
            yield from _named(words[1], body.numbers(words[2], count * 3, key), 3, axes)
        elif key == "COLOR_SCALARS" and len(words) >= 3:
            width = header_count(words[2], body.path, key)
            kind = "unsigned_char" if not body._ascii else "float"
            colors = body.numbers(kind, count * width, key)
            yield from _named(words[1], colors, width, ("red", "green", "blue", "alpha"))
        elif key == "FIELD" and len(words) >= 3:
            for _ in range(header_count(words[2], body.path, key)):
                name, each, tuples, kind = (body.line() + [""] * 4)[:4]
                num, size = header_count(tuples, body.path, name), header_count(each, body.path, name)
                values = body.numbers(kind, num * size, name)
                if num == count:
                    roles: tuple[str, ...] = ()
                    if kind == "unsigned_char" and size in (3, 4):
                        roles = ("red", "green", "blue", "alpha")
                    elif name.lower() in ("normals", "normal") and size == 3:
                        roles = ("nx", "ny", "nz")
                    yield from _named(name, values, size, roles)
                else:
                    unread.append(name)
        elif key not in ("METADATA", "INFORMATION", "NAME", "DATA"):
            unread.append(f"what follows {words[0][:40]}")
            return


def _named(
    name: str, values: NDArray[Any], width: int, roles: tuple[str, ...] = ()
) -> Iterator[tuple[str, NDArray[Any]]]:
    for k, column in enumerate(values.reshape(-1, width).T if width else ()):
        yield roles[k] if k < len(roles) else name if width == 1 else f"{name}_{k}", column
