"""How sure: status, reasons and confidence from the evidence, and the information of the fit.

Place: decide, the last step. The confidence is P(the answer is right), a logistic function of the evidence of
the clouds, its lead over the best clearly different motion, the overlap, how firmly the shared surface holds
the source and its sensor, and the share of correspondences that agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomoe3d.config import DecisionConfig
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.geometry.se3 import cross_matrix, transform_points
from geomoe3d.result import Status
from geomoe3d.scoring.network import opinion_of
from geomoe3d.scoring.surfaces import Evidence, evidence_of
from geomoe3d.types import FloatArray, Hypothesis, PreparedCloud

# Fitted by scripts/fit_confidence.py on generated rooms that the network was not trained on and a recorded
# one, mixed by overlap as the benchmarks are, and on unrelated pairs: 300 and 150 pairs, each with one look
# and with two; docs/measurements.md holds what came of it on real scans.
# Offset and slopes by (heard a network, asked free space). Where it is not known what must be empty, the same
# evidence is worth less; without a network a clear lead makes up for it. The first offset is 0.3 lower than fitted:
# since then what refines to the answer itself is no rival any more, and leads are longer.
_COEFFICIENTS = {
    (True, True): (-1.433, np.array([0.954, 0.998, -3.072, 0.794, -2.45, 0.658, -74.012])),
    (False, True): (-1.216, np.array([0.888, 2.244, -3.972, 0.435, -3.014, 1.249, -74.871])),
    (True, False): (-7.984, np.array([1.953, 1.534, -4.965, 0.444, -2.722, 0.169, 0.0])),
    (False, False): (-1.976, np.array([1.813, 3.895, -5.902, 1.117, -2.994, 1.447, 0.0])),
}
FITTED_PRIOR = 0.88  # 300 related pairs, and 160 unrelated ones that count a quarter each
_LEAST_SCORE, _LEAST_SUPPORT, _LEAST_OVERLAP, _ADDED_OBSERVABILITY = 1e-3, 0.002, 0.01, 1e-3
_LEAST_LOOSENESS, _MOST_LOOSENESS = 0.02, 10.0
_LOOSEST = 1000.0
_ASKED = 200  # points of a scan of unknown sensor whose deviation is asked for
MOST_LEAD = 30.0
_MOST_VIOLATION = 0.1
UNRIVALLED_LEAD = 3.0
_LIKELY = 0.5
_CLOSE_VERDICTS = 5.0  # of two places that are both right the network has preferred one by up to 3
_LEAST_OBSERVABILITY = 0.005
# Where one sensor is laid on the other its rings and its range gate lie on themselves, and what a corridor leaves open
# seems held: 0.007 to 0.014 there. Of right answers with coinciding sensors, 23 real pairs, the least was 0.042.
_COINCIDING, _LEAST_OBSERVABILITY_COINCIDING = 3.0, 0.03
_LEAST_AGREEING, _LEAST_MATCHED = 6, 30  # right answers called ok on real scans: at least 12 and 120
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
        looseness: standard deviation of where the motion puts the source's sensor, in voxels, if the gaps
            between the surfaces were independent from point to point; where no place is known or guessed, of
            the most loosely held twentieth of its points. They are not independent, so it tells a loose fit
            from a firm one and is no error bar. Of the source alone, so exchanging the scans may change it.
            At most 1000, which is also what stands for fewer than 6 points.
        sensors_known: whether both sensors' places are known or guessed, so that free space could be asked.
        sensors_apart: distance of the two sensors under the motion, in voxels, see `_sensors_apart`; infinite where
            nothing is known of them.
    """

    matrix: FloatArray
    center: FloatArray
    observability: float
    num_matched: int
    looseness: float = _LOOSEST
    sensors_known: bool = False
    sensors_apart: float = np.inf

    @property
    def least_observability(self) -> float:
        """What the observability must reach: more where the motion lays sensor on sensor."""
        coincide = self.sensors_apart < _COINCIDING
        return _LEAST_OBSERVABILITY_COINCIDING if coincide else _LEAST_OBSERVABILITY


def measure_information(
    T_target_source: FloatArray, source: PreparedCloud, target: PreparedCloud, threshold: float
) -> Information:
    """Point-to-plane information of a motion over source points within ``threshold`` of the target.

    Returns NaN matrices, observability 0 and looseness 1000 for fewer than 6 matched points.
    """
    from scipy.spatial import cKDTree

    known = source.viewpoint is not None and target.viewpoint is not None
    moved = transform_points(T_target_source, source.points)
    distance, nearest = cKDTree(target.points).query(moved, distance_upper_bound=threshold)
    distance, nearest = np.asarray(distance), np.asarray(nearest)
    hit = np.isfinite(distance)
    if hit.sum() < 6:
        return Information(np.full((6, 6), np.nan), np.full(3, np.nan), 0.0, int(hit.sum()), _LOOSEST, known)
    points, normals = moved[hit], target.normals[nearest[hit]]
    gaps = np.einsum("ij,ij->i", points - target.points[nearest[hit]], normals)
    center = points.mean(0)
    J = np.hstack([np.cross(points - center, normals), normals])
    # Points on one voxel grid cannot be trusted below a tenth of its edge.
    variance = max(float(np.mean(gaps**2)), (0.1 * source.voxel_size) ** 2)
    radius = float(np.sqrt(np.mean(np.sum((points - center) ** 2, axis=1))))
    scaled = J / np.array([radius] * 3 + [1.0] * 3)
    smallest = float(np.linalg.eigvalsh(scaled.T @ scaled / len(points))[0])
    matrix = J.T @ J / variance
    places = source.points[drawn_rows(source.points, source.voxel_size, _ASKED)]
    if source.viewpoint is not None:
        places = source.viewpoint[None]
    deviations = deviations_at(matrix, center, transform_points(T_target_source, places)) / source.voxel_size
    looseness = float(np.quantile(np.minimum(deviations, _LOOSEST), 0.95))
    apart = _sensors_apart(T_target_source, source, target)
    return Information(matrix, center, max(smallest, 0.0), int(hit.sum()), looseness, known, apart)


def _sensors_apart(T_target_source: FloatArray, source: PreparedCloud, target: PreparedCloud) -> float:
    """Distance in voxels of the sensors under a motion, or, if less, of the files' origins where both lie amid their
    clouds: a spinning sensor stood there, though the cloud may look as if it had been moved there."""
    if not (source.scanned and target.scanned):
        return np.inf
    origins = [-cloud.origin for cloud in (source, target)]
    places = [(source.viewpoint, target.viewpoint)]
    if all(
        ((cloud.points.min(0) <= at) & (at <= cloud.points.max(0))).all()
        for cloud, at in zip((source, target), origins, strict=True)
    ):
        places.append((origins[0], origins[1]))
    gaps = [
        float(np.linalg.norm(transform_points(T_target_source, one[None])[0] - other))
        for one, other in places
        if one is not None and other is not None
    ]
    return min(gaps, default=np.inf) / source.voxel_size


def deviations_at(matrix: FloatArray, center: FloatArray, points: FloatArray) -> FloatArray:
    """Standard deviations (n,) of where a motion puts points (n, 3), by its information about ``center``.

    inf where the matrix holds nothing at all.
    """
    turning, shifting = np.trace(matrix[:3, :3]), np.trace(matrix[3:, 3:])
    if not shifting > 0:
        return np.full(len(points), np.inf)
    # With lengths over the radius of what is shared, what is next to nothing does not depend on the unit.
    scale = np.array([max(np.sqrt(turning / shifting), 1e-12)] * 3 + [1.0] * 3)
    scaled = matrix / np.outer(scale, scale)
    # Never singular: what nothing holds may be anywhere.
    covariance = np.linalg.inv(scaled + 1e-12 * np.trace(scaled) * np.eye(6))
    # p + w x (p - c) + v
    J = np.array([np.hstack([-cross_matrix(point - center), np.eye(3)]) for point in points]) / scale
    variance = np.einsum("nij,jk,nik->n", J, covariance, J)
    deviations: FloatArray = np.sqrt(np.maximum(variance, 0.0))
    return deviations


def judge(
    answer: Hypothesis,
    rival: Hypothesis | None,
    lead: float,
    support: float,
    information: Information,
    config: DecisionConfig,
    num_matches: int | None = None,
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

    Returns:
        ``ambiguous`` where the surfaces let the source slide, or where the answer would be likely but another
        motion is about as good; ``low_confidence`` below the threshold or where next to nothing agrees; else
        ``ok``.
    """
    evidence, heard = evidence_of(answer), opinion_of(answer) is not None
    confidence = confidence_score(evidence, lead, support, information, heard=heard, prior=config.prior)
    notes = []
    if evidence.overlap < _LOW_OVERLAP:
        notes.append(f"the scans share little surface: overlap {100 * evidence.overlap:.0f} %")
    if evidence.free_space_violation > 0.1:
        notes.append(
            "parts lie where the other scan's sensor saw free space "
            f"(rate {evidence.free_space_violation:.2f})"
        )
    if information.observability < information.least_observability:
        slides = (
            "the shared surface lets the source slide or turn along itself "
            f"(observability {information.observability:.4f}, needs {information.least_observability}): it is too "
            "plain, like a single plane, a cylinder or a corridor"
        )
        if information.observability >= _LEAST_OBSERVABILITY:
            slides += "; the sensors lie on each other, so what matches may be their own pattern"
        notes.insert(0, slides)
        return Judgement("ambiguous", tuple(notes), min(confidence, 0.3))
    # Without a rival it would be likely, by the clouds alone: the network doubts what it has seen no like of.
    alone = confidence_score(evidence, UNRIVALLED_LEAD, support, information, prior=config.prior)
    # What the clouds like alike is ambiguous unless the network makes the answer sure: by how much it prefers one
    # hangs on which correspondences it saw.
    alike = (
        rival is not None
        and evidence_of(rival).surface_score >= config.ambiguity_ratio * evidence.surface_score
    )
    unsure = confidence < config.min_confidence or _hardly_told_apart(answer, rival)
    close = lead < 1 / config.ambiguity_ratio or (alike and unsure)
    if close and alone >= _LIKELY:
        notes.append(
            f"a clearly different transform does {min(100 / lead, 100):.0f} % as well; see the alternative, "
            "the scans may show repeated or symmetric structure"
        )
        return Judgement("ambiguous", tuple(notes), min(confidence, 0.5))
    few = _too_few(support, num_matches, information)
    if few is not None:
        return Judgement("low_confidence", (few, *notes), min(confidence, 0.5))
    if confidence < config.min_confidence:
        notes.append(
            f"confidence {confidence:.2f} is below {config.min_confidence:.2f}: the scans may not overlap, "
            "or share too little distinctive surface"
        )
        return Judgement("low_confidence", tuple(notes), confidence)
    return Judgement("ok", tuple(notes), confidence)


def _too_few(support: float, num_matches: int | None, information: Information) -> str | None:
    """A sentence where less agrees than can carry an answer, whatever the confidence says."""
    if information.num_matched < _LEAST_MATCHED:
        return (
            f"too few points: {information.num_matched} points of the grid lie on each other, at least "
            f"{_LEAST_MATCHED} are needed"
        )
    if num_matches is None:
        return None
    agreeing, needed = round(support * num_matches), min(_LEAST_AGREEING, -(-num_matches // 2))
    if agreeing >= needed:
        return None
    return f"too few matches agree with the answer: {agreeing} of {num_matches}, at least {needed} are needed"


def _hardly_told_apart(answer: Hypothesis, rival: Hypothesis | None) -> bool:
    """Whether the network's verdicts on both lie close together."""
    said, other = opinion_of(answer), opinion_of(rival)
    return said is not None and other is not None and abs(said.verdict - other.verdict) < _CLOSE_VERDICTS


def lead_over(score: float, other: float | None) -> float:
    """Score of the answer over that of the best clearly different hypothesis.

    inf where the other scores nothing; 3 where no different one was proposed at all (None), since an answer
    without a rival has not beaten one; 1 where the answer scores nothing.
    """
    if score <= 0:
        return 1.0
    if other is None:
        return UNRIVALLED_LEAD
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
    return np.append(
        np.log(
            [
                max(evidence.surface_score, _LEAST_SCORE),
                min(max(lead, 0.5), MOST_LEAD),
                evidence.overlap + _LEAST_OVERLAP,
                information.observability + _ADDED_OBSERVABILITY,
                min(max(information.looseness, _LEAST_LOOSENESS), _MOST_LOOSENESS),
                support + _LEAST_SUPPORT,
            ]
        ),
        min(evidence.free_space_violation, _MOST_VIOLATION),
    )


def confidence_score(
    evidence: Evidence,
    lead: float,
    support: float,
    information: Information,
    *,
    heard: bool = False,
    prior: float | None = None,
) -> float:
    """P(the answer is right) in [0, 1], a logistic function of `confidence_inputs`; 0 without evidence.

    ``heard``: whether a network was asked about the answer; ``prior``: P(a pair overlaps) before it is looked at, None
    for that of the mix that the coefficients were fitted on; see `judge` for the other arguments.

    Source of the prior: Bayes' rule, which adds to the logit what the prior's differs by.
    """
    if evidence.surface_score <= 0:
        return 0.0
    offset, slopes = _COEFFICIENTS[heard, information.sensors_known]
    strength = offset + confidence_inputs(evidence, lead, support, information) @ slopes
    if prior is not None:
        strength += np.log(prior / (1 - prior)) - np.log(FITTED_PRIOR / (1 - FITTED_PRIOR))
    return float(1 / (1 + np.exp(-np.clip(strength, -50, 50))))
