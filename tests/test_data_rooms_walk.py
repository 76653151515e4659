"""The walk of the camera: its distance from things, its frames, the drift of what it believes."""

from __future__ import annotations

import numpy as np

from geomoe3d.data.rooms.scenes import generate_scene
from geomoe3d.data.rooms.walk import WalkSettings, drifted, frame_poses, walk
from geomoe3d.geometry.se3 import inverse, rotation_angle_deg


def test_camera_keeps_its_distance_and_sees_something() -> None:
    import open3d as o3d

    scene = generate_scene(np.random.default_rng(11))
    settings = WalkSettings()
    stands = walk(np.random.default_rng(1), scene, 8, settings)
    assert len(stands) >= 6
    eyes = np.array([stand.eye for stand in stands], dtype=np.float32)
    assert scene.rays.compute_distance(o3d.core.Tensor(eyes)).numpy().min() > settings.clearance
    again = walk(np.random.default_rng(1), scene, 8, settings)
    assert all(np.array_equal(a.pose, b.pose) for a, b in zip(stands, again, strict=True))


def test_frames_begin_at_the_stand_and_drift_is_none_at_the_first() -> None:
    scene = generate_scene(np.random.default_rng(11))
    stand = walk(np.random.default_rng(1), scene, 1, WalkSettings())[0]
    rng = np.random.default_rng(3)
    poses = frame_poses(rng, stand, 9, WalkSettings())
    believed = drifted(rng, poses, 0.02, 0.5)
    assert np.array_equal(poses[0], stand.pose)
    assert np.array_equal(believed[0], poses[0])
    errors = [inverse(a) @ b for a, b in zip(poses, believed, strict=True)]
    assert 0 < np.linalg.norm(errors[-1][:3, 3]) < 0.1
    assert 0 < rotation_angle_deg(errors[-1][:3, :3]) < 3
    assert all(np.array_equal(x, y) for x, y in zip(poses, drifted(rng, poses, 0, 0), strict=True))
