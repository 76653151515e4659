"""How much two scans overlap under given poses, from a few hundred points of each."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from geomoe3d.config import expert
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.geometry.se3 import inverse, transform_points
from geomoe3d.types import FloatArray


class Overlaps:
    """Predicts overlaps; some 0.1 ms each.

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
        return self.between({source: T_target_source}, {target: np.eye(4)}).get((source, target), 0.0)

    def between(
        self, sources: Mapping[int, FloatArray], targets: Mapping[int, FloatArray], least: float = 0.0
    ) -> dict[tuple[int, int], float]:
        """The same of every source in every target but itself, by (source, target).

        Args:
            sources, targets: poses (4, 4) in one frame.
            least: smaller shares are left out, and so are those that are 0.
        """
        known = [k for k in sources if k in self._points]
        found: dict[tuple[int, int], float] = {}
        if not known:
            return found
        moved = {k: transform_points(sources[k], self._points[k]) for k in known}
        centers = np.stack([transform_points(sources[k], self._center[k][None])[0] for k in known])
        radii = np.array([self._radius[k] for k in known])
        for target in (k for k in targets if k in self._points):
            tree, reach = self._tree(target)
            there = transform_points(targets[target], self._center[target][None])
            close = np.linalg.norm(centers - there, axis=1) <= radii + self._radius[target] + reach
            near = [known[k] for k in np.flatnonzero(close) if known[k] != target]
            if not near:
                continue
            back = inverse(targets[target])
            points = transform_points(back, np.concatenate([moved[k] for k in near])).T
            inside = np.ones(points.shape[1], dtype=np.bool_)
            for axis, (low, high) in enumerate(zip(tree.mins, tree.maxes, strict=True)):
                inside &= (points[axis] >= low - reach) & (points[axis] <= high + reach)
            sizes = np.array([len(moved[k]) for k in near])
            starts = np.cumsum(sizes) - sizes
            inside &= np.repeat(np.add.reduceat(inside, starts, dtype=np.int64) >= least * sizes, sizes)
            distance, _ = tree.query(points[:, inside].T, distance_upper_bound=reach)
            inside[inside] = np.isfinite(distance)
            shares = np.add.reduceat(inside, starts, dtype=np.int64) / sizes
            chosen = np.flatnonzero((shares > 0) & (shares >= least))
            found |= {(near[k], target): float(shares[k]) for k in chosen}
        return found

    def _build(self, scan: int) -> tuple[Any, float]:
        from scipy.spatial import cKDTree

        points = self._points[scan]
        tree = cKDTree(points)
        if len(points) < 2:
            return tree, 0.0
        return tree, expert().many_pairs.overlap_reach * float(
            np.median(np.asarray(tree.query(points, k=2)[0])[:, 1])
        )
