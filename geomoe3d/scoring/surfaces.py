"""How well two clouds, not only their correspondences, lie on each other under a hypothesis.

A count of overlapping points says little: walls lie on walls under many wrong motions. Three further
witnesses speak here. *Distinctiveness*: for each source point that lands on the target, how unlikely it is
that a random target point would look as similar (its FPFH distance ranked among random ones, an empirical
p-value); walls look like walls and prove little, a chair on the same chair proves much. *Normals*: the two
surfaces must face the same way. *Free space*: no point of one cloud may lie where the other's sensor looked
through. About 0.7 ms per hypothesis for clouds of any size, since at most ``num_queries`` points of each are
asked.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geomoe3d.clouds.evidence import Met
from geomoe3d.clouds.pair import Pair
from geomoe3d.clouds.range_image import RangeImage
from geomoe3d.config import expert
from geomoe3d.errors import InputError
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.runtime.threads import each
from geomoe3d.scoring.base import Scorer, scorer
from geomoe3d.types import FloatArray, Hypothesis, IntArray, PreparedCloud

if TYPE_CHECKING:
    from typing_extensions import Self

SURFACES = "surfaces"
"""Name of the scorer without which nothing is said of an answer."""


@dataclass(frozen=True)
class Evidence:
    """What two clouds say of one hypothesis; shares are of the points asked.

    Attributes:
        overlap: share of source points with a target point within the threshold.
        agreement: share of source points that moreover agree in their normals.
        distinctiveness: mean over source points of (-ln p - 1) x (1 - (d / threshold)^2) for agreeing
            points and 0 for the others; about zero for chance overlap, larger is better.
        free_space_violation: share of source points in target's free space over those it could see, plus
            the same with the roles exchanged; 0 where a viewpoint is neither known nor guessed. Of a part of a map,
            which no sensor saw, only the share of its points in the scan's free space.
        surface_score: distinctiveness x exp(-10 free_space_violation), not below zero; its factor of the score.
    """

    overlap: float
    agreement: float
    distinctiveness: float
    free_space_violation: float

    @property
    def surface_score(self) -> float:
        """See the class."""
        weight = expert().surfaces.violation_weight
        return max(self.distinctiveness, 0.0) * float(np.exp(-weight * self.free_space_violation))

    @property
    def factor(self) -> float:
        """See `geomoe3d.types.Score`: the surface score."""
        return self.surface_score


@scorer(SURFACES)
@dataclass(frozen=True)
class SurfaceScorer(Scorer):
    """How well the clouds lie on each other; see the module.

    Attributes:
        num_queries: points of each cloud asked at most, a seeded choice.
    """

    num_queries: int = 1500

    @classmethod
    def from_config(cls, config: object) -> Self:
        """There is nothing to configure."""
        return cls()

    def about(self, pair: Pair) -> Verifier:
        """See `Scorer`; for pairs with clouds."""
        source, target = pair.clouds
        return Verifier(source, target, pair.inlier_threshold, num_queries=self.num_queries, seed=pair.seed)


def evidence_of(hypothesis: Hypothesis) -> Evidence:
    """What the clouds say of a scored hypothesis. Raises KeyError: the clouds were not asked."""
    found = hypothesis.scores[SURFACES]
    assert isinstance(found, Evidence)
    return found


class Verifier:
    """Asks two clouds about hypotheses; build once per pair.

    Args:
        source: cloud with features, local coordinates.
        target: likewise.
        inlier_threshold: largest distance of points on the same surface, cloud units.
        num_queries: points of each cloud asked at most, a seeded choice.
        seed: decides the choice.

    Raises:
        InputError: a cloud without features.
    """

    def __init__(
        self,
        source: PreparedCloud,
        target: PreparedCloud,
        inlier_threshold: float,
        *,
        num_queries: int = 1500,
        seed: int = 0,
    ) -> None:
        if source.features is None or target.features is None:
            raise InputError(
                "clouds without features cannot be compared; call with_features(cloud, descriptor) on both first"
            )
        edge = target.voxel_size
        chosen = drawn_rows(source.points, edge, num_queries, seed)
        random_targets = drawn_rows(target.points, edge, expert().surfaces.num_random, seed + 1)
        self._threshold = inlier_threshold
        self._points, self._normals = source.points[chosen], source.normals[chosen]
        # Products of float32 differ in their last bits with the number of threads; those of float64, rounded,
        # do not, and a random target that is the nearest one is then as similar as itself, not more.
        self._features = source.features[chosen].astype(np.float64)
        self._target = target
        self._target_features = target.features
        self._tree = target.tree
        random_features = target.features[random_targets].astype(np.float64)
        similarity = (self._features @ random_features.T).astype(np.float32)
        # Sorted, and each row lifted above the one before, so that one search counts what is more similar.
        self._num_random = similarity.shape[1]
        # Four is more than two similarities of unit features can differ by.
        self._lift = 4.0 * np.arange(len(similarity))
        self._random_similarity = (np.sort(similarity, axis=1) + self._lift[:, None]).ravel()
        self._back = target.points[drawn_rows(target.points, edge, num_queries, seed + 2)]
        self._signed = source.viewpoint is not None and target.viewpoint is not None
        views = [
            RangeImage.of(cloud.points, cloud.viewpoint)
            if self._signed and cloud.viewpoint is not None and cloud.scanned
            else None
            for cloud in (source, target)
        ]
        self._source_view, self._target_view = views

    def evidence(self, T_target_source: FloatArray) -> Evidence:
        """What the clouds say of one transform (4, 4) in local coordinates."""
        return self._evidence(T_target_source[None])[0]

    def __call__(self, transforms: FloatArray) -> list[Evidence]:
        """What the clouds say of transforms (K, 4, 4), one each."""
        at_once = 5  # hypotheses asked about together, for any number of threads
        lots = [transforms[k : k + at_once] for k in range(0, len(transforms), at_once)]
        return [evidence for lot in each(self._evidence, lots) for evidence in lot]

    def _evidence(self, motions: FloatArray) -> list[Evidence]:
        """Of motions (K, 4, 4), one each; asked about together, since the many small steps cost more than
        what they compute."""
        R, t = motions[:, :3, :3], motions[:, None, :3, 3]
        K, n = len(motions), len(self._points)
        moved = self._points @ R.transpose(0, 2, 1) + t
        met = Met.of(moved, self._tree, self._threshold)
        motion, asked = np.divmod(met.rows, n)
        turned = self._normals @ R.transpose(0, 2, 1)
        agrees = met.cosines(turned, self._target.normals, self._signed) > expert().surfaces.least_cosine
        # -ln p of a uniform p has mean 1, so chance overlap sums to zero.
        surprise = -np.log(self._chance(asked[agrees], met.nearest[agrees])) - 1
        surprise *= 1 - (met.distance[agrees] / self._threshold) ** 2
        overlap, agreement, distinctiveness = (
            np.bincount(motion[some], weights, minlength=K) / n
            for some, weights in ((slice(None), None), (agrees, None), (agrees, surprise))
        )
        violation = self._violations(R, t, moved)
        columns = (overlap, agreement, distinctiveness, violation)
        return [Evidence(*row) for row in np.stack(columns, axis=1).tolist()]

    def _chance(self, asked: IntArray, nearest: IntArray) -> FloatArray:
        """p-values: how likely a random target point is as similar to an asked point as its ``nearest``."""
        features = self._target_features[nearest].astype(np.float64)
        similarity = np.einsum("ij,ij->i", self._features[asked], features).astype(np.float32)
        place = np.searchsorted(self._random_similarity, similarity + self._lift[asked], side="right")
        more_similar = self._num_random * (asked + 1) - place
        p: FloatArray = (1 + more_similar) / (1 + self._num_random)
        return p

    def _violations(self, R: FloatArray, t: FloatArray, moved: FloatArray) -> FloatArray:
        total = np.zeros(len(R))
        back = (self._back - t) @ R
        for view, points in ((self._target_view, moved), (self._source_view, back)):
            if view is None:
                continue
            margins, _ = view.margins(points)
            through, seen = (some.sum(1) for some in (margins < -2 * self._threshold, np.isfinite(margins)))
            total += through / (seen + expert().surfaces.visible_floor * points.shape[1])
        return total
