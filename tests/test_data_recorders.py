"""Recorders beside the depth camera: laser scanners in rooms, and views all around single bodies."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
import trimesh
from scipy.spatial import cKDTree

from geomoe3d.data.collection import load_fragment, open_collection
from geomoe3d.data.record import choose_scene, record
from geomoe3d.data.rooms.arrange import MAKERS
from geomoe3d.data.rooms.bodies import generate_body, looks_the_same_turned
from geomoe3d.data.rooms.models import open_library
from geomoe3d.data.rooms.scanner import SPINNING, TRIPOD, LaserScanner, ScannerSettings, stand_scanner
from geomoe3d.data.rooms.scenes import Scene, generate_scene
from geomoe3d.data.rooms.solids import Solids
from geomoe3d.data.settings import SynthesisSettings
from geomoe3d.data.synthesize import MANIFEST, synthesize
from geomoe3d.errors import InputError
from geomoe3d.geometry.se3 import make_transform, transform_points

SCANS = SynthesisSettings(recorder="scanner", fragments_per_scene=3, grid=0.1, min_points=500)
VIEWS = SynthesisSettings(recorder="orbit", fragments_per_scene=4, min_points=500)


def hall(length: float = 6.0, floor: float = 0.0) -> Scene:
    """6 x 4 x 3 m, empty, seen from inside; its floor is found by rays, as in scene meshes."""
    solids = Solids()
    solids.box((0, 0, floor), (length, 4, 3))
    return Scene("mesh", "hall", solids, [(0.0, 0.0, length, 4.0)], floor=None)


@pytest.mark.parametrize("settings", [SPINNING, TRIPOD], ids=["spinning", "tripod"])
def test_a_scan_lies_on_the_walls_but_for_its_noise(settings: ScannerSettings) -> None:
    pose = make_transform(np.eye(3), np.array([2.0, 1.5, 1.4]))
    points = LaserScanner(settings).scan(hall().rays, pose, np.random.default_rng(0))
    reach = np.linalg.norm(points, axis=1)
    elevation = np.degrees(np.arcsin(points[:, 2] / reach))
    assert elevation.min() == pytest.approx(settings.elevation_deg[0], abs=1.0)
    assert elevation.max() == pytest.approx(settings.elevation_deg[1], abs=1.0)
    world = transform_points(pose, points)
    gap = np.abs(np.concatenate([world, world - (6, 4, 3)], axis=1)).min(1)
    assert np.median(gap) < settings.range_noise
    assert gap.max() < 6 * settings.range_noise
    other = LaserScanner(settings).scan(hall().rays, pose, np.random.default_rng(1))
    assert other.shape == points.shape  # the pattern is the scanner's, the noise is not
    assert not np.array_equal(other, points)


def test_far_and_grazing_surfaces_return_nothing() -> None:
    pose = make_transform(np.eye(3), np.array([0.5, 2.0, 1.4]))
    kept = LaserScanner(ScannerSettings(near=1.0, far=3.0)).scan(hall().rays, pose, np.random.default_rng(0))
    reach = np.linalg.norm(kept, axis=1)  # the wall behind is 0.5 m away, the one in front 5.5 m
    assert 0.9 < reach.min() < 1.1
    assert 2.9 < reach.max() < 3.1
    steep = LaserScanner(ScannerSettings(min_slope=0.9, range_noise=0.0)).scan(
        hall().rays, pose, np.random.default_rng(0)
    )
    directions = steep / np.linalg.norm(steep, axis=1, keepdims=True)
    assert np.abs(directions).max(1).min() > 0.9  # the hall's faces are perpendicular to the axes


def test_scanners_stand_free_upright_and_in_reach_of_each_other() -> None:
    scene = hall(length=40.0, floor=2.0)
    poses = stand_scanner(np.random.default_rng(0), scene, 6)
    eyes = np.array([pose[:3, 3] for pose in poses])
    assert len(eyes) == 6
    assert eyes[:, :2].min() > 0.4
    assert (eyes[:, :2] < (39.6, 3.6)).all()
    assert eyes[:, 2].min() >= 3.2
    assert eyes[:, 2].max() <= 3.7
    assert all(pose[2, 2] > np.cos(np.radians(15)) for pose in poses)
    apart = np.linalg.norm(eyes[:, None] - eyes[None], axis=2)
    assert all(((apart[k, :k] > 1) & (apart[k, :k] < 8)).any() for k in range(1, 6))
    nowhere = Scene("mesh", "slit", scene.solids, [(0.0, 0.0, 0.3, 0.3)], floor=None)
    assert stand_scanner(np.random.default_rng(0), nowhere, 2) == []
    outside = Scene("mesh", "yard", scene.solids, [(50.0, 0.0, 60.0, 9.0)], floor=None)
    assert stand_scanner(np.random.default_rng(0), outside, 2) == []


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


def test_fragments_of_a_body_lie_on_it_also_where_views_were_joined() -> None:
    scene = choose_scene(np.random.default_rng(5), VIEWS, None, [])
    recorded = record(np.random.default_rng(0), scene, VIEWS)
    low, high = scene.solids.bounds
    assert len(recorded.clouds) == 4
    for cloud, pose in zip(recorded.clouds, recorded.poses, strict=True):
        world = transform_points(pose, cloud.astype(np.float64)).astype(np.float32)
        away = scene.rays.compute_distance(o3d.core.Tensor(world)).numpy()
        assert np.percentile(away, 95) < 0.01 * np.linalg.norm(high - low)


def test_bodies_of_a_library_are_left_as_they_are(tmp_path: Path) -> None:
    mesh = trimesh.util.concatenate(
        [
            trimesh.creation.box((0.4, 0.5, 0.9)),
            trimesh.creation.box((0.3, 0.2, 0.2)).apply_translation((0.3, 0.1, 0.4)),
        ]
    )
    mesh.export(tmp_path / "chair.ply")
    library = open_library([tmp_path])
    first = library.draw("chair", np.random.default_rng(0))
    assert first is not None
    before = [v.copy() for v in first.solids.vertices]
    for seed in range(20):
        generate_body(np.random.default_rng(seed), library)
    again = library.draw("chair", np.random.default_rng(0))
    assert again is not None
    assert all(np.array_equal(a, b) for a, b in zip(before, again.solids.vertices, strict=True))


def test_bodies_that_cannot_be_told_from_themselves_turned_are_recognised() -> None:
    rng = np.random.default_rng(0)
    for name in ("lamp", "picture", "table", "fridge"):
        assert looks_the_same_turned(MAKERS[name](rng).solids), name
    for name in ("chair", "desk", "sofa", "toilet"):
        assert not looks_the_same_turned(MAKERS[name](rng).solids), name


def test_orbits_take_no_scene_meshes(tmp_path: Path) -> None:
    trimesh.creation.box().export(tmp_path / "scene.ply")
    with pytest.raises(InputError, match="no scene meshes"):
        synthesize(tmp_path / "set", 1, settings=VIEWS, meshes=[str(tmp_path / "scene.ply")])


def test_a_set_made_before_there_were_recorders_goes_on(tmp_path: Path) -> None:
    settings = VIEWS.model_copy(update={"recorder": "camera", "frames_per_fragment": 2, "fusion_voxel": 0.03})
    synthesize(tmp_path / "set", 1, seed=1, settings=settings)
    manifest = json.loads((tmp_path / "set" / MANIFEST).read_text())
    del manifest["settings"]["recorder"]
    (tmp_path / "set" / MANIFEST).write_text(json.dumps(manifest))
    assert synthesize(tmp_path / "set", 1, seed=1, settings=settings).kept == 1


def test_rooms_can_be_scanned() -> None:
    scene = generate_scene(np.random.default_rng(2))
    recorded = record(np.random.default_rng(0), scene, SCANS)
    assert len(recorded.clouds) == len(recorded.poses) >= 2
    for cloud, pose in zip(recorded.clouds, recorded.poses, strict=True):
        world = transform_points(pose, cloud.astype(np.float64)).astype(np.float32)
        assert np.median(scene.rays.compute_distance(o3d.core.Tensor(world)).numpy()) < 0.02
