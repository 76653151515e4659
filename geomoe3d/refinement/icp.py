"""Refinement of one transform on the clouds: point-to-plane ICP or GICP, by small_gicp.

The alignment uses one thread, so that the same input gives the same
bytes on any machine; two clouds of 5,000 points take some 15 ms, since only what lies near the other cloud
takes part: to find that a point is near nothing costs far more than to find its partner, in every step
again. Lengths are passed in voxels, because small_gicp's stopping rule is an absolute length.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from geomoe3d.clouds.pair import Pair
from geomoe3d.config import RefinementConfig
from geomoe3d.geometry.gicp import LEAST_MATCHED, LocalCloud, align, too_few
from geomoe3d.geometry.se3 import inverse, transform_points
from geomoe3d.refinement.base import PairRefiner, Refiner, refiner
from geomoe3d.runtime.threads import usable_threads
from geomoe3d.types import FloatArray, IntArray, PreparedCloud

_MARGIN_VOXELS = (
    2.5  # beyond the reach: points may come nearer in the course, and normals need their neighbours
)
_NORMAL_NEIGHBORS = 20
_UNREFINED = "the unrefined motion is given"


@refiner("icp", "gicp")
@dataclass(frozen=True)
class IcpRefiner(Refiner):
    """Point-to-plane ICP or GICP.

    Attributes:
        config: method (its name), reach and iterations.
    """

    config: RefinementConfig = field(default_factory=RefinementConfig)

    @classmethod
    def from_config(cls, config: RefinementConfig) -> IcpRefiner:
        """As configured."""
        return cls(config)

    def about(self, pair: Pair) -> PairRefiner:
        """See `geomoe3d.refinement.base.Refiner`."""
        aligner = CloudAligner(*pair.clouds, self.config)
        return lambda hypothesis: aligner(hypothesis.T_target_source)


class CloudAligner:
    """Polishes transforms of one pair of clouds.

    Args:
        source: prepared cloud.
        target: prepared cloud with normals.
        config: method, reach and iterations.
    """

    def __init__(self, source: PreparedCloud, target: PreparedCloud, config: RefinementConfig) -> None:
        from scipy.spatial import cKDTree

        self._config, self._voxel = config, source.voxel_size
        self._centre = source.points.mean(0) / source.voxel_size
        self._source, self._target = (cloud.points / source.voxel_size for cloud in (source, target))
        self._source_tree, self._target_tree = (
            cKDTree(points, balanced_tree=False, compact_nodes=False)
            for points in (self._source, self._target)
        )

    def __call__(self, T_target_source: FloatArray) -> tuple[FloatArray, str | None]:
        """The motion polished so that the source's points lie in the target's surface.

        Twice: where the library stops hangs on where it began, by a tenth of a voxel at times, and hardly any more on
        where a second course began.

        Args:
            T_target_source: (4, 4) start, local coordinates.

        Returns:
            The refined motion and None; or the start unchanged and a sentence that says why: the library's
            own `converged` is true even where nothing matched, so the number of matched points, finiteness
            and the distance moved are checked here.
        """
        found, note = self._polished(T_target_source)
        if note is not None:
            return found, note
        return self._polished(found)[0], None

    def _polished(self, T_target_source: FloatArray) -> tuple[FloatArray, str | None]:
        config = self._config
        voxel = self._voxel
        start = T_target_source.copy()
        start[:3, 3] /= voxel
        near_target = self._near(self._target_tree, transform_points(start, self._source))
        near_source = self._near(self._source_tree, transform_points(inverse(start), self._target))
        num_matched = min(len(near_target), len(near_source))
        if num_matched < LEAST_MATCHED:
            return T_target_source, f"{too_few(num_matched)}; {_UNREFINED}"
        found = align(
            LocalCloud.of(self._source[near_target], _NORMAL_NEIGHBORS if config.name == "gicp" else None),
            LocalCloud.of(self._target[near_source], _NORMAL_NEIGHBORS),
            start,
            self._centre,
            reach=config.max_distance,
            method=config.name,
            max_iterations=config.max_iterations,
        )
        if found.T_target_source is None:
            return T_target_source, f"{found.problem}; {_UNREFINED}"
        T = found.T_target_source
        T[:3, 3] *= voxel
        return T, None

    def _near(self, tree: Any, points: FloatArray) -> IntArray:
        """Which points (n, 3) have one of the tree's within the reach of the refinement and some more."""
        reach = self._config.max_distance + _MARGIN_VOXELS
        distance, _ = tree.query(points, distance_upper_bound=reach, workers=usable_threads())
        return np.flatnonzero(np.isfinite(distance))
