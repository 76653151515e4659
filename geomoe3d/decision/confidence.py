"""How sure: status, reasons and confidence from the evidence.

Place: decide, the last step. The confidence is P(the answer is right), a logistic function of the evidence of
the clouds, its lead over the best clearly different motion, the overlap, how firmly the shared surface holds
the source and its sensor, and the share of correspondences that agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomoe3d.config import DecisionConfig, expert
from geomoe3d.decision.information import Information
from geomoe3d.result import Status
from geomoe3d.runtime.words import of_the_score
from geomoe3d.scoring.network import opinion_of
from geomoe3d.scoring.surfaces import Evidence, evidence_of
from geomoe3d.types import FloatArray, Hypothesis


@dataclass(frozen=True)
class Judgement:
    """Status with its reasons, sentences, and the confidence in [0, 1].

    Attributes:
        status, reasons, confidence: as in the result.
        unspecific: that one of the reasons which only says that the confidence is low, or None; it gives way where a
            cause becomes known.
    """

    status: Status
    reasons: tuple[str, ...]
    confidence: float
    unspecific: str | None = None


def judge(
    answer: Hypothesis,
    rival: Hypothesis | None,
    lead: float,
    support: float,
    information: Information,
    config: DecisionConfig,
    num_matches: int | None = None,
    margin: float | None = None,
) -> Judgement:
    """Decide whether an answer may be believed.

    Args:
        answer: scored, after refinement.
        rival: the best clearly different hypothesis, if there is one.
        lead: as `lead_over` gives it.
        support: share of the correspondences that agree with the answer.
        information: of the answer.
        config: thresholds.
        num_matches: the correspondences of which the support is a share; None: not counted.
        margin: logarithm of the factor by which the scorers that help to choose prefer the answer to the best clearly
            different candidate; None: nobody was asked.

    Returns:
        ``ambiguous`` where the surfaces let the source slide, or where the answer would be likely but another
        motion is about as good; ``low_confidence`` below the threshold or where next to nothing agrees; else
        ``ok``.
    """
    limits, evidence, heard = expert().confidence, evidence_of(answer), opinion_of(answer) is not None
    confidence = confidence_score(
        evidence, lead, support, information, heard=heard, prior=config.prior, margin=margin
    )
    notes = []
    if evidence.overlap < limits.low_overlap:
        notes.append(f"the scans share little surface: overlap {100 * evidence.overlap:.0f} %")
    if evidence.free_space_violation > limits.high_violation:
        notes.append(
            "parts lie where the other scan's sensor saw free space "
            f"(rate {evidence.free_space_violation:.2f}; 0 is none, 2 all of both scans)"
        )
    if information.observability < information.least_observability:
        slides = (
            "the shared surface lets the source slide or turn along itself "
            f"(observability {information.observability:.4f}, needs {information.least_observability}): it is too "
            "plain, like a single plane, a cylinder or a corridor"
        )
        if information.observability >= limits.least_observability:
            slides += "; the sensors lie on each other, so what matches may be their own pattern"
        notes.insert(0, slides)
        return Judgement("ambiguous", tuple(notes), min(confidence, limits.most_sliding))
    if rival is not None and _may_be_the_pattern(evidence, rival, information):
        share = 1 / lead_over(evidence.surface_score, evidence_of(rival).surface_score)
        notes.insert(
            0,
            "the transform lays the sensors on each other, where what matches may be their own pattern, and by the "
            f"surfaces a clearly different one has {of_the_score(share)} of this one; see the alternative: the scans "
            "may show repeated or symmetric structure",
        )
        return Judgement("ambiguous", tuple(notes), min(confidence, limits.most_doubted))
    # Without a rival it would be likely, by the clouds alone: the network doubts what it has seen no like of.
    alone = confidence_score(evidence, limits.unrivalled_lead, support, information, prior=config.prior)
    # What the clouds like alike is ambiguous unless the network makes the answer sure: by how much it prefers one
    # hangs on which correspondences it saw.
    alike = (
        rival is not None
        and evidence_of(rival).surface_score >= config.ambiguity_ratio * evidence.surface_score
    )
    told_apart = margin is not None and margin >= limits.told_apart
    unsure = confidence < config.min_confidence or (_hardly_told_apart(answer, rival) and not told_apart)
    close = (lead < 1 / config.ambiguity_ratio and not told_apart) or (alike and unsure)
    if close and alone >= limits.likely:
        notes.append(_rival_note(lead, config.ambiguity_ratio, evidence, rival, margin))
        return Judgement("ambiguous", tuple(notes), min(confidence, limits.most_doubted))
    few = _too_few(support, num_matches, information)
    if few is not None:
        return Judgement("low_confidence", (few, *notes), min(confidence, limits.most_doubted))
    if confidence < config.min_confidence:
        low = (
            f"confidence {said_below(confidence, config.min_confidence)} is below {config.min_confidence:.2f}: "
            "the scans may not overlap, or share too little distinctive surface"
        )
        return Judgement("low_confidence", (*notes, low), confidence, low)
    return Judgement("ok", tuple(notes), confidence)


def is_likely(judgement: Judgement) -> bool:
    """Whether an answer is ok, or may become so where it comes out again."""
    return judgement.status == "ok" or (
        judgement.unspecific is not None and judgement.confidence >= expert().confidence.likely
    )


def repeated(was: Judgement, lead: float) -> Judgement:
    """The judgement of an answer beside which the clouds would believe another one as well; ``lead`` by them alone."""
    twin = (
        f"the place repeats: by the surfaces alone a clearly different transform has {of_the_score(1 / lead)} of this "
        "one and would be believed by itself; see the alternative"
    )
    others = (reason for reason in was.reasons if reason != was.unspecific)
    return Judgement("ambiguous", (twin, *others), min(was.confidence, expert().confidence.most_doubted))


def _may_be_the_pattern(evidence: Evidence, rival: Hypothesis, information: Information) -> bool:
    """Whether an answer lays sensor on sensor, which makes any place look like any other, and has a rival that most of
    the source lies on as well."""
    limits = expert().confidence
    if information.sensors_apart >= limits.near_sensors:
        return False
    other = evidence_of(rival)
    fits = other.surface_score >= limits.near_sensors_rival * evidence.surface_score
    return fits and other.overlap >= limits.near_sensors_overlap


def said_below(confidence: float, limit: float) -> str:
    """Two digits as everywhere else, but never those of a limit which the number is below."""
    said = f"{confidence:.2f}"
    return said if float(said) < limit else f"{np.floor(100 * confidence) / 100:.2f}"


def _rival_note(
    lead: float, ratio: float, evidence: Evidence, rival: Hypothesis | None, margin: float | None
) -> str:
    """A sentence about a rival that is as good, by the score or by the surfaces alone."""
    by_score = lead < 1 / ratio or rival is None
    if rival is not None and not by_score:
        lead = lead_over(evidence.surface_score, evidence_of(rival).surface_score)
    share = 1 / lead
    rungs = (
        (1.005, "better than"),
        (0.995, "as well as"),
        (0.75, "nearly as well as"),
        (0.0, "less well than"),
    )
    fits = next(words for least, words in rungs if share >= least)
    said = f"a clearly different transform fits {fits} this one ({of_the_score(share)})"
    if not by_score:
        said = f"by the surfaces alone {said}"
    elif share >= 1.005 and margin is not None and margin > 0:
        said += ", and only the surface network prefers the answer"
    return f"{said}; see the alternative, the scans may show repeated or symmetric structure"


def _too_few(support: float, num_matches: int | None, information: Information) -> str | None:
    """A sentence where less agrees than can carry an answer, whatever the confidence says."""
    least_points, least_matches = expert().confidence.least_points, expert().confidence.least_matches
    if information.num_matched < least_points:
        return (
            f"too few points: {information.num_matched} points of the grid lie on each other, at least "
            f"{least_points} are needed"
        )
    if num_matches is None:
        return None
    agreeing, needed = round(support * num_matches), min(least_matches, -(-num_matches // 2))
    if agreeing >= needed:
        return None
    return f"too few matches agree with the answer: {agreeing} of {num_matches}, at least {needed} are needed"


def _hardly_told_apart(answer: Hypothesis, rival: Hypothesis | None) -> bool:
    """Whether the network's verdicts on both lie close together."""
    said, other = opinion_of(answer), opinion_of(rival)
    return (
        said is not None
        and other is not None
        and abs(said.verdict - other.verdict) < expert().confidence.close_verdicts
    )


def lead_over(score: float, other: float | None) -> float:
    """Score of the answer over that of the best clearly different hypothesis.

    inf where the other scores nothing; 3 where no different one was proposed at all (None), since an answer
    without a rival has not beaten one; 1 where the answer scores nothing.
    """
    if score <= 0:
        return 1.0
    if other is None:
        return expert().confidence.unrivalled_lead
    return score / other if other > 0 else float("inf")


CONFIDENCE_INPUTS = (
    "log evidence",
    "log lead",
    "log overlap",
    "log observability",
    "log looseness",
    "log support",
    "free-space violation",
)
"""What the confidence is made of, in the order of `confidence_inputs`."""


def confidence_inputs(
    evidence: Evidence, lead: float, support: float, information: Information
) -> FloatArray:
    """(7,) natural logarithms, bounded below and the lead above too; see `judge` for the arguments.

    More overlap at equal evidence is a bad sign: it is evidence by chance that grows with it. A surface that
    hardly holds the source is one: the answer may have slid off along it; and one that leaves the sensor
    loose, far off at the end of a lever, is the worst. The violation enters as it is, bounded, beside its
    part in the evidence, which choosing needs but which is not all that it says of the answer. The verdict of
    a network enters through the lead alone: by itself it is surer on scans like those it was trained on.
    """
    bounds = expert().confidence
    return np.append(
        np.log(
            [
                max(evidence.surface_score, bounds.least_score),
                min(max(lead, bounds.least_lead), bounds.most_lead),
                evidence.overlap + bounds.added_overlap,
                information.observability + bounds.added_observability,
                min(max(information.looseness, bounds.least_looseness), bounds.most_looseness),
                support + bounds.added_support,
            ]
        ),
        min(evidence.free_space_violation, bounds.most_violation),
    )


def margin_inputs(strength: float, margin: float) -> FloatArray:
    """(2,) what the fit of the evidence says, and the margin, both logits and bounded."""
    bounds = expert().confidence.second_look
    return np.array(
        [
            np.clip(strength, -bounds.most_evidence, bounds.most_evidence),
            np.clip(margin, bounds.least_margin, bounds.most_margin),
        ]
    )


def confidence_score(
    evidence: Evidence,
    lead: float,
    support: float,
    information: Information,
    *,
    heard: bool = False,
    prior: float | None = None,
    margin: float | None = None,
) -> float:
    """P(the answer is right) in [0, 1], a logistic function of `confidence_inputs`; 0 without evidence.

    ``heard``: whether a network was asked about the answer; ``prior``: P(a pair overlaps) before it is looked at, None
    for that of the mix that the coefficients were fitted on; see `judge` for the other arguments. With a margin, what
    that function says and the margin are the inputs of a second one.

    Source of the prior: Bayes' rule, which adds to the logit what the prior's differs by.
    """
    if evidence.surface_score <= 0:
        return 0.0
    fit = expert().confidence.fit(heard=heard, sensors_known=information.sensors_known)
    inputs = confidence_inputs(evidence, lead, support, information)
    strength = fit.offset + inputs @ np.array(fit.slopes)
    if margin is not None and information.sensors_known:
        second = expert().confidence.second_look
        strength = second.offset + np.array([second.evidence, second.margin]) @ margin_inputs(
            strength, margin
        )
    strength += prior_logit(prior)
    if np.isnan(strength):  # of numbers that say nothing nothing is believed
        return 0.0
    return float(1 / (1 + np.exp(-np.clip(strength, -50, 50))))


def prior_logit(prior: float | None) -> float:
    """What a prior, P(a pair overlaps), adds to the logit of a confidence; 0 where none is given."""
    if prior is None:
        return 0.0
    fitted = expert().confidence.fitted_prior
    return float(np.log(prior / (1 - prior)) - np.log(fitted / (1 - fitted)))
