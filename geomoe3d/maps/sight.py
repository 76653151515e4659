"""What the sensors of a map saw through: space in which no surface of a scan can stand.

A map of E57 scans or of posed scans knows where its sensors stood. Around each of them its surfaces make a range image;
a point of the scan in front of what a sensor saw, and on no surface of the map, speaks against a transform, as points
of the map in front of what the scan's sensor saw do. 0.1 microseconds for each point of the map and sensor, once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomoe3d.clouds.pair import Pair
from geomoe3d.config import expert
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.maps.level import Level
from geomoe3d.scoring.base import Belief, PairScorer, Scorer
from geomoe3d.types import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class Sight(Scorer):
    """A scorer of transforms of a scan into a map whose sensors are known.

    Attributes:
        level: of the map.
        points: (N, 3) some of the scan, local coordinates.
    """

    level: Level
    points: FloatArray

    def about(self, pair: Pair) -> PairScorer:
        """The same for every pair: the map as a whole is asked."""
        return lambda transforms: [Belief(self.factor(T)) for T in transforms]

    def factor(self, T: FloatArray) -> float:
        """exp(-10 v), v the share of the points that stand under a transform (4, 4) where a sensor saw through."""
        moved = transform_points(T, self.points)
        distance, _ = self.level.tree.query(moved, distance_upper_bound=2 * self.level.voxel_size)
        return seen_factor(self.level, moved[~np.isfinite(distance)], len(moved))


def seen_factor(level: Level, off: FloatArray, count: int) -> float:
    """exp(-10 v), v the share of ``count`` points that a sensor of the map saw through, ``off`` (M, 3) being those of
    them that lie on none of its surfaces."""
    return float(np.exp(-expert().surfaces.violation_weight * seen_through(level, off).sum() / max(count, 1)))


def seen_through(level: Level, points: FloatArray) -> BoolArray:
    """Which of some points (N, 3), local coordinates, stand in front of what one of the map's sensors saw, of those
    that are nearest to them."""
    seen = np.zeros(len(points), dtype=np.bool_)
    if not len(points) or not len(level.sensors):
        return seen
    known = expert().locating
    away = np.linalg.norm(level.sensors - points.mean(0), axis=1)
    for number in np.argsort(away, kind="stable")[: known.asked_sensors]:
        margin, _ = level.range_image(int(number)).margins(points)
        seen |= margin < -known.seen_through * level.voxel_size
    return seen
