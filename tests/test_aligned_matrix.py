"""Every attribute from every readable format to every writable one: kept with its value, or named as lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cloud_files import needed, rigid, write_full

from geomoe3d.clouds.formats.raw import RawCloud
from geomoe3d.clouds.io import READABLE_SUFFIXES, WRITABLE_MESH_SUFFIXES, WRITABLE_SUFFIXES, save_aligned
from geomoe3d.clouds.loading import finite_part, read_raw

T = rigid(7)


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    for module in ("laspy", "pye57", "trimesh"):
        needed(module)
    folder = tmp_path_factory.mktemp("sources")
    for suffix in READABLE_SUFFIXES:
        write_full(folder / f"a{suffix}")
    return folder


@pytest.mark.parametrize("suffix", READABLE_SUFFIXES)
def test_what_is_said_to_be_lost_is_what_is_lost(tmp_path: Path, sources: Path, suffix: str) -> None:
    source, _ = finite_part(read_raw(sources / f"a{suffix}"), suffix)
    for target in dict.fromkeys(WRITABLE_SUFFIXES + WRITABLE_MESH_SUFFIXES):
        if target not in (WRITABLE_SUFFIXES if source.faces is None else (*WRITABLE_MESH_SUFFIXES, ".npz")):
            continue
        lost = save_aligned(tmp_path / f"b{target}", sources / f"a{suffix}", T)
        found = read_raw(tmp_path / f"b{target}")
        if source.faces is not None and target not in WRITABLE_MESH_SUFFIXES:
            assert "faces" in lost and len(found.points) == 100_000
            assert source.colors is None or "colors" in lost
            continue
        whole = (suffix, target) in ((".obj", ".obj"), (".glb", ".glb"), (".gltf", ".glb"))
        assert whole or set(source.unread) - {"texture coordinates", "materials"} <= set(lost), target
        check(source, found, lost, target)


def check(source: RawCloud, found: RawCloud, lost: tuple[str, ...], target: str) -> None:
    expected = source.points @ T[:3, :3].T + T[:3, 3]
    if source.faces is None:
        expected[~source.points.any(axis=1)] = 0.0
    if len(expected) == len(found.points):  # STL gives each triangle corners of its own
        atol = 1e-5 if target in (".ply", ".pcd", ".stl", ".glb") else 1e-6
        np.testing.assert_allclose(found.points, expected, atol=atol)
    turned = None if source.normals is None else source.normals @ T[:3, :3].T
    for name, had, has in (("normals", turned, found.normals), ("colors", source.colors, found.colors)):
        if had is None or name in lost:
            continue
        assert has is not None, (target, name)
        if len(had) == len(has):
            np.testing.assert_allclose(has, had, atol=0.5 / 255 + 1e-7 if name == "colors" else 1e-6)
    renamed = {
        line.split(" (kept as ")[0]: line.split(" (kept as ")[1].split(";")[0]
        for line in lost
        if " (kept" in line
    }
    for name, values in source.fields.items():
        if name in lost:
            assert name not in found.fields, f"{name} is said to be lost in {target}, and is there"
            continue
        np.testing.assert_array_equal(
            found.fields[renamed.get(name, name)].astype(float), values.astype(float)
        )


def test_fields_keep_their_types(tmp_path: Path) -> None:
    for suffix in (".ply", ".pcd", ".npz", ".las"):
        write_full(tmp_path / f"a{suffix}")
        kept = read_raw(tmp_path / f"a{suffix}").fields
        assert {name: kept[name].dtype for name in ("intensity", "ring", "gps_time", "reflectance")} == {
            **{"intensity": np.uint16, "ring": np.uint8, "gps_time": np.float64, "reflectance": np.float32}
        }
