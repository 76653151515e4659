"""Clouds of unknown scale: the ratio of their lengths is tried out, and the similarity p_target = s R p_source + t.

Place: around the whole line, which is rigid. The ratio of the extents says about how large one cloud is beside the
other; rungs of a ladder about it, the likeliest first, are taken for true, and each time the source is brought to
that size and registered. Registration bears an error of a fifth in scale, and where it has found the place the
surfaces give the ratio (`geomoe3d.decision.scale`): the source is brought to that size, and all is done again. The
first answer that is ok, its scale checked as that of any rigid answer is, ends the ladder. Surfaces lie on each other
at wrong scales too, so its neighbours are asked until neither scores higher. A pair costs four to six registrations
where the extents say about the truth, some twenty where no rung leads to an answer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from geomoe3d.clouds.prepare import robust_extent
from geomoe3d.decision.explanation import Explanation
from geomoe3d.decision.scale import DIFFERS, seeming_units
from geomoe3d.result import RegistrationResult
from geomoe3d.types import FloatArray, PointCloud

Attempt = Callable[[float, bool], Explanation]
"""The source with its lengths divided by a ratio, on the target; True: with all looks at a doubtful pair."""

_STEP, _RUNGS = 1.2, 7  # from the ratio of extents up to 3.6 times more and less
_LARGEST = 1100.0  # that of two extents is no more than about right
_PROMISING = 0.3  # confidence from which surfaces are believed to say the ratio
_MOST_SETTLING, _SETTLED = 4, 0.002
_MOST_SETTLED = 3
_SAME = 0.02  # closer logarithms of ratios are those of one place


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
        if found.result.confidence >= _PROMISING:
            settled.append(_settle(found, ratio, attempt))
            if settled[-1][0].result.ok:
                return _climb(*settled[-1], attempt)
    tried.sort(key=lambda one: -one[0].result.confidence)
    settled += [_settle(*one, attempt, always=True) for one in tried[: _MOST_SETTLED - len(settled)]]
    return max(settled, key=lambda one: (one[0].result.ok, one[0].result.confidence))


def likely_ratios(source: PointCloud, target: PointCloud) -> list[float]:
    """Ratios of lengths, source over target, the nearest to that of the extents first; from 1/1000 to 1000."""
    middle = robust_extent(source.points) / robust_extent(target.points)
    ratios = [middle * _STEP**rung for rung in sorted(range(-_RUNGS, _RUNGS + 1), key=abs)]
    return [ratio for ratio in ratios if 1 / _LARGEST <= ratio <= _LARGEST]


def _settle(
    found: Explanation, ratio: float, attempt: Attempt, *, always: bool = False
) -> tuple[Explanation, float]:
    """The same place registered anew at the ratio that its surfaces give, until that stays; the surest of these.

    ``always``: once more even where the surfaces give none.
    """
    best, at = found, ratio
    for _ in range(_MOST_SETTLING):
        off = found.result.evidence.get("scale_ratio")
        if off is None and not always:
            break
        ratio, always = ratio * (off or 1.0), False
        found = attempt(ratio, True)
        if (found.result.ok, found.result.confidence) >= (best.result.ok, best.result.confidence):
            best, at = found, ratio
        if off is not None and abs(np.log(found.result.evidence.get("scale_ratio", 1.0))) < _SETTLED:
            break
    return best, at


def _climb(best: Explanation, ratio: float, attempt: Attempt) -> tuple[Explanation, float]:
    """What scores higher than an answer at the neighbouring ratios, settled, and so on."""
    for _ in range(_RUNGS):
        for side in (_STEP, 1 / _STEP):
            near = attempt(ratio * side, False)
            if _score(near) <= _score(best):
                continue
            other, at = _settle(near, ratio * side, attempt)
            if _score(other) > _score(best) and abs(np.log(at / ratio)) > _SAME:
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


def mirrored_cloud(cloud: PointCloud) -> PointCloud:
    """The cloud with x the other way round."""
    flip = np.array([-1.0, 1.0, 1.0])
    sensor = None if cloud.sensor is None else flip * cloud.sensor
    return replace(cloud, points=flip * cloud.points, origin=flip * cloud.origin, normals=None, sensor=sensor)


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
            reasons[k] = f"no scale settles: at {1 / ratio:.4g} the surfaces ask for another"
    unit = seeming_units(ratio).removeprefix("; ")
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
