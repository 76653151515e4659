"""Where in a map a scan may lie: windows of the scan's size, voted for by its points, and motions into the best ones.

Place: propose, for a scan in a map. Every compared point of the scan gives each window its best match there; a window
is as likely as its matches are better than those elsewhere. Consensus then proposes motions from the matches of one
window at a time, which have two to five times the share of true ones that the matches of a whole map have. Time: a
product of the compared points of both (0.1 s for a map of 100,000 points on the grid) and 20 ms for each window.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomoe3d.estimators.consensus import ConsensusEstimator
from geomoe3d.estimators.surroundings import Surroundings
from geomoe3d.maps.level import Level
from geomoe3d.runtime.threads import each, single_blas_thread
from geomoe3d.types import (
    BoolArray,
    Correspondences,
    Float32Array,
    FloatArray,
    Hypothesis,
    IntArray,
    PreparedCloud,
)

_ASKED = 1000  # points of the scan
_MATCHES = 500  # of a window, from which motions are proposed
_THRESHOLD = 3.0  # voxels: keypoints are two apart
_ROWS = 50
"""Points of the scan whose similarities to all of the map are held at once."""


@dataclass(frozen=True, eq=False)
class Window:
    """A part of a map about as large as the scan.

    Attributes:
        center: (3,) local coordinates of the map.
        keys: rows of the compared points in it.
        votes: how much better the scan's points match there than elsewhere; larger is likelier.
    """

    center: FloatArray
    keys: IntArray
    votes: float


class Query:
    """A scan's compared points, and how they match the map.

    Args:
        scan: on the level's grid, normals turned to its sensor.
        features: (n, 99) of its points, by `MultiscaleDescriptor`.
        level: of the map.
        seed: decides which points are asked.
    """

    def __init__(self, scan: PreparedCloud, features: Float32Array, level: Level, *, seed: int = 0) -> None:
        rows, features = level.described(scan, features)
        chosen = np.sort(np.random.default_rng(seed).permutation(len(rows))[:_ASKED])
        self.level, self.seed = level, seed
        self.points, self.normals = scan.points[rows[chosen]], scan.normals[rows[chosen]]
        self.features = features[chosen]
        self.radius = float(np.quantile(np.linalg.norm(scan.points - scan.points.mean(0), axis=1), 0.95))

    @single_blas_thread()
    def windows(self, count: int, within: tuple[FloatArray, float] | None = None) -> list[Window]:
        """The likeliest windows, none at the centre of another, best first.

        Args:
            count: at most so many.
            within: (3,) where the scan's centre is said to lie, local coordinates, and how far off at most.
        """
        level, edge = self.level, self.radius / 1.5
        cells = np.floor(level.key_points / edge).astype(np.int64)
        cells -= cells.min(0)
        shape = cells.max(0) + 1
        flat = np.ravel_multi_index(tuple(cells.T), tuple(shape))
        order = np.argsort(flat, kind="stable")
        starts = np.flatnonzero(np.concatenate([[True], np.diff(flat[order]) > 0]))
        used = flat[order][starts]
        sorted_features = np.ascontiguousarray(level.key_features[order].T)
        places = np.stack(np.unravel_index(used, tuple(shape)), axis=1)
        around = np.linalg.norm(places[:, None] - places[None], axis=2) * edge <= 1.25 * self.radius
        best = np.concatenate(
            each(
                lambda start: np.maximum.reduceat(
                    self.features[start : start + _ROWS] @ sorted_features, starts, axis=1
                ),
                range(0, len(self.features), _ROWS),
            )
        )
        members = [np.flatnonzero(row) for row in around]
        most = np.stack([best[:, m].max(1) for m in members], axis=1)  # (asked, windows)
        votes = _votes(most)
        counts = np.add.reduceat(np.ones(len(order)), starts)
        sums = np.add.reduceat(level.key_points[order], starts, axis=0)
        ends = np.append(starts[1:], len(order))
        found: list[Window] = []
        for k in np.argsort(-votes, kind="stable"):
            if len(found) == count:
                break
            m = members[k]
            center = sums[m].sum(0) / counts[m].sum()
            if within is not None and np.linalg.norm(center - within[0]) > within[1] + self.radius:
                continue
            if any(np.linalg.norm(center - window.center) < 0.6 * self.radius for window in found):
                continue
            keys = np.concatenate([order[starts[j] : ends[j]] for j in m])
            found.append(Window(center, np.sort(keys), float(votes[k])))
        return found

    def motions(self, window: Window, count: int) -> list[Hypothesis]:
        """Motions into a window, best first, T_map_scan (4, 4) local coordinates of both."""
        level = self.level
        similarity = self.features @ level.key_features[window.keys].T
        choice = similarity.argmax(1)
        value = similarity[np.arange(len(choice)), choice]
        mutual: BoolArray = value >= similarity.max(0)[choice]
        order = np.lexsort((-value, ~mutual))[:_MATCHES]
        rows, columns = order, window.keys[choice[order]]
        matched = Correspondences(
            np.hstack([self.points[rows], level.key_points[columns]]),
            normals=(self.normals[rows], level.key_normals[columns]),
            normals_signed=True,
        )
        threshold = _THRESHOLD * level.voxel_size
        return ConsensusEstimator(num_hypotheses=count, num_seeds=250, num_refined=30)(
            matched.points,
            np.where(mutual[order], 1.0, 0.5),
            inlier_threshold=threshold,
            seed=self.seed,
            surroundings=Surroundings.of(matched, threshold),
        )


def _votes(most: Float32Array) -> FloatArray:
    """(windows,) mean over the scan's points of how far each window's best match stands out among all windows'."""
    spread = most.std(1, keepdims=True) + 1e-6
    stands = (most - most.mean(1, keepdims=True)) / spread
    votes: FloatArray = np.maximum(stands, 0).mean(0).astype(np.float64)
    return votes
