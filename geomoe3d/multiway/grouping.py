"""From edges of which some are wrong to groups of scans with poses, by growing what is sure.

Two groups are joined by the motion for which most evidence speaks: every edge between them votes, edges that
agree add up, and those that contradict count against it. One very sure edge, or two agreeing ones, are
needed; where two motions compete, the groups stay apart. Pairs that would overlap well by the motion, were
registered and do not say so, speak against it. What has been joined is never torn by weaker edges:
these are found to disagree with the poses and rejected. Cost: some milliseconds per joined scan.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from geomoe3d.geometry.se3 import inverse
from geomoe3d.multiway.edges import Edge, Shape, agrees, expected_error, predicted_motion
from geomoe3d.multiway.overlaps import Overlaps
from geomoe3d.multiway.pose_graph import optimise
from geomoe3d.types import BoolArray, FloatArray

_MOST_ROUNDS = 6


@dataclass(frozen=True)
class GroupingRules:
    """When groups are joined and edges kept.

    Attributes:
        least_worth: edges with a lower log-odds have no voice (0: a confidence of 0.5).
        joined_worth: log-odds that the winning motion must collect (6: one confidence of 0.9975, or several).
        tolerance: largest displacement of motions that agree when groups are joined, cloud units.
        turn_deg: their largest turn.
        near_tolerance: largest displacement from the poses of an edge over which they are optimised.
        near_turn_deg: its largest turn from them.
        kept_tolerance: largest displacement of a kept edge from the final poses, cloud units.
        kept_turn_deg: its largest turn from them.
        kept_error: largest `expected_error` of a kept edge, cloud units.
        correlation: real errors of the sensor's place over what independent gaps would give: neighbouring
            points err alike. In four scenes of depth cameras half lay above 14 to 21, a tenth above 26 to 45.
        further_share: of the log-odds of all supporters but the surest, since they are not independent.
        silent_overlap: a pair that overlaps this much should have been registered rightly: 94 % of them are.
        silent_worth: log-odds by which such a pair counts against a motion that it does not support.
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
    silent_overlap: float = 0.5
    silent_worth: float = 2.0
    least_worth: float = 0.0
    joined_worth: float = 6.0


@dataclass
class Group:
    """Scans with poses T_group_scan (4, 4), local coordinates, and the edges that hold them together."""

    poses: dict[int, FloatArray]
    edges: list[Edge] = field(default_factory=list)


@dataclass(frozen=True)
class Vote:
    """What speaks for one motion T_a_b between two groups.

    Attributes:
        T_a_b: (4, 4) group b in the frame of group a.
        supporters: edges that agree with it.
        worth: their log-odds, not counted in full, minus those of the edges against it.
    """

    T_a_b: FloatArray
    supporters: tuple[Edge, ...]
    worth: float

    def enough(self, rules: GroupingRules) -> bool:
        """Whether the groups may be joined by it."""
        return self.worth >= rules.joined_worth


def group_scans(
    shapes: Sequence[Shape],
    edges: Sequence[Edge],
    rules: GroupingRules,
    tried: Collection[tuple[int, int]] = (),
    overlaps: Overlaps | None = None,
    start: Sequence[Group] | None = None,
) -> list[Group]:
    """Groups of scans, the largest first; a scan that nothing sure ties to another is a group of its own.

    Args:
        shapes: of all scans.
        edges: of all registered pairs.
        rules: thresholds.
        tried: pairs (smaller, larger number) that were registered, whatever came of it.
        overlaps: predicts how much two scans overlap; None takes no account of pairs that are silent.
        start: groups to begin with, every scan in one of them; None: every scan by itself.
    """
    shapes = list(shapes)
    voices = [edge for edge in edges if edge.worth > rules.least_worth]
    alone = [Group({k: np.eye(4)}) for k in range(len(shapes))]
    groups = {min(group.poses): group for group in (alone if start is None else start)}
    member = [0] * len(shapes)
    for number, group in groups.items():
        for scan in group.poses:
            member[scan] = number
    votes: dict[tuple[int, int], Vote | None] = {}
    heard: set[tuple[int, int]] = set()  # votes from which silent pairs have been taken off
    between: dict[tuple[int, int], list[Edge]] = {}
    for edge in voices:
        if member[edge.source] != member[edge.target]:
            between.setdefault(_pair(member[edge.source], member[edge.target]), []).append(edge)
    while True:
        for key, crossing in between.items():
            if key not in votes:
                votes[key] = best_vote(groups[key[0]], groups[key[1]], crossing, shapes, rules)
        sure = [(vote.worth, key) for key, vote in votes.items() if vote is not None and vote.enough(rules)]
        if not sure:
            break
        _, (a, b) = max(sure, key=lambda item: (item[0], (-item[1][0], -item[1][1])))
        vote = votes[a, b]
        assert vote is not None
        if overlaps is not None and (a, b) not in heard:
            heard.add((a, b))
            silent = _num_silent(groups[a], groups[b], vote, tried, overlaps, rules)
            votes[a, b] = replace(vote, worth=vote.worth - rules.silent_worth * silent)
            continue
        groups[a] = _join(groups[a], groups.pop(b), vote, shapes, rules)
        for scan in groups[a].poses:
            member[scan] = a
        votes = {key: v for key, v in votes.items() if a not in key and b not in key}
        heard = {key for key in heard if a not in key and b not in key}
        between = {}
        for edge in voices:
            one, other = member[edge.source], member[edge.target]
            if one != other:
                between.setdefault(_pair(one, other), []).append(edge)
    return sorted(groups.values(), key=lambda group: (-len(group.poses), min(group.poses)))


def _num_silent(
    a: Group,
    b: Group,
    vote: Vote,
    tried: Collection[tuple[int, int]],
    overlaps: Overlaps,
    rules: GroupingRules,
) -> int:
    """Registered pairs across two groups that would overlap well by a motion but do not support it."""
    speaking = {_pair(edge.source, edge.target) for edge in vote.supporters}
    count = 0
    for i in a.poses:
        for j in b.poses:
            pair = _pair(i, j)
            if pair not in tried or pair in speaking:
                continue
            T = inverse(a.poses[i]) @ vote.T_a_b @ b.poses[j]
            count += overlaps.of(j, i, T) >= rules.silent_overlap and (
                overlaps.of(i, j, inverse(T)) >= rules.silent_overlap
            )
    return count


def best_vote(
    a: Group, b: Group, crossing: Sequence[Edge], shapes: list[Shape], rules: GroupingRules
) -> Vote | None:
    """The motion T_a_b for which the crossing edges speak most, with what speaks against it taken off.

    Every edge proposes its own motion. Against it counts the most that the other edges bring together for one
    other motion: wrong edges scatter, right ones gather.
    """
    if not crossing:
        return None
    motions = np.stack([_between_groups(edge, a, b) for edge in crossing])
    agreeing = _agreements(motions, [_end_in(edge, b) for edge in crossing], b, shapes, rules)
    worth = np.array([edge.worth for edge in crossing])
    outside = np.where(agreeing, 0.0, worth)  # row: what does not speak for the row's motion
    against = np.where(~agreeing, outside @ agreeing.T, 0.0).max(axis=1, initial=0.0)
    # Agreeing edges are no independent witnesses: scans taken one after the other are deceived alike.
    surest = (agreeing * worth).max(axis=1)
    total = surest + rules.further_share * (agreeing @ worth - surest) - against
    best = int(total.argmax())
    supporters = tuple(edge for edge, yes in zip(crossing, agreeing[best], strict=True) if yes)
    return Vote(motions[best], supporters, float(total[best]))


def _agreements(
    motions: FloatArray, ends: list[int], b: Group, shapes: list[Shape], rules: GroupingRules
) -> BoolArray:
    """(n, n) True where motion k (rows) moves the scan of edge e (columns) as edge e itself does.

    Args:
        motions: (n, 4, 4) T_a_b by every edge.
        ends: the scan of every edge that lies in ``b``.
    """
    poses = np.stack([b.poses[scan] for scan in ends])
    R = poses[:, :3, :3]
    centers = np.einsum("eij,ej->ei", R, np.stack([shapes[k].center for k in ends])) + poses[:, :3, 3]
    spreads = R @ np.stack([shapes[k].spread for k in ends]) @ R.transpose(0, 2, 1)
    D = motions[:, None] - motions[None]
    shift = np.einsum("keij,ej->kei", D[..., :3, :3], centers) + D[..., :3, 3]
    squares = (shift**2).sum(-1) + np.einsum("keij,ejl,keil->ke", D[..., :3, :3], spreads, D[..., :3, :3])
    cosine = (np.einsum("kij,eij->ke", motions[:, :3, :3], motions[:, :3, :3]) - 1) / 2
    turn = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    agreeing: BoolArray = (squares < rules.tolerance**2) & (turn < rules.turn_deg)
    np.fill_diagonal(agreeing, True)
    return agreeing


def _end_in(edge: Edge, group: Group) -> int:
    return edge.source if edge.source in group.poses else edge.target


def _between_groups(edge: Edge, a: Group, b: Group) -> FloatArray:
    """T_a_b by one edge, whichever way it runs."""
    T: FloatArray
    if edge.target in a.poses:
        T = a.poses[edge.target] @ edge.T_target_source @ inverse(b.poses[edge.source])
    else:
        T = a.poses[edge.source] @ inverse(edge.T_target_source) @ inverse(b.poses[edge.target])
    return T


def _join(a: Group, b: Group, vote: Vote, shapes: list[Shape], rules: GroupingRules) -> Group:
    """One group, its poses optimised over all edges that agree."""
    poses = {**a.poses, **{scan: vote.T_a_b @ pose for scan, pose in b.poses.items()}}
    edges = [*a.edges, *b.edges, *vote.supporters]
    grown = len(b.poses) > 1 or _octave(len(poses)) > _octave(len(a.poses))
    if grown and len(edges) >= len(poses):  # there is a loop to close
        poses = optimise(poses, edges, rules.tolerance)
    return Group(poses, edges)


def settle(
    group: Group,
    edges: Sequence[Edge],
    shapes: Sequence[Shape],
    rules: GroupingRules,
    align: Callable[[dict[int, FloatArray]], dict[int, FloatArray]] | None = None,
) -> list[Group]:
    """The group held by the edges that agree closely with its final poses.

    Poses are optimised over the edges near them until none comes or goes, and then laid on each other by
    their surfaces. An edge is kept where it agrees with what came of that: surfaces that all agree show the
    error of a single pair, which the pose graph would have spread among its neighbours.

    Args:
        group: from `group_scans`.
        edges: of all registered pairs.
        shapes: of all scans.
        rules: thresholds.
        align: poses to better poses, by the surfaces; None leaves them as the edges give them.

    Returns:
        One group, or several where only edges that do not agree closely held them together.
    """
    inside = [e for e in edges if e.source in group.poses and e.target in group.poses]
    inside = [e for e in inside if e.worth > rules.least_worth]
    poses, kept = group.poses, group.edges
    for _ in range(_MOST_ROUNDS):
        near = _agreeing(inside, poses, shapes, rules.near_tolerance, rules.near_turn_deg)
        if {id(e) for e in near} == {id(e) for e in kept}:
            break
        kept = near
        parts = connected_parts(poses, kept)
        if len(parts) > 1:
            return _settled_apart(poses, parts, kept, shapes, rules, align)
        poses = optimise(poses, kept, rules.tolerance)
    if align is not None and len(poses) > 1:
        poses = align(poses)
    kept = _agreeing(inside, poses, shapes, rules.kept_tolerance, rules.kept_turn_deg)
    kept = [
        e for e in kept if expected_error(e, poses, shapes[e.source], rules.correlation) < rules.kept_error
    ]
    parts = connected_parts(poses, kept)
    if len(parts) > 1:
        return _settled_apart(poses, parts, kept, shapes, rules, align)
    return [Group(poses, kept)]


def _settled_apart(
    poses: dict[int, FloatArray],
    parts: list[list[int]],
    edges: Sequence[Edge],
    shapes: Sequence[Shape],
    rules: GroupingRules,
    align: Callable[[dict[int, FloatArray]], dict[int, FloatArray]] | None,
) -> list[Group]:
    """Every part of a group settled by itself: what let go of it may have bent it."""
    groups = [Group({k: poses[k] for k in part}) for part in parts]
    return [piece for part in groups for piece in settle(part, edges, shapes, rules, align)]


def _agreeing(
    edges: Sequence[Edge],
    poses: dict[int, FloatArray],
    shapes: Sequence[Shape],
    tolerance: float,
    turn_deg: float,
) -> list[Edge]:
    """The edges that say what the poses say."""
    return [
        edge
        for edge in edges
        if agrees(
            predicted_motion(edge.source, edge.target, poses),
            edge.T_target_source,
            shapes[edge.source],
            tolerance,
            turn_deg,
        )
    ]


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


def _octave(count: int) -> int:
    """Rises by one with every quarter more: optimising after each single scan would cost its square."""
    return int(np.log(count) / np.log(1.25))


def _pair(a: int, b: int) -> tuple[int, int]:
    return (a, b) if a < b else (b, a)
