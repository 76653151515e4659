"""What a map answers: where a scan lies in it, and at which other places it might."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

from geomoe3d.decision.remarks import flatness
from geomoe3d.result import RegistrationResult, Status
from geomoe3d.types import FloatArray, PointCloud


@dataclass(frozen=True, eq=False)
class Place:
    """One place of a scan in a map.

    Attributes:
        T_map_scan: (4, 4), p_map = R p_scan + t, file coordinates.
        relative_score: its score over that of the answer; 1 means as good.
    """

    T_map_scan: FloatArray
    relative_score: float


@dataclass(frozen=True, eq=False)
class Location:
    """Where a scan lies in a map.

    Attributes:
        result: the answer as of a pair, the scan being the source and the map the target.
        places: the best clearly different places, the answer first; empty where there is none.
    """

    result: RegistrationResult
    places: tuple[Place, ...]

    @property
    def ok(self) -> bool:
        """True only for status ok."""
        return self.result.ok

    @property
    def status(self) -> Status:
        """ok | low_confidence | ambiguous | failed, as of a pair."""
        return self.result.status

    @property
    def T_map_scan(self) -> FloatArray:
        """(4, 4), p_map = R p_scan + t, file coordinates; NaN where nothing was found, never the identity."""
        return self.result.T_target_source

    def to_json(self, indent: int | None = 2) -> str:
        """The result's JSON with ``places``."""
        told = json.loads(self.result.to_json())
        told["places"] = [
            {
                "T_map_scan": place.T_map_scan.tolist(),
                "relative_score": place.relative_score if math.isfinite(place.relative_score) else None,
            }
            for place in self.places
        ]
        return json.dumps(told, indent=indent, allow_nan=False)


def nowhere(scan: PointCloud, world: str) -> str:
    """The reason of an answer without any candidate."""
    flat = flatness(scan.name, scan.points)
    said = f"no place was found in '{world}' at which '{scan.name}' could lie"
    return said if flat is None else f"{said}: {flat}"
