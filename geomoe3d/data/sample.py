"""The sample pair: two views of one generated furnished room, as a depth camera would see them.

Each view is what an RGB-D fragment is: a few depth frames of a camera that turns by some degrees, laid
together in the frame of its first pose, so that the camera stands at the origin. Depth carries the noise
of a structured-light sensor, surfaces seen at a grazing angle drop out, and nothing beyond the sensor's
range is seen. The room has no symmetry, so that exactly one motion is right, and that one is known.
About two seconds and 200 MB, most of it the import of Open3D, which casts the rays.
"""

from __future__ import annotations

import filecmp
import os
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from geomoe3d.data.rooms.sensor import Camera, cast
from geomoe3d.data.rooms.solids import Solids
from geomoe3d.data.rooms.walk import camera_pose as _camera_pose
from geomoe3d.data.sample_room import furnished_room
from geomoe3d.errors import InputError
from geomoe3d.geometry.se3 import inverse, transform_points
from geomoe3d.types import FloatArray, PointCloud

_CAMERA = Camera(320, 240, 262.5)  # 63 by 49 degrees


class SamplePaths(NamedTuple):
    """Files of a written sample pair."""

    source: Path
    target: Path
    truth: Path


def make_sample_pair(seed: int = 0) -> tuple[PointCloud, PointCloud, FloatArray]:
    """Two views of one generated room and the motion between them.

    Args:
        seed: decides the clutter, the camera's exact path and the noise; same seed, same arrays.

    Returns:
        Source and target, each in metres in the frame of its own first camera (x right, y down, z into
        the room, the camera at the origin), coloured by object; and T_target_source (4, 4).

    Raises:
        InputError: the seed is negative.
    """
    if seed < 0:
        raise InputError(f"the seed must not be negative, found {seed}")
    rng = np.random.default_rng(seed)
    room = furnished_room(rng)
    source, T_world_source = _view(room, (0.75, 0.70, 1.50), (22.0, 44.0, 66.0), "source", rng)
    target, T_world_target = _view(room, (2.35, 0.45, 1.35), (74.0, 99.0, 124.0), "target", rng)
    return source, target, inverse(T_world_target) @ T_world_source


def write_sample_pair(folder: str | os.PathLike[str], seed: int = 0, force: bool = False) -> SamplePaths:
    """Write source.ply, target.ply and T_target_source.txt, the true motion, into a folder.

    Args:
        folder: is made if it does not exist.
        seed: as in `make_sample_pair`; same seed, same bytes.
        force: True replaces files of an earlier pair.

    Called again, it leaves files that hold this very pair as they are.

    Raises:
        OutputError: the folder cannot be made or written, or a file of other content exists and ``force`` is False;
            then nothing has been written.
        InputError: the seed is negative.
    """
    from geomoe3d.clouds.io import save_points
    from geomoe3d.clouds.transform_files import save_transform
    from geomoe3d.runtime.files import check_output, make_folder

    folder = Path(folder)
    make_folder(folder)
    paths = SamplePaths(folder / "source.ply", folder / "target.ply", folder / "T_target_source.txt")
    if not force and all(path.is_file() for path in paths):
        with tempfile.TemporaryDirectory() as place:
            again = write_sample_pair(place, seed)
            if all(filecmp.cmp(*both, shallow=False) for both in zip(paths, again, strict=True)):
                return paths
    for path in paths:
        check_output(path, force=force)
    source, target, T_target_source = make_sample_pair(seed)
    for path, cloud in ((paths.source, source), (paths.target, target)):
        save_points(path, cloud.points, colors=cloud.colors, force=force)
    save_transform(
        paths.truth,
        T_target_source,
        [
            "the true transform of the sample pair",
            "maps source.ply into target.ply: p_target = R p_source + t",
        ],
        force=force,
    )
    return paths


def _view(
    room: Solids,
    eye: tuple[float, float, float],
    yaws_deg: tuple[float, ...],
    name: str,
    rng: np.random.Generator,
) -> tuple[PointCloud, FloatArray]:
    """Frames of a camera that turns on the spot, nearly; in the frame of the first, with its pose."""
    poses = [
        _camera_pose(
            np.asarray(eye) + rng.uniform(-0.06, 0.06, 3),
            yaw + rng.uniform(-3, 3),
            rng.uniform(-22, -14),
            rng.uniform(-4, 4),
        )
        for yaw in yaws_deg
    ]
    scene, face_colors = room.scene(), np.concatenate(room.colors)
    parts, colors = [], []
    for pose in poses:
        points, color = _depth_frame(scene, face_colors, pose, rng)
        parts.append(transform_points(inverse(poses[0]) @ pose, points))
        colors.append(color)
    points, color = np.concatenate(parts), np.concatenate(colors)
    # One point is kept per voxel of this edge, as fusing the frames of a fragment does.
    _, first = np.unique(np.floor(points / 0.0125).astype(np.int64), axis=0, return_index=True)
    keep = np.sort(first)
    # As a PLY of a scanner holds them: single precision, 8 bits per colour.
    points = points[keep].astype(np.float32).astype(np.float64)
    return PointCloud(points, colors=np.round(color[keep] * 255) / 255, name=name), poses[0]


def _depth_frame(
    scene: Any, face_colors: FloatArray, T_world_camera: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """One depth image as (n, 3) points in the camera's frame and their (n, 3) colours."""
    hits = cast(scene, _CAMERA, T_world_camera)
    depth, slope, rays = hits.depth.ravel(), hits.slope.ravel(), _CAMERA.rays()
    dropped = rng.uniform(size=len(depth)) > np.clip((slope - 0.05) / 0.20, 0, 1)
    sigma = np.clip(0.0015 * np.where(np.isfinite(depth), depth, 0.0) ** 2, 0.003, 0.015)
    noisy = depth + sigma * rng.standard_normal(len(depth))
    seen = np.isfinite(depth) & (depth > 0.4) & (depth < 4.5) & ~dropped  # metres
    points: FloatArray = rays[seen] * noisy[seen, None]
    return points, face_colors[hits.triangle[seen]]
