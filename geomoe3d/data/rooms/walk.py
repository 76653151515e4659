"""Where the camera is for every fragment, and how it moves while one is recorded.

A person walks with a camera at hand height, looks at what stands there rather than at bare walls, and comes
back to places seen before. The steps between fragments and the motion within one follow what was measured
on the benchmark's ground truth and recordings (medians: 0.3 m and 15 degrees from fragment to fragment,
0.2 m and 8 degrees within; 1.7 m and 54 degrees between fragments that overlap by 10 to 30 %).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomoe3d.config import Section
from geomoe3d.data.rooms.scenes import Scene
from geomoe3d.data.rooms.sensor import Camera, Hits, cast
from geomoe3d.data.rooms.solids import between
from geomoe3d.geometry.se3 import make_transform, transform_points
from geomoe3d.types import FloatArray

_FINDER = Camera(40, 30, 36.5)  # a Kinect's view in few pixels


class WalkSettings(Section):
    """How a camera walks.

    Attributes:
        step: median way between consecutive fragments, metres.
        turn_deg: standard deviation of the turn between them.
        around: chance that a fragment looks from elsewhere at what an earlier one looked at.
        around_deg: standard deviation of the angle by which the camera has gone around it.
        motion: median way within a fragment, metres.
        motion_deg: median turn within one.
        height: range of the camera above the floor, metres.
        pitch_deg: mean and standard deviation of looking up.
        clearance: least distance to any surface, metres.
        min_share: share of the view that must be usable depth.
        fit: views whose middle is nearer than this are wanted less, metres.
        candidates: views of which the best is taken.
    """

    step: float = 0.33
    turn_deg: float = 18.0
    around: float = 0.4
    around_deg: float = 74.0
    motion: float = 0.25
    motion_deg: float = 10.0
    height: tuple[float, float] = (1.0, 1.75)
    pitch_deg: tuple[float, float] = (-22.0, 14.0)
    clearance: float = 0.3
    min_share: float = 0.35
    fit: float = 1.6
    candidates: int = 6


@dataclass(frozen=True)
class Stand:
    """Where a fragment begins: position, heading, pitch and roll in degrees."""

    eye: FloatArray
    yaw: float
    pitch: float
    roll: float

    @property
    def pose(self) -> FloatArray:
        """T_world_camera."""
        return camera_pose(self.eye, self.yaw, self.pitch, self.roll)


def camera_pose(eye: FloatArray, yaw_deg: float, pitch_deg: float, roll_deg: float) -> FloatArray:
    """T_world_camera of a camera that looks along its z, x right and y down; world z is up."""
    yaw, pitch, roll = np.radians([yaw_deg, pitch_deg, roll_deg])
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    R = np.column_stack([c * right + s * down, c * down - s * right, forward])
    return make_transform(R, np.asarray(eye, dtype=np.float64))


def walk(rng: np.random.Generator, scene: Scene, count: int, settings: WalkSettings) -> list[Stand]:
    """First poses of ``count`` fragments, fewer where the scene has no place for a camera."""
    stands: list[Stand] = []
    failures = 0
    while len(stands) < count and failures < 60:
        # Around something seen before, on from the last fragment, or, after failures, on from any.
        around = bool(stands) and rng.random() < settings.around
        last = (
            stands[int(rng.integers(len(stands))) if around or failures % 5 == 4 else -1] if stands else None
        )
        candidates = []
        for _ in range(settings.candidates):
            stand = _propose(rng, scene, last, around, settings)
            score = _score(rng, scene, stand, settings) if stand is not None else 0.0
            if stand is not None and score > 0:
                candidates.append((score, stand))
        if candidates:
            stands.append(max(candidates, key=lambda pair: pair[0])[1])
        else:
            failures += 1
    return stands


def frame_poses(
    rng: np.random.Generator, stand: Stand, count: int, settings: WalkSettings
) -> list[FloatArray]:
    """T_world_camera of the frames of one fragment; the first is the stand's pose exactly."""
    way = settings.motion * float(rng.lognormal(0, 0.7))
    turn = settings.motion_deg * float(rng.lognormal(0, 0.6))
    direction = rng.normal(size=3) * (1.0, 1.0, 0.4)
    direction *= way / max(float(np.linalg.norm(direction)), 1e-9)
    angle = rng.uniform(0, 2 * np.pi)
    d_yaw, d_pitch = turn * np.cos(angle), 0.6 * turn * np.sin(angle)
    bend = rng.normal(0, 0.25 * way, 3)
    poses = []
    for share in np.linspace(0, 1, count):
        eye = stand.eye + share * direction + share * (1 - share) * bend
        shake = rng.normal(0, 0.15, 3) if share > 0 else np.zeros(3)
        pitch = float(np.clip(stand.pitch + share * d_pitch + shake[1], -80, 80))
        poses.append(camera_pose(eye, stand.yaw + share * d_yaw + shake[0], pitch, stand.roll + shake[2]))
    return poses


def drifted(
    rng: np.random.Generator, poses: list[FloatArray], metres: float, degrees: float
) -> list[FloatArray]:
    """What a tracker believes the poses to be: errors that grow as a random walk, none at the first.

    Args:
        rng: decides them.
        poses: T_world_camera, the true ones.
        metres: standard deviation of the position at the end.
        degrees: standard deviation of each angle at the end.
    """
    from scipy.spatial.transform import Rotation

    steps = max(len(poses) - 1, 1)
    shift, angle, believed = np.zeros(3), np.zeros(3), [poses[0]]
    for pose in poses[1:]:
        shift = shift + rng.normal(0, metres / np.sqrt(3 * steps), 3)
        angle = angle + rng.normal(0, degrees / np.sqrt(steps), 3)
        error = make_transform(Rotation.from_euler("xyz", angle, degrees=True).as_matrix(), shift)
        believed.append(pose @ error)
    return believed


def _propose(
    rng: np.random.Generator, scene: Scene, last: Stand | None, around: bool, settings: WalkSettings
) -> Stand | None:
    """A place for a camera: anywhere, near the last one, or on the other side of what that one saw."""
    pitch = float(np.clip(rng.normal(*settings.pitch_deg), -65, 25))
    if last is None:
        x0, y0, x1, y1 = scene.areas[int(rng.integers(len(scene.areas)))]
        x, y = rng.uniform([x0 + 0.3, y0 + 0.3], [max(x1 - 0.3, x0 + 0.31), max(y1 - 0.3, y0 + 0.31)])
        yaw = between(rng, 0, 360)
    elif around:
        ahead = np.array([np.cos(np.radians(last.yaw)), np.sin(np.radians(last.yaw))])
        target = last.eye[:2] + between(rng, 1.6, 2.6) * ahead
        bearing = np.radians(last.yaw + 180 + float(rng.normal(0, settings.around_deg)))
        x, y = target + between(rng, 1.3, 3.0) * np.array([np.cos(bearing), np.sin(bearing)])
        yaw = float(np.degrees(np.arctan2(target[1] - y, target[0] - x)) + rng.normal(0, 12))
    else:
        way = settings.step * float(rng.lognormal(0, 0.8))
        angle = between(rng, 0, 2 * np.pi)
        x, y = last.eye[:2] + way * np.array([np.cos(angle), np.sin(angle)])
        yaw = last.yaw + float(rng.normal(0, settings.turn_deg))
        pitch = float(np.clip(last.pitch + rng.normal(0, 8), -65, 25))
    floor = floor_below(scene, float(x), float(y))
    if floor is None:
        return None
    eye = np.array([x, y, floor + rng.uniform(*settings.height)])
    if last is not None and not around:
        low, high = floor + np.array(settings.height)
        eye[2] = np.clip(last.eye[2] + rng.normal(0, 0.12), low, high)
    if not is_free(scene, eye, settings.clearance):
        return None
    return Stand(eye, yaw, pitch, float(rng.normal(0, 5)))


def floor_below(scene: Scene, x: float, y: float) -> float | None:
    """Height of the floor at a place; None outside the areas and where nobody could stand."""
    inside = any(x0 < x < x1 and y0 < y < y1 for x0, y0, x1, y1 in scene.areas)
    if not inside:
        return None
    if scene.floor is not None:
        return scene.floor
    import open3d as o3d

    low, high = scene.solids.bounds
    # Down from 1.2 m over the lowest level: under tables' tops a camera is not held anyway.
    start = float(low[2]) + min(1.8, 0.6 * float(high[2] - low[2]))
    ray = np.array([[x, y, start, 0, 0, -1.0]], dtype=np.float32)
    depth = float(scene.rays.cast_rays(o3d.core.Tensor.from_numpy(ray), nthreads=1)["t_hit"].numpy()[0])
    return start - depth if np.isfinite(depth) and depth > 1.2 else None


def is_free(scene: Scene, eye: FloatArray, clearance: float) -> bool:
    """Whether no surface is as near to a place (3,) as ``clearance``, metres."""
    import open3d as o3d

    point = o3d.core.Tensor.from_numpy(eye[None].astype(np.float32))
    return float(scene.rays.compute_distance(point, nthreads=1).numpy()[0]) > clearance


def _score(rng: np.random.Generator, scene: Scene, stand: Stand, settings: WalkSettings) -> float:
    """How much a person would want to record this view: 0 for an unusable one.

    Counts the pixels that a fragment would keep (0.5 to 3.5 m ahead, not grazed), and prefers views in which
    no single plane is everything.
    """
    hits = cast(scene.rays, _FINDER, stand.pose)
    usable = (hits.depth > 0.5) & (hits.depth < 3.5) & (hits.slope > 0.1)
    share = float(usable.mean())
    if share < settings.min_share:
        return 0.0
    # People step back until something fits the view; recorded fragments have their middle at 2.3 m.
    fit = min(float(np.median(hits.depth[usable])) / settings.fit, 1.0)
    return share * fit * (1.0 - 0.85 * _flatness(hits, usable, stand)) + 0.15 * float(rng.random())


def _flatness(hits: Hits, usable: np.ndarray, stand: Stand) -> float:
    """Share of the usable pixels on the plane that holds most of them, of those tried."""
    rays = _FINDER.rays()
    points = transform_points(stand.pose, rays * np.where(usable, hits.depth, 0.0).reshape(-1, 1))
    points = points[usable.ravel()][:: max(1, int(usable.sum()) // 300)]
    rng = np.random.default_rng(0)
    best = 0.0
    for _ in range(12):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-4:
            continue
        best = max(best, float(np.mean(np.abs((points - a) @ (normal / length)) < 0.04)))
    return best
