"""Small scans of one made-up scene, quick to register: boxes turned every way, seen in parts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geomoe3d.geometry.se3 import inverse, make_transform, transform_points

SETTINGS = ["voxel_size=0.12", "preparation.viewpoint=centroid", "matching.max_correspondences=400"]
"""Configuration under which a pair takes some 0.1 s of one core."""
UTM = np.array([583394.0, 5283100.0, 498.0])
CUTS = ((0.0, 2.6), (0.5, 3.1), (1.0, 3.6), (1.4, 4.0), (1.8, 4.6))
"""Five parts of a scene, low and high x of each: neighbours share most of what they show."""


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


def write_room(folder: Path) -> tuple[Path, dict[str, np.ndarray]]:
    """Five scans of one scene at map coordinates, one of another scene, one broken file; true poses."""
    points, poses = scene(), {}
    for number, (low, high) in enumerate(CUTS):
        part, T = cut(points, low, high, seed=number)
        np.save(folder / f"scan_{number}.npy", part + UTM)
        poses[f"scan_{number}"] = T
    np.save(folder / "scan_8.npy", cut(scene(77), 0.0, 3.0, seed=8)[0])
    (folder / "scan_9.ply").write_text("ply\nnothing\n")
    return folder, poses


def write_table(path, pairs):
    """A table of pairs for a batch: id, and the names of two scans beside it."""
    lines = [f"{name},{source}.npy,{target}.npy" for name, source, target in pairs]
    path.write_text("\n".join(["id,source,target", *lines]) + "\n")


def write_batch(folder):
    """a.npy, b.npy, c.npy, a broken file and a table of five pairs in a folder; the true poses."""
    points = scene()
    poses = {}
    for number, (name, low, high) in enumerate((("a", 0.0, 3.0), ("b", 0.8, 3.6), ("c", 0.4, 3.2))):
        part, poses[name] = cut(points, low, high, seed=number)
        np.save(folder / f"{name}.npy", part)
    (folder / "broken.ply").write_bytes(b"ply\nnothing of use\n")
    write_table(folder / "pairs.csv", [("ab", "a", "b"), ("ac", "a", "c"), ("bc", "b", "c")])
    with (folder / "pairs.csv").open("a") as stream:
        stream.write("bad,a.npy,broken.ply\ngone,missing.ply,b.npy\n")
    return poses


def everything(folder):
    """The content of every file in a folder."""
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
