"""From edges of which most may be wrong to groups of scans with poses, by growing what is sure.

Two groups are joined by the motion for which most speaks: edges between them that agree add up, the best
other motion is taken off, and so is what the scans themselves contradict, such as points of one group where
sensors of the other saw through. The surest joint is made first. What has been joined is never torn by
weaker edges: these are found to disagree with the poses and rejected. Cost: milliseconds per joined scan.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from geomoe3d.config import expert
from geomoe3d.geometry.se3 import inverse
from geomoe3d.multiway.bending import unbend
from geomoe3d.multiway.edges import Edge, Shape, differences
from geomoe3d.multiway.pose_graph import optimise
from geomoe3d.multiway.rules import Group, GroupingRules, Poses
from geomoe3d.types import BoolArray, FloatArray

Witness = Callable[[Mapping[int, FloatArray], Mapping[int, FloatArray], FloatArray], tuple[FloatArray, float]]
"""Asked of two groups (poses of each) and a motion T_a_b (4, 4): the motion as the surfaces have it, and the
log-odds by which the scans speak for it (negative: against)."""
Align = Callable[[Poses], Poses]
"""Poses to better poses, by the surfaces of the scans."""


@dataclass
class Motion:
    """One way to join two groups.

    Attributes:
        T_a_b: (4, 4) group b in the frame of group a.
        supporters: edges that agree with it.
        voices: what they bring together.
        worth: that; once ``weighed``, without what the scans contradict.
        weighed: whether the scans have been asked.
        poses: of all scans of both groups in the frame of a, where joining them unbends them.
    """

    T_a_b: FloatArray
    supporters: list[Edge]
    voices: float
    worth: float
    weighed: bool = False
    poses: Poses | None = None


class Growth:
    """Groups that grow together.

    Args:
        groups: to begin with; no scan is in two of them.
        edges: of all registered pairs, with what cycles say of them.
        shapes: of all scans.
        rules: thresholds.
        witness: what the scans say of a motion between two groups; None: they are not asked.
        align: lays scans on each other's surfaces, for groups that are unbent as they join; None: none are.
    """

    def __init__(
        self,
        groups: Sequence[Group],
        edges: Sequence[Edge],
        shapes: Sequence[Shape],
        rules: GroupingRules,
        witness: Witness | None = None,
        align: Align | None = None,
    ) -> None:
        self.groups = {min(group.poses): group for group in groups}
        self._shapes, self._rules, self._witness, self._align = shapes, rules, witness, align
        self._unbent: set[tuple[tuple[int, ...], tuple[int, ...]]] = set()
        home = {scan: number for number, group in self.groups.items() for scan in group.poses}
        self._between: dict[tuple[int, int], list[Edge]] = {}
        for edge in edges:
            a, b = home[edge.source], home[edge.target]
            if a != b and edge.worth > rules.least_worth:
                self._between.setdefault((min(a, b), max(a, b)), []).append(edge)
        self._ways: dict[tuple[int, int], list[Motion]] = {}

    def run(self) -> list[Group]:
        """Join while anything is sure; the groups, the largest first."""
        while True:
            for pair in self._between.keys() - self._ways.keys():
                self._ways[pair] = self._motions(*pair)
            worth, pair = max(
                ((lead(ways), (-a, -b)) for (a, b), ways in self._ways.items()), default=(0.0, (0, 0))
            )
            if worth < self._rules.joined_worth:
                if any(self._unbend(*pair) for pair in self._bent()):
                    continue
                return largest_first(self.groups.values())
            a, b = -pair[0], -pair[1]
            if all(way.weighed for way in self._ways[a, b]):
                self._join(a, b)
            else:
                self._weigh(a, b)

    def rivals(self) -> list[Motion]:
        """Of two groups: the ways to join them, weighed, the best first; none if only one is worth a look."""
        for pair in self._between:
            ways = self._motions(*pair)
            if len(ways) > 1 and ways[1].worth > expert().many_groups.rival * ways[0].worth:
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
        agreeing = self._agreements(motions, edges, other)
        free = np.ones(len(edges), dtype=np.bool_)
        found: list[Motion] = []
        while len(found) < expert().many_groups.most_transforms and free.any():
            voices = np.where(agreeing & free, worth, 0.0)
            surest = voices.max(axis=1)
            total = surest + self._rules.further_share * (voices.sum(axis=1) - surest)
            best = int(np.where(free[: len(total)], total, -1.0).argmax())
            if not free[best]:
                break
            mine = np.flatnonzero(agreeing[best] & free)
            worth_of_all = float(total[best])
            found.append(Motion(motions[best], [edges[k] for k in mine], worth_of_all, worth_of_all))
            free[mine] = False
        return found

    def _agreements(self, motions: FloatArray, edges: list[Edge], b: Group) -> BoolArray:
        """(m, n) True where motion m of the first ones moves the scan of edge n as that edge does."""
        ends = [edge.source if edge.source in b.poses else edge.target for edge in edges]
        poses = np.stack([b.poses[scan] for scan in ends])
        rows, count = min(len(edges), expert().many_groups.most_proposals), len(edges)
        moved = (motions[:rows, None] @ poses[None]).reshape(-1, 4, 4)
        own = np.tile(motions @ poses, (rows, 1, 1))
        shift, turn = differences(moved, own, [self._shapes[scan] for scan in ends] * rows)
        alike = (shift < self._rules.tolerance) & (turn < self._rules.turn_deg)
        agreeing: BoolArray = alike.reshape(rows, count) | np.eye(rows, count, dtype=np.bool_)
        return agreeing

    def _weigh(self, a: int, b: int) -> None:
        """Take off every motion what the scans contradict."""
        for way in self._ways[a, b]:
            if self._witness is not None and not way.weighed:
                one, other = (self._around(self.groups[k].poses, way.supporters) for k in (a, b))
                way.T_a_b, told = self._witness(one, other, way.T_a_b)
                way.worth += told
            way.weighed = True
        self._ways[a, b] = self._merged(self._ways[a, b], b)

    def _bent(self) -> list[tuple[int, int]]:
        """Pairs of groups that more than one way would join, the surest first, each asked once as they are."""
        found = []
        for (a, b), ways in self._ways.items():
            sizes = [len(self.groups[k].poses) for k in (a, b)]
            if (
                self._align
                and min(sizes) >= expert().many_groups.least_bent
                and len(ways) > 1
                and not self._was_unbent(a, b)
            ):
                found.append((-sum(way.voices for way in ways), a, b))
        return [(a, b) for _, a, b in sorted(found)]

    def _was_unbent(self, a: int, b: int) -> bool:
        return (tuple(self.groups[a].poses), tuple(self.groups[b].poses)) in self._unbent

    def _unbend(self, a: int, b: int) -> bool:
        """Find one way of those that differ as far as drift explains, if the scans agree with it."""
        self._unbent.add((tuple(self.groups[a].poses), tuple(self.groups[b].poses)))
        ways = sorted(self._ways[a, b], key=lambda way: -way.voices)
        one, other, best = self.groups[a], self.groups[b], ways[0]
        further = [edge for way in ways[1:] for edge in way.supporters]
        poses, fitting = unbend(one, other, best.T_a_b, best.supporters, further, self._shapes, self._rules)
        share, ids = self._rules.further_share, {id(edge) for edge in fitting}
        voices = best.voices + share * sum(min(e.worth, expert().many_groups.most_worth) for e in fitting)
        if not fitting or voices < self._rules.joined_worth or self._align is None or self._witness is None:
            return False
        joint = [*best.supporters, *fitting]
        near = [self._around(group.poses, joint) for group in (one, other)]
        aligned = self._align({k: poses[k] for part in near for k in part})
        here, there = ({k: aligned[k] for k in part} for part in near)
        _, told = self._witness(here, there, np.eye(4))
        if len(aligned) == len(poses):
            poses = aligned
        rivals = [way for way in ways[1:] if not ids & {id(edge) for edge in way.supporters}]
        way = Motion(best.T_a_b, joint, voices, voices + told, weighed=True, poses=poses)
        if lead([way, *sorted(rivals, key=lambda rival: -rival.worth)]) < self._rules.joined_worth:
            return False
        self._ways[a, b] = [way, *rivals]
        return True

    def _around(self, poses: Poses, supporters: Sequence[Edge]) -> Poses:
        """The scans of a group nearest to where some edges end in it: far away, poses have drifted."""
        if len(poses) <= expert().many_groups.asked:
            return poses
        centers = {k: T[:3, :3] @ self._shapes[k].center + T[:3, 3] for k, T in poses.items()}
        ends = np.array([centers[k] for e in supporters for k in (e.source, e.target) if k in poses])
        away = {k: float(np.linalg.norm(ends - c, axis=1).min()) for k, c in centers.items()}
        return {k: poses[k] for k in sorted(poses, key=lambda k: (away[k], k))[: expert().many_groups.asked]}

    def _merged(self, ways: list[Motion], b: int) -> list[Motion]:
        """The ways, the best first, those that the surfaces drew together as one."""
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
        return bool((shift < self._rules.tolerance).all() and (turn < self._rules.turn_deg).all())

    def _join(self, a: int, b: int) -> None:
        """Group b becomes part of group a; poses are optimised where there are loops to close."""
        way, one, other = self._ways[a, b][0], self.groups[a], self.groups.pop(b)
        poses = way.poses or {**one.poses, **{scan: way.T_a_b @ T for scan, T in other.poses.items()}}
        edges = [*one.edges, *other.edges, *way.supporters]
        grown = len(other.poses) > 1 or _octave(len(poses)) > _octave(len(one.poses))
        if grown and len(edges) >= len(poses):
            poses = optimise(poses, edges, self._rules.tolerance, library=self._rules.optimizer)
        self.groups[a] = Group(poses, edges)
        crossing, self._between = self._between, {}
        for pair, some in crossing.items():
            c, d = sorted(a if number == b else number for number in pair)
            if c != d:
                self._between.setdefault((c, d), []).extend(some)
        self._ways = {pair: ways for pair, ways in self._ways.items() if not {a, b} & set(pair)}


def reconsidered(
    group: Group,
    edges: Sequence[Edge],
    shapes: Sequence[Shape],
    rules: GroupingRules,
    witness: Witness,
) -> list[Group]:
    """The group with every scan that has a rival place put where most speaks for it now, or let go.

    A scan that joined early was weighed against few others; now the whole model can be asked.

    Args:
        group: from `Growth`.
        edges, shapes, rules, witness: as `Growth` takes them.

    Returns:
        The group, and scans by themselves for which no place leads clearly enough.
    """
    released: list[Group] = []
    edges = [replace(e, evidence=0.0) for e in edges]  # what triangles say is what the model says
    for scan in sorted(group.poses) if len(group.poses) > 2 else ():
        rest = {k: T for k, T in group.poses.items() if k != scan}
        mine = [
            e for e in edges if scan in (e.source, e.target) and {e.source, e.target} <= group.poses.keys()
        ]
        ways = Growth([Group(rest), Group({scan: np.eye(4)})], mine, shapes, rules, witness).rivals()
        if len(ways) < 2:
            continue
        found = ways[0].T_a_b if min(rest) < scan else inverse(ways[0].T_a_b)
        shift, turn = differences(group.poses[scan][None], found[None], [shapes[scan]])
        if shift[0] < 2 * rules.tolerance and turn[0] < 2 * rules.turn_deg:
            continue
        others = [e for e in group.edges if scan not in (e.source, e.target)]
        if lead(ways) >= rules.joined_worth:
            group = Group({**rest, scan: found}, [*others, *ways[0].supporters])
        else:
            group = Group(rest, others)
            released.append(Group({scan: np.eye(4)}))
    return [group, *released]


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
    """Rises by one with every quarter more: optimising after each single scan would cost its square."""
    return int(np.log(count) / np.log(1.25))
