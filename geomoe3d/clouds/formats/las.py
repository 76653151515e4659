"""LAS and LAZ (extra ``geomoe3d[las]``, laspy with lazrs): exact float64 coordinates and 16 bit colours."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from geomoe3d.clouds.formats.raw import RawCloud, columns_by_name, scale_colors, wrong_count
from geomoe3d.clouds.formats.registry import reader, writer
from geomoe3d.errors import DependencyError, FormatError, InputError, plain_reason
from geomoe3d.runtime.optional import optional_module
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray


def require_laspy(compressed: bool) -> Any:
    """The module laspy, able to read and write LAZ if ``compressed``. Raises DependencyError: it is not installed."""
    laspy = optional_module("laspy", "LAS and LAZ files need laspy", "'laspy[lazrs]'")
    if compressed and not laspy.LazBackend.detect_available():
        raise DependencyError("LAZ files need lazrs, which is not installed: pip install 'laspy[lazrs]'")
    return laspy


@reader(".las", ".laz")
def read_las(path: Path) -> RawCloud:
    """Coordinates X * scale + offset in float64, with colours, and normals if extra dimensions name them.

    Colours are 16 bit by the standard; a file whose largest value fits 8 bits is taken as 8 bit, and one
    with nothing but zeros as having none. The other dimensions are fields, unless all are zero: each format
    has them all. COPC is read as the LAZ that it is, every level. Points beyond the header's count are left
    out, as PDAL does.

    Raises:
        FormatError: no LAS file, damaged, or a count in the header that the content does not bear out.
        DependencyError: laspy (or lazrs for LAZ) is absent.
    """
    with _opened(path) as reader:
        las = reader.read()
        if len(las.points) != reader.header.point_count:
            raise wrong_count(path, reader.header.point_count, len(las.points))
        rest = _held(path, reader.header) - len(las.points)
        note = f"the header says {len(las.points)} points, the file holds {len(las.points) + rest}; "
        notes = (f"{note}the rest is left out, as PDAL does",) if rest > 0 else ()
        return replace(_cloud(las), notes=notes)


def read_pieces(path: Path, size: int) -> Iterator[FloatArray]:
    """The coordinates (n, 3) of a file as `read_las` gives them, at most ``size`` points at a time. Raises
    FormatError, DependencyError: as `read_las`, in the course of reading."""
    with _opened(path) as reader:
        count = 0
        for some in reader.chunk_iterator(size):
            points = np.empty((len(some), 3))
            for k, axis in enumerate((some.x, some.y, some.z)):
                points[:, k] = axis
            count += len(points)
            yield points
        if count != reader.header.point_count:
            raise wrong_count(path, reader.header.point_count, count)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """laspy's reader of a file whose header was held against its size; what it raises becomes `FormatError`."""
    laspy = require_laspy(path.suffix.lower() == ".laz")
    _check_records(path)
    try:
        with laspy.open(path) as reader:
            _check_size(path, reader.header)
            yield reader
    except (InputError, PermissionError):
        raise
    except BaseException as error:  # lazrs may panic on damaged data, which is no Exception
        if isinstance(error, (KeyboardInterrupt, SystemExit, MemoryError, GeneratorExit)):
            raise
        raise FormatError(f"'{path}' is no LAS file or damaged: {plain_reason(error)}") from None


def _cloud(las: Any) -> RawCloud:
    """Coordinates, colours, normals and fields of what laspy has read."""
    points = np.empty((len(las.points), 3))
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
    fields: dict[str, NDArray[Any]] = {}
    unread = []
    for name in names:
        values = np.asarray(las[name])
        if name not in read and values.any():
            if values.ndim == 1:
                fields[name] = values
            else:
                unread.append(name)
    return RawCloud(points, normals, colors, fields=fields, unread=tuple(unread))


def _check_records(path: Path) -> None:
    """The numbers of records that laspy would believe and loop over, against the room there is for them."""
    size = path.stat().st_size
    with path.open("rb") as handle:
        head = handle.read(375)
    if len(head) < 227 or head[:4] != b"LASF":
        raise FormatError(
            f"'{path}' is no LAS file or truncated: it has {size:,} bytes and does not begin with LASF"
        )
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


def _held(path: Path, header: Any) -> int:
    """Points that a LAS has room for up to its end or what follows them; those of a LAZ are as many as it says."""
    if header.are_points_compressed:
        return int(header.point_count)
    end = path.stat().st_size
    for key in ("start_of_first_evlr", "start_of_waveform_data_packet_record"):
        end = min(end, getattr(header, key, 0) or end)
    return int((end - header.offset_to_point_data) // header.point_format.size)


def _check_size(path: Path, header: Any) -> None:
    """Hold the header against the file's size, which laspy does not."""
    size = path.stat().st_size
    if header.are_points_compressed:
        # A hundred points in a byte are far more than any compression gives, of points that differ.
        if header.point_count > 100 * size:
            raise FormatError(
                f"'{path}': the header says {header.point_count} points, {size} bytes cannot hold them; its "
                "header is wrong"
            )
        _check_chunk_table(path, header, size)
        return
    held = _held(path, header)
    if held < header.point_count:
        raise wrong_count(path, header.point_count, max(held, 0))


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
    if max(1_000_000, header.point_count) < chunk_points < 0xFFFFFFFF:  # lazrs makes room for all of them
        raise FormatError(
            f"'{path}' is damaged: it says {chunk_points} points per chunk and {header.point_count} in all"
        )
    if 0 < chunk_points < 0xFFFFFFFF and -(-header.point_count // chunk_points) != num_chunks:
        raise FormatError(
            f"'{path}': the header says {header.point_count} points, the file holds "
            f"{counted(num_chunks, 'chunk')} of at most {chunk_points}; its header is wrong"
        )


_STANDARD = {  # the point formats in use, by what they hold besides intensity, returns and classes
    0: (),
    1: ("gps_time",),
    2: ("red",),
    3: ("gps_time", "red"),
    6: ("gps_time", "scanner_channel", "overlap"),
    7: ("gps_time", "scanner_channel", "overlap", "red"),
    8: ("gps_time", "scanner_channel", "overlap", "red", "nir"),
}


@writer(".las")
def write_las(handle: BinaryIO, cloud: RawCloud) -> tuple[str, ...]:
    """LAS 1.2 or 1.4; coordinates on a grid of a power of ten that is at most 1e-8 of the cloud's extent.

    LAS stores 32 bit integers times a scale. The scale is the finest power of ten that spans the cloud (1e-7
    for 100 units), so a coordinate moves by at most half of it. Colours are 16 bit. Fields go where LAS has a
    place of that name that holds their values, else, like normals, into extra dimensions.
    """
    return _write(handle, cloud, False)


@writer(".laz")
def write_laz(handle: BinaryIO, cloud: RawCloud) -> tuple[str, ...]:
    """As `write_las`, compressed."""
    return _write(handle, cloud, True)


def _write(handle: BinaryIO, cloud: RawCloud, compressed: bool) -> tuple[str, ...]:
    laspy = require_laspy(compressed)
    wanted = {name for name in cloud.fields if any(name in held for held in _STANDARD.values())}
    wanted |= {"red"} if cloud.colors is not None else set()
    wanted |= {"overlap"} if "scan_angle" in cloud.fields or _beyond(cloud, "classification", 31) else set()
    number = next((k for k, held in _STANDARD.items() if wanted <= set(held)), 8)
    header = laspy.LasHeader(point_format=number, version="1.2" if number < 6 else "1.4")
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    offset = np.floor((low + high) / 2.0)
    reach = max(float(np.abs(high - offset).max()), float(np.abs(low - offset).max()), 1e-3)
    header.offsets = offset
    # LAS stores signed integers of 32 bits; this leaves a margin.
    header.scales = np.full(3, 10.0 ** math.ceil(math.log10(reach / 2_000_000_000)))
    standard = {d.name: d for d in header.point_format.dimensions}
    extra = (
        {}
        if cloud.normals is None
        else {f"normal_{a}": n for a, n in zip("xyz", cloud.normals.T, strict=True)}
    )
    lost = []
    plain: dict[str, NDArray[Any]] = {}
    for name, values in cloud.fields.items():
        if name in standard and name not in ("X", "Y", "Z", "red", "green", "blue"):
            if _fits(standard[name], values):
                plain[name] = values
            else:
                extra[f"{name}_{values.dtype.name}"] = values
                lost.append(
                    f"{name} (kept as {name}_{values.dtype.name}; the place that LAS has cannot hold it)"
                )
        elif (
            name.lower() in ("x", "y", "z", "red", "green", "blue")
            or len(name.encode()) > 32
            or name in extra
        ):
            lost.append(name)
        else:
            extra[name] = values.astype(np.float32) if values.dtype == np.float16 else values
    header.add_extra_dims(
        [laspy.ExtraBytesParams(name=name, type=values.dtype.str[1:]) for name, values in extra.items()]
    )
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.points.T
    for name, values in {**plain, **extra}.items():
        las[name] = values
    if cloud.colors is not None:
        stored = np.rint(cloud.colors * 65535.0)
        if stored.max() <= 255:  # readers, this one too, would take them for 8 bit values
            stored = np.rint(cloud.colors * 255.0) * 257.0
        las.red, las.green, las.blue = stored.astype(np.uint16).T
    las.write(handle, do_compress=compressed)
    return tuple(lost)


def _beyond(cloud: RawCloud, name: str, limit: float) -> bool:
    return name in cloud.fields and bool((cloud.fields[name] > limit).any())


def _fits(dimension: Any, values: NDArray[Any]) -> bool:
    """Whether a dimension of LAS holds the values (N,) exactly."""
    if dimension.kind.name == "FloatingPoint":
        return values.dtype.kind == "f" or bool((values.astype(np.float64) == values).all())
    low, high = (dimension.min, dimension.max)
    with np.errstate(invalid="ignore"):
        whole = values.dtype.kind in "iu" or bool((values == np.rint(values)).all())
    return whole and bool((values >= low).all() and (values <= high).all())
