"""Small scans of one made-up scene, quick to register: boxes turned every way, seen in parts."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from geomoe3d.geometry.se3 import inverse, make_transform, transform_points

SETTINGS = ["voxel_size=0.12", "preparation.viewpoint=centroid", "matching.max_correspondences=400"]
"""Configuration under which a pair takes some 0.1 s of one core."""


def scene(seed=0, *, count=12, size=4.0, density=150):
    """(N, 3) points on the surfaces of turned boxes in a cube of the given size."""
    rng = np.random.default_rng(seed)
    parts = []
    for _ in range(count):
        dims, centre = rng.uniform(0.3, 1.2, 3), rng.uniform(0, size, 3)
        R = Rotation.random(random_state=int(rng.integers(1_000_000))).as_matrix()
        for face in range(6):
            axis, sides = face % 3, np.delete(dims, face % 3)
            points = rng.uniform(-0.5, 0.5, (int(sides[0] * sides[1] * density), 3))
            points[:, axis] = 0.5 if face < 3 else -0.5
            parts.append((points * dims) @ R.T + centre)
    return np.concatenate(parts)


def cut(points, low, high, *, seed, keep=0.8):
    """Points with x between low and high, a random share of them, in a frame of their own, and its pose.

    Returns:
        (n, 3) points p_scan and T_scene_scan (4, 4).
    """
    rng = np.random.default_rng(seed)
    part = points[(points[:, 0] > low) & (points[:, 0] < high)]
    part = part[rng.random(len(part)) < keep]
    pose = make_transform(Rotation.random(random_state=seed).as_matrix(), rng.uniform(-3, 3, 3))
    return transform_points(inverse(pose), part), pose
