"""Consensus: motions proposed by sets of correspondences that agree about distances and planes.

A rigid motion preserves lengths, so two true correspondences i, j satisfy |p_i - p_j| = |q_i - q_j| up to
noise; and how the planes at the points lie to each other, where those are known. The steps, each one function
below: *compatibility* of all pairs; *seeds*, the best supported correspondences spread over the scene; for
each seed the *local sets* of correspondences that share most compatible partners with it (second-order
compatibility, Chen et al., SC2-PCR, CVPR 2022); one weighted Kabsch per set; a *score* over all
correspondences; reweighted *refinement* of the best distinct motions.

What differs from that paper: correspondences that share one target point vote with less weight (one-way
matching sends many source points to one target, and such bundles agree with wrong motions by chance);
the score is a smooth function of the residual; every seed is scored on all correspondences; several
distinct hypotheses are kept for a later choice on the clouds; and what surrounds the correspondences is asked
of pairs and of motions (`geomoe3d.estimators.surroundings`), without which lengths alone decide.

Place: solve. Cost for N correspondences, M seeds and W witnesses: O(N^2) memory (4 bytes each, N at most
``max_dense``), M N W multiply-adds; 1,000 take some 27 ms on one core, a third of it for what surrounds them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from geomoe3d.config import EstimatorConfig
from geomoe3d.estimators.base import Estimator, check_correspondences, estimator
from geomoe3d.estimators.surroundings import Surroundings
from geomoe3d.geometry.draws import Ranks, cell_ranks
from geomoe3d.geometry.rigid_fit import (
    fit_rigid,
    fit_rigid_shared,
    products,
    spread_shared,
    squared_residuals_shared,
)
from geomoe3d.geometry.se3 import make_transform
from geomoe3d.runtime.threads import each, single_blas_thread
from geomoe3d.types import BoolArray, Float32Array, FloatArray, Hypothesis, IntArray

if TYPE_CHECKING:
    from typing_extensions import Self

_BLOCK = 250  # rows of the matrix of all pairs that one thread works on: they stay in its cache
_PAIR_BLOCK = 125  # the same where several such blocks are worked on
_SCORED_AT_ONCE = 64_000


@estimator("consensus")
@dataclass(frozen=True)
class ConsensusEstimator(Estimator):
    """Consensus about lengths and planes; deterministic for a given seed.

    Attributes:
        num_hypotheses: distinct motions returned at most.
        num_seeds: correspondences whose local set proposes a motion.
        set_sizes: correspondences in the local sets of a seed besides itself, rising. Small sets, because
            larger ones take in wrong correspondences where inliers are rare; more than one, because they err
            on different pairs.
        length_tolerance: difference of lengths that is compatible, in inlier thresholds.
        num_witnesses: correspondences among which common partners are counted, chosen as seeds are: the best
            supported, and a quarter spread over the others.
        num_refined: distinct proposals that are refined before the choice, at least ``num_hypotheses``.
        num_refits: rounds of reweighted refinement before the choice, and as many of the chosen after it.
        still_turn, still_shift: what moves less in a round, an entry of the rotation and inlier thresholds, is at its
            end.
        distinct_angle_deg, distinct_thresholds: two motions are the same when they differ by less than
            this angle and, at the centroid, by less than so many inlier thresholds.
        settled_share, settled_lead: where the best motion has so many votes for each correspondence, and so many
            times those of any different one, it is `settled` (`Hypothesis`): of 210 recorded pairs 92 were, all
            right, and the network thought so. Where 250 seeds say that, the others propose nothing, and no more
            proposals are refined than are carried to the end.
        num_tried: distinct proposals of these seeds that are refined to see that.
        max_dense: largest N for which all pairs are formed; beyond it the heaviest are taken, ties by a
            seeded choice. The score always uses all correspondences.
    """

    num_hypotheses: int = 8
    num_seeds: int = 700
    set_sizes: tuple[int, ...] = (3, 6)
    length_tolerance: float = 0.8
    num_witnesses: int = 300
    num_refined: int = 100
    num_refits: int = 2
    still_turn: float = 5e-5
    still_shift: float = 1e-3
    distinct_angle_deg: float = 15.0
    distinct_thresholds: float = 3.0
    settled_share: float = 0.04
    settled_lead: float = 2.0
    num_tried: int = 12
    max_dense: int = 5000
    uses_surroundings: ClassVar[bool] = True

    @classmethod
    def from_config(cls, config: EstimatorConfig) -> Self:
        """With as many hypotheses as configured."""
        return cls(num_hypotheses=config.num_hypotheses)

    def with_less_effort(self) -> Self:
        """Fewer seeds, and fewer proposals refined: what is drawn closer need not be proposed so well."""
        return replace(self, num_seeds=500, num_refined=60)

    def with_least_effort(self) -> Self:
        """See `Estimator`."""
        return replace(self, num_hypotheses=3, num_seeds=150, num_refined=15)

    @single_blas_thread()
    def __call__(
        self,
        correspondences: ArrayLike,
        weights: ArrayLike | None = None,
        *,
        inlier_threshold: float,
        seed: int = 0,
        surroundings: Surroundings | None = None,
    ) -> list[Hypothesis]:
        """See `Estimator`."""
        rows, given = check_correspondences(correspondences, weights, inlier_threshold)
        if surroundings is not None:
            surroundings = surroundings.take(given > 0)
        rows, given = rows[given > 0], given[given > 0]
        if len(rows) < 3:
            return []
        centre = rows.mean(0)
        # One unit of length is the inlier threshold from here on, so float32 keeps enough digits.
        unit = (rows - centre) / inlier_threshold
        known = products(unit[:, :3], unit[:, 3:])
        # Multiples of 1/1024 add up exactly in float32, in whatever order. Weighed by planes they do not:
        # fixed blocks and one BLAS thread keep the answers the same for any number of threads.
        vote = (np.ceil(given / given.max() * bundle_weights(rows[:, 3:]) * 1024) / 1024).astype(np.float32)
        ranks = cell_ranks(rows, inlier_threshold, seed)
        dense = self._dense_rows(given, ranks)
        R, t, scores, settled = self._propose(
            unit.astype(np.float32), known, vote, ranks, dense, surroundings
        )
        # Refits bring some together, and some are not firm: half as many again are carried to the end.
        some = self.num_hypotheses + self.num_hypotheses // 2
        most = some if settled else max(self.num_refined, some)
        for limit, refits in ((most, self.num_refits), (some, 10)):
            keep = self._distinct_rows(R, t, scores, limit)
            R, t = R[keep], t[keep]
            R, t = self._refitted(R, t, known, vote, refits)
            scores = score(R, t, known, vote, surroundings)
            if surroundings is not None:
                scores = scores * surroundings.plausibility(R, _shift(R, t, centre / inlier_threshold))
        best = self._distinct_rows(R, t, scores, some)
        finished = _finished(R[best], t[best], scores[best], unit, known, centre, vote, inlier_threshold)
        if finished and self._is_settled(R[best], t[best], scores[best], len(rows)):
            finished[0].settled = finished[0].proposal_score == float(scores[best[0]])
        return finished[: self.num_hypotheses]

    def _is_settled(self, R: FloatArray, t: FloatArray, scores: FloatArray, count: int) -> bool:
        """Whether one of the motions (K, 3, 3), (K, 3) has all that it takes; see `settled_share`."""
        first, *others = self._distinct_rows(R, t, scores, 2)
        rival = max((float(scores[k]) for k in others), default=0.0)
        return bool(scores[first] > max(self.settled_share * count, self.settled_lead * rival))

    def _dense_rows(self, given: FloatArray, ranks: Ranks) -> IntArray:
        """Rows that take part in proposing, at most ``max_dense``: the heaviest, ties by seeded choice."""
        if len(given) <= self.max_dense:
            return np.arange(len(given))
        return np.sort(np.lexsort((ranks, -given))[: self.max_dense])

    def _propose(
        self,
        unit: Float32Array,
        known: FloatArray,
        vote: Float32Array,
        ranks: Ranks,
        rows: IntArray,
        surroundings: Surroundings | None,
    ) -> tuple[FloatArray, FloatArray, FloatArray, bool]:
        """One motion per seed and size of its local set: R (K, 3, 3), t (K, 3), their scores (K,), and whether the
        first seeds settled it."""
        p, q = (np.ascontiguousarray(side[rows]) for side in np.hsplit(unit, 2))
        v = vote[rows]
        near = None if surroundings is None else surroundings.take(rows)
        source_distance, compatible = compatibility(p, q, self.length_tolerance, near)
        strength = strengths(compatible @ v, source_distance)
        seeds = choose_seeds(strength, ranks[rows], self.num_seeds)
        witnesses = np.sort(choose_seeds(strength, ranks[rows], self.num_witnesses))

        def of(some: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            members, weights = local_sets(compatible, some, v, max(self.set_sizes), witnesses)
            sets = [(members[:, : size + 1], weights[:, : size + 1]) for size in self.set_sizes]
            fits = [fit_rigid(p[rows], q[rows], weight) for rows, weight in sets]
            R, t = (np.concatenate(part).astype(np.float64) for part in zip(*fits, strict=True))
            return R, t, score(R, t, known, vote, surroundings)

        # The first block holds strong seeds and drawn ones: these propose what a second, weaker motion has.
        half = _BLOCK // 2
        first, *others = _blocks(np.concatenate([seeds[:half], seeds[half:][::-1]]))
        proposed = [of(first)]
        settled = self._seems_settled(*proposed[0], known, vote, surroundings)
        if not settled:
            proposed += each(of, others)
        R, t, scores = (np.concatenate(part) for part in zip(*proposed, strict=True))
        return R, t, scores, settled

    def _seems_settled(
        self,
        R: FloatArray,
        t: FloatArray,
        scores: FloatArray,
        known: FloatArray,
        vote: Float32Array,
        surroundings: Surroundings | None,
    ) -> bool:
        """`_is_settled` once the best few are refined: as proposed, one motion comes in several that lie apart."""
        if scores.max() < self.settled_share * len(vote) / 2:
            return False
        best = self._distinct_rows(R, t, scores, self.num_tried)
        R, t = R[best], t[best]
        R, t = self._refitted(R, t, known, vote, self.num_refits)
        return self._is_settled(R, t, score(R, t, known, vote, surroundings), len(vote))

    def _refitted(
        self, R: FloatArray, t: FloatArray, known: FloatArray, vote: Float32Array, rounds: int
    ) -> tuple[FloatArray, FloatArray]:
        """Motions after so many rounds of `refit`; one that stays where it is takes part in no further one."""
        R, t = R.copy(), t.copy()
        moving = np.arange(len(R))
        for _ in range(rounds):
            R_new, t_new = refit(R[moving], t[moving], known, vote)
            turned = np.abs(R_new - R[moving]).max((1, 2)) > self.still_turn
            shifted = np.abs(t_new - t[moving]).max(1) > self.still_shift
            R[moving], t[moving] = R_new, t_new
            moving = moving[turned | shifted]
            if not len(moving):
                break
        return R, t

    def _distinct_rows(self, R: FloatArray, t: FloatArray, scores: FloatArray, limit: int) -> list[int]:
        """Greedy choice by score; each pick takes all motions close to it out of the race."""
        least_trace = 1 + 2 * np.cos(np.radians(self.distinct_angle_deg))
        turns, squares = R.reshape(-1, 9), np.einsum("ki,ki->k", t, t)

        def close(some: IntArray, others: IntArray | list[int]) -> BoolArray:
            # The centroid is at zero in these coordinates, so t is where it goes.
            away = squares[some, None] + squares[others] - 2 * (t[some] @ t[others].T)
            found: BoolArray = away < self.distinct_thresholds**2
            found &= turns[some] @ turns[others].T > least_trace
            return found

        keep: list[int] = []
        for some in _blocks(np.argsort(-scores, kind="stable"), _PAIR_BLOCK):
            free = some[~close(some, keep).any(1)]
            among, left = close(free, free), np.ones(len(free), dtype=np.bool_)
            for row in range(len(free)):
                if left[row]:
                    keep.append(int(free[row]))
                    left &= ~among[row]
                    if len(keep) == limit:
                        return keep
        return keep


def _finished(
    R: FloatArray,
    t: FloatArray,
    scores: FloatArray,
    unit: FloatArray,
    known: FloatArray,
    centre: FloatArray,
    vote: Float32Array,
    inlier_threshold: float,
) -> list[Hypothesis]:
    """A last fit on the inliers of each motion, in order; those without enough are left out.

    R (K, 3, 3), t (K, 3), unit (N, 6) in inlier thresholds about ``centre``; known (N, 17) the products of unit.
    """
    r2 = squared_residuals_shared(R, t, known)
    weights = vote * (r2 < 1) / (1 + r2)
    # A set thinner than a twentieth of the threshold leaves the turn about its line to the noise.
    thinnest = np.minimum(spread_shared(unit[:, :3], weights), spread_shared(unit[:, 3:], weights))
    firm = ((weights > 0).sum(1) >= 3) & (thinnest >= 0.05)
    if not firm.any():
        return []
    R, t = fit_rigid_shared(known, weights[firm])
    counts = (squared_residuals_shared(R, t, known) < 1).sum(1)
    shift = _shift(R, t * inlier_threshold, centre)
    return [
        Hypothesis(make_transform(*motion), float(score_value), int(count))
        for *motion, score_value, count in zip(R, shift, scores[firm], counts, strict=True)
    ]


def _shift(R: FloatArray, t: FloatArray, centre: FloatArray) -> FloatArray:
    """t (K, 3) of motions about ``centre`` (6,), the means of both halves, as they are about the origin."""
    found: FloatArray = t + centre[3:] - np.einsum("kij,j->ki", R, centre[:3])
    return found


def bundle_weights(target: FloatArray) -> Float32Array:
    """1 / sqrt(number of correspondences that share the target point), (N,) float32."""
    _, inverse, counts = np.unique(target, axis=0, return_inverse=True, return_counts=True)
    weights: Float32Array = (1.0 / np.sqrt(counts[inverse.ravel()])).astype(np.float32)
    return weights


def distances(a: Float32Array, b: Float32Array) -> Float32Array:
    """(N, M) Euclidean distances of points (N, 3) and (M, 3), near zero, through one matrix product."""
    a2, b2 = (a * a).sum(1, keepdims=True), (b * b).sum(1, keepdims=True)
    # [-2a, |a|^2, 1] . [b, 1, |b|^2] = |a - b|^2 without a further pass over N x M numbers.
    left, right = np.hstack([-2 * a, a2, np.ones_like(a2)]), np.hstack([b, np.ones_like(b2), b2])
    found: Float32Array = left @ right.T
    np.maximum(found, 0, out=found)
    np.sqrt(found, out=found)
    return found


def compatibility(
    source: Float32Array,
    target: Float32Array,
    tolerance: float = 1.0,
    surroundings: Surroundings | None = None,
) -> tuple[Float32Array, Float32Array]:
    """Distances of the source points (N, N), and how compatible two correspondences are, in [0, 1].

    0 where they do not preserve length; else 1, or how well their planes agree where those are known.
    Points (N, 3) in inlier thresholds, as the tolerance; the diagonal of the second (N, N) is zero.
    """
    apart = np.empty((len(source), len(source)), dtype=np.float32)
    compatible = np.empty_like(apart)

    agree = None if surroundings is None else surroundings.of_pairs(source, target)

    def fill(some: IntArray) -> None:
        # Both are symmetric: from the diagonal on, and the same below it.
        rows, rest = slice(some[0], some[-1] + 1), slice(some[0], None)
        near = distances(source[rows], source[rest])
        gap = distances(target[rows], target[rest])
        gap -= near
        found = np.less(np.abs(gap, out=gap), tolerance, out=gap, casting="unsafe")
        if agree is not None:
            found *= agree(rows, near)
        for whole, part in ((apart, near), (compatible, found)):
            whole[rows, rest] = part
            whole[rest, rows] = part.T

    each(fill, _blocks(np.arange(len(source)), _PAIR_BLOCK))
    np.fill_diagonal(compatible, 0)
    return apart, compatible


def _blocks(rows: IntArray, size: int = _BLOCK) -> list[IntArray]:
    """Rows in parts of at most ``size``, the same ones for any number of threads."""
    return [rows[start : start + size] for start in range(0, len(rows), size)]


def strengths(support: Float32Array, source_distance: Float32Array) -> Float32Array:
    """Support (N,), half of it where a neighbour within the threshold has more, so that a dense bundle of wrong matches
    does not take all places."""
    beaten = ((source_distance < 1.0) & (support[None, :] > support[:, None])).any(1)
    return np.where(beaten, np.float32(0.5) * support, support)


def choose_seeds(strength: Float32Array, ranks: Ranks, limit: int) -> IntArray:
    """Rows with the largest strength, and a quarter of the limit drawn from all others, those of the lowest ranks: they
    give a second, weaker motion its proposals."""
    if len(strength) <= limit:
        return np.arange(len(strength))
    order = np.argsort(-strength, kind="stable")
    strongest = limit - limit // 4
    rest = order[strongest:]
    drawn = rest[np.argsort(ranks[rest], kind="stable")[: limit // 4]]
    return np.concatenate([order[:strongest], drawn])


def local_sets(
    compatible: Float32Array, seeds: IntArray, vote: Float32Array, size: int, witnesses: IntArray
) -> tuple[IntArray, Float32Array]:
    """For each seed the ``size`` correspondences with the largest second-order compatibility.

    Returns:
        Rows (M, size + 1), the seed first, and their weights (M, size + 1): S_ij = C_ij v_j sum_k C_ik
        v_k C_kj over the ``witnesses`` k; the seed weighs as much as its best partner. Partners without any
        compatibility weigh nothing.
    """
    size = min(size, len(compatible) - 1)
    first = compatible[seeds]
    second = np.ascontiguousarray(first[:, witnesses] * vote[witnesses]) @ compatible[witnesses]
    second *= first
    second *= vote
    members = np.empty((len(seeds), size), dtype=np.int64)
    weights = np.empty((len(seeds), size), dtype=np.float32)
    rows = np.arange(len(seeds))
    for rank in range(size):  # a few passes for the maximum are much faster than a partition
        members[:, rank] = second.argmax(1)
        weights[:, rank] = second[rows, members[:, rank]]
        second[rows, members[:, rank]] = -1
    seed_weight = weights.max(1, keepdims=True) + np.float32(1e-6)
    return np.concatenate([seeds[:, None], members], 1), np.concatenate([seed_weight, weights], 1)


def score(
    R: FloatArray,
    t: FloatArray,
    known: FloatArray,
    vote: Float32Array,
    surroundings: Surroundings | None = None,
) -> FloatArray:
    """Sum of vote x exp(-r^2 / (2 0.75^2)) over all correspondences for each motion, (K,).

    Residuals r in units of the inlier threshold; with surroundings each term is weighed by how well the
    normals meet. A smooth kernel, somewhat narrower than the threshold, told right from wrong better than a
    count or a truncated square.
    """
    scores = np.empty(len(R))
    step = max(1, _SCORED_AT_ONCE // max(len(known), 1))
    for start in range(0, len(R), step):
        part = slice(start, start + step)
        kernel = squared_residuals_shared(R[part], t[part], known).astype(np.float32)
        kernel *= np.float32(-0.5 / 0.75**2)
        np.exp(kernel, out=kernel)
        if surroundings is not None:
            kernel *= surroundings.matched(R[part])
        scores[part] = kernel @ vote
    return scores


def refit(
    R: FloatArray, t: FloatArray, known: FloatArray, vote: Float32Array
) -> tuple[FloatArray, FloatArray]:
    """One reweighted fit per motion on residuals under the threshold, weights vote / (1 + r^2).

    A motion left with fewer than three inliers stays as it is.
    """
    r2 = squared_residuals_shared(R, t, known)
    weights = vote * (r2 < 1)
    enough = np.count_nonzero(weights, axis=1) >= 3
    r2 += 1
    R_new, t_new = fit_rigid_shared(known, weights / r2)
    return np.where(enough[:, None, None], R_new, R), np.where(enough[:, None], t_new, t)
