"""glTF 2.0 (GLB, GLTF): the geometry of all meshes of the scene, and a GLB moved as a whole.

Own code because trimesh passes over `normalized` accessors and over extensions that the file requires, and so
returns boxes 32,767 units wide, or nothing. Whatever is required and not understood here is refused by name.
Moving a GLB puts one node above its scene; materials, animations and all else stay byte for byte.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from geomoe3d.clouds.formats.raw import RawCloud, scale_colors
from geomoe3d.clouds.formats.registry import reader
from geomoe3d.errors import EmptyCloudError, FormatError, plain_reason
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.runtime.plain import parse_json
from geomoe3d.types import FloatArray, IntArray

_UNDERSTOOD = (  # extensions that change no position, and quantisation, which `_Document.array` honours
    *("KHR_mesh_quantization", "KHR_texture_transform", "KHR_lights_punctual", "KHR_texture_basisu"),
    *("EXT_texture_webp", "EXT_texture_avif", "KHR_xmp_json_ld", "KHR_node_visibility"),
)
_TYPES = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}


@reader(".glb", ".gltf")
def read_gltf(path: Path) -> RawCloud:
    """All triangles of the scene in its own frame, or, where it has none, its points; with vertex colours.
    Raises FormatError: no glTF 2.0, truncated, damaged, or a required extension is not understood (named);
    EmptyCloudError: no geometry."""
    try:
        return _read(path)
    except (FormatError, EmptyCloudError, OSError, MemoryError):
        raise
    except Exception as error:  # whatever a damaged document leads to: missing keys, wrong types, no numbers
        raise FormatError(f"'{path}' is damaged: {plain_reason(error)}") from None


def _read(path: Path) -> RawCloud:
    document = _Document(path)
    parts = list(document.parts())
    if any(part.faces is not None for part in parts):
        parts = [part for part in parts if part.faces is not None]
    if not sum(len(part.points) for part in parts):
        raise EmptyCloudError(f"'{path}' holds 0 points: no mesh and no point cloud")
    starts = np.cumsum([0] + [len(part.points) for part in parts])
    faces = [p.faces + start for p, start in zip(parts, starts, strict=False) if p.faces is not None]
    colors = [part.colors for part in parts if part.colors is not None]
    whole = len(colors) == len(parts)
    return RawCloud(
        np.concatenate([part.points for part in parts]),
        colors=np.concatenate(colors) if whole else None,
        faces=np.concatenate(faces) if faces else None,
        unread=tuple(dict.fromkeys((*document.unread, *(() if whole or not colors else ("COLOR_0",))))),
    )


class _Document:
    """The JSON of a file with its buffers.

    Attributes:
        content: the JSON.
        binary: the binary chunk of a GLB.
        unread: names of what is passed over.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.content, self.binary = read_chunks(path)
        self._buffers: dict[int, bytes] = {}
        required = [e for e in self.content.get("extensionsRequired", ()) if e not in _UNDERSTOOD]
        if required:
            raise FormatError(
                f"'{path}' needs {', '.join(map(str, required))}, which is not read here; export it without "
                "compression, or as PLY or OBJ"
            )
        self.unread = [
            key for key in ("materials", "animations", "skins", "cameras") if self.content.get(key)
        ]

    def parts(self) -> Iterator[RawCloud]:
        """Each primitive of each node of the scene, in the scene's frame."""
        nodes = self.content.get("nodes", [])
        scene = _scenes(self.content)[self.content.get("scene", 0)]
        waiting = [(root, np.eye(4), 0) for root in reversed(scene.get("nodes", []))]
        visited = 0
        while waiting:
            index, above, depth = waiting.pop()
            visited += 1
            if depth > 200 or visited > 1_000_000:
                raise FormatError(f"'{self._path}': its nodes are nested in a circle or too deep")
            node = nodes[index]
            place = above @ _placement(node)
            waiting += [(child, place, depth + 1) for child in reversed(node.get("children", []))]
            if "mesh" in node:
                for primitive in self.content["meshes"][node["mesh"]]["primitives"]:
                    part = self._part(primitive)
                    if part is not None and not np.array_equal(place, np.eye(4)):  # unmoved ones stay exact
                        part = replace(part, points=transform_points(place, part.points))
                    if part is not None:
                        yield part

    def _part(self, primitive: dict[str, Any]) -> RawCloud | None:
        attributes = primitive["attributes"]
        self.unread += [key for key in attributes if key not in ("POSITION", "COLOR_0")]
        if primitive.get("targets"):
            self.unread.append("morph targets")
        mode = primitive.get("mode", 4)
        if mode in (1, 2, 3) or "POSITION" not in attributes:
            self.unread.append("lines")
            return None
        points = np.asarray(self.array(attributes["POSITION"]), dtype=np.float64)
        colors = None
        if "COLOR_0" in attributes:
            colors = scale_colors(self.array(attributes["COLOR_0"])[:, :3])
        if points.shape[1] != 3 or (colors is not None and len(colors) != len(points)):
            raise FormatError(f"'{self._path}': positions and colours of different number or form")
        if mode == 0:
            return RawCloud(points, colors=colors)
        if "indices" in primitive:
            rows = self.array(primitive["indices"])[:, 0].astype(np.int64)
        else:
            rows = np.arange(len(points))
        faces = _triangles(rows, mode)
        if len(faces) and faces.max() >= len(points):
            raise FormatError(
                f"'{self._path}': a face names vertex {faces.max()}, there are {len(points)} vertices"
            )
        return RawCloud(points, None, colors, faces)

    def array(self, index: int) -> NDArray[Any]:
        """The values (count, width) of an accessor; normalised integers as the numbers they stand for."""
        accessor = self.content["accessors"][index]
        widths = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
        kind, width = np.dtype("<" + _TYPES[accessor["componentType"]]), widths[accessor["type"]]
        count = accessor["count"]
        if "bufferView" in accessor:
            values = self._view(accessor["bufferView"], accessor.get("byteOffset", 0), kind, count, width)
        else:
            values = np.zeros((self._bounded(count, 1), width), kind)
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            at, new = sparse["indices"], sparse["values"]
            where = np.dtype("<" + _TYPES[at["componentType"]])
            rows = self._view(at["bufferView"], at.get("byteOffset", 0), where, sparse["count"], 1)[:, 0]
            values = values.copy()
            offset = new.get("byteOffset", 0)
            values[rows] = self._view(new["bufferView"], offset, kind, sparse["count"], width)
        if accessor.get("normalized") and kind.kind in "iu":
            numbers: NDArray[Any] = np.maximum(values / float(np.iinfo(kind).max), -1.0)
            return numbers
        return values

    def _bounded(self, count: int, size: int) -> int:
        if not 0 <= count * size <= 10 * self._path.stat().st_size + len(self.binary):
            raise FormatError(f"'{self._path}' is damaged: an accessor states {count} values")
        return count

    def _view(self, index: int, offset: int, kind: np.dtype[Any], count: int, width: int) -> NDArray[Any]:
        view = self.content["bufferViews"][index]
        if "EXT_meshopt_compression" in view.get("extensions", {}):
            raise FormatError(f"'{self._path}' needs EXT_meshopt_compression, which is not read here")
        buffer = self._buffer(view["buffer"])
        stride = view.get("byteStride") or kind.itemsize * width
        begin = view.get("byteOffset", 0) + offset
        end = begin + stride * (count - 1) + kind.itemsize * width if count else begin
        if min(begin, offset, count, stride) < 0 or end > len(buffer):
            raise FormatError(
                f"'{self._path}': an accessor ends at byte {end}, its buffer at {len(buffer)}; truncated or "
                "damaged"
            )
        values: NDArray[Any] = np.ndarray((count, width), kind, buffer, begin, (stride, kind.itemsize))
        return values

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            buffer = self.content["buffers"][index]
            uri = buffer.get("uri")
            data = self.binary if uri is None else _resource(self._path, uri)
            if len(data) < buffer["byteLength"]:
                raise FormatError(
                    f"'{self._path}': a buffer should have {buffer['byteLength']} bytes, it has {len(data)}; "
                    "truncated"
                )
            self._buffers[index] = data
        return self._buffers[index]


def _resource(path: Path, uri: str) -> bytes:
    """What a glTF file refers to: in itself, or a file beside it."""
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition(",")[2])
    file = path.parent / unquote(uri)
    if not file.is_file():
        raise FormatError(f"'{path}' refers to a missing file '{file}'")
    return file.read_bytes()


def buffer_files(path: Path) -> list[Path]:
    """The files beside a GLTF in which its buffers lie, there or not. Raises as `read_chunks`, or whatever a damaged
    document leads to."""
    uris = [buffer.get("uri", "data:") for buffer in read_chunks(path)[0].get("buffers", ())]
    return [path.parent / unquote(uri) for uri in uris if not uri.startswith("data:")]


def _scenes(content: dict[str, Any]) -> list[dict[str, Any]]:
    """The scenes, or one of all nodes that are nobody's child."""
    nodes = content.get("nodes", [])
    children = {child for node in nodes for child in node.get("children", ())}
    roots = [root for root in range(len(nodes)) if root not in children]
    return content.get("scenes") or [{"nodes": roots}]


def _placement(node: dict[str, Any]) -> FloatArray:
    """The affine (4, 4) of a node: p_parent = A p_node."""
    if "matrix" in node:
        matrix: FloatArray = np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
        return matrix
    A = np.eye(4)
    if "rotation" in node:
        from scipy.spatial.transform import Rotation

        A[:3, :3] = Rotation.from_quat(node["rotation"]).as_matrix()
    A[:3, :3] *= np.array(node.get("scale", [1, 1, 1]), dtype=np.float64)
    A[:3, 3] = node.get("translation", [0, 0, 0])
    return A


def _triangles(rows: IntArray, mode: int) -> IntArray:
    """Faces of a list (4), a strip (5) or a fan (6) of triangles."""
    if mode == 4:
        return rows[: len(rows) // 3 * 3].reshape(-1, 3)
    if mode not in (5, 6):
        raise ValueError(f"unknown mode {mode} of a primitive")
    first = rows[:-2] if mode == 5 else np.full(max(len(rows) - 2, 0), rows[:1])
    faces: IntArray = np.stack([first, rows[1:-1], rows[2:]], axis=1)
    if mode == 5:
        faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces


def read_chunks(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON of a GLB or GLTF and the binary chunk (empty where there is none). Raises FormatError: no glTF
    2.0, or shorter than it says."""
    data = path.read_bytes()
    binary = b""
    text = data
    if path.suffix.lower() == ".glb" or data[:4] == b"glTF":
        if len(data) < 20 or data[:4] != b"glTF":
            raise FormatError(f"'{path}' is no GLB file: it does not start with 'glTF'")
        version, said, size = struct.unpack("<III", data[4:16])
        if said > len(data) or 20 + size > said:
            raise FormatError(
                f"'{path}': the header says {said} bytes, the file holds {len(data)}; truncated"
            )
        if version != 2:
            raise FormatError(f"'{path}' is glTF version {version}; only version 2 is read")
        text = data[20 : 20 + size]
        head = data[20 + size : 28 + size]
        if len(head) == 8 and head[4:] == b"BIN\0":
            binary = data[28 + size : 28 + size + struct.unpack("<I", head[:4])[0]]
    content = parse_json(text)
    if not isinstance(content, dict) or not str(content.get("asset", {}).get("version", "")).startswith("2."):
        raise FormatError(f"'{path}' is no glTF 2.0 file: its JSON has no asset of version 2")
    return content, binary


def moved_glb(path: Path, T: FloatArray) -> bytes:
    """A GLB or GLTF file as a GLB under a motion (4, 4): each scene gets one node above the others.

    All else stays as it is; what a GLTF keeps in files beside it is taken in.
    """
    content, binary = read_chunks(path)
    nodes = content.setdefault("nodes", [])
    content["scenes"] = [scene for scene in _scenes(content) if scene.get("nodes")]
    for scene in content["scenes"]:
        nodes.append({"name": "T_target_source", "matrix": T.T.ravel().tolist(), "children": scene["nodes"]})
        scene["nodes"] = [len(nodes) - 1]
    for part in (*content.get("buffers", []), *content.get("images", [])):
        if "uri" in part and not part["uri"].startswith("data:"):
            kind = {"png": "image/png", "jpg": "image/jpeg", "jpeg": "image/jpeg", "webp": "image/webp"}.get(
                part["uri"].rpartition(".")[2].lower(), "application/octet-stream"
            )
            part["uri"] = f"data:{kind};base64,{base64.b64encode(_resource(path, part['uri'])).decode()}"
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if binary:
        binary += b"\0" * (-len(binary) % 4)
        chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
