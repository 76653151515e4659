"""Going round the loops of a group by what its pairs measured, and what is off when one comes back.

A group that was bent to make its edges agree shows it here: the poses hide what the pairs themselves did not
close. Every sure edge beside the spanning tree of the surest closes one loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from geomoe3d.config import expert
from geomoe3d.geometry.se3 import inverse
from geomoe3d.multiway.edges import Edge, Shape, differences
from geomoe3d.multiway.pose_graph import spanning_tree
from geomoe3d.multiway.rules import Poses
from geomoe3d.types import FloatArray


@dataclass(frozen=True)
class Loop:
    """One loop of measured motions.

    Attributes:
        scans: in the order in which they are passed; the edge from the last to the first closes it.
        shift: how far the first scan's points are from where they were, root mean square, cloud units.
        turn_deg: by what angle it is turned.
        closes: whether both are within what a loop of this length may be off.
    """

    scans: tuple[int, ...]
    shift: float
    turn_deg: float
    closes: bool


def find_loops(poses: Poses, edges: Sequence[Edge], shapes: Sequence[Shape], voxel_size: float) -> list[Loop]:
    """The loops of a group, the worst first.

    Args:
        poses: of its scans.
        edges: of all registered pairs; those between its scans and surer than 0.98 take part, and
            those that registration alone was surer of than 0.99.
        shapes: of all scans.
        voxel_size: of the common grid, cloud units.
    """
    sure = [e for e in edges if {e.source, e.target} <= poses.keys() and closes_loops(e)]
    tree = spanning_tree(sure)
    beside: dict[int, list[tuple[int, Edge]]] = {}
    for edge in sure:
        if id(edge) in tree:
            beside.setdefault(edge.source, []).append((edge.target, edge))
            beside.setdefault(edge.target, []).append((edge.source, edge))
    up: dict[int, tuple[int, Edge] | None] = {}
    for root in sorted(beside):
        if root in up:
            continue
        up[root], waiting = None, [root]
        while waiting:
            here = waiting.pop()
            for there, edge in beside[here]:
                if there not in up:
                    up[there] = here, edge
                    waiting.append(there)
    found = [_loop(edge, up, shapes, voxel_size) for edge in sure if id(edge) not in tree]
    return sorted(found, key=lambda loop: (loop.closes, -loop.shift, loop.scans))


def closes_loops(edge: Edge) -> bool:
    """Whether a pair is sure enough to be followed: in the company of the others, or by itself though the others
    contradict it, since they may be wrong alike."""
    known = expert().many_groups
    return edge.worth >= known.loop_worth or edge.confidence >= known.loop_confidence


def _loop(
    closing: Edge, up: dict[int, tuple[int, Edge] | None], shapes: Sequence[Shape], voxel_size: float
) -> Loop:
    """The loop that an edge closes with the tree."""
    down, back = _path(closing.source, up), _path(closing.target, up)
    while len(down) > 1 and len(back) > 1 and down[-2] == back[-2]:  # the way both go to the root
        down.pop()
        back.pop()
    scans = (*down, *reversed(back[:-1]))
    T = np.eye(4)  # T_here_source, going from the source to the target
    for here, there in pairwise(scans):
        T = _step(here, there, up) @ T
    shift, turn = differences(T[None], closing.T_target_source[None], [shapes[closing.source]])
    longer = float(np.sqrt(len(scans) / 3))
    known = expert().many_groups
    near = shift[0] < known.loop_shift * longer * voxel_size
    closes = bool(near and turn[0] < known.loop_turn_deg * longer)
    return Loop(scans, float(shift[0]), float(turn[0]), closes)


def _path(scan: int, up: dict[int, tuple[int, Edge] | None]) -> list[int]:
    """From a scan to the root of its tree."""
    path = [scan]
    while (step := up[path[-1]]) is not None:
        path.append(step[0])
    return path


def _step(here: int, there: int, up: dict[int, tuple[int, Edge] | None]) -> FloatArray:
    """T_there_here by the edge of the tree between two scans."""
    step = up[here]
    if step is None or step[0] != there:
        step = up[there]
    assert step is not None
    edge = step[1]
    return edge.T_target_source if edge.source == here else inverse(edge.T_target_source)
