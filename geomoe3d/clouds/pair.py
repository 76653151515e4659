"""Two scans on one grid and what is matched between them: what estimators, scorers and refiners are given."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from geomoe3d.clouds.keypoints import KeypointSurfaces
from geomoe3d.types import Correspondences, PreparedCloud


@dataclass(frozen=True)
class Pair:
    """See the module.

    Attributes:
        matched: N putative correspondences.
        voxel_size: edge of the grid, cloud units.
        inlier_threshold: largest residual of an inlier, cloud units.
        seed: decides every random choice.
        source, target: preprocessed clouds with features, or None for both where only the correspondences
            are known.
    """

    matched: Correspondences
    voxel_size: float
    inlier_threshold: float
    seed: int = 0
    source: PreparedCloud | None = None
    target: PreparedCloud | None = None

    @property
    def clouds(self) -> tuple[PreparedCloud, PreparedCloud]:
        """Source and target. Raises ValueError: only the correspondences are known."""
        if self.source is None or self.target is None:
            raise ValueError("this pair has correspondences and no clouds")
        return self.source, self.target

    @cached_property
    def keypoint_surfaces(self) -> KeypointSurfaces:
        """The matched points of each scan as a coarse surface, lengths in inlier thresholds."""
        places = self.matched.viewpoints or (None, None)
        return KeypointSurfaces.of(self.matched.points, places, self.inlier_threshold)
