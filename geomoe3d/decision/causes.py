"""What is wrong with a pair as a whole, found by one more registration: units that differ, axes that are mirrored."""

from __future__ import annotations

from collections.abc import Callable

from geomoe3d.clouds.prepare import robust_extent
from geomoe3d.config import expert
from geomoe3d.decision.answer import Decision
from geomoe3d.decision.scale import likely_unit_ratio, seeming_units
from geomoe3d.decision.similarity import mirrored_cloud, scaled_cloud
from geomoe3d.errors import EmptyCloudError
from geomoe3d.result import RegistrationResult
from geomoe3d.runtime.timing import StageClock
from geomoe3d.types import PointCloud

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
    names = f"'{source.name}'", f"'{target.name}'"  # not roles, which may be exchanged here
    return (
        f"units differ: with all lengths of '{source.name}' divided by {ratio:.6g} the clouds fit"
        f"{seeming_units(ratio, names)}; bring both to one unit, a rigid motion cannot change scale"
    )


def mirrored_axes(
    clouds: tuple[PointCloud, PointCloud], decision: Decision, register: Register, clock: StageClock
) -> str | None:
    """A sentence where the clouds fit clearly better once the source is mirrored, else None.

    Nothing is registered where the answer is quite sure.
    """
    judgement = decision.judgement
    if judgement.status == "ok" and judgement.confidence > expert().causes.sure:
        return None
    clock("mirrored")
    found = register(mirrored_cloud(clouds[0]), clouds[1])
    score = 0.0 if decision.answer is None else decision.answer.score
    if not found.ok or found.evidence["score"] < expert().causes.mirrored_lead * score:
        return None
    return (
        f"mirrored: with x of '{clouds[0].name}' the other way round the clouds fit (confidence "
        f"{found.confidence:.2f}); a rigid motion cannot mirror, so bring both to right-handed axes (often two "
        "axes are exchanged)"
    )
