"""Posed scans: four views of one surface in a folder, or the published benchmark where it is at hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomoe3d.clouds.io import save_points
from geomoe3d.data.threedmatch import find_benchmark_root, write_gt_log, write_gt_overlap
from geomoe3d.errors import InputError
from geomoe3d.geometry.se3 import inverse, make_transform, transform_points

COUNT = 4


def motion(k: int) -> np.ndarray:
    R = Rotation.from_euler("xyz", [3.0 * k, -5.0 * k, 8.0 * k], degrees=True).as_matrix()
    return make_transform(R, np.array([0.1 * k, 0.05 * k, -0.04 * k]))


def surface(rng: np.random.Generator, count: int = 6000) -> np.ndarray:
    x, y = rng.uniform(-1.2, 1.2, (2, count))
    z = 2.0 + 0.25 * np.sin(3 * x) * np.cos(4 * y) + 0.1 * np.sin(9 * x + 5 * y)
    return np.column_stack([x, y, z])


def write_posed(folder: Path) -> Path:
    """Four views of one surface with all their six pairs. Returns the folder of the set."""
    room = folder / "posed" / "room"
    room.mkdir(parents=True)
    rng = np.random.default_rng(0)
    poses = [motion(k) for k in range(COUNT)]
    for k, pose in enumerate(poses):
        save_points(room / f"cloud_bin_{k}.ply", transform_points(inverse(pose), surface(rng)))
    pairs = [(i, j) for i in range(COUNT) for j in range(i + 1, COUNT)]
    write_gt_log(room / "gt.log", [(i, j, inverse(poses[i]) @ poses[j]) for i, j in pairs], COUNT)
    write_gt_overlap(room / "gt_overlap.log", dict.fromkeys(pairs, 0.9))
    return room.parent


def real_root() -> Path:
    try:
        return find_benchmark_root()
    except InputError as error:
        pytest.skip(str(error))
