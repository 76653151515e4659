"""How well two clouds, not only their correspondences, lie on each other under a hypothesis.

A count of overlapping points says little: walls lie on walls under many wrong motions. Three further
witnesses speak here. *Distinctiveness*: for each source point that lands on the target, how unlikely it is
that a random target point would look as similar (its FPFH distance ranked among random ones, an empirical
p-value); walls look like walls and prove little, a chair on the same chair proves much. *Normals*: the two
surfaces must face the same way. *Free space*: no point of one cloud may lie where the other's sensor looked
through. Place: verify, between solve and refine. About 0.7 ms per hypothesis for clouds of any size, since
at most ``num_queries`` points of each are asked.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomoe3d.clouds.range_image import RangeImage
from geomoe3d.errors import InputError
from geomoe3d.geometry.se3 import motions_apart
from geomoe3d.runtime.threads import each
from geomoe3d.types import FloatArray, Hypothesis, IntArray, PreparedCloud

_NUM_RANDOM = 256  # random target features per source point: p-values down to 1/257
_LIFT = 4.0  # more than two similarities of unit features can differ by
_AT_ONCE = 5  # hypotheses asked about together, for any number of threads
_LEAST_COSINE = 0.7  # normals of one surface, estimated twice, differ by less than 45 degrees
_VIOLATION_WEIGHT = 10.0  # a tenth of the visible points in free space divides the score by e
_VERDICT_WEIGHT = 0.5
_MOST_VERDICT = 8.0
_MOST_TURN_DEG = 15.0
_VISIBLE_FLOOR = 0.05  # fewer visible points than this share make the violation rate unreliable


@dataclass(frozen=True)
class Evidence:
    """What two clouds say of one hypothesis; shares are of the points asked.

    Attributes:
        overlap: share of source points with a target point within the threshold.
        agreement: share of source points that moreover agree in their normals.
        distinctiveness: mean over source points of (-ln p - 1) x (1 - (d / threshold)^2) for agreeing
            points and 0 for the others; about zero for chance overlap, larger is better.
        free_space_violation: share of source points in target's free space over those it could see, plus
            the same with the roles exchanged; 0 where a viewpoint is neither known nor guessed.
        verdict: logit by which a network believes in the motion, or None without one.
        surface_score: distinctiveness x exp(-10 free_space_violation), not below zero.
        score: surface_score x exp(verdict / 2), the verdict bounded to [-8, 8]; surface_score without one.
    """

    overlap: float
    agreement: float
    distinctiveness: float
    free_space_violation: float
    verdict: float | None = None

    @property
    def surface_score(self) -> float:
        """See the class; what the clouds alone say."""
        return max(self.distinctiveness, 0.0) * float(np.exp(-_VIOLATION_WEIGHT * self.free_space_violation))

    def by_clouds(self) -> Evidence:
        """The same without what a network says."""
        return replace(self, verdict=None)

    @property
    def score(self) -> float:
        """See the class; the quantity by which hypotheses are chosen."""
        if self.verdict is None:
            return self.surface_score
        verdict = min(max(self.verdict, -_MOST_VERDICT), _MOST_VERDICT)
        return self.surface_score * float(np.exp(_VERDICT_WEIGHT * verdict))


class Verifier:
    """Asks two described clouds about hypotheses; build once per pair.

    Args:
        source: described cloud, local coordinates.
        target: described cloud, local coordinates.
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
        from scipy.spatial import cKDTree

        if source.features is None or target.features is None:
            raise InputError(
                "verification needs described clouds; call describe(cloud, config) on both first"
            )
        rng = np.random.default_rng(seed)
        chosen = np.sort(rng.permutation(len(source))[:num_queries])
        random_targets = rng.permutation(len(target))[:_NUM_RANDOM]
        self._threshold = inlier_threshold
        self._points, self._normals = source.points[chosen], source.normals[chosen]
        # Products of float32 differ in their last bits with the number of threads; those of float64, rounded,
        # do not, and a random target that is the nearest one is then as similar as itself, not more.
        self._features = source.features[chosen].astype(np.float64)
        self._target = target
        self._target_features = target.features
        self._tree = cKDTree(target.points)
        random_features = target.features[random_targets].astype(np.float64)
        similarity = (self._features @ random_features.T).astype(np.float32)
        # Sorted, and each row lifted above the one before, so that one search counts what is more similar.
        self._num_random = similarity.shape[1]
        self._lift = _LIFT * np.arange(len(similarity))
        self._random_similarity = (np.sort(similarity, axis=1) + self._lift[:, None]).ravel()
        self._back = target.points[np.sort(rng.permutation(len(target))[:num_queries])]
        self._source_view = self._target_view = None
        if source.viewpoint is not None and target.viewpoint is not None:
            self._source_view = RangeImage.of(source.points, source.viewpoint)
            self._target_view = RangeImage.of(target.points, target.viewpoint)

    def evidence(self, T_target_source: FloatArray) -> Evidence:
        """What the clouds say of one motion (4, 4) in local coordinates."""
        return self._evidence(T_target_source[None])[0]

    def _evidence(self, motions: FloatArray) -> list[Evidence]:
        """Of motions (K, 4, 4), one each; asked about together, since the many small steps cost more than
        what they compute."""
        R, t = motions[:, :3, :3], motions[:, None, :3, 3]
        K, n = len(motions), len(self._points)
        moved = self._points @ R.transpose(0, 2, 1) + t
        distance, nearest = map(
            np.asarray, self._tree.query(moved.reshape(-1, 3), distance_upper_bound=self._threshold)
        )
        hit = np.flatnonzero(np.isfinite(distance))
        distance, nearest = distance[hit], nearest[hit]
        motion, asked = np.divmod(hit, n)
        turned = (self._normals @ R.transpose(0, 2, 1)).reshape(-1, 3)[hit]
        cosine = np.einsum("ij,ij->i", turned, self._target.normals[nearest])
        # Without both sensor positions the normals' signs are a guess, and only their lines can be compared.
        agrees = (cosine if self._target_view is not None else np.abs(cosine)) > _LEAST_COSINE
        # -ln p of a uniform p has mean 1, so chance overlap sums to zero.
        surprise = -np.log(self._chance(asked[agrees], nearest[agrees])) - 1
        surprise *= 1 - (distance[agrees] / self._threshold) ** 2
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
        if self._source_view is None or self._target_view is None:
            return total
        back = (self._back - t) @ R
        for view, points in ((self._target_view, moved), (self._source_view, back)):
            seen, margins = (
                values.reshape(points.shape[:2]) for values in view.margins(points.reshape(-1, 3))
            )
            through = (margins < -2 * self._threshold).sum(1)
            total += through / (seen.sum(1) + _VISIBLE_FLOOR * points.shape[1])
        return total

    def rank(self, hypotheses: list[Hypothesis]) -> list[tuple[Hypothesis, Evidence]]:
        """Hypotheses with their evidence, best first; equal evidence keeps the given order."""
        motions = [h.T_target_source for h in hypotheses]
        lots = [np.array(motions[k : k + _AT_ONCE]) for k in range(0, len(motions), _AT_ONCE)]
        found = [evidence for lot in each(self._evidence, lots) for evidence in lot]
        return best_first(list(zip(hypotheses, found, strict=True)))


def best_first(judged: list[tuple[Hypothesis, Evidence]]) -> list[tuple[Hypothesis, Evidence]]:
    """The same, the largest score first; equal evidence keeps the given order."""
    return sorted(judged, key=lambda pair: (-pair[1].score, -pair[1].distinctiveness))


def distinct(
    ranked: list[tuple[Hypothesis, Evidence]], source: PreparedCloud, max_shift: float, limit: int
) -> list[Hypothesis]:
    """The best hypotheses that are all different motions, at most ``limit``; see `clearly_different`."""
    chosen: list[Hypothesis] = []
    for hypothesis, _ in ranked:
        if len(chosen) == limit:
            break
        T = hypothesis.T_target_source
        if all(are_different(c.T_target_source, T, source, max_shift) for c in chosen):
            chosen.append(hypothesis)
    return chosen


def clearly_different(
    ranked: list[tuple[Hypothesis, Evidence]],
    T_target_source: FloatArray,
    source: PreparedCloud,
    max_shift: float,
) -> tuple[Hypothesis, Evidence] | None:
    """The first hypothesis that is another motion than the given one, or None; see `are_different`.

    Args:
        ranked: candidates, best first.
        T_target_source: (4, 4) the motion to differ from.
        source, max_shift: as in `are_different`.
    """
    for hypothesis, evidence in ranked:
        if are_different(T_target_source, hypothesis.T_target_source, source, max_shift):
            return hypothesis, evidence
    return None


def are_different(T_a: FloatArray, T_b: FloatArray, source: PreparedCloud, max_shift: float) -> bool:
    """Whether two motions (4, 4) are clearly different.

    Args:
        T_a, T_b: target from source.
        source: its centroid is where shifts are measured.
        max_shift: motions closer than this, cloud units, and closer than 15 degrees are the same.
    """
    shift, turn = motions_apart(T_a, T_b, source.points.mean(0))
    return shift > max_shift or turn > _MOST_TURN_DEG
