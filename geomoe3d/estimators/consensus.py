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

from geomoe3d.config import EstimatorConfig, expert
from geomoe3d.estimators.base import Estimator, check_correspondences, estimator
from geomoe3d.estimators.compatibility import (
    BLOCK,
    PAIR_BLOCK,
    blocks,
    bundle_weights,
    choose_seeds,
    compatibility,
    local_sets,
    strengths,
)
from geomoe3d.estimators.fitting import about_origin, finished, refit, score
from geomoe3d.estimators.surroundings import Surroundings
from geomoe3d.geometry.draws import Ranks, cell_ranks
from geomoe3d.geometry.rigid_fit import fit_rigid, products
from geomoe3d.runtime.threads import each, single_blas_thread
from geomoe3d.types import BoolArray, Float32Array, FloatArray, Hypothesis, IntArray

if TYPE_CHECKING:
    from typing_extensions import Self


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
        num_seeds, num_refined = expert().consensus.less_effort
        return replace(self, num_seeds=num_seeds, num_refined=num_refined)

    def with_least_effort(self) -> Self:
        """See `Estimator`."""
        num_seeds, num_refined, num_returned = expert().consensus.least_effort
        return replace(self, num_hypotheses=num_returned, num_seeds=num_seeds, num_refined=num_refined)

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
        for limit, refits in ((most, self.num_refits), (some, expert().consensus.last_refits)):
            keep = self._distinct_rows(R, t, scores, limit)
            R, t = R[keep], t[keep]
            R, t = self._refitted(R, t, known, vote, refits)
            scores = score(R, t, known, vote, surroundings)
            if surroundings is not None:
                scores = scores * surroundings.plausibility(R, about_origin(R, t, centre / inlier_threshold))
        best = self._distinct_rows(R, t, scores, some)
        found = finished(R[best], t[best], scores[best], unit, known, centre, vote, inlier_threshold)
        if found and self._is_settled(R[best], t[best], scores[best], len(rows)):
            found[0].settled = found[0].proposal_score == float(scores[best[0]])
        return found[: self.num_hypotheses]

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
        close, compatible = compatibility(p, q, self.length_tolerance, near)
        strength = strengths(compatible @ v, close)
        seeds = choose_seeds(strength, ranks[rows], self.num_seeds)
        witnesses = np.sort(choose_seeds(strength, ranks[rows], self.num_witnesses))

        def of(some: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
            members, weights = local_sets(compatible, some, v, max(self.set_sizes), witnesses)
            sets = [(members[:, : size + 1], weights[:, : size + 1]) for size in self.set_sizes]
            fits = [fit_rigid(p[rows], q[rows], weight) for rows, weight in sets]
            R, t = (np.concatenate(part).astype(np.float64) for part in zip(*fits, strict=True))
            return R, t, score(R, t, known, vote, surroundings)

        # The first block holds strong seeds and drawn ones: these propose what a second, weaker motion has.
        half = BLOCK // 2
        first, *others = blocks(np.concatenate([seeds[:half], seeds[half:][::-1]]))
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

        def part(moving: IntArray) -> None:
            for _ in range(rounds):
                R_new, t_new = refit(R[moving], t[moving], known, vote)
                turned = np.abs(R_new - R[moving]).max((1, 2)) > self.still_turn
                shifted = np.abs(t_new - t[moving]).max(1) > self.still_shift
                R[moving], t[moving] = R_new, t_new
                moving = moving[turned | shifted]
                if not len(moving):
                    break

        each(part, blocks(np.arange(len(R)), 50))  # motions that one thread refits
        return R, t

    def _distinct_rows(self, R: FloatArray, t: FloatArray, scores: FloatArray, limit: int) -> list[int]:
        """Greedy choice by score; each pick takes all motions close to it out of the race."""
        least_trace = 1 + 2 * np.cos(np.radians(self.distinct_angle_deg))
        turns, squares = R.reshape(-1, 9), np.einsum("ki,ki->k", t, t)

        def close(some: IntArray, others: IntArray | list[int]) -> BoolArray:
            # The centroid is at zero in these coordinates, so t is where it goes.
            away = squares[some, None] + squares[others] - 2 * (t[some] @ t[others].T)
            near: BoolArray = away < self.distinct_thresholds**2
            near &= turns[some] @ turns[others].T > least_trace
            return near

        keep: list[int] = []
        for some in blocks(np.argsort(-scores, kind="stable"), PAIR_BLOCK):
            free = some[~close(some, keep).any(1)]
            among, left = close(free, free), np.ones(len(free), dtype=np.bool_)
            for row in range(len(free)):
                if left[row]:
                    keep.append(int(free[row]))
                    left &= ~among[row]
                    if len(keep) == limit:
                        return keep
        return keep
