"""E57 (extra ``geomoe3d[e57]``, pye57): all scans of a file in its global frame, and posed scans as a file.

Fields are read and written as doubles through libE57 itself: pye57's own reader assumes 8 bit colours and an
order of the quaternion's members, and its writer stores single precision.
"""

from __future__ import annotations

import struct
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from geomoe3d.clouds.formats.raw import RawCloud, scale_colors
from geomoe3d.clouds.formats.registry import reader, writer
from geomoe3d.errors import FormatError, plain_reason
from geomoe3d.runtime.optional import optional_module
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_COLORS = ("colorRed", "colorGreen", "colorBlue")
_NORMALS = ("nor:normalX", "nor:normalY", "nor:normalZ")


def require_pye57() -> Any:
    """The module pye57. Raises DependencyError: it is not installed."""
    return optional_module("pye57", "E57 files need pye57", "pye57")


@reader(".e57")
def read_e57(path: Path) -> RawCloud:
    """Points of all scans, each moved by its pose; points that the file marks invalid are left out.

    Colours, normals and fields such as intensity are kept when every scan has them, and named where only some
    have.

    Raises:
        FormatError: no E57 file, truncated, or damaged.
        DependencyError: pye57 is absent.
    """
    scans = list(read_scans(path))
    if not scans:
        return RawCloud(np.empty((0, 3)))
    unread: list[str] = []

    def together(name: str, parts: list[Any]) -> Any:
        """One array of all scans, or None where a scan lacks it."""
        held = [part for part in parts if part is not None]
        if held and len(held) < len(parts):
            unread.append(f"{name} of some scans")
        return np.concatenate(held) if held and len(held) == len(parts) else None

    names = dict.fromkeys(name for scan in scans for name in scan.fields)
    fields = {name: together(name, [scan.fields.get(name) for scan in scans]) for name in names}
    return RawCloud(
        np.concatenate([scan.points for scan in scans]),
        together("normals", [scan.normals for scan in scans]),
        together("colors", [scan.colors for scan in scans]),
        fields={name: values for name, values in fields.items() if values is not None},
        unread=(*dict.fromkeys(name for scan in scans for name in scan.unread), *unread),
        sensor=scans[0].sensor if len(scans) == 1 else None,
    )


def read_scans(path: Path) -> Iterator[RawCloud]:
    """The scans of a file that hold points, one by one, each moved by its pose, ``sensor`` being its place.
    Raises FormatError, DependencyError: as `read_e57`, in the course of reading."""
    pye57 = require_pye57()
    _check_size(path)
    try:
        with pye57.E57(str(path)) as file:
            for index in range(file.scan_count):
                scan = _read_scan(pye57.libe57, file, index)
                if len(scan.points):
                    yield scan
    except FormatError:
        raise
    except Exception as error:
        reason = (str(error).strip().splitlines() or [plain_reason(error)])[0]
        raise FormatError(f"'{path}' is no E57 file or damaged: {reason}") from None


def _check_size(path: Path) -> None:
    """The header names the file's length; libE57 complains about a wrong one without numbers."""
    with path.open("rb") as handle:
        head = handle.read(24)
    if len(head) < 24 or head[:8] != b"ASTM-E57":
        raise FormatError(f"'{path}' is no E57 file: it does not start with 'ASTM-E57'")
    said, held = struct.unpack("<Q", head[16:24])[0], path.stat().st_size
    if said != held:
        raise FormatError(f"'{path}': the header says {said} bytes, the file holds {held}; it is truncated")


def _read_scan(libe57: Any, file: Any, index: int) -> RawCloud:
    header = file.get_header(index)
    count, present = header.point_count, set(header.point_fields)
    if not count:
        return RawCloud(np.empty((0, 3)))
    axes = _CARTESIAN if set(_CARTESIAN) <= present else _SPHERICAL
    if not set(axes) <= present:
        raise FormatError(
            f"'{file.path}': scan {index} has no coordinates, only: {', '.join(sorted(present))}"
        )
    state = "cartesianInvalidState" if axes is _CARTESIAN else "sphericalInvalidState"
    numeric = {name for name in present if isinstance(_prototype(libe57, header, name), _numbers(libe57))}
    data = {name: np.empty(count) for name in header.point_fields if name in numeric}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in data.items():
        # The two flags: convert any stored type to double, and apply the scale of scaled integers.
        buffers.append(libe57.SourceDestBuffer(file.image_file, name, array, count, True, True))
    held = header.points.reader(buffers).read()
    if held != count:
        raise FormatError(
            f"'{file.path}': scan {index} says {counted(count, 'point')}, the file holds {held}"
        )
    points = np.stack([data[name] for name in axes], axis=1)
    if axes is _SPHERICAL:
        points = _cartesian(points)
    rotation, translation = _pose(header.node)
    points = points @ rotation.T + translation
    colors = normals = None
    used = {*axes, state}
    if set(_COLORS) <= data.keys():
        colors = _scaled_colors(header.node, np.stack([data[name] for name in _COLORS], axis=1))
        used |= set() if colors is None else {*_COLORS, "isColorInvalid"}
    if set(_NORMALS) <= data.keys():
        normals = np.stack([data[name] for name in _NORMALS], axis=1) @ rotation.T
        used |= set(_NORMALS)
    fields = {name: values for name, values in data.items() if name not in used and values.any()}
    unread, sensor = tuple(sorted(present - numeric)), translation if translation.any() else None
    cloud = RawCloud(points, normals, colors, fields=fields, unread=unread, sensor=sensor)
    return cloud.take(data[state] == 0) if state in data else cloud


def _prototype(libe57: Any, header: Any, name: str) -> Any:
    """The node that describes a field of a scan's points."""
    return libe57.StructureNode(header.points.prototype())[name]


def _numbers(libe57: Any) -> tuple[type, ...]:
    return (libe57.IntegerNode, libe57.ScaledIntegerNode, libe57.FloatNode)


def _cartesian(spherical: FloatArray) -> FloatArray:
    """x = r cos(el) cos(az), y = r cos(el) sin(az), z = r sin(el); ASTM E2807, spherical coordinates."""
    reach, azimuth, elevation = spherical.T
    flat = reach * np.cos(elevation)
    points: FloatArray = np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), reach * np.sin(elevation)], 1
    )
    return points


def _pose(node: Any) -> tuple[FloatArray, FloatArray]:
    """Rotation (3, 3) and translation (3,): p_file = R p_scan + t; the identity where the scan has none."""
    rotation, translation = np.eye(3), np.zeros(3)
    if not node.isDefined("pose"):
        return rotation, translation
    pose = node["pose"]
    if pose.isDefined("translation"):
        translation = np.array([pose["translation"][axis].value() for axis in "xyz"], dtype=np.float64)
    if pose.isDefined("rotation"):
        w, x, y, z = (pose["rotation"][part].value() for part in "wxyz")
        from scipy.spatial.transform import Rotation

        rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
    return rotation, translation


def _scaled_colors(node: Any, colors: FloatArray) -> FloatArray | None:
    """Colours over the limit that the file states, else by the general rule."""
    if node.isDefined("colorLimits") and node["colorLimits"].isDefined("colorRedMaximum"):
        limit = float(node["colorLimits"]["colorRedMaximum"].value())
        if limit > 0 and colors.min() >= 0 and colors.max() <= limit:
            return colors / limit
    return scale_colors(colors)


_SURFACE_NORMALS = "http://www.libe57.org/E57_NOR_surface_normals.txt"


@writer(".e57")
def write_e57(handle: BinaryIO, cloud: RawCloud) -> tuple[str, ...]:
    """One scan in the file's frame; see `write_scans`."""
    return write_scans(Path(handle.name), [("cloud", cloud, np.eye(4))])


def write_scans(path: Path, scans: Iterable[tuple[str, RawCloud, FloatArray]]) -> tuple[str, ...]:
    """An E57 file of posed scans: double coordinates, 8 bit colours, normals, intensity and time.

    Args:
        path: replaced if it is there.
        scans: name, points in the scan's own frame, and pose (4, 4): p_file = R p_scan + t; taken one by one.

    Returns:
        Names of what the scans hold and E57 has no place for.

    Raises:
        DependencyError: pye57 is absent.
    """
    from scipy.spatial.transform import Rotation

    pye57 = require_pye57()
    lib = pye57.libe57
    lost: list[str] = []
    with pye57.E57(str(path), mode="w") as file:
        image = file.image_file
        image.extensionsAdd("nor", _SURFACE_NORMALS)

        def structure(parent: Any, name: str, values: dict[str, float]) -> None:
            node = lib.StructureNode(image)
            parent.set(name, node)
            for key, value in values.items():
                node.set(key, lib.FloatNode(image, float(value)))

        for name, cloud, T in scans:
            scan = lib.StructureNode(image)
            scan.set("guid", lib.StringNode(image, f"{{{uuid.uuid5(uuid.NAMESPACE_URL, name)}}}"))
            scan.set("name", lib.StringNode(image, name))
            pose = lib.StructureNode(image)
            scan.set("pose", pose)
            x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
            structure(pose, "rotation", {"w": w, "x": x, "y": y, "z": z})
            structure(pose, "translation", dict(zip("xyz", T[:3, 3], strict=True)))
            columns = dict(zip(_CARTESIAN, cloud.points.T, strict=True))
            if cloud.normals is not None:
                columns.update(zip(_NORMALS, cloud.normals.T, strict=True))
            for field in ("intensity", "timeStamp"):
                if field in cloud.fields:
                    columns[field] = cloud.fields[field]
            lost += [field for field in cloud.fields if field not in columns]
            if "intensity" in columns:
                low, high = float(columns["intensity"].min()), float(columns["intensity"].max())
                structure(scan, "intensityLimits", {"intensityMinimum": low, "intensityMaximum": high})
            prototype = lib.StructureNode(image)
            for field in columns:
                prototype.set(field, lib.FloatNode(image, 0.0, lib.E57_DOUBLE))
            if cloud.colors is not None:
                columns.update(zip(_COLORS, np.rint(cloud.colors * 255.0).T, strict=True))
                for field in _COLORS:
                    prototype.set(field, lib.IntegerNode(image, 0, 0, 255))
                limits = lib.StructureNode(image)
                scan.set("colorLimits", limits)
                for field in _COLORS:
                    limits.set(f"{field}Minimum", lib.IntegerNode(image, 0))
                    limits.set(f"{field}Maximum", lib.IntegerNode(image, 255))
            points = lib.CompressedVectorNode(image, prototype, lib.VectorNode(image, True))
            scan.set("points", points)
            file.data3d.append(scan)
            buffers = lib.VectorSourceDestBuffer()
            held = {
                field: np.ascontiguousarray(column, dtype=np.float64) for field, column in columns.items()
            }
            for field, column in held.items():
                buffers.append(lib.SourceDestBuffer(image, field, column, len(column), True, True))
            writing = points.writer(buffers)
            writing.write(len(cloud.points))
            writing.close()
    return tuple(dict.fromkeys(lost))
