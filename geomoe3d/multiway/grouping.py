"""From edges of which most may be wrong to groups of scans with poses, by growing what is sure.

Two groups are joined by the motion for which most speaks: edges between them that agree add up, the best
other motion is taken off, and so is what the scans themselves contradict, such as points of one group where
sensors of the other saw through. The surest joint is made first. What has been joined is never torn by
weaker edges: these are found to disagree with the poses and rejected. Where nothing is sure any more, groups may
bend: edges far apart in them agree within what a chain of scans drifts, and the scans are asked about the poses
that the joint would bend both groups to. Cost: milliseconds per joined scan.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from geomoe3d.config import expert
from geomoe3d.geometry.se3 import inverse
from geomoe3d.multiway.bending import agree_apart, drifts
from geomoe3d.multiway.edges import Edge, Shape, differences
from geomoe3d.multiway.pose_graph import optimise
from geomoe3d.multiway.rules import Group, GroupingRules, Poses
from geomoe3d.types import BoolArray, FloatArray

Witness = Callable[
    [Mapping[int, FloatArray], Mapping[int, FloatArray], FloatArray | None], tuple[FloatArray, float]
]
"""Asked of two groups (poses of each) and a motion T_a_b (4, 4): the motion as the surfaces have it, and the
log-odds by which the scans speak for it (negative: against). No motion: both were bent into one frame."""


@dataclass
class Motion:
    """One way to join two groups.

    Attributes:
        T_a_b: (4, 4) group b in the frame of group a.
        supporters: edges that agree with it.
        voices: what they bring together.
        worth: that; once ``weighed``, without what the scans contradict.
        bends: whether edges far apart agree with it, if both groups are bent.
        weighed: whether the scans have been asked.
    """

    T_a_b: FloatArray
    supporters: list[Edge]
    voices: float
    worth: float
    bends: bool = False
    weighed: bool = False


class Growth:
    """Groups that grow together.

    Args:
        groups: to begin with; no scan is in two of them.
        edges: of all registered pairs, with what cycles say of them.
        shapes: of all scans.
        rules: thresholds.
        witness: what the scans say of a motion between two groups; None: they are not asked.
    """

    def __init__(
        self,
        groups: Sequence[Group],
        edges: Sequence[Edge],
        shapes: Sequence[Shape],
        rules: GroupingRules,
        witness: Witness | None = None,
    ) -> None:
        self.groups = {min(group.poses): group for group in groups}
        self._shapes, self._rules, self._witness = shapes, rules, witness
        home = {scan: number for number, group in self.groups.items() for scan in group.poses}
        self._between: dict[tuple[int, int], list[Edge]] = {}
        for edge in edges:
            a, b = home[edge.source], home[edge.target]
            if a != b and edge.worth > rules.least_voice:
                self._between.setdefault((min(a, b), max(a, b)), []).append(edge)
        self._ways: dict[tuple[int, int], list[Motion]] = {}
        self._bending = False

    def run(self) -> list[Group]:
        """Join while anything is sure; the groups, the largest first."""
        while True:
            for pair in self._between.keys() - self._ways.keys():
                self._ways[pair] = self._motions(*pair)
            worth, pair = max(
                ((lead(ways), (-a, -b)) for (a, b), ways in self._ways.items()), default=(0.0, (0, 0))
            )
            if worth < self._rules.joined_worth:
                likely = self._likely()
                if likely is not None:
                    self._weigh(*likely)
                    continue
                if self._bending or self._witness is None:
                    return largest_first(self.groups.values())
                self._bending = True
                self._ways = {pair: ways for pair, ways in self._ways.items() if not self._bends(*pair)}
                continue
            a, b = -pair[0], -pair[1]
            if all(way.weighed for way in self._ways[a, b]):
                self._join(a, b)
            else:
                self._weigh(a, b)

    def _bends(self, a: int, b: int) -> bool:
        """Whether two groups may be bent to be joined: rigidly nothing could be, and both hold enough scans."""
        return (
            self._bending
            and min(len(self.groups[k].poses) for k in (a, b)) >= expert().many_groups.bends_from
        )

    def _likely(self) -> tuple[int, int] | None:
        """The surest two groups that the scans could join, and have not been asked about."""
        least = self._rules.joined_worth - expert().many_groups.most_for
        voices = {
            (a, b): max((way.voices for way in ways if not way.weighed), default=least)
            for (a, b), ways in self._ways.items()
            if self._witness is not None and len(self.groups[a].poses) + len(self.groups[b].poses) > 2
        }
        pair = max(voices, key=lambda pair: (voices[pair], -pair[0], -pair[1]), default=None)
        return pair if pair is not None and voices[pair] > least else None

    def rivals(self) -> list[Motion]:
        """Of two groups: the ways to join them, weighed, the best first; none if only one is worth a look."""
        for pair in self._between:
            ways = self._motions(*pair)
            if len(ways) > 1 and ways[1].worth > max(expert().many_groups.rival * ways[0].worth, 0.0):
                self._ways[pair] = ways
                self._weigh(*pair)
                return self._ways[pair]
        return []

    def _motions(self, a: int, b: int) -> list[Motion]:
        """The ways to join two groups for which most speaks, no two alike, the best first."""
        one, other = self.groups[a], self.groups[b]
        edges = sorted(self._between[a, b], key=lambda e: (-e.worth, e.source, e.target))
        worth = np.array([min(edge.worth, expert().many_groups.most_worth) for edge in edges])
        motions = np.stack([_between_groups(edge, one, other) for edge in edges])
        bends = self._bends(a, b)
        agreeing = self._agreements(motions, edges, other, drifts(one, other, edges) if bends else None)
        free = np.ones(len(edges), dtype=np.bool_)
        found: list[Motion] = []
        while len(found) < expert().many_groups.most_transforms and free.any():
            voices = np.where(agreeing & free, worth, -np.inf)
            surest = voices.max(axis=1)
            further = np.maximum(voices, 0.0).sum(axis=1) - np.maximum(surest, 0.0)
            apart = np.array([agree_apart(edges, row & free, worth) for row in agreeing] if bends else [0.0])
            total = surest + np.maximum(self._rules.further_share * further, apart)
            best = int(np.where(free[: len(total)], total, -np.inf).argmax())
            if not free[best]:
                break
            mine = np.flatnonzero(agreeing[best] & free)
            voice = float(total[best])
            bent = bends and apart[best] > 0
            found.append(Motion(motions[best], [edges[k] for k in mine], voice, voice, bent))
            free[mine] = False
        return found

    def _agreements(
        self, motions: FloatArray, edges: list[Edge], b: Group, drift: FloatArray | None
    ) -> BoolArray:
        """(m, n) True where motion m of the first ones moves the scan of edge n as that edge does.

        Tolerances grow by ``drift`` (n, n), if given.
        """
        ends = [edge.source if edge.source in b.poses else edge.target for edge in edges]
        poses = np.stack([b.poses[scan] for scan in ends])
        rows, count = min(len(edges), expert().many_groups.most_proposals), len(edges)
        moved = (motions[:rows, None] @ poses[None]).reshape(-1, 4, 4)
        own = np.tile(motions @ poses, (rows, 1, 1))
        shift, turn = differences(moved, own, [self._shapes[scan] for scan in ends] * rows)
        more = 1.0 if drift is None else drift[:rows].ravel()
        alike = (shift < more * self._rules.tolerance) & (turn < more * self._rules.turn_deg)
        agreeing: BoolArray = alike.reshape(rows, count) | np.eye(rows, count, dtype=np.bool_)
        return agreeing

    def _weigh(self, a: int, b: int) -> None:
        """Take off every motion what the scans contradict."""
        for way in self._ways[a, b]:
            if self._witness is not None and not way.weighed:
                joined = self._joined(a, b, way)[1] if way.bends else None
                one, other = (self._around(self.groups[k].poses, way.supporters, joined) for k in (a, b))
                T, told = self._witness(one, other, None if way.bends else way.T_a_b)
                way.T_a_b = way.T_a_b if way.bends else T
                # Scans of one place are deceived alike: what many say does not outvote what was seen through.
                known = expert().many_groups
                most = known.most_worth if told < known.hopeless else np.inf
                way.worth = min(way.voices, most) + told
            way.weighed = True
        self._ways[a, b] = self._merged(self._ways[a, b], b)

    def _around(self, poses: Poses, supporters: Sequence[Edge], bent: Poses | None) -> Poses:
        """The scans of a group nearest to where some edges end in it: far away, poses have drifted; as bent, if so."""
        if bent is not None:
            poses = {k: bent[k] for k in poses}
        if len(poses) <= expert().many_groups.asked:
            return poses
        centers = {k: T[:3, :3] @ self._shapes[k].center + T[:3, 3] for k, T in poses.items()}
        ends = np.array([centers[k] for e in supporters for k in (e.source, e.target) if k in poses])
        away = {k: float(np.linalg.norm(ends - c, axis=1).min()) for k, c in centers.items()}
        return {k: poses[k] for k in sorted(poses, key=lambda k: (away[k], k))[: expert().many_groups.asked]}

    def _merged(self, ways: list[Motion], b: int) -> list[Motion]:
        """The ways, the best first; those that surfaces drew together, or that a bend tells apart, as one."""
        merged: list[Motion] = []
        for way in sorted(ways, key=lambda way: -way.worth):
            same = next((one for one in merged if self._alike(one, way, b)), None)
            if same is None:
                merged.append(way)
            elif way.worth > 0:
                same.worth += self._rules.further_share * way.worth
                same.supporters = [*same.supporters, *way.supporters]
        return merged

    def _alike(self, one: Motion, other: Motion, b: int) -> bool:
        poses = self.groups[b].poses
        ends = [edge.source if edge.source in poses else edge.target for edge in other.supporters]
        there = np.stack([poses[scan] for scan in ends])
        shift, turn = differences(one.T_a_b @ there, other.T_a_b @ there, [self._shapes[k] for k in ends])
        bent = expert().many_groups.bent
        alike = (shift < bent * self._rules.tolerance) & (turn < bent * self._rules.turn_deg)
        return bool(alike.all())

    def _joined(self, a: int, b: int, way: Motion) -> tuple[list[Edge], Poses]:
        """Edges and poses of two groups as one, optimised where there are loops to close."""
        one, other = self.groups[a], self.groups[b]
        poses = {**one.poses, **{scan: way.T_a_b @ T for scan, T in other.poses.items()}}
        edges = [*one.edges, *other.edges, *way.supporters]
        grown = len(other.poses) > 1 or _octave(len(poses)) > _octave(len(one.poses))
        if grown and len(edges) >= len(poses):
            poses = optimise(poses, edges, self._rules.tolerance, library=self._rules.optimizer)
        return edges, poses

    def _join(self, a: int, b: int) -> None:
        """Group b becomes part of group a."""
        way = self._ways[a, b][0]
        if way.bends:  # what agrees is believed together
            believed = [
                replace(e, evidence=e.evidence + max(way.worth - e.worth, 0.0)) for e in way.supporters
            ]
            way = replace(way, supporters=believed)
        edges, poses = self._joined(a, b, way)
        before, neighbors = self.groups[a].poses, {k for pair in self._between if b in pair for k in pair}
        self.groups.pop(b)
        self.groups[a] = Group(poses, edges)
        stays = not self._bending and all(poses[scan] is T for scan, T in before.items())
        crossing, self._between = self._between, {}
        for pair, some in crossing.items():
            c, d = sorted(a if number == b else number for number in pair)
            if c != d:
                self._between.setdefault((c, d), []).extend(some)
        # To groups that nothing ties to b the ways are what they were, unless scans have been asked about them.
        self._ways = {
            pair: ways
            for pair, ways in self._ways.items()
            if not {a, b} & set(pair)
            or (stays and neighbors.isdisjoint(set(pair) - {a}) and not any(way.weighed for way in ways))
        }


def lead(ways: Sequence[Motion]) -> float:
    """What speaks for the first motion, without what speaks for the second once the scans have been asked."""
    if not ways[0].weighed:
        return ways[0].worth
    return ways[0].worth - (max(ways[1].worth, 0.0) if len(ways) > 1 else 0.0)


def largest_first(groups: Iterable[Group]) -> list[Group]:
    """The groups by their number of scans; of equals the one with the first scan."""
    return sorted(groups, key=lambda group: (-len(group.poses), min(group.poses)))


def _between_groups(edge: Edge, a: Group, b: Group) -> FloatArray:
    """T_a_b by one edge, whichever way it runs."""
    T: FloatArray
    if edge.target in a.poses:
        T = a.poses[edge.target] @ edge.T_target_source @ inverse(b.poses[edge.source])
    else:
        T = a.poses[edge.source] @ inverse(edge.T_target_source) @ inverse(b.poses[edge.target])
    return T


def _octave(count: int) -> int:
    """Rises by one with every so many more: optimising after each single scan would cost its square."""
    return int(np.log(count) / np.log(expert().many_groups.fitted_from))
