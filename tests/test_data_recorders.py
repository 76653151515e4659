"""Recorders beside the depth camera: laser scanners in rooms, and views all around single bodies."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from geomoe3d.data.collection import load_fragment, open_collection
from geomoe3d.data.rooms.bodies import generate_body
from geomoe3d.data.rooms.scanner import SPINNING, TRIPOD, LaserScanner, ScannerSettings, stand_scanner
from geomoe3d.data.rooms.scenes import Scene, generate_scene
from geomoe3d.data.rooms.solids import Solids
from geomoe3d.data.settings import SynthesisSettings
from geomoe3d.data.synthesize import MANIFEST, synthesize
from geomoe3d.geometry.se3 import make_transform, transform_points

SCANS = SynthesisSettings(recorder="scanner", fragments_per_scene=3, grid=0.1, min_points=500)
VIEWS = SynthesisSettings(recorder="orbit", fragments_per_scene=4, min_points=500)


def hall() -> Scene:
    """6 x 4 x 3 m, empty, seen from inside."""
    solids = Solids()
    solids.box((0, 0, 0), (6, 4, 3))
    return Scene("mesh", "hall", solids, [(0.0, 0.0, 6.0, 4.0)])


@pytest.mark.parametrize("settings", [SPINNING, TRIPOD], ids=["spinning", "tripod"])
def test_a_scan_lies_on_the_walls_but_for_its_noise(settings: ScannerSettings) -> None:
    pose = make_transform(np.eye(3), np.array([2.0, 1.5, 1.4]))
    points = LaserScanner(settings).scan(hall().rays, pose, np.random.default_rng(0))
    reach = np.linalg.norm(points, axis=1)
    assert reach.min() > settings.near
    elevation = np.degrees(np.arcsin(points[:, 2] / reach))
    assert elevation.min() == pytest.approx(settings.elevation_deg[0], abs=1.0)
    world = transform_points(pose, points)
    gap = np.abs(np.concatenate([world, world - (6, 4, 3)], axis=1)).min(1)
    assert np.median(gap) < settings.range_noise
    assert gap.max() < 6 * settings.range_noise
    other = LaserScanner(settings).scan(hall().rays, pose, np.random.default_rng(1))
    assert other.shape == points.shape  # the pattern is the scanner's, the noise is not
    assert not np.array_equal(other, points)


def test_far_and_grazing_surfaces_return_nothing() -> None:
    pose = make_transform(np.eye(3), np.array([0.5, 2.0, 1.4]))
    near = LaserScanner(ScannerSettings(far=3.0)).scan(hall().rays, pose, np.random.default_rng(0))
    assert np.linalg.norm(near, axis=1).max() < 3.2
    steep = LaserScanner(ScannerSettings(min_slope=0.9, range_noise=0.0)).scan(
        hall().rays, pose, np.random.default_rng(0)
    )
    directions = steep / np.linalg.norm(steep, axis=1, keepdims=True)
    assert np.abs(directions).max(1).min() > 0.9  # the hall's faces are perpendicular to the axes


def test_scanners_stand_free_upright_and_in_reach_of_each_other() -> None:
    scene = hall()
    poses = stand_scanner(np.random.default_rng(0), scene, 6)
    eyes = np.array([pose[:3, 3] for pose in poses])
    assert len(eyes) == 6
    assert eyes[:, 0].min() > 0.4 and eyes[:, 0].max() < 5.6 and eyes[:, 1].max() < 3.6
    assert all(pose[2, 2] > np.cos(np.radians(15)) for pose in poses)
    apart = np.linalg.norm(eyes[:, None] - eyes[None], axis=2) + 9 * np.eye(6)
    assert apart[1:].min(1).max() < 8
    nowhere = Scene("mesh", "slit", scene.solids, [(0.0, 0.0, 0.3, 0.3)])
    assert stand_scanner(np.random.default_rng(0), nowhere, 2) == []


def test_bodies_have_the_asked_for_size_and_depend_on_their_generator_alone() -> None:
    kinds = set()
    for seed in range(30):
        kind, body = generate_body(np.random.default_rng(seed), None)
        low, high = body.bounds
        assert 1.8 <= np.linalg.norm(high - low) <= 5.0
        assert np.allclose(low + high, 0, atol=1e-9)
        assert sum(map(len, body.vertices)) == body.num_vertices
        kinds.add(kind)
    assert kinds == {"piece", "pile", "grown"}
    again = generate_body(np.random.default_rng(3), None)[1]
    assert np.array_equal(again.vertices[0], generate_body(np.random.default_rng(3), None)[1].vertices[0])


@pytest.mark.parametrize("settings", [SCANS, VIEWS], ids=["scanner", "orbit"])
def test_truth_fits_the_clouds(settings: SynthesisSettings, tmp_path: Path) -> None:
    synthesize(tmp_path / "set", 1, seed=1, settings=settings)
    pairs = [p for p in open_collection(tmp_path / "set").pairs if p.overlap and p.overlap > 0.3]
    assert pairs
    radius = 1.5 * (settings.grid if settings.recorder == "scanner" else 0.025)
    for pair in pairs[:3]:
        source, target = (load_fragment(path).file_points for path in (pair.source, pair.target))
        moved = transform_points(pair.T_target_source, source)
        share = np.mean(cKDTree(target).query(moved)[0] < radius)
        assert share == pytest.approx(pair.overlap, abs=0.01)
        off = pair.T_target_source @ make_transform(np.eye(3), np.full(3, 2.0 * radius))
        assert np.mean(cKDTree(target).query(transform_points(off, source))[0] < radius) < share


def test_a_set_made_before_there_were_recorders_goes_on(tmp_path: Path) -> None:
    settings = VIEWS.model_copy(update={"recorder": "camera", "frames_per_fragment": 2, "fusion_voxel": 0.03})
    synthesize(tmp_path / "set", 1, seed=1, settings=settings)
    manifest = json.loads((tmp_path / "set" / MANIFEST).read_text())
    del manifest["settings"]["recorder"]
    (tmp_path / "set" / MANIFEST).write_text(json.dumps(manifest))
    assert synthesize(tmp_path / "set", 1, seed=1, settings=settings).kept == 1


def test_rooms_can_be_scanned() -> None:
    from geomoe3d.data.record import record

    scene = generate_scene(np.random.default_rng(2))
    recorded = record(np.random.default_rng(0), scene, SCANS)
    assert len(recorded.clouds) == len(recorded.poses) >= 2
    import open3d as o3d

    for cloud, pose in zip(recorded.clouds, recorded.poses, strict=True):
        world = transform_points(pose, cloud.astype(np.float64)).astype(np.float32)
        assert np.median(scene.rays.compute_distance(o3d.core.Tensor(world)).numpy()) < 0.02
