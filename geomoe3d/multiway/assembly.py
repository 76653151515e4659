"""From registered pairs to groups with poses: triangles, growth, second thoughts, surfaces.

Place: after every round of pairs. What speaks for an edge is heard first (`cycles`), then groups grow
(`grouping`), where two groups meet their scans are asked (free space, and pairs that should have been
registered rightly and were not), every scan with a rival place is weighed again, and what came of it is laid
on its surfaces (`settling`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from geomoe3d.config import expert
from geomoe3d.geometry.se3 import inverse
from geomoe3d.multiway.alignment import align_groups, align_scans
from geomoe3d.multiway.cycles import with_cycles
from geomoe3d.multiway.edges import Edge, agrees
from geomoe3d.multiway.free_space import told_by
from geomoe3d.multiway.grouping import Growth, largest_first
from geomoe3d.multiway.holding import loosely_held
from geomoe3d.multiway.rules import Group, Poses
from geomoe3d.multiway.second_thoughts import reconsidered
from geomoe3d.multiway.settling import connected_parts, settle
from geomoe3d.multiway.survey import PairKey, Survey, key_of
from geomoe3d.types import FloatArray


class Assembly:
    """Puts the scans of a survey together, again after every round.

    Args:
        survey: described scans and what is known of their pairs.

    Attributes:
        edges: those that the last groups were made of, with what triangles say of them.
    """

    def __init__(self, survey: Survey) -> None:
        self._survey = survey
        self.edges: list[Edge] = []
        self._let_go: set[int] = set()
        self._aligned: dict[tuple[tuple[int, bytes], ...], Poses] = {}

    def groups(self) -> list[Group]:
        """Groups by all edges so far; a scan that cannot be used is a group of its own."""
        self.edges = self._heard()
        return self._grown()

    def _grown(self) -> list[Group]:
        """Groups by the edges as they are heard.

        What settling lets go may find its place among scans that are better aligned now, so groups are joined
        and settled again while that joins any.
        """
        survey = self._survey
        groups = [Group({k: np.eye(4)}) for k in range(len(survey.scans))]
        self._let_go = set()
        for turn in range(expert().many_groups.most_turns):
            grown = Growth(groups, self._usable(), survey.shapes, survey.rules, self.witness).run()
            if turn and len(grown) == len(groups):
                break
            # Edges that bent groups together are believed more than before.
            held = {id(edge.T_target_source): edge for group in grown for edge in group.edges}
            self.edges = [held.get(id(edge.T_target_source), edge) for edge in self.edges]
            told = self._usable(), survey.shapes, survey.rules
            placed = [part for group in grown for part in reconsidered(group, *told, self.witness)]
            groups = [part for group in placed for part in self._settled(group)]
        return largest_first(groups)

    def _usable(self) -> list[Edge]:
        """The edges but those that held a scan where it cannot be."""
        return [edge for edge in self.edges if id(edge.T_target_source) not in self._let_go]

    def _settled(self, group: Group) -> list[Group]:
        """The group laid on its surfaces, and what let go of it, or is let go with the edges that held it."""
        survey, parts = self._survey, []
        for part in settle(group, self._usable(), survey.shapes, survey.rules, self.align):
            loose = loosely_held(survey, part)
            if not loose:
                parts.append(part)
                continue
            self._let_go |= {id(e.T_target_source) for e in part.edges if loose & {e.source, e.target}}
            parts += [Group({k: np.eye(4)}) for k in sorted(loose)]
            kept = [e for e in part.edges if not loose & {e.source, e.target}]
            for scans in connected_parts(part.poses.keys() - loose, kept):
                parts += self._settled(Group({k: part.poses[k] for k in scans}))
        return parts

    def _heard(self) -> list[Edge]:
        """All edges so far, with what triangles and the order of the scans say of them.

        Where a pair of scans and one of local maps about them agree, the surer of the two is taken: the same
        said twice is no second witness.
        """
        survey = self._survey
        known: dict[PairKey, list[Edge]] = {key: [survey.edges[key]] for key in sorted(survey.edges)}
        for edge in [*survey.map_edges.values(), *survey.odometry()]:
            rivals = known.setdefault(key_of(edge.source, edge.target), [])
            same = next((k for k, one in enumerate(rivals) if self._alike(one, edge)), None)
            if same is None:
                rivals.append(edge)
            elif edge.confidence > rivals[same].confidence:
                rivals[same] = edge
        edges = [edge for rivals in known.values() for edge in rivals]
        if survey.sequence:
            likely = expert().many_groups.in_sequence
            edges = [replace(e, expected=likely) if abs(e.source - e.target) == 1 else e for e in edges]
        return with_cycles(edges, survey.shapes, survey.rules.tolerance, survey.rules.turn_deg)

    def _alike(self, one: Edge, other: Edge) -> bool:
        T = other.T_target_source if other.source == one.source else inverse(other.T_target_source)
        return agrees(
            one.T_target_source,
            T,
            self._survey.shapes[one.source],
            self._survey.rules.tolerance,
            self._survey.rules.turn_deg,
        )

    def witness(
        self, a: Mapping[int, FloatArray], b: Mapping[int, FloatArray], T_a_b: FloatArray | None
    ) -> tuple[FloatArray, float]:
        """What the scans say of joining two groups, see `geomoe3d.multiway.grouping.Witness`.

        Of two single scans nothing: registration asked them already.
        """
        known, free_space = expert().many_groups, self._survey.free_space
        usual = known.usual
        if T_a_b is None:
            T_a_b, usual = np.eye(4), known.usual_bent
        elif len(a) * len(b) == 1:
            return T_a_b, 0.0
        else:
            told = told_by(*free_space.between(a, b, T_a_b), usual)
            if told < known.hopeless:
                return T_a_b, told
            T_a_b = align_groups(
                a, b, T_a_b, self._survey.surfaces, self._survey.overlaps, self._survey.voxel_size
            )
        silent = sum(self._silence(i, j, inverse(a[i]) @ T_a_b @ b[j]) for i, j in self._tried_between(a, b))
        told = told_by(*free_space.between(a, b, T_a_b), usual)
        return T_a_b, told - known.shared_silence * silent

    def _tried_between(
        self, a: Mapping[int, FloatArray], b: Mapping[int, FloatArray]
    ) -> list[tuple[int, int]]:
        """Registered pairs (i in a, j in b) across two groups."""
        return [(i, j) for i in a for j in b if key_of(i, j) in self._survey.outcomes]

    def _silence(self, i: int, j: int, T_i_j: FloatArray) -> float:
        """Log-odds against a motion by a pair that would overlap under it, but was registered otherwise."""
        overlap = min(self._survey.overlaps.of(j, i, T_i_j), self._survey.overlaps.of(i, j, inverse(T_i_j)))
        known = zip(expert().many_groups.silent_overlaps, expert().many_groups.silent_odds, strict=True)
        told = next((odds for least, odds in known if overlap >= least), 0.0)
        edge = self._survey.edges.get(key_of(i, j))
        if told == 0.0 or edge is None:
            return told
        T = T_i_j if edge.target == i else inverse(T_i_j)
        near = 2 * self._survey.rules.tolerance, 2 * self._survey.rules.turn_deg
        return 0.0 if agrees(T, edge.T_target_source, self._survey.shapes[edge.source], *near) else told

    def align(self, poses: Poses) -> Poses:
        """The poses of a group laid on each other by the scans' surfaces; once, however often asked.

        Args:
            poses: T_group_scan (4, 4) in local coordinates, by number; so is what is returned.
        """
        key = tuple((scan, poses[scan].tobytes()) for scan in sorted(poses))
        if key not in self._aligned:
            self._aligned[key] = align_scans(
                poses,
                self._survey.surfaces,
                self._survey.overlaps,
                self._survey.voxel_size,
                seed=self._survey.config.seed,
            )
        return dict(self._aligned[key])
