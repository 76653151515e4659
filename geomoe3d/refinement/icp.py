"""Refinement of one transform on the clouds: point-to-plane ICP or GICP, by small_gicp.

The alignment uses one thread, so that the same input gives the same
bytes on any machine; two clouds of 5,000 points take some 15 ms, since only what lies near the other cloud
takes part: to find that a point is near nothing costs far more than to find its partner, in every step
again. Lengths are passed in voxels, because small_gicp's stopping rule is an absolute length.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from geomoe3d.clouds.pair import Pair
from geomoe3d.config import RefinementConfig, expert
from geomoe3d.geometry.gicp import Aligned, LocalCloud, align, too_few
from geomoe3d.geometry.se3 import inverse, transform_points
from geomoe3d.refinement.base import PairRefiner, Refiner, refiner
from geomoe3d.runtime.threads import usable_threads
from geomoe3d.types import FloatArray, IntArray, PreparedCloud

_UNREFINED = "the unrefined transform is given"


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


class _Near(NamedTuple):
    """The parts of two clouds that lie near each other, in voxels: the source's points, how many of the cloud that has
    fewer, and both as the library takes them, None where these are too few."""

    points: FloatArray
    num_matched: int
    source: LocalCloud | None
    target: LocalCloud | None


class CloudAligner:
    """Polishes transforms of one pair of clouds.

    Args:
        source: prepared cloud.
        target: prepared cloud with normals.
        config: method, reach and iterations.
    """

    def __init__(self, source: PreparedCloud, target: PreparedCloud, config: RefinementConfig) -> None:
        self._config, self._voxel = config, source.voxel_size
        self._centre = source.points.mean(0) / source.voxel_size
        self._source, self._target = (cloud.points / source.voxel_size for cloud in (source, target))
        self._trees = source.tree, target.tree

    def __call__(self, T_target_source: FloatArray) -> tuple[FloatArray, str | None]:
        """The motion polished so that the source's points lie in the target's surface.

        Twice: where the library stops hangs on where it began, by a tenth of a voxel at times, and hardly any more on
        where a second course began. The second takes the points and covariances of the first, unless one moved so far
        that others may be near now.

        Args:
            T_target_source: (4, 4) start, local coordinates.

        Returns:
            The refined motion and None; or the start unchanged and a sentence that says why: the library's
            own `converged` is true even where nothing matched, so the number of matched points, finiteness
            and the distance moved are checked here.
        """
        start = T_target_source.copy()
        start[:3, 3] /= self._voxel
        near = self._near(start)
        found = self._aligned(near, start)
        if found.T_target_source is None:
            return T_target_source, f"{found.problem}; {_UNREFINED}"
        T = found.T_target_source
        moved = transform_points(T, near.points) - transform_points(start, near.points)
        if np.sum(moved**2, axis=1).max() > (expert().alignment.margin / 2) ** 2:
            near = self._near(T)
        again = self._aligned(near, T).T_target_source
        T = T if again is None else again
        T[:3, 3] *= self._voxel
        return T, None

    def _aligned(self, near: _Near, start: FloatArray) -> Aligned:
        """The motion near ``start``, both in voxels, by one course of the library."""
        config = self._config
        if near.source is None or near.target is None:
            return Aligned(None, too_few(near.num_matched))
        return align(
            near.source,
            near.target,
            start,
            self._centre,
            reach=config.max_distance,
            method=config.name,
            max_iterations=config.max_iterations,
        )

    def _near(self, start: FloatArray) -> _Near:
        """What of either cloud lies within the reach of the refinement, and some more, of the other one."""
        source = self._source[self._close(1, transform_points(start, self._source))]
        target = self._target[self._close(0, transform_points(inverse(start), self._target))]
        num_matched = min(len(source), len(target))
        if num_matched < expert().alignment.least_matched:
            return _Near(source, num_matched, None, None)
        neighbors = expert().alignment.normal_neighbors
        ours = neighbors if self._config.name == "gicp" else None
        return _Near(source, num_matched, LocalCloud.of(source, ours), LocalCloud.of(target, neighbors))

    def _close(self, which: int, points: FloatArray) -> IntArray:
        """Which points (n, 3), in voxels, have one of a cloud's within the reach of the refinement and some more."""
        reach = (self._config.max_distance + expert().alignment.margin) * self._voxel
        places = points * self._voxel
        distance, _ = self._trees[which].query(places, distance_upper_bound=reach, workers=usable_threads())
        return np.flatnonzero(np.isfinite(distance))
