"""Two groups whose pairs disagree only as far as drift explains: joined by all of them at once, and so unbent.

Place: the last resort of growth. A long group is bent by what its pairs are off, each a little. Right pairs at its two
ends then put a second group in places that differ by more than motions of one place may, and each by itself has the
surfaces against it. Errors add up as the root of the number of pairs on the way round, so pairs that differ by no
more than that are taken together, the poses of both groups optimised over all of them, and the surfaces asked then.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from geomoe3d.config import expert
from geomoe3d.multiway.edges import Edge, Shape, agrees, predicted_motion
from geomoe3d.multiway.pose_graph import optimise
from geomoe3d.multiway.rules import Group, GroupingRules, Poses
from geomoe3d.types import FloatArray


def unbend(
    a: Group,
    b: Group,
    T_a_b: FloatArray,
    supporters: Sequence[Edge],
    others: Sequence[Edge],
    shapes: Sequence[Shape],
    rules: GroupingRules,
) -> tuple[Poses, list[Edge]]:
    """Poses of both groups in the frame of the first by all edges between them that drift reconciles.

    Args:
        a, b: the groups.
        T_a_b: (4, 4) b in the frame of a, as its supporters have it.
        supporters: edges that agree on it.
        others: further edges between the groups, which do not.
        shapes: of all scans.
        rules: tolerances, for a loop of three edges.

    Returns:
        Poses, and those of the others that fit them; none where they cannot all be had without straining the groups.
    """
    start = {**a.poses, **{scan: T_a_b @ T for scan, T in b.poses.items()}}
    ends = {scan for edge in supporters for scan in (edge.source, edge.target)}
    away = {**_steps(a, ends), **_steps(b, ends)}
    fitting = [edge for edge in others if _drifted(edge, start, away, shapes, rules)]
    own = [*a.edges, *b.edges]
    for _ in range(len(fitting)):
        joint = [*supporters, *fitting]
        poses = optimise(start, [*own, *joint], rules.tolerance, sure=joint, library=rules.optimizer)
        kept = [edge for edge in fitting if _near(edge, poses, shapes, rules)]
        if len(kept) == len(fitting):
            strained = sum(not _near(e, poses, shapes, rules) for e in own if _near(e, start, shapes, rules))
            held = all(_near(edge, poses, shapes, rules) for edge in supporters)
            most = expert().many_poses.most_strained * len(own)
            return (poses, fitting) if held and strained <= most else (start, [])
        fitting = kept
        if not fitting:
            break
    return start, []


def _near(edge: Edge, poses: Poses, shapes: Sequence[Shape], rules: GroupingRules) -> bool:
    predicted = predicted_motion(edge.source, edge.target, poses)
    limits = rules.near_tolerance, rules.near_turn_deg
    return agrees(predicted, edge.T_target_source, shapes[edge.source], *limits)


def _drifted(
    edge: Edge, poses: Poses, away: dict[int, int], shapes: Sequence[Shape], rules: GroupingRules
) -> bool:
    """Whether an edge is off the poses by no more than a loop of its length may be."""
    loop = 2 + away.get(edge.source, 0) + away.get(edge.target, 0)
    wider = float(np.sqrt(max(loop / expert().many_poses.triangle, 1.0)))
    predicted = predicted_motion(edge.source, edge.target, poses)
    limits = wider * rules.tolerance, wider * rules.turn_deg
    return agrees(predicted, edge.T_target_source, shapes[edge.source], *limits)


def _steps(group: Group, starts: Iterable[int]) -> dict[int, int]:
    """By how many of its edges each scan of a group is away from the nearest of some scans."""
    beside: dict[int, list[int]] = {}
    for edge in group.edges:
        beside.setdefault(edge.source, []).append(edge.target)
        beside.setdefault(edge.target, []).append(edge.source)
    found = {scan: 0 for scan in starts if scan in group.poses}
    waiting = list(found)
    for scan in waiting:
        for other in beside.get(scan, ()):
            if other not in found:
                found[other] = found[scan] + 1
                waiting.append(other)
    return found
