"""How sure: status, reasons and confidence from the evidence, and the information of the fit.

Place: judge, the last step. The confidence is P(the answer is right), a logistic function of the evidence of
the clouds, its lead over the best clearly different motion, the overlap, how firmly the shared surface holds
the source, and the verdict of the network, or the share of correspondences that agree where there is none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomoe3d.config import JudgementConfig
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.result import Status
from geomoe3d.types import FloatArray, PreparedCloud
from geomoe3d.verification import MOST_VERDICT, Evidence

# Fitted by scripts/fit_confidence.py on generated rooms that the network was not trained on and a recorded
# one, mixed by overlap as the benchmarks are, and on unrelated pairs: 300 and 150 pairs, each with one look
# and with two; docs/measurements.md holds what came of it on real scans.
_OFFSET = 8.763
_SLOPES = np.array([1.245, 0.847, -1.49, 0.941, -76.562, 1.253])
_OFFSET_WITH_VERDICT = 1.323
_SLOPES_WITH_VERDICT = np.array([1.315, 0.543, -2.034, 0.642, -45.163, 0.638])
_LEAST_SCORE, _LEAST_SUPPORT, _LEAST_OVERLAP, _ADDED_OBSERVABILITY = 1e-3, 0.002, 0.01, 1e-3
_MOST_LEAD = 30.0
_MOST_VIOLATION = 0.1
UNRIVALLED_LEAD = 3.0
_LIKELY = 0.5
_CLOSE_VERDICTS = 2.0  # odds of seven to one
_LEAST_OBSERVABILITY = 0.005
_LOW_OVERLAP = 0.1


@dataclass(frozen=True)
class Judgement:
    """Status with its reasons, sentences, and the confidence in [0, 1]."""

    status: Status
    reasons: tuple[str, ...]
    confidence: float


@dataclass(frozen=True)
class Information:
    """How firmly the overlapping surfaces hold the motion.

    Attributes:
        matrix: (6, 6) sum of J^T J / variance, J = [(x - c) x n, n] per matched point: order [rotation
            (rad), translation], target axes, about ``center``; 1 / cloud unit^2 where it applies.
        center: (3,) centroid c of the matched points, target local coordinates.
        observability: smallest eigenvalue of the same sum per point with lengths divided by the root mean
            square radius; 1/3 would be held equally from all sides, 0 means that the source can slide.
        num_matched: matched points.
    """

    matrix: FloatArray
    center: FloatArray
    observability: float
    num_matched: int


def measure_information(
    T_target_source: FloatArray, source: PreparedCloud, target: PreparedCloud, threshold: float
) -> Information:
    """Point-to-plane information of a motion over source points within ``threshold`` of the target.

    Returns NaN matrices and observability 0 for fewer than 6 matched points.
    """
    from scipy.spatial import cKDTree

    moved = transform_points(T_target_source, source.points)
    distance, nearest = cKDTree(target.points).query(moved, distance_upper_bound=threshold)
    distance, nearest = np.asarray(distance), np.asarray(nearest)
    hit = np.isfinite(distance)
    if hit.sum() < 6:
        return Information(np.full((6, 6), np.nan), np.full(3, np.nan), 0.0, int(hit.sum()))
    points, normals = moved[hit], target.normals[nearest[hit]]
    gaps = np.einsum("ij,ij->i", points - target.points[nearest[hit]], normals)
    center = points.mean(0)
    J = np.hstack([np.cross(points - center, normals), normals])
    # Points on one voxel grid cannot be trusted below a tenth of its edge.
    variance = max(float(np.mean(gaps**2)), (0.1 * source.voxel_size) ** 2)
    radius = float(np.sqrt(np.mean(np.sum((points - center) ** 2, axis=1))))
    scaled = J / np.array([radius] * 3 + [1.0] * 3)
    smallest = float(np.linalg.eigvalsh(scaled.T @ scaled / len(points))[0])
    return Information(J.T @ J / variance, center, max(smallest, 0.0), int(hit.sum()))


def judge(
    evidence: Evidence,
    lead: float,
    support: float,
    information: Information,
    config: JudgementConfig,
    rival: Evidence | None = None,
) -> Judgement:
    """Decide whether an answer may be believed.

    Args:
        evidence: of the answer, after refinement.
        lead: as `lead_over` gives it.
        support: share of the correspondences that agree with the answer.
        information: of the answer.
        config: thresholds.
        rival: of the best clearly different motion, if there is one.

    Returns:
        ``ambiguous`` where the surfaces let the source slide, or where the answer would be likely but another
        motion is about as good; ``low_confidence`` below the threshold; else ``ok``.
    """
    confidence = confidence_score(evidence, lead, support, information.observability)
    notes = []
    if evidence.overlap < _LOW_OVERLAP:
        notes.append(f"the scans share little surface: overlap {100 * evidence.overlap:.0f} %")
    if evidence.free_space_violation > 0.1:
        notes.append(
            "parts lie where the other scan's sensor saw free space "
            f"(rate {evidence.free_space_violation:.2f})"
        )
    if information.observability < _LEAST_OBSERVABILITY:
        notes.append(
            "the shared surface lets the source slide or turn along itself "
            f"(observability {information.observability:.4f}, needs {_LEAST_OBSERVABILITY}): it is too "
            "plain, like a single plane or cylinder"
        )
        return Judgement("ambiguous", tuple(notes), min(confidence, 0.3))
    # Without a rival it would be likely, by the clouds alone: the network doubts what it has seen no like of.
    alone = confidence_score(evidence.by_clouds(), UNRIVALLED_LEAD, support, information.observability)
    close = lead < 1 / config.ambiguity_ratio or _hardly_told_apart(evidence, rival, config.ambiguity_ratio)
    if close and alone >= _LIKELY:
        notes.append(
            f"a clearly different motion does {min(100 / lead, 100):.0f} % as well; see the alternative, "
            "the scans may show repeated or symmetric structure"
        )
        return Judgement("ambiguous", tuple(notes), min(confidence, 0.5))
    if confidence < config.min_confidence:
        notes.append(
            f"confidence {confidence:.2f} is below {config.min_confidence:.2f}: the scans may not overlap, "
            "or share too little distinctive surface"
        )
        return Judgement("low_confidence", tuple(notes), confidence)
    return Judgement("ok", tuple(notes), confidence)


def _hardly_told_apart(evidence: Evidence, rival: Evidence | None, ratio: float) -> bool:
    """Whether the clouds like both about as well and the network's verdicts lie close together."""
    if rival is None or evidence.verdict is None or rival.verdict is None:
        return False
    alike = rival.surface_score >= ratio * evidence.surface_score
    return alike and abs(evidence.verdict - rival.verdict) < _CLOSE_VERDICTS


def lead_over(evidence: Evidence, other: Evidence | None) -> float:
    """Score of the answer over that of the best clearly different motion.

    inf where the other scores nothing; 3 where no different motion was proposed at all, since an answer
    without a rival has not beaten one; 1 where neither scores.
    """
    if evidence.score <= 0:
        return 1.0
    if other is None:
        return UNRIVALLED_LEAD
    return evidence.score / other.score if other.score > 0 else float("inf")


CONFIDENCE_INPUTS = (
    "log evidence",
    "log lead",
    "log overlap",
    "log observability",
    "free-space violation",
    "log support",
)
"""What the confidence is made of without a network, in the order of `confidence_inputs`.

With one, its verdict stands in the place of the support, which the network sees itself."""


def confidence_inputs(evidence: Evidence, lead: float, support: float, observability: float) -> FloatArray:
    """(6,) natural logarithms, bounded below and the lead above too; see `judge` for the arguments.

    More overlap at equal evidence is a bad sign: it is evidence by chance that grows with it. A surface that
    hardly holds the source is one: the answer may have slid off along it. The violation enters as it is,
    bounded, beside its part in the evidence, which choosing needs but which is not all that it says of the
    answer. The last entry is the verdict of the network, bounded, where there is one, and the logarithm of
    the support where not.
    """
    shared = np.log(
        [
            max(evidence.surface_score, _LEAST_SCORE),
            min(max(lead, 0.5), _MOST_LEAD),
            evidence.overlap + _LEAST_OVERLAP,
            observability + _ADDED_OBSERVABILITY,
        ]
    )
    shared = np.append(shared, min(evidence.free_space_violation, _MOST_VIOLATION))
    if evidence.verdict is None:
        return np.append(shared, np.log(support + _LEAST_SUPPORT))
    return np.append(shared, np.clip(evidence.verdict, -MOST_VERDICT, MOST_VERDICT))


def confidence_score(evidence: Evidence, lead: float, support: float, observability: float) -> float:
    """P(the answer is right) in [0, 1], a logistic function of `confidence_inputs`; 0 without evidence."""
    if evidence.score <= 0:
        return 0.0
    offset, slopes = _OFFSET, _SLOPES
    if evidence.verdict is not None:
        offset, slopes = _OFFSET_WITH_VERDICT, _SLOPES_WITH_VERDICT
    strength = offset + confidence_inputs(evidence, lead, support, observability) @ slopes
    return float(1 / (1 + np.exp(-np.clip(strength, -50, 50))))
