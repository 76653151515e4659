"""Rings of scans with known poses and an edge for every two that are near, as the grouping gets them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from geomoe3d.geometry.se3 import inverse, make_transform
from geomoe3d.multiway.edges import Edge, Shape
from geomoe3d.multiway.rules import GroupingRules

RULES = GroupingRules(tolerance=0.2, near_tolerance=0.125, kept_tolerance=0.125, kept_error=0.4)


def graph(seed=0, *, count=8, noise=0.01):
    """A ring of scans: shapes, true poses, and an edge for every two that are at most two steps apart."""
    rng = np.random.default_rng(seed)
    shapes, poses = [], {}
    for k in range(count):
        points = rng.uniform(-1, 1, (200, 3))
        shapes.append(Shape.of(points, np.zeros(3)))
        poses[k] = make_transform(Rotation.random(random_state=k).as_matrix(), rng.uniform(-4, 4, 3))
    edges = []
    for j in range(count):
        for i in range(j):
            if min(j - i, count - j + i) <= 2:
                edges.append(edge(j, i, inverse(poses[i]) @ poses[j], 0.999, rng, noise))
    return shapes, poses, edges, rng


def edge(source, target, T, confidence, rng, noise=0.0):
    turn = Rotation.from_rotvec(noise * rng.normal(size=3)).as_matrix()
    moved = make_transform(turn @ T[:3, :3], T[:3, 3] + noise * rng.normal(size=3))
    return Edge(source, target, moved, confidence, np.eye(6) * 1000)


def largest_error(poses, truth):
    T = truth[0] @ inverse(poses[0])
    return max(np.abs(T @ poses[k] - truth[k]).max() for k in poses)
