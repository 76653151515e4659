"""How much two scans overlap under given poses, from a few hundred points of each."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from geomoe3d.config import expert
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.types import FloatArray


class Overlaps:
    """Predicts overlaps; some 0.2 ms each.

    Args:
        points: (N, 3) voxel points by scan, local coordinates.
        voxel_size: of the common grid, cloud units.
        seed: decides the sample.
    """

    def __init__(self, points: dict[int, FloatArray], voxel_size: float, *, seed: int = 0) -> None:
        most = expert().many_pairs.overlap_sample
        self._points = {k: p[drawn_rows(p, voxel_size, most, seed)] for k, p in points.items()}
        self._center = {k: p.mean(0) for k, p in self._points.items()}
        self._radius = {
            k: float(np.linalg.norm(p - self._center[k], axis=1).max()) for k, p in self._points.items()
        }
        self._tree = lru_cache(maxsize=None)(self._build)

    def of(self, source: int, target: int, T_target_source: FloatArray) -> float:
        """Share of the source's sample that lies among the target's; 0 for a scan that is not known."""
        if source not in self._points or target not in self._points:
            return 0.0
        tree, reach = self._tree(target)
        away = transform_points(T_target_source, self._center[source][None])[0] - self._center[target]
        if float(np.linalg.norm(away)) > self._radius[source] + self._radius[target] + reach:
            return 0.0
        moved = transform_points(T_target_source, self._points[source])
        distance, _ = tree.query(moved, distance_upper_bound=reach)
        return float(np.isfinite(distance).mean())

    def _build(self, scan: int) -> tuple[Any, float]:
        from scipy.spatial import cKDTree

        points = self._points[scan]
        tree = cKDTree(points)
        if len(points) < 2:
            return tree, 0.0
        # A thinned surface has holes of the size of its points' distances.
        return tree, 1.5 * float(np.median(np.asarray(tree.query(points, k=2)[0])[:, 1]))
