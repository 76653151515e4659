"""From hypotheses to a decision about one pair: score, refine, decide.

Hypotheses may come in several lots, from any estimator or grid; all are scored on the same clouds, so the choice
among them does not depend on where they came from. Everything that becomes known of a hypothesis stands in the
hypothesis itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from geomoe3d.clouds.pair import Pair
from geomoe3d.config import DecisionConfig, RegistrationConfig, expert
from geomoe3d.decision.answer import Decision
from geomoe3d.decision.choosers import Choosers
from geomoe3d.decision.confidence import (
    Judgement,
    confidence_score,
    is_likely,
    judge,
    lead_over,
    repeated,
)
from geomoe3d.decision.distinct import are_different, distinct
from geomoe3d.decision.information import measure_information
from geomoe3d.decision.parallel import Parallel
from geomoe3d.decision.twins import elsewhere, looks_around
from geomoe3d.geometry.se3 import check_motion, motions_apart, residuals, shift_frames
from geomoe3d.refinement.base import PairRefiner
from geomoe3d.runtime.threads import each
from geomoe3d.runtime.timing import StageClock
from geomoe3d.scoring.base import PairScorer, Scorer
from geomoe3d.scoring.surfaces import SURFACES, SurfaceScorer, evidence_of
from geomoe3d.types import FloatArray, Hypothesis

_UNREFINED = (
    "the answer could not be refined without fitting less well, and where the sensors stood is not known; right "
    "answers can be"
)
_WORSE = "refinement made the clouds fit less well; the unrefined transform is given"


class Selection:
    """Selects among the hypotheses of one pair; build once per pair.

    Args:
        pair: clouds with features on one grid, and the correspondences of which a right answer has its share.
        scorers: by name, in the order in which they are asked. Without any the first hypothesis that was added
            is the answer, and the clouds only say how sure it is.
        refiner: polishes the best hypotheses of the pair; one that several selections share polishes none twice.
        config: of the registration.
        clock: told of the stages score, refine and decide.
        choosing: scorers that are asked about refined candidates alone. They help to choose the answer, and by how much
            they prefer it to the best clearly different candidate, the margin, makes the confidence; score and lead
            know nothing of them.
        surfaces: `surfaces_of` the pair, where somebody has them already.
        parallel: by which answers are made parallel in the end, and rivals compared as they then are; None: they stay
            as they are.
    """

    def __init__(
        self,
        pair: Pair,
        scorers: Mapping[str, Scorer],
        refiner: PairRefiner,
        config: RegistrationConfig,
        clock: StageClock,
        choosing: Mapping[str, Scorer] = MappingProxyType({}),
        surfaces: PairScorer | None = None,
        parallel: Parallel | None = None,
    ) -> None:
        self._pair, self._scorers, self._config, self._clock = pair, scorers, config, clock
        self._source, self._choosers = pair.clouds[0], Choosers(choosing, pair, self._are_apart)
        self._parallel = parallel
        self._bound: dict[str, PairScorer] = {SURFACES: surfaces or surfaces_of(pair, scorers)}
        self._refiner = refiner
        self._first: Hypothesis | None = None
        self._guess: FloatArray | None = None
        self._candidates: list[Hypothesis] = []
        self.hypotheses: list[Hypothesis] = []
        """All of them, best first."""

    def add(self, hypotheses: Sequence[Hypothesis]) -> None:
        """Add a lot of hypotheses, the estimator's best one first, and score them."""
        self._clock("score")
        if self._first is None and hypotheses:
            self._first = hypotheses[0]
        for name in (SURFACES, *(n for n, s in self._scorers.items() if not s.selective and n != SURFACES)):
            self._ask(name, hypotheses)
        self.hypotheses += hypotheses
        self._rank()

    def add_guess(self, initial: ArrayLike) -> None:
        """Add a user's first guess (4, 4), file coordinates, and its refinement: scored, not trusted."""
        source, target = self._pair.clouds
        T = shift_frames(check_motion(initial), -source.origin, -target.origin)
        given = Hypothesis(T)
        refined, _ = self._refiner(given)
        self._guess = T if refined is None else refined
        self.add([given, Hypothesis(self._guess)])

    def decide(self, num_refined: int = 1, num_shown: int = 3) -> Decision:
        """The best of all hypotheses so far, and how sure.

        Args:
            num_refined: so many of the best distinct hypotheses are refined before the choice; where there are
                several, before costly scorers are asked. One alone refined would be judged beside others that are not.
            num_shown: so many that the clouds like best are shown to scorers that are selective.
        """
        selective = [name for name, scorer in self._scorers.items() if scorer.selective]
        if num_refined > 1:
            self._refine_best(num_refined)
        if selective:
            self._clock("score")
            for name in selective:
                self._show_best(name, num_shown)
        self._clock("refine")
        answer = self._answer(selective, num_refined)
        if answer is None:
            self._clock("decide")
            return Decision.failed("no rigid transform aligns three non-collinear correspondences")
        rival, lead = self._rival(answer)
        refined = [h for h in self.hypotheses if h.is_refined]
        margin = self._choosers.margin(answer, [*self._candidates, *refined, rival])
        return self._judged(answer, rival, lead, margin, self._config.decision)

    def check(
        self,
        decision: Decision,
        choosing: Mapping[str, Scorer],
        pair: Pair,
        limits: DecisionConfig,
        count: int,
    ) -> Decision:
        """A decision of this selection, judged anew with what others say of its answer.

        Args:
            decision: whose answer it is.
            choosing: asked about the answer and the hypotheses that are clearly different.
            pair: the same clouds with the features that they want.
            limits: by which it is judged.
            count: so many different hypotheses, the best ones, are refined and asked about.
        """
        answer = decision.answer
        if answer is None:
            return decision
        self._clock("refine")
        different = (h for h in self.hypotheses if self._differ(answer, h))
        others = self._refine_all(distinct(different, self._source, self._shift, count))
        margin = Choosers(choosing, pair, self._are_apart).margin(answer, [*others, decision.alternative])
        if margin is None:
            return decision
        return self._judged(answer, decision.alternative, decision.lead, margin, limits)

    def _judged(
        self,
        answer: Hypothesis,
        rival: Hypothesis | None,
        lead: float,
        margin: float | None,
        limits: DecisionConfig,
    ) -> Decision:
        self._clock("decide")
        information = measure_information(
            answer.T_target_source, *self._pair.clouds, self._pair.inlier_threshold
        )
        support, count = self._support(answer), len(self._pair.matched)
        judgement = judge(answer, rival, lead, support, information, limits, count, margin)
        twin = self._twin(answer) if is_likely(judgement) else None
        if twin is not None:
            rival, lead = twin, lead_over(evidence_of(answer).surface_score, evidence_of(twin).surface_score)
            judgement = repeated(judgement, lead)
        if judgement.status == "ok" and answer.note is not None and self._pair.matched.viewpoints is None:
            # Scans of two places that were ok had not been refined either.
            most = expert().selection.most_unrefined
            judgement = Judgement("low_confidence", (_UNREFINED, *judgement.reasons), most)
        decision = Decision(
            answer, rival, lead, information, judgement, tuple(self.hypotheses), margin=margin
        )
        for note in (answer.note, self._overruled(answer)):
            decision = decision if note is None else decision.with_note(note)
        return decision

    def _ask(self, name: str, hypotheses: Sequence[Hypothesis]) -> bool:
        """Have a scorer's word written into hypotheses; False where it says nothing of this pair."""
        if not hypotheses:
            return True
        if name not in self._bound:  # not before it is needed
            self._bound[name] = self._scorers[name].about(self._pair)
        said = self._bound[name](np.array([h.T_target_source for h in hypotheses]))
        if len(said) < len(hypotheses):
            return False
        for hypothesis, score in zip(hypotheses, said, strict=True):
            hypothesis.scores[name] = score
            hypothesis.asked.add(name)
        return True

    def _show_best(self, name: str, count: int) -> None:
        """Ask a selective scorer about the distinct hypotheses that the clouds like best, and then about whatever
        leads; what stands for its word on the others is its own affair (`Scorer.unasked`)."""
        if not self.hypotheses:
            return
        by_clouds = sorted(self.hypotheses, key=lambda h: -evidence_of(h).surface_score)
        granted = self._scorers[name].granted()
        if granted is not None and self._is_settled(by_clouds):
            for hypothesis in self.hypotheses:
                same = not self._differ(by_clouds[0], hypothesis)
                hypothesis.scores[name] = granted if same else self._scorers[name].unasked([granted])
            self._rank()
            return
        shown = distinct(by_clouds, self._source, self._shift, count)
        for _ in range(expert().selection.most_rounds):
            if not self._ask(name, [h for h in shown if name not in h.asked]):
                return
            known = [h.scores[name] for h in self.hypotheses if name in h.asked]
            for hypothesis in self.hypotheses:
                if name not in hypothesis.asked:
                    hypothesis.scores[name] = self._scorers[name].unasked(known)
            self._rank()
            if name in self.hypotheses[0].asked:
                return
            shown = self.hypotheses[:1]

    def _is_settled(self, by_clouds: list[Hypothesis]) -> bool:
        """Whether correspondences and clouds both like one transform so clearly that nobody else is asked."""
        first, *others = distinct(by_clouds, self._source, self._shift, 2)
        scores = [evidence_of(h).surface_score for h in (first, *others)]
        settled = any(h.settled and not self._differ(first, h) for h in by_clouds)
        return settled and scores[0] > expert().selection.settled_lead * max(scores[1:], default=0.0)

    def _rank(self) -> None:
        """Best first; equal ones keep their order."""
        self.hypotheses.sort(key=lambda h: (-h.score, -evidence_of(h).distinctiveness))

    def _answer(self, selective: list[str], num_refined: int) -> Hypothesis | None:
        """What the scorers, or without any the estimator, like best, refined."""
        if self._first is None:
            return None
        if not self._scorers:
            return self._refine(self._first)
        asked = [h for h in self.hypotheses if all(name in h.asked for name in selective)]
        best = distinct(asked or self.hypotheses, self._source, self._shift, num_refined)
        self._candidates = self._refine_all(best)
        values = np.array([candidate.score for candidate in self._candidates])
        liked = self._choosers.likings(self._candidates)
        if liked is not None:
            values *= np.exp(liked)
        return self._candidates[int(values.argmax())]

    def _refine_best(self, count: int) -> None:
        """Refine the ``count`` best distinct hypotheses by the clouds, and add what comes of them: costly scorers are
        then asked about finished transforms. Many right ones are proposed too far off to be liked as they are."""
        self._clock("refine")
        by_clouds = sorted(self.hypotheses, key=lambda h: -evidence_of(h).surface_score)
        best = distinct(by_clouds, self._source, self._shift, count)
        todo = [h for h in best if not h.is_refined and h.refined is None]
        for hypothesis, refined in zip(todo, self._refined(todo), strict=True):
            hypothesis.refined = replace(refined, is_refined=True)
            self.hypotheses.append(hypothesis.refined)
        self._rank()

    def _refine_all(self, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
        """`_refine` of each, those that were not refined before side by side."""
        todo = [h for h in hypotheses if not h.is_refined and h.refined is None]
        for hypothesis, refined in zip(todo, self._refined(todo), strict=True):
            hypothesis.refined = refined
        return [self._refine(h) for h in hypotheses]

    def _refine(self, hypothesis: Hypothesis) -> Hypothesis:
        """The hypothesis refined and scored, or as it was where that made the clouds fit less well.

        A scorer that was asked about it is asked about the refined one; else what was assumed holds.
        """
        if hypothesis.is_refined:
            return hypothesis
        if hypothesis.refined is None:  # a second look often likes what the first one did
            (hypothesis.refined,) = self._refined([hypothesis])
        refined = hypothesis.refined
        same = refined.T_target_source is hypothesis.T_target_source
        for name in self._scorers:
            if name == SURFACES or name not in hypothesis.scores or name in refined.asked:
                continue
            if name not in hypothesis.asked or same:
                refined.scores[name] = hypothesis.scores[name]
                refined.asked |= hypothesis.asked & {name}
            else:
                self._ask(name, [refined])
        return refined

    def _refined(self, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
        """All refined, and scored by the clouds alone."""

        def unrefined(hypothesis: Hypothesis, note: str | None) -> Hypothesis:
            known = {SURFACES: hypothesis.scores[SURFACES]}
            return replace(hypothesis, scores=known, asked={SURFACES}, note=note)

        found: list[Hypothesis] = []
        for hypothesis, (T, note) in zip(hypotheses, each(self._refiner, hypotheses), strict=True):
            if T is None or T is hypothesis.T_target_source:
                found.append(unrefined(hypothesis, note))
            else:
                found.append(replace(hypothesis, T_target_source=T, scores={}, asked=set(), note=note))
        self._ask(SURFACES, [h for h in found if not h.asked])
        for k, hypothesis in enumerate(hypotheses):
            least = expert().selection.kept_evidence * evidence_of(hypothesis).surface_score
            if evidence_of(found[k]).surface_score < least:
                found[k] = unrefined(hypothesis, _WORSE)
        return found

    def _rival(self, answer: Hypothesis) -> tuple[Hypothesis | None, float]:
        """The best clearly different hypothesis, and the answer's lead over it."""
        best: Hypothesis | None = None
        different = (h for h in self.hypotheses if self._differ(answer, h))
        others = distinct(different, self._source, self._shift, expert().selection.most_rivals)
        # A fair race: a rival that could matter is refined too. One that refines to the answer itself, or becomes it
        # once both are made parallel, was only proposed less well, and is none: how far off is an accident.
        most_lead = expert().confidence.most_lead
        close = [h for h in others if lead_over(answer.score, h.score) < most_lead]
        polished = dict(zip(map(id, close), self._refine_all(close), strict=True))
        for other in others:
            refined = polished.get(id(other), other)
            if not self._are_apart(answer, refined):
                continue
            other = max(other, refined, key=lambda h: h.score)
            if best is None or other.score > best.score:
                best = other
        return best, lead_over(answer.score, None if best is None else best.score)

    def _twin(self, answer: Hypothesis) -> Hypothesis | None:
        """The clearly different transform that the clouds would believe if the answer were not there, if any; sought
        for scans that look all around alone."""
        if self._parallel is None or not all(map(looks_around, self._pair.clouds)):
            return None
        known, score = expert().twins, evidence_of(answer).surface_score
        places = [Hypothesis(T) for T in elsewhere(answer.T_target_source, self._parallel.shared)]
        self._ask(SURFACES, places)
        liked = sorted([*self.hypotheses, *places], key=lambda h: -evidence_of(h).surface_score)
        liked = [h for h in liked if evidence_of(h).surface_score >= known.least_proposed * score]
        different = (h for h in liked if self._differ(answer, h))
        for twin in self._refine_all(distinct(different, self._source, self._shift, known.most_refined)):
            evidence, T = evidence_of(twin), twin.T_target_source
            if evidence.surface_score >= known.least_score * score and self._are_apart(answer, twin):
                information = measure_information(T, *self._pair.clouds, self._pair.inlier_threshold)
                lead = expert().confidence.unrivalled_lead
                if confidence_score(evidence, lead, self._support(twin), information) >= known.believed:
                    return twin
        return None

    def _differ(self, one: Hypothesis, other: Hypothesis) -> bool:
        return are_different(one.T_target_source, other.T_target_source, self._source, self._shift)

    def _are_apart(self, one: Hypothesis, other: Hypothesis) -> bool:
        """Whether two hypotheses are clearly different, as they are and as they would be reported."""
        if self._parallel is None:
            return self._differ(one, other)
        return self._parallel.differ(one.T_target_source, other.T_target_source)

    def _overruled(self, answer: Hypothesis) -> str | None:
        """A sentence where the answer is clearly another transform than the user's first guess, refined."""
        if self._guess is None:
            return None
        T, guess = answer.T_target_source, self._guess
        if not are_different(T, guess, self._source, self._shift):
            return None
        shift, turn = motions_apart(T, guess, self._source.center)
        return f"the first guess is not the answer: refined, it lies {turn:.1f} deg and {shift:.3g} away"

    def _support(self, answer: Hypothesis) -> float:
        """Share of the correspondences that agree with the answer."""
        matched = self._pair.matched
        if len(matched) == 0:
            return 0.0
        gaps = residuals(answer.T_target_source, matched.source, matched.target)
        return float((gaps < self._pair.inlier_threshold).mean())

    @property
    def _shift(self) -> float:
        return expert().selection.different_shift * self._pair.inlier_threshold


def surfaces_of(pair: Pair, scorers: Mapping[str, Scorer]) -> PairScorer:
    """What asks the clouds of a pair about hypotheses, as the scorers do or, where none of them asks clouds, as is
    usual."""
    return scorers.get(SURFACES, SurfaceScorer()).about(pair)
