"""LAS and LAZ (extra ``geomoe3d[las]``, laspy with lazrs): exact float64 coordinates and 16 bit colours."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from geomoe3d.clouds.formats.raw import RawCloud, columns_by_name, scale_colors
from geomoe3d.errors import DependencyError, FormatError

_LARGEST = 2_000_000_000  # of the signed 32 bit integers that LAS stores, with a margin


def _laspy(compressed: bool) -> Any:
    try:
        import laspy
    except ImportError:
        raise DependencyError(
            "LAS and LAZ files need laspy, which is not installed: pip install 'laspy[lazrs]'"
        ) from None
    if compressed and not laspy.LazBackend.detect_available():
        raise DependencyError("LAZ files need lazrs, which is not installed: pip install 'laspy[lazrs]'")
    return laspy


def read_las(path: Path) -> RawCloud:
    """Coordinates X * scale + offset in float64, with colours, and normals if extra dimensions name them.

    Colours are 16 bit by the standard; a file whose largest value fits 8 bits is taken as 8 bit, and one
    with nothing but zeros as having none.

    Raises:
        FormatError: no LAS file, damaged, or a count in the header that the content does not bear out.
        DependencyError: laspy (or lazrs for LAZ) is absent.
    """
    laspy = _laspy(path.suffix.lower() == ".laz")
    _check_records(path)
    try:
        with laspy.open(path) as reader:
            header = reader.header
            _check_size(path, header)
            las = reader.read()
    except (FormatError, PermissionError):
        raise
    except BaseException as error:  # lazrs may panic on damaged data, which is no Exception
        if isinstance(error, (KeyboardInterrupt, SystemExit, MemoryError)):
            raise
        raise FormatError(f"'{path}' is no LAS file or damaged: {error}") from None
    num_points = len(las.points)
    if num_points != header.point_count:
        raise _wrong_count(path, header.point_count, num_points)
    points = np.empty((num_points, 3))
    for k, axis in enumerate((las.x, las.y, las.z)):
        points[:, k] = axis
    names = list(las.point_format.dimension_names)
    groups = columns_by_name(names)
    colors = normals = None
    if {"red", "green", "blue"} <= set(names):
        stored = np.stack([np.asarray(las[name]) for name in ("red", "green", "blue")], axis=1)
        colors = scale_colors(stored) if stored.any() else None
    if "normals" in groups:
        normals = np.stack([np.asarray(las[names[k]], dtype=np.float64) for k in groups["normals"]], axis=1)
    read = {"X", "Y", "Z", "red", "green", "blue", *(names[k] for k in groups.get("normals", ()))}
    others = [name for name in names if name not in read]  # each format has them all; zeros say nothing
    return RawCloud(points, normals, colors, unread=tuple(n for n in others if np.asarray(las[n]).any()))


def _wrong_count(path: Path, said: int, held: int) -> FormatError:
    reason = "it is truncated or its header is wrong" if held < said else "its header is wrong"
    return FormatError(f"'{path}': the header says {said} points, the file holds {held}; {reason}")


def _check_records(path: Path) -> None:
    """The numbers of records that laspy would believe and loop over, against the room there is for them."""
    size = path.stat().st_size
    with path.open("rb") as handle:
        head = handle.read(375)
    if len(head) < 227 or head[:4] != b"LASF":
        raise FormatError(f"'{path}' is no LAS file or truncated: {size} bytes, starting with {head[:4]!r}")
    header_size, first, num_records = struct.unpack("<HII", head[94:104])
    if first > size:
        raise FormatError(f"'{path}': the points begin at byte {first}, the file holds {size}; truncated")
    room = first - header_size
    if num_records * 54 > room:
        raise FormatError(
            f"'{path}' is damaged: its header says {num_records} records before the points, {room} bytes "
            "cannot hold them"
        )
    num_records = struct.unpack("<I", head[243:247])[0] if head[25] >= 4 and len(head) == 375 else 0
    if num_records * 60 > size:
        raise FormatError(
            f"'{path}' is damaged: its header says {num_records} records behind the points, {size} bytes "
            "cannot hold them"
        )


def _check_size(path: Path, header: Any) -> None:
    """Hold the header against the file's size, which laspy does not."""
    size = path.stat().st_size
    if header.are_points_compressed:
        _check_chunk_table(path, header, size)
        return
    held = (size - header.offset_to_point_data) // header.point_format.size
    followed = getattr(header, "number_of_evlrs", 0) or getattr(
        header, "start_of_waveform_data_packet_record", 0
    )
    if held < header.point_count or (held > header.point_count and not followed):
        raise _wrong_count(path, header.point_count, max(held, 0))


def _check_chunk_table(path: Path, header: Any, size: int) -> None:
    """LAZ keeps a table behind the points; on a broken one lazrs ends the whole process."""
    first = header.offset_to_point_data
    with path.open("rb") as handle:
        handle.seek(first)
        place = int.from_bytes(handle.read(8), "little", signed=True)
        if place == -1:  # written by a stream: the place is at the file's end
            handle.seek(max(0, size - 8))
            place = int.from_bytes(handle.read(8), "little", signed=True)
        if not first + 8 <= place <= size - 8:
            raise FormatError(
                f"'{path}': the header says {header.point_count} points with a table at byte {place}, the "
                f"file holds {size} bytes; it is truncated or damaged"
            )
        handle.seek(place + 4)
        num_chunks = int.from_bytes(handle.read(4), "little")
    if num_chunks > place - first:
        raise FormatError(
            f"'{path}' is damaged: its table says {num_chunks} chunks, {place - first} bytes cannot hold them"
        )
    records = header.vlrs.get("LasZipVlr")
    chunk_points = int.from_bytes(records[0].record_data[12:16], "little") if records else 0
    if 0 < chunk_points < 0xFFFFFFFF and -(-header.point_count // chunk_points) != num_chunks:
        raise FormatError(
            f"'{path}': the header says {header.point_count} points, the file holds {num_chunks} chunks of "
            f"at most {chunk_points}; its header is wrong"
        )


def write_las(handle: BinaryIO, cloud: RawCloud, compressed: bool) -> None:
    """LAS 1.2 or LAZ; coordinates on a grid of a power of ten that is at most 1e-8 of the cloud's extent.

    LAS stores 32 bit integers times a scale. The scale is the finest power of ten that spans the cloud (1e-7
    for 100 units), so a coordinate moves by at most half of it. Colours are 16 bit, normals extra dimensions.
    """
    laspy = _laspy(compressed)
    header = laspy.LasHeader(point_format=2 if cloud.colors is not None else 0, version="1.2")
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    offset = np.floor((low + high) / 2.0)
    reach = max(float(np.abs(high - offset).max()), float(np.abs(low - offset).max()), 1e-3)
    header.offsets = offset
    header.scales = np.full(3, 10.0 ** math.ceil(math.log10(reach / _LARGEST)))
    if cloud.normals is not None:
        header.add_extra_dims([laspy.ExtraBytesParams(name=f"normal_{axis}", type="f8") for axis in "xyz"])
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.points.T
    if cloud.normals is not None:
        for k, axis in enumerate("xyz"):
            las[f"normal_{axis}"] = cloud.normals[:, k]
    if cloud.colors is not None:
        stored = np.rint(cloud.colors * 65535.0)
        if stored.max() <= 255:  # readers, this one too, would take them for 8 bit values
            stored = np.rint(cloud.colors * 255.0) * 257.0
        las.red, las.green, las.blue = stored.astype(np.uint16).T
    las.write(handle, do_compress=compressed)
