"""One generated scene recorded into fragments: scene, places, sensor and fusion put together.

A fragment is what a carried depth camera saw over some frames, one scan of a laser scanner, or a few views
of a single body. Its frame is that of its first pose, which is exact, so the motion between two fragments
is exact as well; what drifts is the inside of a camera's fragment, as in real recordings. About 1 s per
such fragment on one core, 0.2 s per scan, 0.05 s per fragment of a body.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from geomoe3d.data.fusion import FusionSettings, fuse, thin
from geomoe3d.data.rooms.bodies import generate_body
from geomoe3d.data.rooms.models import ModelLibrary
from geomoe3d.data.rooms.relief import Relief
from geomoe3d.data.rooms.scanner import SPINNING, TRIPOD, LaserScanner, stand_scanner
from geomoe3d.data.rooms.scenes import Scene, generate_scene, load_mesh_scene
from geomoe3d.data.rooms.sensor import KINECT, DepthSensor, cast
from geomoe3d.data.rooms.walk import camera_pose, drifted, frame_poses, walk
from geomoe3d.data.settings import SynthesisSettings
from geomoe3d.geometry.se3 import inverse, transform_points
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
    """A mesh or a generated scene, with models or without, by the settings' shares; or a single body."""
    if settings.recorder == "orbit":
        kind, body = generate_body(rng, library)
        return Scene("body", kind, body, [], floor=None)
    if meshes and rng.random() < settings.shares.meshes:
        return load_mesh_scene(meshes[int(rng.integers(len(meshes)))])
    mixed = library is not None and rng.random() < settings.shares.models
    return generate_scene(rng, library if mixed else None, settings.clutter)


def record(rng: np.random.Generator, scene: Scene, settings: SynthesisSettings) -> Recorded:
    """Record fragments with what the settings name; those that show too little are left out."""
    if settings.recorder == "scanner":
        return record_scans(rng, scene, settings)
    if settings.recorder == "orbit":
        return record_orbit(rng, scene, settings)
    return record_walk(rng, scene, settings)


def record_scans(rng: np.random.Generator, scene: Scene, settings: SynthesisSettings) -> Recorded:
    """Scan a scene from several places, all with the same kind of scanner; the frame is the sensor's."""
    recorded = Recorded(scene)
    scanner = LaserScanner(SPINNING if rng.random() < 0.5 else TRIPOD)
    for pose in stand_scanner(rng, scene, settings.fragments_per_scene):
        points = thin(scanner.scan(scene.rays, pose, rng), settings.grid)
        if len(points) >= settings.min_points:
            recorded.clouds.append(points.astype(np.float32))
            recorded.poses.append(pose)
    return recorded


def record_orbit(rng: np.random.Generator, scene: Scene, settings: SynthesisSettings) -> Recorded:
    """Look at a single body from all around; a fragment is one view, or a few of neighbouring ones."""
    recorded = Recorded(scene)
    low, high = scene.solids.bounds
    diagonal = float(np.linalg.norm(high - low))
    # Shares of the diagonal.
    noise = diagonal * float(rng.uniform(0.0005, 0.004))
    for _ in range(settings.fragments_per_scene):
        yaw, pitch = float(rng.uniform(0, 360)), float(rng.normal(0, 25))
        poses, parts = [], []
        for _ in range(int(rng.integers(1, 4))):
            pose = camera_pose(np.zeros(3), yaw, pitch, float(rng.normal(0, 10)))
            pose[:3, 3] = (low + high) / 2 - float(rng.uniform(1.2, 1.8)) * diagonal * pose[:3, 2]
            depth = cast(scene.rays, KINECT, pose).depth.ravel()
            seen = np.isfinite(depth)
            depth = depth[seen] + noise * rng.standard_normal(int(seen.sum()))
            poses.append(pose)
            parts.append(transform_points(inverse(poses[0]) @ pose, KINECT.rays()[seen] * depth[:, None]))
            yaw, pitch = yaw + float(rng.uniform(10, 30)), pitch + float(rng.normal(0, 8))
        points = thin(np.concatenate(parts), settings.grid)
        if len(points) >= settings.min_points:
            recorded.clouds.append(points.astype(np.float32))
            recorded.poses.append(poses[0])
    return recorded


def record_walk(rng: np.random.Generator, scene: Scene, settings: SynthesisSettings) -> Recorded:
    """Walk through a scene with a depth camera and fuse its frames into fragments."""
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
