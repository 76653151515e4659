"""Places that repeat: an answer beside which another one fits as well is not ok, also where no match shows that one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from surface_pairs import prepared

from geomoe3d.config import expert, load_config
from geomoe3d.data.rooms.scanner import LaserScanner, ScannerSettings
from geomoe3d.data.rooms.solids import Solids, turn
from geomoe3d.decision.shared_surface import SharedSurface
from geomoe3d.decision.twins import elsewhere, looks_around
from geomoe3d.geometry.se3 import inverse, make_transform, rotation_error_deg, transform_points
from geomoe3d.registration import Registrar

SCANNER = LaserScanner(
    ScannerSettings(rings=120, elevation_deg=(-70.0, 80.0), azimuth_step_deg=1.2, range_noise=0.003, near=0.3)
)
MIDDLE = (2.25, 3.0, 0.0)
QUICK = ["second_look.descriptor=none", "second_look.grids=[]", "second_look.max_correspondences=0"]


def room(twice: bool) -> Solids:
    """4.5 by 6 metres; the furniture of one half stands in the other one too, turned about, or something else does."""
    made, half, rng = Solids(), Solids(), np.random.default_rng(1)
    made.box((0, 0, -0.1), (4.5, 6, 0.1))
    for corner, size in (((0, -0.1, 0), (4.5, 0.1, 2.5)), ((-0.1, 0, 0), (0.1, 6, 2.5))):
        made.box(corner, size)
        made.box(tuple(np.add(corner, (0, 6.1, 0) if size[0] > 1 else (4.6, 0, 0))), size)
    for k in range(5):
        place = (0.3 + 0.8 * k, float(rng.uniform(0, 1.5)), 0.0)
        half.box(
            place, tuple(rng.uniform((0.3, 0.3, 0.4), (0.7, 0.9, 1.8))), turn_deg=float(rng.uniform(0, 60))
        )
    made.place(half, np.eye(4))
    if twice:
        made.place(half, turn(180, MIDDLE))
    else:
        for k in range(4):
            size = tuple(rng.uniform((0.3, 0.3, 0.3), (1.0, 0.6, 1.2)))
            made.box((0.3 + k, 4.2 + 0.3 * (k % 2), 0.0), size, turn_deg=float(rng.uniform(0, 60)))
    return made


def scans(twice: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Source, target, and the true transform; from one end of the room, and from the other one."""
    scene, rng = room(twice).scene(), np.random.default_rng(0)
    poses = []
    for (x, y), angle in (((1.9, 2.3), 10.0), ((3.3, 3.0), 150.0)):
        pose = turn(angle, (0.0, 0.0, 0.0))
        pose[:3, 3] = (x, y, 1.6)
        poses.append(pose)
    source, target = (SCANNER.scan(scene, pose, rng) for pose in poses)
    return source, target, inverse(poses[1]) @ poses[0]


def off(T: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    return rotation_error_deg(T, truth), float(np.linalg.norm(T[:3, 3] - truth[:3, 3]))


def test_of_a_room_that_looks_alike_after_a_half_turn_no_end_is_ok() -> None:
    source, target, truth = scans(twice=True)
    found = Registrar(load_config(None, [*QUICK, "second_look.repeat_below=0"])).register(source, target)
    assert found.status == "ambiguous" and found.confidence <= expert().confidence.most_doubted
    assert found.alternative is not None
    errors = [off(T, truth) for T in (found.T_target_source, found.alternative.T_target_source)]
    assert sorted(round(turned / 90) for turned, _ in errors) == [0, 2]
    assert min(errors)[1] < 0.1


def test_of_a_room_with_two_different_ends_it_is() -> None:
    source, target, truth = scans(twice=False)
    found = Registrar(load_config(None, [*QUICK, "second_look.repeat_below=0"])).register(source, target)
    assert found.ok and off(found.T_target_source, truth)[0] < 1


@pytest.mark.parametrize("far", [0.0, 3000.0])
def test_the_other_place_is_found_by_surfaces_alone(far: float) -> None:
    """Also where some points lie so far off that a grid of all would fit into no memory."""
    rng = np.random.default_rng(0)
    walls = rng.uniform(0, 1, (20_000, 3)) * (4.5, 6.0, 2.5)
    face = rng.integers(0, 5, len(walls))
    for axis, side, number in ((0, 0.0, 0), (0, 4.5, 1), (1, 0.0, 2), (1, 6.0, 3), (2, 0.0, 4)):
        walls[face == number, axis] = side
    half_turn = turn(180, MIDDLE)
    box = rng.uniform(0, 1, (3000, 3)) * (0.8, 1.4, 1.0) + (0.6, 0.5, 0)
    points = np.vstack([walls, box, transform_points(half_turn, box)])
    if far:
        points = np.vstack([points, *(far * side + 0.3 * rng.normal(size=(2000, 3)) for side in np.eye(3))])
    T = make_transform(turn(25, (0, 0, 0))[:3, :3], np.array([3.0, -2.0, 1.0]))
    source, target = prepared(points), prepared(transform_points(T, points))
    local = T.copy()
    local[:3, 3] += T[:3, :3] @ source.origin - target.origin
    expected = T @ half_turn
    expected[:3, 3] += expected[:3, :3] @ source.origin - target.origin
    found = elsewhere(local, SharedSurface(source, target))
    assert 0 < len(found) <= expert().twins.most_asked
    errors = [off(F, expected) for F in found]
    assert min(shift for turned, shift in errors if turned < 2) < 0.4  # two cells
    assert all(max(off(F, local)[0] / 45, off(F, local)[1] / 0.6) > 1 for F in found)  # none is the answer


def test_who_looks_around() -> None:
    rng = np.random.default_rng(0)
    corner = prepared(
        np.where(np.eye(3, dtype=bool)[rng.integers(0, 3, 6000)], 0, rng.uniform(0, 2, (6000, 3)))
    )
    around = replace(corner, viewpoint=corner.points.mean(0))
    ahead = replace(corner, viewpoint=corner.points.mean(0) + 5.0)
    assert looks_around(corner) and looks_around(around) and not looks_around(ahead)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.eye(3)])
def test_without_walls_at_right_angles_there_is_none(points: np.ndarray) -> None:
    ball = np.random.default_rng(0).normal(size=(6000, 3))
    cloud = prepared(3 * ball / np.linalg.norm(ball, axis=1, keepdims=True))
    shared = SharedSurface(cloud, cloud)
    shared.__dict__["directions"] = (points, points[:1])
    assert len(elsewhere(np.eye(4), shared)) == 0
