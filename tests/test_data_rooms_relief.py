"""Relief on flat walls: fixed in the world, as steep as asked, less on structure."""

from __future__ import annotations

import numpy as np
import pytest
from generated_rooms import SMALL, wall_scene

from geomoe3d.data.rooms.relief import Relief, ReliefSettings
from geomoe3d.data.rooms.scenes import Scene
from geomoe3d.data.rooms.sensor import cast
from geomoe3d.data.rooms.walk import camera_pose
from geomoe3d.geometry.se3 import transform_points


def bent(scene: Scene, settings: ReliefSettings, pose: np.ndarray, seed: int = 3) -> tuple[np.ndarray, ...]:
    """World points (n, 3) of an image before and after bending."""
    hits = cast(scene.rays, SMALL, pose)
    relief = Relief(np.random.default_rng(seed), scene.solids, settings)
    moved = relief.bend(hits, SMALL.rays(), pose)
    return tuple(transform_points(pose, SMALL.rays() * h.depth.reshape(-1, 1)) for h in (hits, moved))


def test_relief_is_fixed_in_the_world_and_as_steep_as_asked() -> None:
    settings = ReliefSettings(bend=0.2, spread=0.0, structure=1.0)
    poses = [camera_pose(np.array([0, y, 0.0]), yaw, 0, 0) for y, yaw in ((-0.5, 9.0), (0.5, -9.0))]
    slopes = []
    for seed in range(12):
        seen: list[dict[tuple[int, int], float]] = []
        for pose in poses:
            flat, uneven = bent(wall_scene(), settings, pose, seed)
            assert np.allclose(flat[:, 0], 3.0, atol=1e-4)
            # How far the surface stands out in the cells of a grid on the wall, in metres.
            cells = np.floor(uneven[:, 1:] / 0.05).astype(int).tolist()
            heights = dict(zip(map(tuple, cells), (uneven[:, 0] - 3.0).tolist(), strict=True))
            for step in ((1, 0), (0, 1)):
                next_cell = {(y, z): (y + step[0], z + step[1]) for y, z in heights}
                rise = [heights[b] - heights[a] for a, b in next_cell.items() if b in heights]
                slopes.append(np.mean(np.square(rise)) / 0.05**2)
            seen.append(heights)
        both = sorted(set(seen[0]) & set(seen[1]))
        one, two = (np.array([heights[cell] for cell in both]) for heights in seen)
        assert len(both) > 300
        assert np.corrcoef(one, two)[0, 1] > 0.9
    assert np.sqrt(2 * np.mean(slopes)) == pytest.approx(0.2, rel=0.25)  # along both axes of the wall


def test_relief_spares_structure_and_can_be_none() -> None:
    pose = camera_pose(np.zeros(3), 20, 0, 0)
    flat, still = bent(wall_scene(), ReliefSettings(bend=0.0), pose)
    assert np.array_equal(flat, still)
    flat, weak = bent(wall_scene(), ReliefSettings(spread=0.0, structure=0.25), pose)
    _, full = bent(wall_scene(), ReliefSettings(spread=0.0, structure=1.0), pose)
    ratio = (full - flat).std() / (weak - flat).std()
    assert ratio == pytest.approx(4.0, rel=0.01)
