"""A doubtful answer is sought once more, from the start, on a shifted grid: two answers are made one.

Which points stand for a cloud, their features and a good part of the matches are then others. A right answer comes out
again; a wrong one often does not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomoe3d.config import expert
from geomoe3d.decision.answer import Decision, Repeat
from geomoe3d.decision.confidence import Judgement, lead_over, prior_logit, said_below

_TWICE = "registered on two grids, the answers"
_DIFFERENT = "are clearly different"


def joined(
    first: Decision, second: Decision, agree: bool, least: float, prior: float | None = None
) -> tuple[Decision, bool]:
    """What is decided of a pair that has two answers: the surer one, and whether that is the second.

    Where they agree, the logit of the confidence is a linear function of the mean of theirs, each as it is for the mix
    of the fit: what a prior adds is added once. Else both cannot be right: with odds a and b it is a / (1 + a + b),
    never ok, and the other answer is the alternative. A cause that either names, of the same transform, stays.

    Args:
        first, second: found on different grids, with an answer each.
        agree: whether their transforms are not clearly different.
        least: confidence from which an answer is ok.
        prior: that both confidences were made with, see `confidence_score`.
    """
    said = Repeat(first.judgement.confidence, second.judgement.confidence, agree)
    taken = second.judgement.confidence > first.judgement.confidence
    best, other = (second, first) if taken else (first, second)
    ours, theirs = (logit(decision.judgement.confidence) for decision in (best, other))
    doubt = _named(best.judgement)
    if agree:
        fit, added = expert().repeat, prior_logit(prior)
        strength = fit.offset + fit.slope * ((ours + theirs) / 2 - added) + added
        confidence = 1 / (1 + np.exp(-strength))
        if doubt is None and (doubt := _named(other.judgement)) is not None:  # of the same transform
            best = replace(best, alternative=other.alternative, lead=other.lead)
    else:
        confidence = np.exp(ours) / (1 + np.exp(ours) + np.exp(theirs))
        confidence = min(confidence, expert().confidence.most_doubted)
        if doubt is not None:  # of a rival that stays the alternative
            doubt = replace(doubt, reasons=(*doubt.reasons, f"{_TWICE} {_DIFFERENT}"))
        elif best.answer is not None and other.answer is not None:
            lead = lead_over(best.answer.score, other.answer.score)
            best = replace(best, alternative=other.answer, lead=lead)
    if doubt is not None:
        limits = expert().confidence
        slides = doubt.confidence <= limits.most_sliding
        most = doubt.confidence if slides else limits.most_doubted
        judgement = replace(doubt, confidence=min(float(confidence), most))
    else:
        judgement = _judged(best.judgement, float(confidence), agree, least)
    return replace(best, judgement=judgement, repeat=said), taken


def _named(judgement: Judgement) -> Judgement | None:
    """A judgement that names a cause for its doubt, else None."""
    return None if judgement.status == "ok" or judgement.unspecific is not None else judgement


def _judged(was: Judgement, confidence: float, agree: bool, least: float) -> Judgement:
    """A judgement that names no cause for doubt, with the confidence of both answers."""
    reasons = tuple(reason for reason in was.reasons if reason != was.unspecific)
    if agree and confidence >= least:
        return Judgement("ok", reasons, confidence)
    low = f"{_TWICE} {_DIFFERENT} (see the alternative)"
    if agree:
        low = f"{_TWICE} agree; confidence {said_below(confidence, least)} is below {least:.2f}"
    return Judgement("low_confidence", (*reasons, low), confidence, low)


def logit(confidence: float) -> float:
    """Logarithm of the odds, of a confidence that is neither 0 nor 1 to the last digits."""
    bounded = float(np.clip(confidence, 1e-6, 1 - 1e-6))
    return float(np.log(bounded / (1 - bounded)))
