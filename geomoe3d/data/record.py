"""One generated scene recorded into fragments: scene, walk, sensor and fusion put together.

The fragment's frame is that of its first camera, whose pose is exact, so the motion between two fragments
is exact as well; what drifts is the inside of a fragment, as in real recordings. About 1 s per fragment on
one core.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from geomoe3d.data.fusion import FusionSettings, fuse, thin
from geomoe3d.data.rooms.models import ModelLibrary
from geomoe3d.data.rooms.relief import Relief
from geomoe3d.data.rooms.scenes import Scene, generate_scene, load_mesh_scene
from geomoe3d.data.rooms.sensor import KINECT, DepthSensor, cast
from geomoe3d.data.rooms.walk import drifted, frame_poses, walk
from geomoe3d.data.settings import SynthesisSettings
from geomoe3d.geometry.se3 import inverse
from geomoe3d.types import Float32Array, FloatArray


@dataclass
class Recorded:
    """Fragments of one scene.

    Attributes:
        scene: what was recorded.
        clouds: (n, 3) float32 points of each fragment in the frame of its first camera, metres.
        poses: T_world_fragment (4, 4) of each, exact.
    """

    scene: Scene
    clouds: list[Float32Array] = field(default_factory=list)
    poses: list[FloatArray] = field(default_factory=list)


def choose_scene(
    rng: np.random.Generator, settings: SynthesisSettings, library: ModelLibrary | None, meshes: list[str]
) -> Scene:
    """A mesh, or a generated scene with or without models, by the shares of the settings."""
    if meshes and rng.random() < settings.shares.meshes:
        return load_mesh_scene(meshes[int(rng.integers(len(meshes)))])
    mixed = library is not None and rng.random() < settings.shares.models
    return generate_scene(rng, library if mixed else None, settings.clutter)


def record(rng: np.random.Generator, scene: Scene, settings: SynthesisSettings) -> Recorded:
    """Walk through a scene and record its fragments; views that show too little are left out."""
    recorded = Recorded(scene)
    sensor = DepthSensor(KINECT, settings.sensor, rng)
    relief = Relief(rng, scene.solids, settings.relief)
    rays = KINECT.rays()
    for stand in walk(rng, scene, settings.fragments_per_scene, settings.walk):
        poses = frame_poses(rng, stand, settings.frames_per_fragment, settings.walk)
        believed = drifted(rng, poses, settings.drift_metres, settings.drift_deg)
        origin = inverse(stand.pose)
        frames = [
            (sensor.measure(relief.bend(cast(scene.rays, KINECT, true), rays, true)), origin @ thought)
            for true, thought in zip(poses, believed, strict=True)
        ]
        fusion = FusionSettings(settings.fusion_voxel, 3 * settings.fusion_voxel, settings.sensor.far)
        points = thin(fuse(frames, KINECT.intrinsics, fusion), settings.grid)
        if len(points) >= settings.min_points:
            recorded.clouds.append(points.astype(np.float32))
            recorded.poses.append(stand.pose)
    return recorded
