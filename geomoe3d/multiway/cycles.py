"""What triangles of edges say of each edge: right edges close, wrong ones do not, whatever their confidence.

Place: before grouping. Three edges between three scans close when two of them, one after the other, move the
third scan as the third edge does. Belief propagation over all triangles turns the confidence of every edge
into log-odds that hold in the company of the others: of an edge whose neighbours are likely right, a triangle
that closes speaks for it and one that does not against it; an edge is never told what it said itself. Cost:
linear in the triangles, some 50 ms for 60 scans with all their pairs.
Source: Zach, Klopschitz and Pollefeys, CVPR 2010 (loops as evidence); Pearl's sum-product rule.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from geomoe3d.config import expert
from geomoe3d.geometry.se3 import inverse
from geomoe3d.multiway.edges import Edge, Shape, differences
from geomoe3d.types import BoolArray, FloatArray, IntArray


def with_cycles(
    edges: Sequence[Edge], shapes: Sequence[Shape], tolerance: float, turn_deg: float
) -> list[Edge]:
    """The edges, each with what triangles say of it as its ``evidence``.

    Args:
        edges: of all registered pairs; several of one pair are rivals.
        shapes: of all scans.
        tolerance: largest displacement at which a triangle closes, cloud units.
        turn_deg: its largest turn.
    """
    known = expert().many_groups
    voices = [k for k, edge in enumerate(edges) if edge.confidence >= known.least_confidence]
    heard = [edges[k] for k in voices]
    triangles = find_triangles(heard)
    evidence = np.zeros(len(edges))
    if len(triangles):
        closed = closes(heard, triangles, shapes, tolerance, turn_deg)
        prior = np.array([edge.prior for edge in heard])
        evidence[voices] = propagate(prior, triangles, closed)
    return [replace(edge, evidence=float(told)) for edge, told in zip(edges, evidence, strict=True)]


def find_triangles(edges: Sequence[Edge]) -> IntArray:
    """(K, 3) numbers of the edges a-b, b-c and a-c of all triangles of scans a < b < c."""
    between: dict[tuple[int, int], list[int]] = {}
    later: dict[int, list[int]] = {}
    for number, edge in enumerate(edges):
        pair = min(edge.source, edge.target), max(edge.source, edge.target)
        if pair not in between:
            later.setdefault(pair[0], []).append(pair[1])
        between.setdefault(pair, []).append(number)
    found = [
        (ab, bc, ac)
        for (a, b), first in between.items()
        for c in later.get(b, ())
        if (a, c) in between
        for ab in first
        for bc in between[b, c]
        for ac in between[a, c]
    ]
    return np.array(found, dtype=np.int64).reshape(-1, 3)


def closes(
    edges: Sequence[Edge], triangles: IntArray, shapes: Sequence[Shape], tolerance: float, turn_deg: float
) -> BoolArray:
    """(K,) whether going round a triangle comes back to where it began.

    Args:
        edges, triangles: as `find_triangles` takes and gives them.
        shapes, tolerance, turn_deg: as in `with_cycles`.
    """
    # T_a_b of every edge with a < b, whichever way the pair was registered.
    motions = np.stack(
        [e.T_target_source if e.target < e.source else inverse(e.T_target_source) for e in edges]
    )
    ab, bc, ac = triangles.T
    last = [shapes[max(edges[k].source, edges[k].target)] for k in bc]
    shift, turn = differences(motions[ab] @ motions[bc], motions[ac], last)
    closed: BoolArray = (shift < tolerance) & (turn < turn_deg)
    return closed


def propagate(prior: FloatArray, triangles: IntArray, closed: BoolArray) -> FloatArray:
    """(M,) log-odds that the triangles add to the prior ones (M,) of the edges.

    Args:
        prior: log-odds of every edge by itself.
        triangles: (K, 3) numbers of edges.
        closed: (K,) from `closes`.
    """
    known = expert().many_groups
    none, one, two, three = known.closing
    messages = np.zeros(triangles.shape)

    def told() -> FloatArray:
        """What each message adds: the strongest in full, every further one less, since scans of one place
        are deceived alike."""
        edge, message = triangles.ravel(), messages.ravel()
        order = np.lexsort((-np.abs(message), edge))
        before = np.arange(len(order)) - np.searchsorted(edge[order], edge[order])
        added = np.empty(len(order))
        added[order] = known.triangle_share**before * message[order]
        return added.reshape(triangles.shape)

    def summed(added: FloatArray) -> FloatArray:
        return np.bincount(triangles.ravel(), added.ravel(), minlength=len(prior)).astype(np.float64)

    for _ in range(known.rounds):
        # What an edge tells a triangle leaves out what that triangle told it.
        added = told()
        odds = (prior + summed(added))[triangles] - added
        likely = 1 / (1 + np.exp(-np.clip(odds, -known.most_told, known.most_told)))
        q, r = np.roll(likely, -1, axis=1), np.roll(likely, -2, axis=1)
        both, either, neither = q * r, q * (1 - r) + r * (1 - q), (1 - q) * (1 - r)
        if_right = none * both + one * either + two * neither
        if_wrong = one * both + two * either + three * neither
        closing, open_ = np.log(if_right / if_wrong), np.log((1 - if_right) / (1 - if_wrong))
        fresh = np.where(closed[:, None], closing, open_)
        messages = known.damping * messages + (1 - known.damping) * fresh
    return summed(told())
