"""Recording a generated scene: fragments lie on its surfaces."""

from __future__ import annotations

import numpy as np
from generated_rooms import CLEAN, TINY

from geomoe3d.data import record as record_module
from geomoe3d.data.rooms.relief import ReliefSettings
from geomoe3d.data.rooms.scenes import generate_scene
from geomoe3d.geometry.se3 import transform_points


def test_fragments_lie_on_the_surfaces_of_their_scene() -> None:
    """Ground truth is exact: with nothing disturbed, fused points moved by their pose meet the scene."""
    import open3d as o3d

    ideal = {"sensor": CLEAN, "relief": ReliefSettings(bend=0.0), "drift_metres": 0.0, "drift_deg": 0.0}
    settings = TINY.model_copy(update=ideal)
    scene = generate_scene(np.random.default_rng(21))
    recorded = record_module.record(np.random.default_rng(4), scene, settings)
    assert len(recorded.clouds) >= 2
    for cloud, pose in zip(recorded.clouds, recorded.poses, strict=True):
        world = transform_points(pose, cloud.astype(np.float64)).astype(np.float32)
        away = scene.rays.compute_distance(o3d.core.Tensor(world)).numpy()
        assert np.median(away) < 0.005
        assert np.percentile(away, 95) < settings.fusion_voxel
        # Cut off to 3DMatch's cube in front of the first camera.
        assert cloud[:, 2].min() >= 0.5
        assert np.abs(cloud[:, :2]).max() <= 1.5
