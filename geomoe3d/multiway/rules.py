"""What growth and what comes after it share: poses, groups, and when groups are joined and edges kept."""

from __future__ import annotations

from dataclasses import dataclass, field

from geomoe3d.multiway.edges import Edge
from geomoe3d.multiway.pose_graph import Library
from geomoe3d.types import FloatArray

Poses = dict[int, FloatArray]
"""T_group_scan (4, 4) in local coordinates, by number of the scan."""


@dataclass(frozen=True)
class GroupingRules:
    """When groups are joined and edges kept.

    Attributes:
        tolerance: largest displacement of motions that agree when groups are joined, cloud units.
        turn_deg: their largest turn.
        near_tolerance: largest displacement from the poses of an edge over which they are optimised.
        near_turn_deg: its largest turn from them.
        kept_tolerance: largest displacement of a kept edge from the final poses, cloud units.
        kept_turn_deg: its largest turn from them.
        kept_error: largest `expected_error` of a kept edge, cloud units.
        correlation: real errors of the sensor's place over what independent gaps would give: neighbouring
            points err alike. In four scenes of depth cameras half lay above 14 to 21, a tenth above 26 to 45.
        least_worth: edges with lower log-odds are taken for wrong.
        least_voice: those with lower ones propose no motion between groups, which the scans may speak for.
        joined_worth: log-odds that the winning motion must have left.
        optimizer: the library that fits poses to edges.
        further_share: of the log-odds of all supporters but the surest, since they are not independent.
    """

    tolerance: float
    near_tolerance: float
    kept_tolerance: float
    kept_error: float
    turn_deg: float = 8.0
    near_turn_deg: float = 5.0
    kept_turn_deg: float = 3.0
    correlation: float = 20.0
    further_share: float = 0.5
    least_worth: float = 0.0
    least_voice: float = -2.0
    joined_worth: float = 2.0
    optimizer: Library = "open3d"


@dataclass
class Group:
    """Scans with poses T_group_scan (4, 4), local coordinates, and the edges that hold them together."""

    poses: Poses
    edges: list[Edge] = field(default_factory=list)
