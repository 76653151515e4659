"""Clouds, motions and files by hand for the tests of reading and writing, and what loading has to say."""

from __future__ import annotations

import os
import struct
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from geomoe3d.clouds.formats.raw import RawCloud
from geomoe3d.clouds.formats.registry import CLOUD_WRITERS
from geomoe3d.clouds.io import load_points
from geomoe3d.errors import FormatError
from geomoe3d.geometry.se3 import make_transform

UTM = np.array([583394.0, 5283100.0, 498.0])
STEP = np.array([5.0, 6.0, 7.0])
MANY = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def absent(reason: str) -> None:
    """Skip a test for want of something; where everything has to be there, as in CI, it fails."""
    if os.environ.get("CI"):
        pytest.fail(reason)
    pytest.skip(reason)


def needed(package: str) -> Any:
    """A package of others, or no test without it (see `absent`)."""
    if find_spec(package) is None:
        absent(f"{package} is not installed; scripts/test.sh installs it")
    return import_module(package)


def cloud(num: int = 200, seed: int = 0, center: np.ndarray | float = 0.0) -> np.ndarray:
    """Points as of a site: some 100 m wide, about a given place."""
    return np.random.default_rng(seed).normal(size=(num, 3)) * [30.0, 20.0, 5.0] + center


def unit_vectors(num: int, seed: int = 1) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(num, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def rigid(seed: int = 3, translation: tuple[float, float, float] = (3.0, -2.0, 7.5)) -> np.ndarray:
    R = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return make_transform(R * np.sign(np.linalg.det(R)), np.array(translation))


def small_cloud(num: int = 100, seed: int = 0) -> np.ndarray:
    """Points about zero, alike in every direction; those that `ply` and `pcd` write."""
    return np.random.default_rng(seed).normal(size=(num, 3)) * 10.0


def fails(path: object, *words: object, error: type[Exception] = FormatError) -> str:
    """Loading raises exactly this class, and the message holds every one of the words."""
    with pytest.raises(error) as caught:
        load_points(path)
    assert type(caught.value) is error
    for word in words:
        assert str(word) in str(caught.value)
    return str(caught.value)


def ply(count: int, rows: int, fmt: str = "ascii") -> bytes:
    """A PLY file whose header says ``count`` points and whose body holds ``rows``."""
    header = f"ply\nformat {fmt} 1.0\nelement vertex {count}\n"
    header += "property double x\nproperty double y\nproperty double z\nend_header\n"
    points = small_cloud(rows)
    if fmt == "ascii":
        return header.encode() + "".join(f"{x} {y} {z}\n" for x, y, z in points).encode()
    return header.encode() + points.astype("<f8" if "little" in fmt else ">f8").tobytes()


def pcd(count: int, rows: int, data: str) -> bytes:
    """A PCD file whose header says ``count`` points and whose body holds ``rows``."""
    header = "VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\n"
    header += f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA {data}\n"
    points = small_cloud(rows)
    if data == "ascii":
        return header.encode() + "".join(f"{x} {y} {z}\n" for x, y, z in points).encode()
    body = points.tobytes()
    if data == "binary_compressed":  # literal runs of 32 bytes
        plain = points.T.tobytes()
        body = b"".join(
            bytes([len(plain[k : k + 32]) - 1]) + plain[k : k + 32] for k in range(0, len(plain), 32)
        )
        body = struct.pack("<II", len(body), len(plain)) + body
    return header.encode() + body


def assert_on_box(points: np.ndarray, num: int) -> None:
    """All points on the surface of the unit cube about zero, spread evenly over its six faces."""
    assert points.shape == (num, 3)
    assert np.abs(np.abs(points).max(axis=1) - 0.5).max() < 1e-6
    side = np.argmax(np.abs(points), axis=1) * 2 + (
        points[np.arange(num), np.argmax(np.abs(points), axis=1)] > 0
    )
    shares = np.bincount(side, minlength=6) / num
    assert np.abs(shares - 1 / 6).max() < 5 * np.sqrt(1 / 6 * 5 / 6 / num)


# ---- files with all that their format can hold ---------------------------------------------------------

FULL = 60
COLORS = np.random.default_rng(2).integers(1, 256, (FULL, 3)) / 255
FIELDS = {
    "intensity": np.random.default_rng(3).integers(1, 4000, FULL).astype(np.uint16),
    "ring": (np.arange(FULL) % 32).astype(np.uint8),
    "gps_time": np.linspace(1e5, 1e5 + 1, FULL),
    "reflectance": np.linspace(-1, 1, FULL).astype(np.float32),
    "number": np.arange(FULL, dtype=np.int64) + 2**40,
}


def _full_points() -> np.ndarray:
    cloud = small_cloud(FULL).astype(np.float32).astype(np.float64)
    cloud[[3, 30]] = 0.0  # no return
    return cloud


def write_full(path: Path) -> None:
    """A file with all that its format can hold."""
    suffix, xyz = path.suffix, _full_points()
    if suffix in CLOUD_WRITERS:
        with path.open("wb") as handle:
            CLOUD_WRITERS[suffix](handle, RawCloud(xyz, unit_vectors(FULL), COLORS, fields=FIELDS))
        return
    rows = np.column_stack([xyz, FIELDS["intensity"], np.rint(COLORS * 255)])
    if suffix in (".pts", ".ptx"):
        pose = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
        path.write_text(f"{FULL}\n" if suffix == ".pts" else f"{FULL}\n1\n{pose}")
        with path.open("a") as handle:
            np.savetxt(handle, rows, fmt="%.17g")
    elif suffix == ".bin":
        path.write_bytes(np.column_stack([rows[:, :4], FIELDS["ring"]]).astype("<f4").tobytes())
    elif suffix == ".vtk":
        text = f"# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\nPOINTS {FULL} double\n"
        text += "\n".join(" ".join(map(repr, row)) for row in xyz.tolist())
        text += f"\nPOINT_DATA {FULL}\nSCALARS ring int\nLOOKUP_TABLE default\n"
        path.write_text(text + "\n".join(map(str, FIELDS["ring"].tolist())) + "\n")
    else:
        trimesh = pytest.importorskip("trimesh")
        box = trimesh.creation.icosphere(2)
        box.visual.vertex_colors = np.full((len(box.vertices), 4), 90, np.uint8)
        box.export(path)
        if suffix == ".obj":
            path.write_text(path.read_text() + "vt 0 0\nvn 0 0 1\nusemtl paint\nf 1/1/1 2/1/1 3/1/1\n")
