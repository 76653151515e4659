"""How well a scan lies on a map in detail: on the scan's own grid, against all that the map keeps.

The grids on which a whole map is described are coarse beside a small scan: there a piece of wall fits as well at many
places as at its own. What the map keeps has steps of centimetres that tell them apart, needs no description, and only
that around a place is asked. So a small scan is sought in many windows, with less care for each, and the motions are
compared in detail in rounds: all with few points of the scan, the best of them with more. Motions are drawn closer many
at a time, one product for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from geomoe3d.clouds.range_image import RangeImage
from geomoe3d.config import expert
from geomoe3d.geometry.se3 import inverse, make_transform, transform_points
from geomoe3d.maps.found import Found
from geomoe3d.maps.locate import Search
from geomoe3d.maps.places import Window
from geomoe3d.maps.voxels import VoxelSums
from geomoe3d.runtime.threads import each, single_blas_thread
from geomoe3d.types import BoolArray, FloatArray, Hypothesis, IntArray, PreparedCloud

Fitting = list[tuple[float, FloatArray]]
"""Scores in detail and distinct motions (4, 4), local coordinates, best first."""

FITS_IN_DETAIL = "in detail the scan fits best here, as a pair of scans better at another place of the map"

_AT_ONCE = 20_000
"""Points of motions that are compared at once: they stay near a core."""


@dataclass(frozen=True, eq=False)
class Detail:
    """A scan on its own grid, and what a map keeps.

    Attributes:
        voxels: of the map.
        voxel_size: edge of the finer of what both can show, cloud units.
        points, normals: (n, 3) of the scan, some of them, drawn: the first k are some of all, too.
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
        rows = np.random.default_rng(seed).permutation(len(scan.points))[: expert().detail.asked[-1]]
        view = None if scan.viewpoint is None else RangeImage.of(scan.points, scan.viewpoint)
        some = scan.points[rows], scan.normals[rows]
        return cls(voxels, scan.voxel_size, *some, search.center, search.reach, view)

    def score(self, T: FloatArray) -> float:
        """Share of the scan's points with the map on their planes, times exp(-10 v), v the share of the map's points
        that stand where the scan's sensor looked through."""
        known = expert().detail
        _, gaps, hit, _ = self._met(T[None], len(self.points), known.reach)
        agreement = float((np.abs(gaps[hit]) < known.gap * self.voxel_size).sum() / len(self.points))
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
        """A motion (4, 4), or several (M, 4, 4), drawn closer along the normals of the scan, in every round."""
        closer = T.reshape(-1, 4, 4)
        for asked, reach in zip(expert().detail.asked, expert().detail.polishing, strict=True):
            closer = self._drawn(closer, asked, reach)
        return closer.reshape(T.shape)

    def _drawn(self, T: FloatArray, asked: int, reach: float) -> FloatArray:
        """Motions (M, 4, 4) drawn closer by so many of the scan's points, within so many voxels of them."""
        from scipy.spatial.transform import Rotation

        for _ in range(expert().detail.steps):
            moved, gaps, hit, normals = self._met(T, asked, reach)
            counts = hit.sum(1)
            middle = (moved * hit[..., None]).sum(1) / np.maximum(counts, 1)[:, None]
            J = np.concatenate([np.cross(moved - middle[:, None], normals), normals], axis=2)
            weighted = (J * (hit / (1 + (gaps / self.voxel_size) ** 2))[..., None]).transpose(0, 2, 1)
            held = weighted @ J + expert().detail.damping * np.eye(6)
            step = np.linalg.solve(held, weighted @ gaps[..., None])[..., 0]
            turn = Rotation.from_rotvec(step[:, :3]).as_matrix()
            shift = middle + step[:, 3:] - (turn @ middle[..., None])[..., 0]
            enough = counts >= expert().maps.least_points
            T = np.where(enough[:, None, None], make_transform(turn, shift) @ T, T)
        return T

    def _lying(self, T: FloatArray, asked: int) -> FloatArray:
        """(M,) how near to the map's surface so many of the scan's points lie under motions (M, 4, 4), in [0, 1]."""
        _, gaps, hit, _ = self._met(T, asked, expert().detail.reach)
        near: FloatArray = (hit / (1 + (2 * gaps / self.voxel_size) ** 2)).mean(1)
        return near

    def _met(
        self, T: FloatArray, asked: int, reach: float
    ) -> tuple[FloatArray, FloatArray, BoolArray, FloatArray]:
        """Of so many of the scan's points (n, 3) under motions (M, 4, 4): they, moved (M, n, 3), how far off the map is
        along their normals (M, n), whether it is near them at all, so many voxels away at most, and the normals."""
        turned = T[:, :3, :3].transpose(0, 2, 1)
        moved = self.points[:asked] @ turned + T[:, None, :3, 3]
        limit = reach * self.voxel_size
        distance, nearest = self.voxels.tree.query(moved, distance_upper_bound=limit)
        hit = np.isfinite(distance)
        there = self.voxels.tree.data[np.where(hit, nearest, 0)]
        normals = self.normals[:asked] @ turned
        gaps = np.einsum("mni,mni->mn", there - moved, normals)
        return moved, np.where(hit, gaps, 0.0), hit, normals

    def fits_better(self, search: Search, T: FloatArray, fitting: Fitting) -> bool:
        """Whether the scan fits better at a place that is clearly different from that of a motion."""
        own = max(self.score(T), self.score(self.polished(T)))
        return any(s > own and search.differ(Hypothesis(T), Hypothesis(other)) for s, other in fitting)

    def ordered(
        self, search: Search, best: Found, places: Sequence[Hypothesis]
    ) -> tuple[Found, list[Hypothesis]]:
        """What was decided at the best of some places, and these, in the order in which the scan fits in detail; not ok
        where that puts another one first.

        Args:
            search: that looked at the places.
            best: what it decided, which is not sure.
            places: its distinct answers, best first.
        """
        scores = [max(map(self.score, (T, self.polished(T)))) for T in (h.T_target_source for h in places)]
        order = np.argsort(-np.array(scores), kind="stable")
        ranked = [places[k] for k in order]
        if not ranked or ranked[0] is places[0]:
            return best, ranked
        first, _ = search.decide([search.look(ranked[0], fully=True)])
        if first.decision.answer is None:
            return best, list(places)
        return replace(first, decision=first.decision.doubted(FITS_IN_DETAIL), sure=False), ranked

    @single_blas_thread()
    def widely(self, search: Search, count: int) -> Fitting:
        """The motions into many windows that fit best in detail.

        Args:
            search: for the scan, on a level of the map.
            count: at most so many.
        """
        known = expert().detail
        drawn = np.random.default_rng(search.config.seed).permutation(len(search.scan.points))
        rows = np.sort(drawn[: known.asked[0]])

        def rough(window: Window) -> FloatArray:
            proposed = search.query.motions(window, known.per_window)
            if not proposed:
                return np.zeros((0, 4, 4))
            T = np.stack([h.T_target_source for h in proposed])
            agreeing = _agreeing(search, T, rows)
            likely = np.argsort(-agreeing, kind="stable")[: known.per_window_polished]
            return T[likely[agreeing[likely] > known.least]]

        T = np.concatenate(each(rough, search.query.windows(known.windows)))
        for asked, reach, kept in zip(known.asked, known.polishing, known.compared, strict=True):
            many = max(1, _AT_ONCE // asked)
            blocks = [T[first : first + many] for first in range(0, len(T), many)]
            if not blocks:
                return []
            T = np.concatenate(each(partial(self._drawn, asked=asked, reach=reach), blocks))
            blocks = [T[first : first + many] for first in range(0, len(T), many)]
            near = np.concatenate(each(partial(self._lying, asked=asked), blocks))
            T = T[np.argsort(-near, kind="stable")]
            T = T[_distinct(search, T, kept)]
        scores = np.array(each(self.score, T))
        order = np.argsort(-scores, kind="stable")
        order = order[scores[order] > 0]
        chosen = order[_distinct(search, T[order], count)]
        return list(zip(scores[chosen].tolist(), T[chosen], strict=True))


def _agreeing(search: Search, T: FloatArray, rows: IntArray) -> FloatArray:
    """(M,) share of some of the scan's points, by their rows, that lie on the map's planes under motions (M, 4, 4)."""
    scan, turned = search.scan, T[:, :3, :3].transpose(0, 2, 1)
    moved = scan.points[rows] @ turned + T[:, None, :3, 3]
    share: FloatArray = search.level.met(moved, scan.normals[rows] @ turned)[1].mean(1)
    return share


def _distinct(search: Search, T: FloatArray, count: int) -> list[int]:
    """Rows of motions (M, 4, 4), each clearly different from all chosen before it, at most so many."""
    places, turns = T[:, :3, :3] @ search.center + T[:, :3, 3], T[:, :3, :3].reshape(-1, 9)
    least = 1 + 2 * np.cos(np.radians(expert().selection.different_turn_deg))
    chosen: list[int] = []
    for row in range(len(T)):
        if len(chosen) >= count:
            break
        near = np.linalg.norm(places[chosen] - places[row], axis=1) <= search.apart
        if not (near & (turns[chosen] @ turns[row] >= least)).any():
            chosen.append(row)
    return chosen
