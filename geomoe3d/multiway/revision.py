"""What to doubt where a model contradicts its surest pairs: the few edges that hold two parts of it in place.

Place: after groups were made. Edges that are wrong alike, as in repeated structure, outvote a right one as long as
each joint is decided by itself. What was joined is weighed as a whole here: where sure pairs inside a group are far
from its poses, the weakest ties between their scans are left out in turn, and groups are made anew from the rest.
"""

from __future__ import annotations

from collections.abc import Sequence

from geomoe3d.config import expert
from geomoe3d.multiway.edges import Edge, Shape, agrees, predicted_motion
from geomoe3d.multiway.pose_graph import spanning_tree
from geomoe3d.multiway.rules import Group, GroupingRules, Poses
from geomoe3d.multiway.settling import connected_parts


def doubted(
    groups: Sequence[Group], edges: Sequence[Edge], shapes: Sequence[Shape], rules: GroupingRules
) -> list[list[Edge]]:
    """The edges without those that hold a contradicted group together, several ways to leave some out.

    Args:
        groups: as they were made from these edges.
        edges: of all registered pairs.
        shapes: of all scans.
        rules: tolerances.

    Returns:
        The weakest ties are left out first; empty where no group contradicts a sure pair.
    """
    own = expert().many_groups
    far, asked = own.revision_far, own.revision_asked
    found: dict[frozenset[int], float] = {}
    for group in groups:
        inside = [e for e in edges if {e.source, e.target} <= group.poses.keys()]
        against = [
            e
            for e in inside
            if e.prior >= own.revision_sure and not _fits(e, group.poses, shapes, rules, far)
        ]
        against = sorted(against, key=lambda e: -e.prior)[:asked]
        tree = spanning_tree(group.edges) if against else set()
        branches = [e for e in group.edges if id(e) in tree]
        for branch in branches:
            side = set(connected_parts(group.poses, [e for e in branches if e is not branch])[0])
            if not any(_crosses(e, side) for e in against):
                continue
            ties = [e for e in inside if _crosses(e, side) and _fits(e, group.poses, shapes, rules, 1.0)]
            held = sum(max(e.prior, 0.0) for e in ties)
            if held < sum(e.prior for e in against if _crosses(e, side)):
                found[frozenset(map(id, ties))] = held
    weakest = sorted(found, key=lambda ties: found[ties])[:asked]
    return [[e for e in edges if id(e) not in ties] for ties in weakest]


def agreement(
    groups: Sequence[Group], edges: Sequence[Edge], shapes: Sequence[Shape], rules: GroupingRules
) -> float:
    """Log-odds of the edges that groups fit, by their confidence alone, without those that they contradict."""
    home = {scan: group.poses for group in groups for scan in group.poses}
    told = 0.0
    for edge in edges:
        if edge.prior > 0 and home.get(edge.source) is home.get(edge.target):
            fits = _fits(edge, home[edge.source], shapes, rules, 1.0)
            told += edge.prior if fits else -edge.prior
    return told


def _fits(edge: Edge, poses: Poses, shapes: Sequence[Shape], rules: GroupingRules, times: float) -> bool:
    predicted = predicted_motion(edge.source, edge.target, poses)
    limits = times * rules.tolerance, times * rules.turn_deg
    return agrees(predicted, edge.T_target_source, shapes[edge.source], *limits)


def _crosses(edge: Edge, side: set[int]) -> bool:
    return (edge.source in side) != (edge.target in side)
