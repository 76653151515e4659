"""How well a scan lies on a map in detail: on the scan's own grid, against all that the map keeps.

The grids on which a whole map is described are coarse beside a small scan: there a piece of wall fits as well at many
places as at its own. What the map keeps has steps of centimetres that tell them apart, needs no description, and only
that around a place is asked. So a small scan is sought in many windows, with less care for each, and the best motions
are compared in detail. 15 ms for each window, 7 ms for each motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from operator import itemgetter

import numpy as np

from geomoe3d.clouds.range_image import RangeImage
from geomoe3d.config import expert
from geomoe3d.geometry.se3 import inverse, make_transform, transform_points
from geomoe3d.maps.locate import Search
from geomoe3d.maps.places import Window
from geomoe3d.maps.voxels import VoxelSums
from geomoe3d.runtime.threads import each, single_blas_thread
from geomoe3d.types import FloatArray, Hypothesis, PreparedCloud

Fitting = list[tuple[float, FloatArray]]
"""Scores in detail and distinct motions (4, 4), local coordinates, best first."""


@dataclass(frozen=True, eq=False)
class Detail:
    """A scan on its own grid, and what a map keeps.

    Attributes:
        voxels: of the map.
        voxel_size: edge of the finer of what both can show, cloud units.
        points, normals: (n, 3) of the scan, some of them.
        center, reach: (3,) of the scan, and the radius around it.
        view: what its sensor saw, None where that is not known.
    """

    voxels: VoxelSums
    voxel_size: float
    points: FloatArray
    normals: FloatArray
    center: FloatArray
    reach: float
    view: RangeImage | None

    @classmethod
    def of(cls, scan: PreparedCloud, voxels: VoxelSums, search: Search, seed: int) -> Detail:
        """Of a scan that was prepared on a fine grid, and the search for it on a coarser one."""
        rows = np.random.default_rng(seed).permutation(len(scan.points))[: expert().detail.asked]
        view = None if scan.viewpoint is None else RangeImage.of(scan.points, scan.viewpoint)
        some = scan.points[rows], scan.normals[rows]
        return cls(voxels, scan.voxel_size, *some, search.center, search.reach, view)

    def score(self, T: FloatArray) -> float:
        """Share of the scan's points with the map on their planes, times exp(-10 v), v the share of the map's points
        that stand where the scan's sensor looked through."""
        known = expert().detail
        _, gaps, _ = self._met(T, known.reach)
        agreement = float((np.abs(gaps) < known.gap * self.voxel_size).sum() / len(self.points))
        if self.view is None or not agreement:
            return agreement
        there = transform_points(T, self.center[None])[0]
        near = np.sort(np.array(self.voxels.tree.query_ball_point(there, self.reach), dtype=np.int64))
        near = near[:: max(1, len(near) // known.asked_back)]
        margin, _ = self.view.margins(transform_points(inverse(T), self.voxels.tree.data[near]))
        seen = np.isfinite(margin).sum() + expert().locating.unseen * len(near)
        violation = float((margin < -known.seen_through * self.voxel_size).sum() / max(seen, 1.0))
        return agreement * float(np.exp(-expert().surfaces.violation_weight * violation))

    def polished(self, T: FloatArray) -> FloatArray:
        """A motion drawn closer along the normals of the scan."""
        from scipy.spatial.transform import Rotation

        known = expert().detail
        for reach in known.polishing:
            moved, gaps, normals = self._met(T, reach)
            if len(moved) < expert().maps.least_points:
                return T
            middle = moved.mean(0)
            J = np.hstack([np.cross(moved - middle, normals), normals])
            weighted = J / (1 + (gaps / self.voxel_size) ** 2)[:, None]
            step = np.linalg.solve(weighted.T @ J + known.damping * np.eye(6), weighted.T @ gaps)
            turn = Rotation.from_rotvec(step[:3]).as_matrix()
            T = make_transform(turn, middle + step[3:] - turn @ middle) @ T
        return T

    def _met(self, T: FloatArray, reach: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of the points that have the map near them, so many voxels away at most: they, how far off it is along their
        normals, and these, in the map."""
        moved = transform_points(T, self.points)
        distance, nearest = self.voxels.tree.query(moved, distance_upper_bound=reach * self.voxel_size)
        hit = np.isfinite(distance)
        normals = self.normals[hit] @ T[:3, :3].T
        there = self.voxels.tree.data[np.asarray(nearest)[hit]]
        return moved[hit], np.einsum("ij,ij->i", there - moved[hit], normals), normals

    def fits_better(self, search: Search, T: FloatArray, fitting: Fitting) -> bool:
        """Whether the scan fits better at a place that is clearly different from that of a motion."""
        own = max(self.score(T), self.score(self.polished(T)))
        return any(s > own and search.differ(Hypothesis(T), Hypothesis(other)) for s, other in fitting)

    @single_blas_thread()
    def widely(self, search: Search, count: int) -> Fitting:
        """The motions into many windows that fit best in detail.

        Args:
            search: for the scan, on a level of the map.
            count: at most so many.
        """
        known = expert().detail

        def rough(window: Window) -> Fitting:
            motions = search.query.motions
            both = [*motions(window, known.per_window), *motions(window, known.per_window, mutual=True)]
            proposed = [h.T_target_source for h in both]
            scored = [(search.quick(T, known.least), T) for T in proposed]
            likely = sorted((x for x in scored if x[0] > known.least), key=itemgetter(0), reverse=True)
            closer = [search.polished(T) for _, T in likely[: known.per_window_polished]]
            return [(search.quick(T, known.least), T) for T in closer]

        def exactly(T: FloatArray) -> tuple[float, FloatArray]:
            T = self.polished(T)
            return self.score(T), T

        found = [x for some in each(rough, search.query.windows(known.windows)) for x in some]
        found.sort(key=itemgetter(0), reverse=True)
        distinct: Fitting = []
        for score, T in sorted(
            each(exactly, [T for _, T in found[: known.compared]]), key=itemgetter(0), reverse=True
        ):
            if (
                score > 0
                and len(distinct) < count
                and all(search.differ(Hypothesis(T), Hypothesis(other)) for _, other in distinct)
            ):
                distinct.append((score, T))
        return distinct
