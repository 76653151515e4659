"""The depth sensor: exact rays, rounded disparity, shadows, surfaces that vanish at grazing angles."""

from __future__ import annotations

import numpy as np
import pytest
from generated_rooms import CLEAN, SMALL, wall_scene

from geomoe3d.data.rooms.scenes import generate_scene
from geomoe3d.data.rooms.sensor import DepthSensor, SensorSettings, cast
from geomoe3d.data.rooms.solids import Solids
from geomoe3d.data.rooms.walk import WalkSettings, camera_pose, walk


def test_cast_depth_is_exact() -> None:
    hits = cast(wall_scene().rays, SMALL, camera_pose(np.zeros(3), 0, 0, 0))
    assert np.allclose(hits.depth, 3.0, atol=1e-5)
    assert hits.slope.max() == pytest.approx(1.0, abs=1e-4)


def test_sensor_rounds_the_disparity() -> None:
    sensor = DepthSensor(SMALL, SensorSettings(bias=0), np.random.default_rng(0))
    depth = sensor.measure(cast(wall_scene().rays, SMALL, camera_pose(np.zeros(3), 0, 0, 0)))
    seen = depth[depth > 0]
    assert np.mean(depth > 0) > 0.9
    assert np.median(seen) == pytest.approx(3.0, abs=0.03)
    values = np.unique(seen)
    assert len(values) < 20
    # z^2 / (f b) / 8: 2.6 cm at 3 m for f = 585 and b = 7.5 cm.
    assert np.median(np.diff(values)) == pytest.approx(9 / (584 * 0.075) / 8, rel=0.1)


def test_clean_sensor_gives_true_depth_within_its_range() -> None:
    scene = generate_scene(np.random.default_rng(2))
    stand = walk(np.random.default_rng(0), scene, 1, WalkSettings())[0]
    hits = cast(scene.rays, SMALL, stand.pose)
    depth = DepthSensor(SMALL, CLEAN, np.random.default_rng(0)).measure(hits)
    seen = depth > 0
    assert seen.mean() > 0.3
    assert np.abs(depth - hits.depth)[seen].max() < 0.002
    assert depth[seen].min() > CLEAN.near
    assert depth.max() < CLEAN.far


def test_nearer_things_cast_a_shadow_and_grazing_surfaces_vanish() -> None:
    s = Solids()
    s.box((3.0, -5, -5), (0.1, 10, 10))
    s.box((1.0, -0.2, -0.2), (0.05, 0.4, 0.4))
    pose = camera_pose(np.zeros(3), 0, 0, 0)
    hits = cast(s.scene(), SMALL, pose)
    depth = DepthSensor(SMALL, CLEAN, np.random.default_rng(0)).measure(hits)
    middle = depth[SMALL.height // 2]
    lost = np.flatnonzero((middle == 0) & (hits.depth[SMALL.height // 2] > 2.9))
    # The wall is hidden from the projector over b f (1/1 - 1/3) pixels on one side of the box.
    assert len(lost) == pytest.approx(0.075 * 146 * (1 - 1 / 3), abs=2)
    assert len({bool(column > SMALL.width / 2) for column in lost}) == 1
    floor = Solids()
    floor.box((-1, -5, -0.3), (20, 10, 0.1))
    hits = cast(floor.scene(), SMALL, pose)
    settings = SensorSettings(min_slope=0.08, full_slope=0.25, far=10.0)
    depth = DepthSensor(SMALL, settings, np.random.default_rng(0)).measure(hits)
    assert not (depth[hits.slope < 0.07] > 0).any()
    steep = (hits.slope > 0.3) & (hits.depth < 9)
    assert (depth[steep] > 0).mean() > 0.75
