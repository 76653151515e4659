"""Motions drawn closer by the keypoints of a pair, each scan's taken as a coarse surface.

A motion fitted to a dozen correspondences close together errs by decimetres at the far end of a scan. The
other keypoints know better, whether they are matched rightly or not: where the scans overlap they lie in each
other's surfaces. Where many correspondences agree, their own fit is better than such coarse planes. Place:
solve, after consensus has proposed and before anything judges. About 5 ms per pair and 1 ms per motion for
1,000 correspondences.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomoe3d.clouds.keypoints import KeypointSurfaces
from geomoe3d.geometry.gicp import LEAST_MATCHED, LocalCloud, align
from geomoe3d.geometry.se3 import residuals, shift_frames
from geomoe3d.threads import each
from geomoe3d.types import FloatArray, Hypothesis

_NEIGHBORS = 10  # of a keypoint, for the plane it lies in
_MOST_AGREEING = 0.2  # share of the correspondences from which on their own fit stands
_REACH = 1.5  # inlier thresholds; wider slides along walls, narrower leaves motions where they were
_MOST_STEPS = 4  # the first ones do it; more slide along walls


class KeypointAligner:
    """Draws motions of one pair closer; build once per pair.

    Args:
        correspondences: (N, 6) rows [source xyz, target xyz].
        inlier_threshold: same unit.
        surfaces: of the same, in inlier thresholds, where somebody has them already.
    """

    def __init__(
        self,
        correspondences: FloatArray,
        inlier_threshold: float,
        surfaces: KeypointSurfaces | None = None,
    ) -> None:
        if surfaces is None:
            sides = [np.unique(side, axis=0) for side in np.hsplit(correspondences, 2)]
        else:
            sides = [side.points * inlier_threshold for side in surfaces.sides]
        self._correspondences, self._threshold = correspondences, inlier_threshold
        self._clouds: tuple[LocalCloud, LocalCloud] | None = None
        if min(map(len, sides)) >= LEAST_MATCHED:
            self._unit = inlier_threshold / 2  # lengths in voxels, as the limits of `align` are
            # About the means: turns about a far origin are badly conditioned.
            self._centres = [side.mean(0) for side in sides]
            near_zero = [
                (side - centre) / self._unit for side, centre in zip(sides, self._centres, strict=True)
            ]
            source, target = each(lambda points: LocalCloud.of(points, _NEIGHBORS), near_zero)
            self._clouds = source, target

    def __call__(self, T_target_source: FloatArray) -> FloatArray:
        """The motion (4, 4) drawn closer; the same where that fails or a fifth of the rows agree with it."""
        if self._clouds is None:
            return T_target_source
        gaps = residuals(T_target_source, *np.hsplit(self._correspondences, 2))
        if (gaps < self._threshold).mean() >= _MOST_AGREEING:
            return T_target_source
        source_centre, target_centre = self._centres
        start = shift_frames(T_target_source, -source_centre, -target_centre)
        start[:3, 3] /= self._unit
        T, _ = align(*self._clouds, start, np.zeros(3), reach=2 * _REACH, max_iterations=_MOST_STEPS)
        if T is None:
            return T_target_source
        T[:3, 3] *= self._unit
        return shift_frames(T, source_centre, target_centre)

    def hypotheses(self, found: list[Hypothesis]) -> list[Hypothesis]:
        """The same hypotheses with their motions drawn closer, in order."""
        return [replace(h, T_target_source=self(h.T_target_source)) for h in found]
