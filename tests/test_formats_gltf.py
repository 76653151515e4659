"""glTF: quantised and sparse values, extensions that are not read, moving a GLB whole."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cloud_files import assert_on_box, fails, rigid

from geomoe3d.clouds.io import load_points, save_aligned
from geomoe3d.clouds.loading import read_raw
from geomoe3d.geometry.se3 import transform_points

CORNERS = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
QUADS = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
FACES = np.array([[a, *pair] for a, b, c, d in QUADS for pair in ((b, c), (c, d))])


def document(
    values: np.ndarray, kind: int, node: dict[str, Any], **accessor: Any
) -> tuple[dict[str, Any], bytes]:
    """A box of one mesh: its JSON and its buffer."""
    rows = values.tobytes()
    body = rows + FACES.astype("<u2").tobytes()
    content: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **node}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
        "materials": [{"name": "paint"}],
        "accessors": [
            {"bufferView": 0, "componentType": kind, "count": 8, "type": "VEC3", **accessor},
            {"bufferView": 1, "componentType": 5123, "count": 36, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": len(rows), "byteStride": values.strides[0]},
            {"buffer": 0, "byteOffset": len(rows), "byteLength": 72},
        ],
        "buffers": [{"byteLength": len(body)}],
    }
    return content, body


def write_glb(path: Path, content: dict[str, Any], body: bytes) -> None:
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    body += bytes(-len(body) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


@pytest.mark.parametrize(("kind", "code"), [("<i1", 5120), ("<u1", 5121), ("<i2", 5122), ("<u2", 5123)])
@pytest.mark.parametrize("normalised", [True, False])
def test_quantised_positions(tmp_path: Path, kind: str, code: int, normalised: bool) -> None:
    limit = float(np.iinfo(kind).max) if normalised else 100.0
    signed = kind[1] == "i"
    stored = np.zeros((8, 4), kind)  # rows of four, as alignment wants
    stored[:, :3] = np.rint(CORNERS * limit if signed else (CORNERS + 1) / 2 * limit)
    size = (0.5 if signed else 1.0) / (1.0 if normalised else limit)
    node = {"scale": [size] * 3, "translation": [0, 0, 0] if signed else [-0.5] * 3}
    content, body = document(stored, code, node, normalized=normalised)
    content["extensionsRequired"] = ["KHR_mesh_quantization"]
    write_glb(tmp_path / "a.glb", content, body)
    assert_on_box(load_points(tmp_path / "a.glb", mesh_points=500).points, 500)


def test_sparse_accessors_and_rotated_nodes(tmp_path: Path) -> None:
    right = (CORNERS / 2).astype("<f4")
    wrong = right.copy()
    wrong[5] = 99
    content, body = document(wrong, 5126, {"rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)]})
    place = len(body)
    body += struct.pack("<HH", 5, 0) + right[5].tobytes()
    views = content["bufferViews"]
    views += [
        {"buffer": 0, "byteOffset": place, "byteLength": 4},
        {"buffer": 0, "byteOffset": place + 4, "byteLength": 12},
    ]
    content["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": 2, "componentType": 5123},
        "values": {"bufferView": 3},
    }
    content["buffers"][0]["byteLength"] = len(body)
    write_glb(tmp_path / "a.glb", content, body)
    raw = read_raw(tmp_path / "a.glb")
    np.testing.assert_allclose(raw.points, right @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-6)
    uri = "data:application/octet-stream;base64," + base64.b64encode(body).decode()
    content["buffers"][0]["uri"] = uri
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    np.testing.assert_array_equal(read_raw(tmp_path / "a.gltf").points, raw.points)


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "ACME_unheard_of"])
def test_what_is_required_and_not_read_is_named(tmp_path: Path, name: str) -> None:
    content, body = document((CORNERS / 2).astype("<f4"), 5126, {})
    content["extensionsRequired"] = [name]
    write_glb(tmp_path / "a.glb", content, body)
    fails(tmp_path / "a.glb", name, "without compression")
    content["extensionsUsed"] = [content.pop("extensionsRequired")[0]]
    write_glb(tmp_path / "a.glb", content, body)
    assert_on_box(load_points(tmp_path / "a.glb", mesh_points=200).points, 200)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda c: c["accessors"][0].update(count=10**9), "truncated"),
        (lambda c: c["accessors"][0].update(count=-1), "truncated"),
        (lambda c: c["accessors"][1].update(componentType=1), "damaged"),
        (lambda c: c["nodes"][0].update(children=[0]), "circle"),
        (lambda c: c["meshes"].clear(), "damaged"),
        (lambda c: c["asset"].update(version="1.0"), "version 2"),
        (lambda c: c["buffers"][0].update(byteLength=10**6), "truncated"),
        (lambda c: c["buffers"][0].update(uri="none.bin"), "missing file"),
        (lambda c: c["accessors"][0].update(count=7), "names vertex 7"),
    ],
)
def test_damaged_documents(tmp_path: Path, change: Any, word: str) -> None:
    content, body = document((CORNERS / 2).astype("<f4"), 5126, {})
    change(content)
    write_glb(tmp_path / "a.glb", content, body)
    fails(tmp_path / "a.glb", word)


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_a_moved_glb_is_the_same_file_under_one_more_node(tmp_path: Path, suffix: str) -> None:
    trimesh = pytest.importorskip("trimesh")
    content, body = document((CORNERS / 2).astype("<f4"), 5126, {"scale": [2, 3, 4]})
    if suffix == ".glb":
        write_glb(tmp_path / "a.glb", content, body)
    else:
        (tmp_path / "b.bin").write_bytes(body)
        content["buffers"][0]["uri"] = "b.bin"
        (tmp_path / "a.gltf").write_text(json.dumps(content))
    source = tmp_path / f"a{suffix}"
    assert save_aligned(tmp_path / "moved.glb", source, rigid()) == ()
    expected = transform_points(rigid(), read_raw(source).points)
    np.testing.assert_allclose(read_raw(tmp_path / "moved.glb").points, expected, atol=1e-12)
    bounds = trimesh.load(tmp_path / "moved.glb").bounds
    np.testing.assert_allclose(bounds, [expected.min(axis=0), expected.max(axis=0)], atol=1e-5)
    assert b'"name":"paint"' in (tmp_path / "moved.glb").read_bytes()
