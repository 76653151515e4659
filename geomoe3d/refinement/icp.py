"""Refinement of one transform on the clouds: point-to-plane ICP or GICP, by small_gicp.

The alignment uses one thread, so that the same input gives the same bytes on any machine; two clouds of 5,000 points
take some 8 ms, since only what of the source lies near the target takes part: to find that a point is near nothing
costs far more than to find its partner, in every step again. Lengths are passed in voxels, because small_gicp's
stopping rule is an absolute length.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from geomoe3d.clouds.pair import Pair
from geomoe3d.config import RefinementConfig, expert
from geomoe3d.geometry.draws import cell_ranks
from geomoe3d.geometry.gicp import Aligned, LocalCloud, align, too_few
from geomoe3d.geometry.se3 import transform_points
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


class CloudAligner:
    """Polishes transforms of one pair of clouds.

    Args:
        source: prepared cloud.
        target: prepared cloud with normals.
        config: method, reach and iterations.
    """

    def __init__(self, source: PreparedCloud, target: PreparedCloud, config: RefinementConfig) -> None:
        self._config, self._voxel = config, source.voxel_size
        self._centre = source.center / source.voxel_size
        self._source, self._target_cloud = source.points / source.voxel_size, target
        ranks = cell_ranks(source.points, source.voxel_size, 0)
        self._all = np.arange(len(source))
        self._first = np.flatnonzero(ranks % np.uint64(expert().alignment.coarse_part) == 0)
        self._known: dict[bytes, tuple[FloatArray | None, str | None]] = {}

    def __call__(self, T_target_source: FloatArray) -> tuple[FloatArray, str | None]:
        """The motion polished so that the source's points lie in the target's surface.

        Twice, at first with a part of the points, where there are many: most steps of a start that is far off are
        then cheap. Where the library stops hangs on where it began, by a tenth of a voxel at times, and hardly any
        more on where a second course began. A motion that was polished before is not polished again.

        Args:
            T_target_source: (4, 4) start, local coordinates.

        Returns:
            The refined motion and None; or the start unchanged and a sentence that says why: the library's
            own `converged` is true even where nothing matched, so the number of matched points, finiteness
            and the distance moved are checked here.
        """
        key = T_target_source.tobytes()
        if key not in self._known:
            self._known[key] = self._polished(T_target_source)
        found, problem = self._known[key]
        return (T_target_source, f"{problem}; {_UNREFINED}") if found is None else (found.copy(), None)

    def _polished(self, T_target_source: FloatArray) -> tuple[FloatArray | None, str | None]:
        """The motion polished, or None and why not."""
        known, start = expert().alignment, T_target_source.copy()
        start[:3, 3] /= self._voxel
        rows = self._near(start, self._first)
        if known.coarse_part * len(rows) >= known.least_thinned:
            some = self._local(rows, known.coarse_neighbors)
        else:
            some = self._local(self._near(start, self._all), known.normal_neighbors)
        found = self._aligned(some, start, known.coarse_steps)
        if found.T_target_source is None:
            return None, found.problem
        T = found.T_target_source
        every = self._local(self._near(T, self._all), known.normal_neighbors)
        again = self._aligned(every, T, self._config.max_iterations).T_target_source
        T = T if again is None else again
        T[:3, 3] *= self._voxel
        return T, None

    @cached_property
    def _target(self) -> LocalCloud:
        """The target as the library takes it, in voxels; made once, whatever is polished."""
        return LocalCloud.of(self._target_cloud.points / self._voxel, expert().alignment.normal_neighbors)

    def _aligned(self, source: LocalCloud, start: FloatArray, max_steps: int) -> Aligned:
        """The motion near ``start``, in voxels, by one course of the library."""
        config = self._config
        if source.cloud.size() < expert().alignment.least_matched:
            return Aligned(None, too_few(source.cloud.size()))
        return align(
            source,
            self._target,
            start,
            self._centre,
            reach=config.max_distance,
            method=config.name,
            max_iterations=max_steps,
        )

    def _near(self, start: FloatArray, rows: IntArray) -> IntArray:
        """Those of the rows that lie within the reach of the refinement, and some more, of the target."""
        reach = (self._config.max_distance + expert().alignment.margin) * self._voxel
        moved = self._voxel * transform_points(start, self._source[rows])
        distance, _ = self._target_cloud.tree.query(
            moved, distance_upper_bound=reach, workers=usable_threads()
        )
        near: IntArray = rows[np.isfinite(distance)]
        return near

    def _local(self, rows: IntArray, num_neighbors: int) -> LocalCloud:
        """These points of the source as the library takes them, in voxels."""
        wanted = self._config.name == "gicp" and len(rows) >= expert().alignment.least_matched
        return LocalCloud.of(self._source[rows], num_neighbors if wanted else None)
