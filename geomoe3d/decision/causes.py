"""What is wrong with a pair as a whole, found by one more look: units that differ, axes that are mirrored."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from geomoe3d.clouds.voxel_size import robust_extent, typical_spacing
from geomoe3d.config import expert
from geomoe3d.decision.answer import Decision
from geomoe3d.decision.confidence import Judgement
from geomoe3d.decision.scale import likely_unit_ratio, units_differ
from geomoe3d.decision.similarity import scaled_cloud
from geomoe3d.errors import EmptyCloudError
from geomoe3d.result import RegistrationResult
from geomoe3d.runtime.timing import StageClock
from geomoe3d.scoring.surfaces import evidence_of
from geomoe3d.types import PointCloud

MIRRORED = "mirrored"

Register = Callable[[PointCloud, PointCloud], RegistrationResult]
"""Registers two clouds at the scale that they have."""


def differing_units(
    clouds: tuple[PointCloud, PointCloud], register: Register, clock: StageClock
) -> str | None:
    """A sentence where the clouds fit once the source is brought to the unit that the extents suggest, else None.

    Nothing is registered unless the extents differ by about the ratio of two units.
    """
    source, target = clouds
    ratio = likely_unit_ratio((robust_extent(source.points), robust_extent(target.points)))
    if ratio is None:
        return None
    clock("units")
    try:
        fits = register(scaled_cloud(source, 1 / ratio), target).ok
    except EmptyCloudError:  # next to nothing is left of it on the grid that was asked for
        return None
    if not fits:
        return None
    return units_differ(ratio, source.name, target.name)  # not roles, which may be exchanged here


def look_like_one_scene(clouds: tuple[PointCloud, PointCloud]) -> bool:
    """Whether one cloud may be the other in another unit: its points lie as much farther apart as it is larger, which
    those of a map, of about the same spacing as a scan in it, do not."""
    sizes = [(robust_extent(cloud.points), typical_spacing(cloud.points)) for cloud in clouds]
    (extent, spacing), (other, others_spacing) = sizes
    if min(extent, spacing, other, others_spacing) <= 0:
        return False
    off = np.log((other / extent) / (others_spacing / spacing))
    return bool(abs(off) < np.log(expert().scale.extent_tolerance))


def is_sure(judgement: Judgement) -> bool:
    """Whether an answer is so sure that nothing is asked about mirrored axes."""
    return judgement.status == "ok" and judgement.confidence > expert().causes.sure


def mirrored_axes(
    decision: Decision,
    name: str,
    agreeing: Callable[[], float],
    look: Callable[[], Decision],
    clock: StageClock,
) -> str | None:
    """A sentence where the clouds fit clearly better once the source is mirrored, else None.

    Args:
        decision: about the clouds as they are.
        name: of the source.
        agreeing: which share of matches of the mirrored source the best of a few motions brings together.
        look: decides about the mirrored source; asked only where that share is more than chance gives.
        clock: told of the stage.
    """
    known = expert().causes
    clock("mirrored")
    if agreeing() < known.mirrored_support:
        return None
    found = look()
    if found.judgement.status != "ok" or found.answer is None:
        return None
    if decision.answer is not None:
        # Of furniture that repeats, mirrored, the network may be far surer than of the answer: the clouds must be too.
        scores = [(h.score, evidence_of(h).surface_score) for h in (found.answer, decision.answer)]
        (score, surfaces), (least, least_surfaces) = scores
        if score < known.mirrored_lead * least or surfaces < known.mirrored_surfaces * least_surfaces:
            return None
    return (
        f"{MIRRORED}: with x of '{name}' the other way round the clouds fit clearly better; if one of "
        "them has left-handed axes (often two are exchanged), bring both to right-handed ones, since a rigid transform "
        "cannot mirror"
    )
