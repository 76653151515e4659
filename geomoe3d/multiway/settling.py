"""A grown group held to what its edges and surfaces say: poses fitted, edges kept or let go, parts that part.

Place: after growth. The pose graph spreads the error of one pair among its neighbours until they agree with
it; surfaces do not, so poses are laid on them before edges are judged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from geomoe3d.config import expert
from geomoe3d.multiway.edges import Edge, Shape, agrees, expected_error, predicted_motion
from geomoe3d.multiway.pose_graph import optimise
from geomoe3d.multiway.rules import Group, GroupingRules, Poses

Align = Callable[[Poses], Poses]
"""Poses to better poses, by the surfaces of the scans."""


def settle(
    group: Group,
    edges: Sequence[Edge],
    shapes: Sequence[Shape],
    rules: GroupingRules,
    align: Align | None = None,
) -> list[Group]:
    """The group with its final poses and the edges that agree with them.

    Poses are optimised over the edges near them until none comes or goes, and then laid on each other by
    their surfaces.

    Args:
        group: from `Growth`.
        edges: of all registered pairs.
        shapes: of all scans.
        rules: thresholds.
        align: by the surfaces; None leaves the poses as the edges give them.

    Returns:
        One group, or several where no edge near the poses held them together.
    """
    inside = [e for e in edges if e.source in group.poses and e.target in group.poses]
    inside = [e for e in inside if e.worth > rules.least_worth]
    poses, near = group.poses, group.edges
    for _ in range(expert().many_poses.most_rounds):
        found = _near(inside, poses, shapes, rules)
        if {id(e) for e in found} == {id(e) for e in near}:
            break
        near = found
        if len(connected_parts(poses, near)) > 1:
            break
        poses = optimise(poses, near, rules.tolerance, library=rules.optimizer)
    if align is not None and len(poses) > 1 and len(connected_parts(poses, near)) == 1:
        poses = align(poses)
        near = _near(inside, poses, shapes, rules)
    parts = connected_parts(poses, near)
    if len(parts) == 1:
        return [Group(poses, near)]
    apart = [Group({k: poses[k] for k in part}) for part in parts]  # what let go of them may have bent them
    return [piece for part in apart for piece in settle(part, edges, shapes, rules, align)]


def _near(edges: Sequence[Edge], poses: Poses, shapes: Sequence[Shape], rules: GroupingRules) -> list[Edge]:
    """The edges that say about what the poses say."""
    return [e for e in edges if _agrees(e, poses, shapes, rules.near_tolerance, rules.near_turn_deg)]


def is_kept(edge: Edge, poses: Poses, shapes: Sequence[Shape], rules: GroupingRules) -> bool:
    """Whether an edge says what the final poses say, and its own surfaces hold the sensor firmly enough."""
    if not _agrees(edge, poses, shapes, rules.kept_tolerance, rules.kept_turn_deg):
        return False
    return expected_error(edge, poses, shapes[edge.source], rules.correlation) < rules.kept_error


def _agrees(edge: Edge, poses: Poses, shapes: Sequence[Shape], tolerance: float, turn_deg: float) -> bool:
    predicted = predicted_motion(edge.source, edge.target, poses)
    return agrees(predicted, edge.T_target_source, shapes[edge.source], tolerance, turn_deg)


def connected_parts(scans: Iterable[int], edges: Sequence[Edge]) -> list[list[int]]:
    """The scans in parts that edges connect, each sorted, the largest first."""
    parent = {scan: scan for scan in scans}

    def root(scan: int) -> int:
        while parent[scan] != scan:
            scan = parent[scan]
        return scan

    for edge in edges:
        if edge.source in parent and edge.target in parent:
            parent[root(edge.source)] = root(edge.target)
    parts: dict[int, list[int]] = {}
    for scan in sorted(parent):
        parts.setdefault(root(scan), []).append(scan)
    return sorted(parts.values(), key=lambda part: (-len(part), part[0]))
