"""Groups that bend: what edges far apart in them say together of a joint that no rigid motion makes.

Place: in growth, once nothing rigid is sure. Scans are bent and chains of them drift, so two right edges at both ends
of two groups do not agree as closely as neighbours do. Cost: a millisecond per pair of groups.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomoe3d.config import expert
from geomoe3d.multiway.edges import Edge
from geomoe3d.multiway.rules import Group
from geomoe3d.types import BoolArray, FloatArray


def drifts(a: Group, b: Group, edges: Sequence[Edge]) -> FloatArray:
    """(n, n) by how much two edges between two groups may differ more than in a loop of three.

    Errors add up as the square root of the length of the way: through both groups, by as few edges as possible. Never
    more than what tells two joints of bent groups apart.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import shortest_path

    ways = np.zeros((len(edges), len(edges)))
    for group in (a, b):
        ends = [e.source if e.source in group.poses else e.target for e in edges]
        number = {scan: k for k, scan in enumerate(group.poses)}
        steps = [(number[e.source], number[e.target]) for e in group.edges]
        ends_of_steps = np.array(steps, dtype=np.int64).reshape(-1, 2).T
        graph = coo_matrix((np.ones(len(steps)), ends_of_steps), shape=(len(number),) * 2)
        rows = [number[scan] for scan in ends]
        ways += shortest_path(graph, directed=False, unweighted=True, indices=rows)[:, rows]
    longer = np.sqrt(1 + np.where(np.isfinite(ways), ways, 0.0) / 3)
    found: FloatArray = np.minimum(longer, expert().many_groups.bent)
    return found


def agree_apart(edges: Sequence[Edge], agreeing: BoolArray, worth: FloatArray) -> float:
    """Log-odds added by the edges that agree with the surest of them and share no scan with it nor with each other.

    What deceives one scan deceives all pairs of it; edges that are wrong for reasons of their own hardly ever agree.
    """
    closing, by_chance = expert().many_groups.closing[:2]
    added, known = 0.0, set[int]()
    for k in map(int, np.flatnonzero(agreeing)):  # the surest first
        ends = {edges[k].source, edges[k].target}
        if known.isdisjoint(ends):
            likely = 1 / (1 + np.exp(-worth[k]))
            added += np.log(likely * closing / by_chance + 1 - likely) if known else 0.0
            known |= ends
    return float(added)
