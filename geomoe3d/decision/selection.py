"""From hypotheses to findings about one pair of described clouds: verify, refine, judge.

Hypotheses may come in several lots, from any estimator or grid; all are measured against the same clouds,
so the choice among them does not depend on where they came from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from geomoe3d.config import RegistrationConfig
from geomoe3d.decision.answer import Findings
from geomoe3d.decision.confidence import judge, lead_over, measure_information
from geomoe3d.geometry.se3 import (
    check_motion,
    motions_apart,
    residuals,
    shift_frames,
)
from geomoe3d.refinement.icp import Refiner
from geomoe3d.runtime.timing import StageClock
from geomoe3d.scoring.surfaces import (
    Evidence,
    Verifier,
    are_different,
    best_first,
    clearly_different,
    distinct,
)
from geomoe3d.types import Correspondences, FloatArray, Hypothesis, PreparedCloud

if TYPE_CHECKING:
    from geomoe3d.filters.motion_judge import Judged

_CLOSE_LEAD = 2.0
_KEPT_EVIDENCE = 0.8  # a refinement that loses more of the evidence than this is thrown away
_UNSEEN_VERDICT = -3.0
_MOST_ROUNDS = 6  # further hypotheses shown one by one, where the network rejects those that the clouds like
_DISTINCT_THRESHOLDS = 3.0  # shift at the centroid from which two motions are different


class Refined(NamedTuple):
    """A motion (4, 4) in local coordinates, its evidence, and what went wrong if anything.

    ``judged`` is what the network said under it; None where it was not asked.
    """

    T_target_source: FloatArray
    evidence: Evidence
    note: str | None
    judged: Judged | None


class Chooser:
    """Chooses among hypotheses by what the clouds say; build once per pair.

    Args:
        described: source and target on one grid, with features.
        matched: correspondences on this grid, of which a right answer has its share.
        threshold: largest distance of points on the same surface, cloud units.
        config: of the registration.
        clock: told of the stages weigh, verify, refine and judge.
        network: what a learned judge says of motions (K, 4, 4), one each, or None without one.
    """

    def __init__(
        self,
        described: tuple[PreparedCloud, PreparedCloud],
        matched: Correspondences,
        threshold: float,
        config: RegistrationConfig,
        clock: StageClock,
        network: Callable[[FloatArray], list[Judged]] | None = None,
    ) -> None:
        self._described, self._matched, self._threshold = described, matched, threshold
        self._config, self._clock, self._network = config, clock, network
        clock("verify")
        self._verifier = Verifier(*described, threshold, seed=config.seed)
        self._refiner = Refiner(*described, config.refinement)
        self._ranked: list[tuple[Hypothesis, Evidence]] = []
        self._first: Hypothesis | None = None
        self._guess: FloatArray | None = None
        self._refined: dict[bytes, Refined] = {}
        self._judged: dict[bytes, Judged] = {}

    def consider(self, hypotheses: list[Hypothesis]) -> None:
        """Add a lot of hypotheses, the estimator's best one first."""
        self._clock("verify")
        if self._first is None and hypotheses:
            self._first = hypotheses[0]
        self._ranked = best_first(self._ranked + self._verifier.rank(hypotheses))

    def consider_guess(self, initial: ArrayLike) -> None:
        """Add a user's first guess (4, 4), file coordinates, and its refinement: verified, not trusted."""
        source, target = self._described
        T = shift_frames(check_motion(initial), -source.origin, -target.origin)
        refined, _ = self._refiner(T)
        self._guess = refined
        self.consider([Hypothesis(motion, 0.0, 0) for motion in (T, refined)])

    def conclude(self, num_refined: int = 1, num_judged: int = 3) -> Findings:
        """The best of all hypotheses so far, and how sure.

        Args:
            num_refined: so many of the best distinct hypotheses are refined before the choice.
            num_judged: so many that the clouds like best are shown to the network, if there is one.
        """
        if self._network is not None and self._config.verification.enabled:
            self._clock("weigh")
            self._ask(self._network, num_judged)
        self._clock("refine")
        answer = self._answer(num_refined)
        self._clock("judge")
        if answer is None:
            return Findings.nothing("no motion brings three correspondences in general position together")
        T, (source, target) = answer.T_target_source, self._described
        other, lead, rival = self._rival(answer)
        information = measure_information(T, source, target, self._threshold)
        support = self._support(T)
        judgement = judge(answer.evidence, lead, support, information, self._config.judgement, rival)
        weighed = None if answer.judged is None else answer.judged.output
        findings = Findings(T, other, lead, answer.evidence, information, judgement, weighed)
        for note in (answer.note, self._overruled(T)):
            findings = findings if note is None else findings.with_note(note)
        return findings

    def _overruled(self, T_target_source: FloatArray) -> str | None:
        """A sentence where the answer is clearly another motion than the user's first guess, refined."""
        if self._guess is None:
            return None
        guess, source = self._guess, self._described[0]
        if not are_different(T_target_source, guess, source, self._shift):
            return None
        shift, turn = motions_apart(T_target_source, guess, source.points.mean(0))
        return f"the first guess is not the answer: refined, it lies {turn:.1f} deg and {shift:.3g} away"

    def _ask(self, network: Callable[[FloatArray], list[Judged]], count: int) -> None:
        """Show the network the distinct hypotheses that the clouds like best, and whatever leads after that.

        A hypothesis that it was not shown ranks as if its verdict were as bad as the worst shown, or -3.
        """
        if not self._ranked:
            return
        by_clouds = sorted(self._ranked, key=lambda pair: -pair[1].surface_score)
        shown = distinct(by_clouds, self._described[0], self._shift, count)
        for _ in range(_MOST_ROUNDS):
            if not self._show(network, [h for h in shown if h.verdict is None]):
                return
            if self._ranked[0][0].verdict is not None:
                return
            shown = [self._ranked[0][0]]

    def _show(self, network: Callable[[FloatArray], list[Judged]], shown: list[Hypothesis]) -> bool:
        """Get verdicts and rank anew; False where the network says nothing of these correspondences."""
        judged = network(np.array([h.T_target_source for h in shown])) if shown else []
        if len(judged) < len(shown):
            return False
        said = {id(h): found for h, found in zip(shown, judged, strict=True)}
        self._judged.update((h.T_target_source.tobytes(), said[id(h)]) for h in shown)
        known = [h.verdict for h, _ in self._ranked if h.verdict is not None]
        unseen = min([_UNSEEN_VERDICT, *known, *(found.verdict for found in judged)])
        ranked = []
        for hypothesis, evidence in self._ranked:
            found = said.get(id(hypothesis))
            if found is not None:
                hypothesis = replace(hypothesis, verdict=found.verdict)
            verdict = unseen if hypothesis.verdict is None else hypothesis.verdict
            ranked.append((hypothesis, replace(evidence, verdict=verdict)))
        self._ranked = best_first(ranked)
        return True

    def _answer(self, num_refined: int) -> Refined | None:
        """The motion that the clouds, or without verification the correspondences, like best, refined."""
        if self._first is None:
            return None
        if not self._config.verification.enabled:
            return self._refine(self._first, None)
        judged = [(h, evidence) for h, evidence in self._ranked if h.verdict is not None]
        best = distinct(judged or self._ranked, self._described[0], self._shift, num_refined)
        return max((self._refine(h, h.verdict) for h in best), key=lambda found: found.evidence.score)

    def _refine(self, hypothesis: Hypothesis, verdict: float | None) -> Refined:
        """The motion refined on the clouds, or as it was where that made them fit less well.

        What the network has judged it judges again after refinement; else ``verdict`` holds, a guess.
        """
        key = hypothesis.T_target_source.tobytes()
        if key not in self._refined:  # a second look often likes what the first one did
            self._refined[key] = self._refined_anew(hypothesis)
        found = self._refined[key]
        if hypothesis.verdict is None:
            return found._replace(evidence=replace(found.evidence, verdict=verdict))
        if found.evidence.verdict is None and self._network is not None:
            after = found.T_target_source.tobytes()
            judged = self._judged.get(after) or self._network(found.T_target_source[None])[0]
            evidence = replace(found.evidence, verdict=judged.verdict)
            found = found._replace(evidence=evidence, judged=judged)
            self._refined[key] = found
        return found

    def _refined_anew(self, hypothesis: Hypothesis) -> Refined:
        """By the clouds alone."""
        T, note = self._refiner(hypothesis.T_target_source)
        before, after = (self._verifier.evidence(motion) for motion in (hypothesis.T_target_source, T))
        if after.score < _KEPT_EVIDENCE * before.score:
            note = "refinement made the clouds fit less well; the unrefined motion is given"
            return Refined(hypothesis.T_target_source, before, note, None)
        return Refined(T, after, note, None)

    def _rival(self, answer: Refined) -> tuple[Hypothesis | None, float, Evidence | None]:
        """The best clearly different motion, the answer's lead over it, and its evidence."""
        T, source = answer.T_target_source, self._described[0]
        other = clearly_different(self._ranked, T, source, self._shift)
        lead = lead_over(answer.evidence, other[1] if other else None)
        # A fair race: a rival that the clouds like about as well is refined too, and judged again.
        if other is not None and lead_over(answer.evidence.by_clouds(), other[1].by_clouds()) < _CLOSE_LEAD:
            rival = self._refine(other[0], other[1].verdict)
            if rival.evidence.score > other[1].score:
                moved = replace(other[0], T_target_source=rival.T_target_source), rival.evidence
                other = clearly_different([moved], T, source, self._shift) or other
                lead = lead_over(answer.evidence, other[1])
        return (other[0], lead, other[1]) if other else (None, lead, None)

    def _support(self, T_target_source: FloatArray) -> float:
        """Share of the correspondences that agree with a motion."""
        if len(self._matched) == 0:
            return 0.0
        gaps = residuals(T_target_source, self._matched.source, self._matched.target)
        return float((gaps < self._threshold).mean())

    @property
    def _shift(self) -> float:
        return _DISTINCT_THRESHOLDS * self._threshold
