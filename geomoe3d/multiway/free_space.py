"""How far a model contradicts itself: points of one scan where another scan's sensor saw through.

Place: asked before two groups are joined. A single pair that was registered rarely contradicts itself, since
registration asked the same; all pairs across two groups under one motion do, as soon as that motion is wrong.
Cost: about 0.1 ms per pair of scans.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from geomoe3d.clouds.range_image import RangeImage
from geomoe3d.config import expert
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.geometry.se3 import inverse, transform_points
from geomoe3d.types import FloatArray


class FreeSpace:
    """What the sensors of all scans saw, and a sample of the points of each.

    Args:
        points: (N, 3) voxel points by scan, local coordinates.
        sensors: (3,) where the sensor of a scan stood; scans whose sensor is not known are missing.
        voxel_size: of the common grid, cloud units.
        seed: decides the sample.
    """

    def __init__(
        self,
        points: Mapping[int, FloatArray],
        sensors: Mapping[int, FloatArray],
        voxel_size: float,
        *,
        seed: int = 0,
    ) -> None:
        most = expert().many_groups.seen_sample
        self._sample = {k: p[drawn_rows(p, voxel_size, most, seed)] for k, p in points.items()}
        self._views = {k: RangeImage.of(points[k], sensor) for k, sensor in sensors.items()}
        self._margin = expert().many_groups.seen_margin * voxel_size

    def between(
        self, a: Mapping[int, FloatArray], b: Mapping[int, FloatArray], T_a_b: FloatArray
    ) -> tuple[float, float]:
        """Two groups under a motion: how much of each other they saw, and saw through.

        Both are sums over all pairs of scans across the groups, each way, of shares of a scan's points.

        Args:
            a, b: poses T_group_scan (4, 4) of the scans of each group.
            T_a_b: (4, 4) group b in the frame of group a.
        """
        there = {k: T_a_b @ T for k, T in b.items()}
        return tuple(sum(x) for x in zip(self._seen(a, there), self._seen(there, a), strict=True))  # type: ignore[return-value]

    def _seen(
        self, sensors: Mapping[int, FloatArray], scans: Mapping[int, FloatArray]
    ) -> tuple[float, float]:
        """What the sensors of some scans saw, and saw through, of the points of others; one frame."""
        known = [self._sample[k] @ T[:3, :3].T + T[:3, 3] for k, T in scans.items() if k in self._sample]
        if not known:
            return 0.0, 0.0
        points, seen, through = np.concatenate(known), 0.0, 0.0
        for k, T in sensors.items():
            if k in self._views:
                margins, _ = self._views[k].margins(transform_points(inverse(T), points))
                seen += float(np.isfinite(margins).sum()) / expert().many_groups.seen_sample
                through += float((margins < -self._margin).sum()) / expert().many_groups.seen_sample
        return seen, through


def told_by(seen: float, through: float, usual: float) -> float:
    """Log-odds that a motion between two groups is right, by what `FreeSpace.between` gives.

    The share ``usual`` of what is seen may be seen through: scans are bent and poses not exact. Between large groups
    the same bend is seen many times over, so there the share counts: of right joints in a scene of bent scans 2 to
    4 %, of wrong ones 6 to 13 %.
    """
    known = expert().many_groups
    excess = (through - usual * seen) / max(seen / known.anew, 1.0)
    if excess > 0:
        return -known.against * excess
    return known.most_for * seen / (seen + known.half_seen) * (1 - through / max(usual * seen, 1e-9))
