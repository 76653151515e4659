"""PCD: ascii, binary and compressed; SIZE 8 coordinates stay doubles.

All three are read here, with the header's count held against the content; no library of others sees the file.
A sensor's pose in VIEWPOINT is not applied to the points, as in the Point Cloud Library itself, but named; its
place is where the sensor stood.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
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
from geomoe3d.clouds.formats.text import parse_numbers, write_rows
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
    unread: tuple[str, ...]
    notes: tuple[str, ...]
    sensor: FloatArray | None

    @property
    def dtype(self) -> np.dtype[Any]:
        fields: list[Any] = []
        for k, (kind, count) in enumerate(zip(self.kinds, self.counts, strict=True)):
            fields.append((f"f{k}", "<" + kind) if count == 1 else (f"f{k}", "<" + kind, (count,)))
        return np.dtype(fields)


@reader(".pcd")
def read_pcd(path: Path) -> RawCloud:
    """Points with normals (normal_x ...), colours (packed rgb, or r, g, b) and fields. Raises FormatError: no
    PCD, a header that does not parse, or a count that the content does not bear out."""
    with path.open("rb") as handle:
        header = _read_header(handle, path)
        single = [k for k, count in enumerate(header.counts) if count == 1 and header.names[k] != "_"]
        if "points" not in columns_by_name([header.names[k] for k in single]):
            raise FormatError(f"'{path}': no fields x, y, z of COUNT 1, only: {' '.join(header.names)}")
        read = {"ascii": _read_ascii, "binary": _read_binary}.get(header.data, _read_compressed)
        columns = read(handle, path, header)
    names: list[str] = []
    chosen: list[NDArray[Any]] = []
    for k in single:
        packed = header.names[k].lower() in ("rgb", "rgba") and columns[k].dtype.itemsize == 4
        if packed and "red" not in names:
            names += ["red", "green", "blue"]
            bits = np.ascontiguousarray(columns[k]).view(np.uint32)  # 0x00RRGGBB, as a float too
            chosen += [(bits >> shift).astype(np.uint8) for shift in (16, 8, 0)]
            if header.names[k].lower() == "rgba" and len(np.unique(bits >> 24)) > 1:
                names.append("alpha")
                chosen.append((bits >> 24).astype(np.uint8))
        else:
            names.append(header.names[k])
            chosen.append(columns[k])
    wide = [name for name, count in zip(header.names, header.counts, strict=True) if count != 1]
    unread = (*(name for name in wide if name != "_"), *header.unread)
    return replace(cloud_of(names, chosen, unread=unread), notes=header.notes, sensor=header.sensor)


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
    if not 0 < sum(repeats) < 1 << 20:
        raise FormatError(f"'{path}': COUNT names {sum(repeats)} values per point")
    unread: list[str] = []
    notes: tuple[str, ...] = ()
    sensor: FloatArray | None = None
    if entries.get("VIEWPOINT") and not _is_identity(entries["VIEWPOINT"]):
        unread.append(f"sensor pose (VIEWPOINT {' '.join(entries['VIEWPOINT'])})")
        notes = (f"{unread[0]} is not applied to its points, as in the Point Cloud Library",)
        sensor = _place(entries["VIEWPOINT"])
    if len(grid) == 2 and grid[1] > 1:
        unread.append(f"grid of {grid[0]} x {grid[1]}")
    stored = [_KINDS[kind] for kind in kinds]
    return _Header(names, stored, repeats, num_points, data, num_lines, tuple(unread), notes, sensor)


def _place(viewpoint: list[str]) -> FloatArray | None:
    """The place (3,) of the sensor where the header gives one other than the origin, which is the default."""
    try:
        values = np.array([float(value) for value in viewpoint])
    except ValueError:
        return None
    sound = len(values) == 7 and np.isfinite(values).all() and abs(np.linalg.norm(values[3:]) - 1) < 1e-3
    return values[:3] if sound and values[:3].any() else None


def _is_identity(viewpoint: list[str]) -> bool:
    try:
        return [float(value) for value in viewpoint] == [0, 0, 0, 1, 0, 0, 0]
    except ValueError:
        return False


def _read_ascii(handle: BinaryIO, path: Path, header: _Header) -> list[NDArray[Any]]:
    """Columns as printed, whatever SIZE says; only whole numbers and packed colours take their type."""
    width = sum(header.counts)
    numbers = parse_numbers(path, handle.read(), header.num_lines)
    if len(numbers) != header.num_points * width:
        raise wrong_count(path, header.num_points, len(numbers) // width)
    table = numbers.reshape(-1, width)
    columns: list[NDArray[Any]] = []
    for name, kind, first in zip(
        header.names, header.kinds, np.cumsum([0, *header.counts])[:-1].tolist(), strict=True
    ):
        column = table[:, min(first, width - 1)]
        with np.errstate(all="ignore"):
            stored = column.astype(kind)
        is_packed = name.lower() in ("rgb", "rgba") and bool(np.isfinite(column).all())
        is_whole = kind[0] != "f" and np.array_equal(stored, column)
        columns.append(stored if is_packed or is_whole else column)
    return columns


def _read_binary(handle: BinaryIO, path: Path, header: _Header) -> list[NDArray[Any]]:
    itemsize = header.dtype.itemsize
    rest = path.stat().st_size - handle.tell()
    surplus = rest - header.num_points * itemsize
    if surplus < 0:
        raise wrong_count(path, header.num_points, rest // itemsize)
    rows = np.fromfile(handle, dtype=header.dtype, count=header.num_points)
    if surplus >= itemsize and np.fromfile(handle, dtype=np.uint8).any():  # PCL pads with a page of zeros
        raise wrong_count(path, header.num_points, rest // itemsize)
    _check_end(handle, path)
    return [rows[f"f{k}"] for k in range(len(header.names))]


def _check_end(handle: BinaryIO, path: Path) -> None:
    """Nothing but padding may follow the points."""
    place = handle.tell()
    if handle.read(64).strip(b"\0\r\n\t "):
        size = path.stat().st_size
        raise FormatError(
            f"'{path}' is {size} bytes long, its header describes {place}; it is damaged or misdescribed"
        )


def _read_compressed(handle: BinaryIO, path: Path, header: _Header) -> list[NDArray[Any]]:
    """Column after column, coded together by LZF."""
    sizes = handle.read(8)
    rest = path.stat().st_size - handle.tell()
    packed, unpacked = struct.unpack("<II", sizes) if len(sizes) == 8 else (1, 0)
    if len(sizes) < 8 or packed > rest:
        raise FormatError(
            f"'{path}': the compressed part should have {packed} bytes, the file holds {rest}; truncated"
        )
    if unpacked != header.num_points * header.dtype.itemsize:
        raise wrong_count(path, header.num_points, unpacked // header.dtype.itemsize)
    body = handle.read(packed)
    _check_end(handle, path)
    try:
        plain = _unpack_lzf(body, unpacked)
    except (IndexError, ValueError):
        raise FormatError(f"'{path}': the compressed part is damaged") from None
    columns: list[NDArray[Any]] = []
    place = 0
    for kind, count in zip(header.kinds, header.counts, strict=True):
        column = np.frombuffer(plain, "<" + kind, header.num_points * count, place)
        columns.append(column)
        place += column.nbytes
    return columns


def _unpack_lzf(packed: bytes, size: int) -> bytearray:
    """Undo LZF: a byte below 32 precedes that many bytes and one; others say how far back to copy from.

    About 20 MB per second in plain Python: there is no package with wheels.

    Raises:
        IndexError, ValueError: damaged.
    """
    out = bytearray()
    place, end = 0, len(packed)
    while place < end:
        control = packed[place]
        place += 1
        if control < 32:
            out += packed[place : place + control + 1]
            place += control + 1
        else:
            length = (control >> 5) + 2
            if length == 9:
                length += packed[place]
                place += 1
            begin = len(out) - ((control & 31) << 8) - packed[place] - 1
            place += 1
            if begin < 0:
                raise ValueError
            piece = out[begin : begin + length]
            out += (piece * (length // len(piece) + 1))[:length]  # a copy may run into itself
        if len(out) > size:
            raise ValueError
    if len(out) != size or place != end:
        raise ValueError
    return out


@writer(".pcd")
def write_pcd(
    handle: BinaryIO, cloud: RawCloud, single: bool | None = None, note: str = ""
) -> tuple[str, ...]:
    """Binary PCD with float coordinates where those suffice, else ASCII with every digit.

    The Point Cloud Library and Open3D's legacy reader take binary floats and misread binary doubles, so
    floats are written when they move no coordinate by more than 1e-6 of the cloud's spread. At map
    coordinates they would lose decimetres: there every digit is printed, though as SIZE 4, without which
    the Point Cloud Library finds no coordinates. Normals are floats, colours 8 bit in a packed rgb.

    Args:
        handle: the file.
        cloud: what to write.
        single: whether to write floats; None decides as above.
        note: one more line of comment.
    """
    if single is None:
        single = fits_single_precision(cloud.points)
    fields = [(axis, 4, "F") for axis in "xyz"]
    if cloud.normals is not None:
        fields += [(f"normal_{axis}", 4, "F") for axis in "xyz"]
    if cloud.colors is not None:
        fields.append(("rgb", 4, "U"))
    kept, lost = storable_fields(cloud, _KINDS.values(), {"_", "rgba", *(name for name, _, _ in fields)})
    fields += [(n, v.dtype.itemsize, v.dtype.kind.upper()) for n, v in kept.items()]
    num = len(cloud.points)
    lines = ["# .PCD v0.7 - Point Cloud Data file format", *([f"# {note}"] * bool(note)), "VERSION 0.7"]
    for k, key in enumerate(("FIELDS", "SIZE", "TYPE")):
        lines.append(f"{key} {' '.join(str(entry[k]) for entry in fields)}")
    lines += [f"COUNT {' '.join('1' for _ in fields)}", f"WIDTH {num}", "HEIGHT 1"]
    lines += ["VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {num}", f"DATA {'binary' if single else 'ascii'}"]
    handle.write(("\n".join(lines) + "\n").encode())
    dtype = np.dtype([(f"f{k}", f"<{kind.lower()}{size}") for k, (_, size, kind) in enumerate(fields)])
    for part in chunks(num, dtype.itemsize):
        columns = [cloud.points[part, k] for k in range(3)]
        if cloud.normals is not None:
            columns += [cloud.normals[part, k].astype(np.float32) for k in range(3)]
        if cloud.colors is not None:
            r, g, b = np.rint(cloud.colors[part] * 255.0).astype(np.uint32).T
            columns.append((r << 16) | (g << 8) | b)
        columns += [values[part] for values in kept.values()]
        if single:
            block = np.empty(part.stop - part.start, dtype=dtype)
            for k, column in enumerate(columns):
                block[f"f{k}"] = column
            handle.write(block.tobytes())
        else:
            write_rows(handle, [column[:, None] for column in columns])
    return lost
