"""Where in a map a scan may lie: windows of the scan's size, voted for by its points, and motions into the best ones.

Place: propose, for a scan in a map. Every compared point of the scan gives each window its best match there; a window
is as likely as its matches are better than those elsewhere. Consensus then proposes motions from the matches of one
window at a time, which have two to five times the share of true ones that the matches of a whole map have. Time: a
product of the compared points of both (0.1 s for a map of 100,000 points on the grid) and 20 ms for each window.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from geomoe3d.config import expert
from geomoe3d.estimators.consensus import ConsensusEstimator
from geomoe3d.estimators.surroundings import Surroundings
from geomoe3d.maps.level import Compared, Level
from geomoe3d.matching.nearest import nearest_features
from geomoe3d.runtime.threads import each, single_blas_thread
from geomoe3d.types import (
    Correspondences,
    Float32Array,
    FloatArray,
    Hypothesis,
    IntArray,
)

_ROWS = 4000
"""Points of the map whose similarities to the scan's are held at once: they stay near a core."""


@dataclass(frozen=True, eq=False)
class Window:
    """A part of a map about as large as the scan.

    Attributes:
        center: (3,) local coordinates of the map.
        keys: rows in it of what is compared.
        votes: how much better the scan's points match there than elsewhere; larger is likelier.
    """

    center: FloatArray
    keys: IntArray
    votes: float


@dataclass(frozen=True, eq=False)
class Cells:
    """What is compared of a map, cell by cell, for scans of one radius.

    Attributes:
        order: (c,) its rows in that order.
        starts: where each cell begins.
        members, windows: the cells of the window around each of w cells, one window after another, and where each
            window begins and ends there (w + 1).
        centers: (w, 3) of the windows, local coordinates.
        features: (c, 65) in that order.
    """

    order: IntArray
    starts: IntArray
    members: IntArray
    windows: IntArray
    centers: FloatArray
    features: Float32Array

    @classmethod
    def of(cls, compared: Compared, radius: float) -> Cells:
        """The cells of a map for scans of a radius, by `radius_of`."""
        from scipy.spatial import cKDTree

        edge = expert().places.cell * radius
        cells = np.floor(compared.points / edge).astype(np.int64)
        cells -= cells.min(0)
        shape = tuple(cells.max(0) + 1)
        flat = np.ravel_multi_index(tuple(cells.T), shape)
        order = np.argsort(flat, kind="stable")
        starts = np.flatnonzero(np.concatenate([[True], np.diff(flat[order]) > 0]))
        places = np.stack(np.unravel_index(flat[order][starts], shape), axis=1)
        around = cKDTree(places).query_ball_point(
            places, expert().places.window * radius / edge + 1e-6, return_sorted=True
        )
        members = np.concatenate(around).astype(np.int64)
        windows = np.cumsum([0, *map(len, around)])
        counts = np.diff(np.append(starts, len(order)))
        sums = np.add.reduceat(compared.points[order], starts, axis=0)
        counted = np.add.reduceat(counts[members], windows[:-1])[:, None]
        centers = np.add.reduceat(sums[members], windows[:-1], axis=0) / counted
        return cls(order, starts, members, windows, centers, compared.features[order])


def radius_of(points: FloatArray) -> float:
    """Within which the compared points (n, 3) of a scan lie around their mean, but for strays."""
    away = np.linalg.norm(points - points.mean(0), axis=1)
    return float(np.quantile(away, expert().places.reach))


class Query:
    """A scan's compared points, and how they match the map.

    Args:
        scan: normals turned to its sensor.
        level: of the map, on the scan's grid.
        seed: decides which points are asked.
        cells: of the map for the scan's radius; None: made when windows are asked for.
    """

    def __init__(self, scan: Compared, level: Level, *, seed: int = 0, cells: Cells | None = None) -> None:
        self.level, self.seed = level, seed
        drawn = np.random.default_rng(seed).permutation(len(scan.points))
        few, many = (np.sort(drawn[:asked]) for asked in expert().places.asked)
        self._scan = scan.take(many)
        self._few = scan.take(few)
        self.radius = radius_of(scan.points)
        self._given_cells = cells

    @cached_property
    def _cells(self) -> Cells:
        given = self._given_cells
        return Cells.of(self.level.compared, self.radius) if given is None else given

    @single_blas_thread()
    def windows(
        self,
        count: int,
        within: tuple[FloatArray, float] | None = None,
        *,
        voters: Float32Array | None = None,
    ) -> list[Window]:
        """The likeliest windows, none at the centre of another, best first.

        Args:
            count: at most so many.
            within: (3,) where the scan's centre is said to lie, local coordinates, and how far off at most.
            voters: (n, 65) features that vote in place of the scan's.
        """
        level, cells = self.level.compared, self._cells
        limit = min(expert().places.voting, expert().places.most_votes // max(len(level.features), 1))
        voters = self._scan.features if voters is None else voters
        asked = voters[:: math.ceil(len(voters) / max(limit, 1))]
        ends = np.append(cells.starts[1:], len(cells.order))
        edges = np.searchsorted(cells.starts, np.arange(0, len(cells.order), _ROWS))
        blocks = np.unique(np.append(edges, len(cells.starts)))

        def best_of(block: tuple[int, int]) -> Float32Array:
            first, last = cells.starts[block[0]], ends[block[1] - 1]
            begins = cells.starts[slice(*block)] - first
            alike = asked @ cells.features[first:last].T
            return np.ascontiguousarray(np.maximum.reduceat(alike, begins, axis=1).T)

        best = np.concatenate(each(best_of, list(pairwise(blocks.tolist()))))
        votes = _votes(np.maximum.reduceat(best[cells.members], cells.windows[:-1]).T)
        apart = expert().places.apart * self.radius
        likely = np.argsort(-votes, kind="stable")
        if within is not None:
            away = np.linalg.norm(cells.centers[likely] - within[0], axis=1)
            likely = likely[away <= within[1] + self.radius]
        found: list[Window] = []
        while len(likely) and len(found) < count:
            k, likely = int(likely[0]), likely[1:]
            center, held = cells.centers[k], cells.members[cells.windows[k] : cells.windows[k + 1]]
            keys = np.concatenate([cells.order[cells.starts[j] : ends[j]] for j in held])
            found.append(Window(center, np.sort(keys), float(votes[k])))
            likely = likely[np.linalg.norm(cells.centers[likely] - center, axis=1) >= apart]
        return found

    @property
    def num_windows(self) -> int:
        """Of the map, also those that overlap."""
        return len(self._cells.centers)

    def motions(
        self,
        window: Window,
        count: int,
        *,
        more: bool = False,
        mutual: bool = False,
        sparing: bool = False,
    ) -> list[Hypothesis]:
        """Motions into a window, best first, T_map_scan (4, 4) local coordinates of both.

        Args:
            window: where to.
            count: at most so many.
            more: from more matches and seeds: two to four times as long, and more is found.
            mutual: from matches alone that are each other's best: a third of the time, enough for what is alike.
            sparing: from fewer of the scan's points, enough where the map has few windows.
        """
        known, there = expert().places, self.level.compared.take(window.keys)
        scan = self._few if sparing else self._scan
        # A small scan has few points to match, and of their first choices too few are right.
        choices = 1 if mutual else min(known.choices, math.ceil(known.matches[more] / len(scan.points)))
        index, distance, _, both = nearest_features(scan.features, there.features, choices, False)
        most = min(known.matches[more], np.count_nonzero(both)) if mutual else known.matches[more]
        order = np.lexsort((distance.ravel(), ~both.ravel()))[:most]
        rows, columns, first = order // index.shape[1], index.ravel()[order], both.ravel()[order]
        matched = Correspondences(
            np.hstack([scan.points[rows], there.points[columns]]),
            normals=(scan.normals[rows], there.normals[columns]),
            normals_signed=True,
        )
        threshold = known.threshold * self.level.voxel_size
        refined = count if mutual else known.refined[more]  # few of these are wrong
        estimate = ConsensusEstimator(num_hypotheses=count, num_seeds=known.seeds[more], num_refined=refined)
        return estimate(
            matched.points,
            np.where(first, 1.0, 0.5),
            inlier_threshold=threshold,
            seed=self.seed,
            surroundings=Surroundings.of(matched, threshold),
        )


def likest(windows: Sequence[Window], center: FloatArray, reach: float, most: int) -> list[Window]:
    """Of windows, most votes first, those that are likest to what lies within ``reach`` of a place (3,), which is none
    of them: some that share points with it, whose votes are its own in part, and some that do not; of each at most so
    many."""
    known = expert().locating
    away = [float(np.linalg.norm(window.center - center)) / reach for window in windows]
    chosen: list[Window] = []
    for low, high in ((1.0, known.twin_apart), (known.twin_apart, np.inf)):
        some = [w for w, d in zip(windows, away, strict=True) if low <= d < high]
        chosen += [w for w in some if w.votes >= known.twin_share * some[0].votes][:most]
    return chosen


def _votes(most: Float32Array) -> FloatArray:
    """(windows,) mean over the scan's points of how far each window's best match stands out among all windows'."""
    spread = most.std(1, keepdims=True) + 1e-6
    stands = (most - most.mean(1, keepdims=True)) / spread
    votes: FloatArray = np.maximum(stands, 0).mean(0).astype(np.float64)
    return votes
