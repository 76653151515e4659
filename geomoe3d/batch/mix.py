"""How many pairs of a batch belong together, by their confidences, and what each is worth beside the others.

The confidence of a pair alone is for a mix in which nine of ten overlap. Where all pairs of many scans are asked, few
do: wrong answers are then as many as right ones of the same evidence, and each must be believed less. Answers are only
made less sure here, never surer.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from geomoe3d.config import RegistrationConfig, expert
from geomoe3d.decision.confidence import prior_logit, said_below
from geomoe3d.decision.repeat import logit
from geomoe3d.decision.scale import UNITS_DIFFER
from geomoe3d.runtime.words import of_all
from geomoe3d.types import FloatArray

Record = dict[str, Any]
ALONE = "confidence_alone"
"""Evidence that holds what the confidence was before."""


def shared_out(
    records: Iterable[Record], config: RegistrationConfig
) -> tuple[dict[str, Record], float | None]:
    """Records by id, their confidences and statuses for the mix of the batch, and the share of right answers that
    these confidences amount to; None, and nothing is changed, where a prior is configured, where there is one answer
    only, or where the share is no lower than in the fit.

    A confidence p becomes the logistic function of logit(p) + logit(prior) - logit(fitted prior), the prior that of
    `share_that_belongs`. An answer that was ok and falls below ``decision.min_confidence`` is low_confidence, and
    gives that as its first reason. What a rule held down, as of a pair that slides along itself or whose units differ,
    does not count: it says nothing of whether the pair belongs together.

    Args:
        records: as the journal keeps them; left as they are.
        config: that they were made with.
    """
    records = list(records)
    unchanged = {record["id"]: record for record in records}
    results = [record["result"] for record in records if record["result"] is not None]
    found = [
        result
        for result in results
        if not held_down(result["confidence"], result["reasons"], result["evidence"])
    ]
    if config.decision.prior is not None or len(results) < 2 or not found:
        return unchanged, None
    alone = np.array([result["confidence"] for result in found])
    added = prior_logit(share_that_belongs(alone))
    if added >= 0:
        return unchanged, None
    share = float(np.mean([beside_others(value, added) for value in np.sort(alone)]))
    least = config.decision.min_confidence
    return {name: _less_sure(record, added, share, least) for name, record in unchanged.items()}, share


def share_that_belongs(confidences: FloatArray) -> float:
    """The share of pairs whose answers are right, of confidences (n,) that each is for the mix of the fit.

    As if `mix_pairs` more had been asked of that mix, so that few pairs say little. To the last digit the same in any
    order, since pairs are finished in any.

    Source: Saerens et al., Neural Computation 2002 (expectation maximisation of prior probabilities).
    """
    known, fitted = expert().confidence.mix_pairs, expert().confidence.fitted_prior
    alone = np.array([logit(value) for value in np.sort(confidences)])
    share, before = fitted, 0.0
    while abs(share - before) > 1e-6:
        before = share
        right = 1 / (1 + np.exp(-alone - prior_logit(share)))
        share = float((right.sum() + known * fitted) / (len(right) + known))
    return share


def beside_others(alone: float, added: float) -> float:
    """A confidence where the prior adds so much to its logit (`prior_logit`), never above what it was alone."""
    return min(alone, float(1 / (1 + np.exp(-logit(alone) - added))))


def held_down(confidence: float, reasons: Sequence[str], evidence: Mapping[str, float]) -> bool:
    """Whether a rule decided a confidence, or one of the two that it was made of, and not what the clouds show;
    arguments as in the result."""
    if any(reason.startswith(UNITS_DIFFER) for reason in reasons):
        return True
    limits = expert().confidence
    most = {limits.most_sliding, limits.most_doubted, expert().causes.most_doubted}
    return not most.isdisjoint(
        (confidence, evidence.get("confidence_first"), evidence.get("confidence_second"))
    )


def _less_sure(record: Record, added: float, share: float, least: float) -> Record:
    result = record["result"]
    if result is None:
        return record
    alone = result["confidence"]
    confidence = beside_others(alone, added)
    evidence = {**result["evidence"], ALONE: alone}
    result = {**result, "confidence": confidence, "evidence": evidence}
    if result["status"] == "ok" and confidence < least:
        reason = (
            f"only {of_all(share)} of the pairs of this batch seem to belong together; among so many others the "
            f"confidence is {said_below(confidence, least)} ({alone:.3f} by itself), below {least:.2f}"
        )
        result |= {"status": "low_confidence", "reasons": [reason, *result["reasons"]]}
    return {**record, "result": result}
