"""Buildings of generated rooms as merged clouds, and single views of their rooms with the true pose."""

from __future__ import annotations

import numpy as np

from geomoe3d.data.rooms.scanner import LaserScanner, ScannerSettings
from geomoe3d.data.rooms.solids import Solids
from geomoe3d.data.sample import _view
from geomoe3d.data.sample_room import furnished_room
from geomoe3d.geometry.se3 import make_transform, transform_points

GRID = 0.08
"""Voxel size at which a scan takes some 0.5 s of one core."""
UTM = np.array([583394.0, 5283100.0, 498.0])
AWAY = np.array([7.0, 1.0, 0.0])
"""Where the first room stands, world coordinates, and from there the other one."""
_COARSE = ScannerSettings(
    rings=150, elevation_deg=(-70.0, 60.0), azimuth_step_deg=0.8, range_noise=0.003, near=0.3
)
_STANDS = ((0.9, 0.8, 1.5), (3.3, 0.7, 1.4), (2.9, 3.0, 1.6))
_EYE, _YAWS = (0.75, 0.70, 1.50), (22.0, 44.0, 66.0)


def other_room(seed):
    """A room with nothing of `furnished_room` in it: other size, turned boxes, a flight of steps."""
    room, rng = Solids(), np.random.default_rng(seed)
    room.box((0.0, 0.0, -0.1), (3.4, 4.6, 0.1))
    room.box((0.0, -0.1, 0.0), (3.4, 0.1, 2.4))
    room.box((0.0, 4.6, 0.0), (3.4, 0.1, 2.4))
    room.box((-0.1, 0.0, 0.0), (0.1, 4.6, 2.4))
    room.box((3.4, 0.0, 0.0), (0.1, 4.6, 2.4))
    for k in range(6):
        room.box((2.2, 1.0 + 0.3 * k, 0.0), (1.2, 0.3, 0.2 * (k + 1)))
    for _ in range(9):
        x, y = rng.uniform((0.3, 1.5), (1.8, 4.0))
        room.box((x, y, 0.0), tuple(rng.uniform(0.2, 0.9, 3)), turn_deg=float(rng.uniform(0, 90)))
    return room


def scanned(room, offset, seed):
    """(N, 3) merged scans of a room that stands at an offset, world coordinates."""
    rng, scene = np.random.default_rng(seed), room.scene()
    parts = []
    for stand in _STANDS:
        pose = make_transform(np.eye(3), np.array(stand))
        parts.append(transform_points(pose, LaserScanner(_COARSE).scan(scene, pose, rng)))
    return np.concatenate(parts) + offset


def view(room, offset, seed):
    """A depth camera's view of the room, (N, 3) with the camera at the origin, and its true pose in the world."""
    cloud, pose = _view(room, _EYE, _YAWS, "scan", np.random.default_rng(seed))
    pose = pose.copy()
    pose[:3, 3] += offset
    return cloud.points, pose


def shift(T, true):
    """How far apart two transforms put the origin."""
    return float(np.linalg.norm(T[:3, 3] - true[:3, 3]))


def two_rooms(rooms):
    """(N, 3) of both at map coordinates, as one cloud without sensors."""
    return np.concatenate([scanned(rooms[0], UTM, 1), scanned(rooms[1], UTM + AWAY, 2)])


def first_room():
    return furnished_room(np.random.default_rng(0))
