"""Clouds of unknown scale: the ratio of their lengths is tried out, and the similarity p_target = s R p_source + t.

Place: around the whole line, which is rigid. The ratio of the extents says about how large one cloud is beside the
other; rungs of a ladder about it, the likeliest first, are taken for true, and each time the source is brought to
that size and registered. Registration bears an error of a fifth in scale, and where it has found the place the
surfaces give the ratio (`geomoe3d.decision.scale`): the source is brought to that size, and all is done again. The
first answer that is ok, its scale checked as that of any rigid answer is, ends the ladder. Surfaces lie on each other
at wrong scales too, so its neighbours are asked until neither scores higher. A pair costs four to six registrations
where the extents say about the truth, some twenty where no rung leads to an answer. The more rungs were tried, the
less the confidence of one is worth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from geomoe3d.clouds.voxel_size import robust_extent
from geomoe3d.config import DecisionConfig, RegistrationConfig, expert
from geomoe3d.decision.answer import failed_result
from geomoe3d.decision.confidence import said_below
from geomoe3d.decision.explanation import Explanation
from geomoe3d.decision.scale import DIFFERS, seeming_units, told_apart
from geomoe3d.result import RegistrationResult
from geomoe3d.runtime.timing import Progress, StageClock
from geomoe3d.types import FloatArray, PointCloud

Attempt = Callable[[float, bool], Explanation]
"""The source with its lengths divided by a ratio, on the target; True: with all looks at a doubtful pair."""

Explain = Callable[..., Explanation]
"""`Registrar.explain`."""


def explain_similarity(
    clouds: tuple[PointCloud, PointCloud],
    rows: FloatArray | None,
    config: RegistrationConfig,
    quick: Explain,
    thorough: Explain,
    clock: StageClock,
    progress: Progress | None,
) -> Explanation:
    """The similarity of two clouds, with what led to it, by rigid answers at many ratios.

    Args:
        clouds: source and target as loaded.
        rows: (N, 6) a user's own matches, file coordinates, or None.
        config: that the result says it was made with.
        quick, thorough: rigid registration with one look, and with all.
        clock: told of the stages.
        progress: told of those of every registration.
    """

    def attempt(ratio: float, thoroughly: bool) -> Explanation:
        clock("scale")
        shrunk = None if rows is None else rows / ([ratio] * 3 + [1.0] * 3)
        smaller = scaled_cloud(clouds[0], 1 / ratio)
        explain = thorough if thoroughly else quick
        return explain(smaller, clouds[1], correspondences=shrunk, progress=progress)

    best = find_similarity(*clouds, attempt)
    if best is None:
        extents = [robust_extent(cloud.points) for cloud in clouds]
        reason = (
            f"the extents of '{clouds[0].name}' and '{clouds[1].name}' are {extents[0]:.4g} and {extents[1]:.4g}; "
            "a scale between 1/1000 and 1000 is sought, so bring them nearer to one unit first"
        )
        return Explanation(failed_result(clouds, reason, config, clock.stop()), *clouds)
    found, ratio = best
    whole = clock.stop()
    stages = {name: time for name, time in found.result.seconds.items() if name not in whole} | whole
    result = replace(found.result, config=config.model_dump(mode="json"), seconds=stages)
    return as_similarity(found, ratio, clouds[0], result)


def find_similarity(
    source: PointCloud, target: PointCloud, attempt: Attempt
) -> tuple[Explanation, float] | None:
    """The best answer over all ratios of lengths, and its ratio, source over target.

    Args:
        source, target: as loaded.
        attempt: registers the source at a ratio.

    Returns:
        None where the extents differ by much more than 1000.
    """
    tried: list[tuple[Explanation, float]] = []
    settled: list[tuple[Explanation, float]] = []
    ratios = likely_ratios(source, target)
    if not ratios:
        return None
    for ratio in ratios:
        found = attempt(ratio, False)
        tried.append((found, ratio))
        if found.result.confidence >= expert().similarity.promising:
            settled.append(_settle(found, ratio, attempt))
            if _one_of_many(settled[-1][0], len(tried)).result.ok:
                best, at = _climb(*settled[-1], attempt)
                return _one_of_many(best, len(tried)), at
    settled += tried
    settled.sort(key=_surest)
    for _, ratio in _distinct(settled)[: expert().similarity.most_thorough]:
        settled.append(_settle(attempt(ratio, True), ratio, attempt, thorough=True))
    best, at = min(settled, key=_surest)
    return _one_of_many(best, len(tried)), at


def _surest(one: tuple[Explanation, float]) -> tuple[bool, float]:
    """Sorts by ok and confidence, the surest first."""
    return not one[0].result.ok, -one[0].result.confidence


def _distinct(ranked: list[tuple[Explanation, float]]) -> list[tuple[Explanation, float]]:
    """Those whose ratio is not about that of one before."""
    kept: list[tuple[Explanation, float]] = []
    for one in ranked:
        if all(abs(np.log(one[1] / other[1])) > expert().similarity.same for other in kept):
            kept.append(one)
    return kept


def _one_of_many(found: Explanation, num_tried: int) -> Explanation:
    """An answer with the confidence that is left where several ratios were tried, each with a chance to look right.

    The odds are divided by one more than their number; what then falls below the limit of ok is not ok.
    """
    result = found.result
    odds = result.confidence / max(1 - result.confidence, 1e-12) / (1 + num_tried)
    confidence = odds / (1 + odds)
    least = result.config.get("decision", {}).get("min_confidence", DecisionConfig().min_confidence)
    if not result.ok or confidence >= least:
        return replace(found, result=replace(result, confidence=confidence))
    reason = (
        f"confidence {said_below(confidence, least)} is below {least:.2f}: {num_tried} scales were tried before one "
        "fitted, and each may look right by chance"
    )
    doubted = replace(
        result, confidence=confidence, status="low_confidence", reasons=(reason, *result.reasons)
    )
    return replace(found, result=doubted)


def likely_ratios(source: PointCloud, target: PointCloud) -> list[float]:
    """Ratios of lengths, source over target, the nearest to that of the extents first; from 1/1000 to 1000."""
    middle = robust_extent(source.points) / robust_extent(target.points)
    known = expert().similarity
    ratios = [middle * known.step**rung for rung in sorted(range(-known.rungs, known.rungs + 1), key=abs)]
    return [ratio for ratio in ratios if 1 / known.largest <= ratio <= known.largest]


def _settle(
    found: Explanation, ratio: float, attempt: Attempt, *, thorough: bool = False
) -> tuple[Explanation, float]:
    """The same place registered anew at the ratio that its surfaces give, until that stays; the surest of these.

    ``thorough``: at most once, with all looks.
    """
    best, at, known = found, ratio, expert().similarity
    for _ in range(1 if thorough else known.most_settling):
        off = found.result.evidence.get("scale_ratio")
        if off is None or abs(np.log(off)) < known.settled:
            break
        ratio *= off
        found = attempt(ratio, thorough)
        if (found.result.ok, found.result.confidence) >= (best.result.ok, best.result.confidence):
            best, at = found, ratio
    return best, at


def _climb(best: Explanation, ratio: float, attempt: Attempt) -> tuple[Explanation, float]:
    """What scores higher than an answer at the neighbouring ratios, settled, and so on."""
    known = expert().similarity
    for _ in range(known.rungs):
        for side in (known.step, 1 / known.step):
            near = attempt(ratio * side, False)
            if _score(near) <= _score(best):
                continue
            other, at = _settle(near, ratio * side, attempt)
            if _score(other) > _score(best) and abs(np.log(at / ratio)) > expert().similarity.same:
                best, ratio = other, at
                break
        else:
            break
    return best, ratio


def _score(found: Explanation) -> float:
    return found.result.evidence.get("score", 0.0)


def scaled_cloud(cloud: PointCloud, factor: float) -> PointCloud:
    """The cloud with all its lengths times a factor."""
    sensor = None if cloud.sensor is None else factor * cloud.sensor
    return replace(cloud, points=factor * cloud.points, origin=factor * cloud.origin, sensor=sensor)


def as_similarity(
    found: Explanation, ratio: float, source: PointCloud, result: RegistrationResult
) -> Explanation:
    """What was found for the source with its lengths divided by ``ratio``, for the source as it is.

    Args:
        found: of the smaller or larger source.
        ratio: its lengths over those of the target.
        source: as loaded.
        result: ``found.result`` with what else differs.
    """
    other = result.alternative
    if other is not None:
        other = replace(other, T_target_source=_of_source(other.T_target_source, ratio))
    evidence = dict(result.evidence)
    if "scale_ratio" in evidence:
        evidence["scale_ratio"] = ratio
    reasons = list(result.reasons)
    for k, reason in enumerate(reasons):
        if reason.startswith(DIFFERS):  # of the ratio that was tried
            reasons[k] = f"no scale settles: at a scale of {1 / ratio:.4g} the surfaces ask for another"
    unit = seeming_units(ratio, told_apart(source.name, result.target.name, ratio)).removeprefix("; ")
    origin = float(source.origin[0]), float(source.origin[1]), float(source.origin[2])
    answer = replace(
        result,
        T_target_source=_of_source(result.T_target_source, ratio),
        scale=1 / ratio,
        alternative=other,
        evidence=evidence,
        reasons=(*reasons, *([unit] if unit and result.has_transform else [])),
        source=replace(result.source, origin=origin),
    )
    points = found.correspondences.points.copy()
    points[:, :3] *= ratio
    hypotheses = tuple(
        replace(h, T_target_source=_of_source(h.T_target_source, ratio)) for h in found.hypotheses
    )
    return replace(
        found,
        result=answer,
        source=source,
        correspondences=replace(found.correspondences, points=points),
        hypotheses=hypotheses,
    )


def _of_source(T: FloatArray, ratio: float) -> FloatArray:
    """A motion of the source with its lengths divided by ``ratio``, as a similarity of the source as it is."""
    similar: FloatArray = T.copy()
    similar[:3, :3] /= ratio
    return similar
