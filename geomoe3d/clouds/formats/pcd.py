"""PCD: ascii, binary and compressed; SIZE 8 coordinates stay doubles.

ASCII and binary are read here, with the header's count held against the content; only the compressed body
is decoded by Open3D's tensor reader, after its sizes have been checked. The sensor pose in VIEWPOINT is not
applied, as in the Point Cloud Library itself.
"""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

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
from geomoe3d.clouds.recentre import fits_single_precision
from geomoe3d.errors import FormatError
from geomoe3d.types import FloatArray

_KINDS = {
    **{"F4": "f4", "F8": "f8", "I1": "i1", "I2": "i2", "I4": "i4", "I8": "i8"},
    **{"U1": "u1", "U2": "u2", "U4": "u4", "U8": "u8"},
}


@dataclass(frozen=True)
class _Header:
    names: list[str]
    kinds: list[str]
    counts: list[int]
    num_points: int
    data: str
    num_lines: int

    @property
    def dtype(self) -> np.dtype[Any]:
        fields: list[Any] = []
        for k, (kind, count) in enumerate(zip(self.kinds, self.counts, strict=True)):
            fields.append((f"f{k}", "<" + kind) if count == 1 else (f"f{k}", "<" + kind, (count,)))
        return np.dtype(fields)


def read_pcd(path: Path) -> RawCloud:
    """Points with normals (normal_x ...) and colours (packed rgb, or r, g, b).

    Raises:
        FormatError: no PCD, a header that does not parse, or a count that the content does not bear out.
    """
    with path.open("rb") as handle:
        header = _read_header(handle, path)
        groups = columns_by_name(header.names)
        if "points" not in groups:
            raise FormatError(f"'{path}': the fields have no x, y, z, only: {' '.join(header.names)}")
        packed = next((k for k, name in enumerate(header.names) if name.lower() in ("rgb", "rgba")), None)
        if packed is not None and header.kinds[packed] in ("f4", "u4", "i4"):
            groups["packed"] = [packed]
        if any(header.counts[k] != 1 for columns in groups.values() for k in columns):
            raise FormatError(f"'{path}': coordinates, normals and colours need COUNT 1")
        if header.data == "binary_compressed":
            return replace(_read_compressed(handle, path, header), unread=_unread(header.names, groups))
        if header.data == "ascii":
            columns = _read_ascii(handle, path, header, groups)
        else:
            columns = _read_binary(handle, path, header, groups)
    colors = None
    if "colors" in columns:
        colors = scale_colors(columns["colors"])
    elif "packed" in columns:
        colors = _unpack(columns["packed"])
    unread = _unread(header.names, groups)
    return RawCloud(columns["points"], columns.get("normals"), colors, unread=unread)


def _unread(names: list[str], groups: dict[str, list[int]]) -> tuple[str, ...]:
    """Without ``_``, the name of padding."""
    return tuple(name for name in unread_names(names, groups) if name != "_")


def _read_header(handle: BinaryIO, path: Path) -> _Header:
    entries: dict[str, list[str]] = {}
    num_lines = 0
    while num_lines < 1000:
        num_lines += 1
        line = handle.readline(100_000)
        words = line.decode("latin-1").split()
        if not line or "\0" in words[0:1]:
            break
        if not words or words[0].startswith("#"):
            continue
        entries[words[0].upper()] = words[1:]
        if words[0].upper() == "DATA":
            break
    names = entries.get("FIELDS", entries.get("COLUMNS", []))
    missing = [key for key in ("SIZE", "TYPE", "DATA") if not entries.get(key)]
    if not names:
        missing.insert(0, "FIELDS")
    if missing:
        raise FormatError(f"'{path}' is no PCD file or truncated: its header lacks {', '.join(missing)}")
    sizes, types = entries["SIZE"], entries["TYPE"]
    counts = entries.get("COUNT") or ["1"] * len(names)
    if not len(names) == len(sizes) == len(types) == len(counts):
        raise FormatError(
            f"'{path}': FIELDS, SIZE, TYPE and COUNT name {len(names)}, {len(sizes)}, {len(types)} and "
            f"{len(counts)} fields; they must agree"
        )
    kinds = [type_.upper() + size for type_, size in zip(types, sizes, strict=True)]
    unknown = [kind for kind in kinds if kind not in _KINDS]
    if unknown:
        raise FormatError(f"'{path}': unknown field type {unknown[0]}; known: {', '.join(_KINDS)}")
    grid = [header_count(entries[key][0], path, key) for key in ("WIDTH", "HEIGHT") if entries.get(key)]
    product = grid[0] * grid[1] if len(grid) == 2 else None
    if entries.get("POINTS"):
        num_points = header_count(entries["POINTS"][0], path, "POINTS")
    elif product is not None:
        num_points = product
    else:
        raise FormatError(f"'{path}': the header has neither POINTS nor WIDTH and HEIGHT")
    if product is not None and product != num_points:
        raise FormatError(f"'{path}': the header says POINTS {num_points} but WIDTH x HEIGHT is {product}")
    data = entries["DATA"][0].lower()
    if data not in ("ascii", "binary", "binary_compressed"):
        raise FormatError(f"'{path}': unknown DATA '{data}'; known: ascii, binary, binary_compressed")
    repeats = [header_count(count, path, "COUNT") for count in counts]
    return _Header(names, [_KINDS[kind] for kind in kinds], repeats, num_points, data, num_lines)


def _wrong_count(path: Path, said: int, held: int) -> FormatError:
    reason = "it is truncated or its header is wrong" if held < said else "its header is wrong"
    return FormatError(f"'{path}': the header says {said} points, the file holds {held}; {reason}")


def _read_ascii(
    handle: BinaryIO, path: Path, header: _Header, groups: dict[str, list[int]]
) -> dict[str, NDArray[Any]]:
    with io.TextIOWrapper(handle, encoding="latin-1") as text:
        table = parse_table(path, DataLines(text, header.num_lines), None, sum(header.counts))
    if len(table) != header.num_points:
        raise _wrong_count(path, header.num_points, len(table))
    first = np.concatenate([[0], np.cumsum(header.counts)])[:-1]
    columns: dict[str, NDArray[Any]] = {}
    for group, fields in groups.items():
        part = np.ascontiguousarray(table[:, first[fields]])
        # Coordinates keep all printed digits whatever SIZE says; packed colours are the bits of their type.
        if group == "packed" and not np.isfinite(part).all():
            continue
        columns[group] = part.astype(header.kinds[fields[0]]) if group == "packed" else part
        if group == "colors" and header.kinds[fields[0]] == "u1":
            columns[group] = part.astype(np.uint8)
    return columns


def _read_binary(
    handle: BinaryIO, path: Path, header: _Header, groups: dict[str, list[int]]
) -> dict[str, NDArray[Any]]:
    rest = path.stat().st_size - handle.tell()
    itemsize = header.dtype.itemsize
    held = rest // itemsize
    surplus = rest - header.num_points * itemsize
    if held < header.num_points or surplus >= itemsize:
        raise _wrong_count(path, header.num_points, held)
    columns = read_columns(handle, header.dtype, header.num_points, groups)
    _check_end(handle, path)
    return columns


def _check_end(handle: BinaryIO, path: Path) -> None:
    """Nothing but padding may follow the points."""
    place = handle.tell()
    if handle.read(64).strip(b"\0\r\n\t "):
        size = path.stat().st_size
        raise FormatError(
            f"'{path}' is {size} bytes long, its header describes {place}; it is damaged or misdescribed"
        )


def _read_compressed(handle: BinaryIO, path: Path, header: _Header) -> RawCloud:
    """Check the sizes, then let Open3D's tensor reader (exact for float and double) undo the LZF coding."""
    sizes = handle.read(8)
    rest = path.stat().st_size - handle.tell()
    packed, unpacked = struct.unpack("<II", sizes) if len(sizes) == 8 else (1, 0)
    if len(sizes) < 8 or packed > rest:
        raise FormatError(
            f"'{path}': the compressed part should have {packed} bytes, the file holds {rest}; truncated"
        )
    if unpacked != header.num_points * header.dtype.itemsize:
        raise _wrong_count(path, header.num_points, unpacked // header.dtype.itemsize)
    handle.seek(packed, io.SEEK_CUR)
    _check_end(handle, path)
    if not header.num_points:
        return RawCloud(np.empty((0, 3)))
    import open3d as o3d

    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud: Any = o3d.t.io.read_point_cloud(path, format="pcd")
    held = len(cloud.point.positions) if "positions" in cloud.point else 0
    if held != header.num_points:
        raise FormatError(
            f"'{path}': the compressed part is damaged, {held} of {header.num_points} points could be decoded"
        )
    normals = cloud.point.normals.numpy().astype(np.float64) if "normals" in cloud.point else None
    colors = scale_colors(cloud.point.colors.numpy()) if "colors" in cloud.point else None
    return RawCloud(cloud.point.positions.numpy().astype(np.float64), normals, colors)


def _unpack(packed: NDArray[Any]) -> FloatArray:
    """Colours from 0x00RRGGBB, stored as an integer or in the bits of a float."""
    bits = packed[:, 0].view(np.uint32)
    return np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], axis=1) / 255.0


def write_pcd(handle: BinaryIO, cloud: RawCloud) -> None:
    """Binary PCD with float coordinates where those suffice, else ASCII with double coordinates.

    The Point Cloud Library and Open3D's legacy reader take binary floats and misread binary doubles, so
    floats are written when they move no coordinate by more than 1e-6 of the cloud's spread. At map
    coordinates they would lose decimetres: there every digit is printed. Normals are floats, colours 8 bit
    in a packed rgb.
    """
    single = fits_single_precision(cloud.points)
    size = 4 if single else 8
    fields = [(axis, size, "F") for axis in "xyz"]
    if cloud.normals is not None:
        fields += [(f"normal_{axis}", 4, "F") for axis in "xyz"]
    if cloud.colors is not None:
        fields.append(("rgb", 4, "U"))
    num = len(cloud.points)
    lines = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7"]
    for k, key in enumerate(("FIELDS", "SIZE", "TYPE")):
        lines.append(f"{key} {' '.join(str(entry[k]) for entry in fields)}")
    lines += [f"COUNT {' '.join('1' for _ in fields)}", f"WIDTH {num}", "HEIGHT 1"]
    lines += ["VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {num}", f"DATA {'binary' if single else 'ascii'}"]
    handle.write(("\n".join(lines) + "\n").encode("ascii"))
    dtype = np.dtype([(f"f{k}", f"<{kind.lower()}{size}") for k, (_, size, kind) in enumerate(fields)])
    for part in chunks(num, dtype.itemsize):
        columns = [cloud.points[part, k] for k in range(3)]
        if cloud.normals is not None:
            columns += [cloud.normals[part, k].astype(np.float32) for k in range(3)]
        if cloud.colors is not None:
            r, g, b = np.rint(cloud.colors[part] * 255.0).astype(np.uint32).T
            columns.append((r << 16) | (g << 8) | b)
        if single:
            block = np.empty(part.stop - part.start, dtype=dtype)
            for k, column in enumerate(columns):
                block[f"f{k}"] = column
            handle.write(block.tobytes())
        else:
            _write_text_rows(handle, columns)


def _write_text_rows(handle: BinaryIO, columns: list[NDArray[Any]]) -> None:
    for start in range(0, len(columns[0]), 50_000):
        rows = zip(*(column[start : start + 50_000].tolist() for column in columns), strict=True)
        handle.write(("\n".join([" ".join(map(repr, row)) for row in rows]) + "\n").encode("ascii"))
