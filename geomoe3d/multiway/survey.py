"""A survey: the scans of one model with what is known so far, the pairs to try next, the groups."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from geomoe3d.batch.folder import JOURNAL_FILE
from geomoe3d.batch.run import Labour, work
from geomoe3d.batch.store import BatchStore, Outcome
from geomoe3d.batch.table import PairRow
from geomoe3d.batch.task import open_cache
from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.viewpoint import find_viewpoints
from geomoe3d.config import RegistrationConfig
from geomoe3d.errors import GeoMoE3DError, InputError
from geomoe3d.geometry.se3 import inverse, shift_frames
from geomoe3d.multiway.alignment import Surface, align_groups, align_scans
from geomoe3d.multiway.cycles import with_cycles
from geomoe3d.multiway.edges import Edge, Shape, agrees, edge_of, predicted_motion
from geomoe3d.multiway.free_space import FreeSpace, told_by
from geomoe3d.multiway.grouping import Group, GroupingRules, Growth, Poses, largest_first, reconsidered
from geomoe3d.multiway.maps import MAPS_FOLDER, MapPair, map_pairs, write_map
from geomoe3d.multiway.overlaps import Overlaps
from geomoe3d.multiway.proposals import most_similar, scan_similarity
from geomoe3d.multiway.scans import Scan, natural_key
from geomoe3d.multiway.settling import settle
from geomoe3d.registration import Registrar
from geomoe3d.runtime.journal import read_journal
from geomoe3d.runtime.timing import StageClock
from geomoe3d.types import Float32Array, FloatArray

_MOST_SETTLINGS = 3
_TOLERANCE = 4.0  # voxels; see GroupingRules
_NEAR_TOLERANCE = 2.5
_KEPT_TOLERANCE = 1.5
_KEPT_ERROR = 3.0
_CLOSING_OVERLAP = 0.3
_SILENCE = ((0.3, 2.5), (0.2, 1.0), (0.1, 0.4))
"""Least overlap both ways, and log-odds against a motion under which a registered pair would overlap so much
but was registered otherwise. Of pairs that overlap by 0.3, 0.2 and 0.1, 98, 87 and 66 % are registered rightly."""
_CLOSING_PER_SCAN = 1
_SHARED_SILENCE = 0.5  # what makes one pair fail makes its neighbours fail

PairKey = tuple[int, int]
"""A pair of scans by their numbers, the smaller first; which of them is the source is told by the edge."""


class Survey:
    """The scans of one call with what is known of them so far.

    A scan is known by its number, its place among those given. Local coordinates are a scan's file
    coordinates minus its float64 origin; lengths are in cloud units.

    Args:
        scans: all of them, usable or not.
        config: of the pairs, with the voxel size of all scans.
        store: where the pairs are kept.
        labour: who registers them; its cache holds the described scans too.
        progress: called with (pairs done, pairs in all so far proposed), or None.
        say: called with sentences on what begins.

    Attributes:
        scans, config, store, labour, progress, say: as given.
        voxel_size: edge of the common grid.
        rules: when groups are joined and edges kept.
        unusable: why a scan cannot be registered, by number.
        shapes: of every scan, where its points lie in local coordinates; of an unusable one all zeros.
        surfaces: voxel points and normals (N, 3) in local coordinates, by number, of the usable scans.
        overlaps: predicts how much two usable scans overlap.
        similarity: (K, K) cosine of the descriptions of the scans as wholes; -inf where one is unusable, and
            between a scan and itself.
        outcomes: what became of every pair asked for so far, with motions in file coordinates.
        edges: those of them that gave a motion, with motions (4, 4) in local coordinates.
        map_edges: edges between scans that local maps about them gave, by the pair's id.
        free_space: tells what the sensors saw through.
        aligned: poses T_group_scan (4, 4) in local coordinates after `align`, by the poses before it.
    """

    def __init__(
        self,
        scans: list[Scan],
        config: RegistrationConfig,
        store: BatchStore,
        labour: Labour,
        progress: Callable[[int, int], None] | None,
        say: Callable[[str], None],
    ) -> None:
        self.scans, self.config, self.store, self.labour = scans, config, store, labour
        self.progress, self.say = progress, say
        self.voxel_size = float(config.voxel_size or 0.0)
        tolerances = (_TOLERANCE, _NEAR_TOLERANCE, _KEPT_TOLERANCE, _KEPT_ERROR)
        self.rules = GroupingRules(*(tolerance * self.voxel_size for tolerance in tolerances))
        self.unusable: dict[int, str] = {}
        self.shapes: list[Shape] = []
        self.surfaces: dict[int, Surface] = {}
        self.aligned: dict[tuple[tuple[int, bytes], ...], dict[int, FloatArray]] = {}
        self.overlaps = Overlaps({})
        self.free_space = FreeSpace({}, {}, self.voxel_size)
        self.similarity: FloatArray = np.zeros((0, 0))
        self.outcomes: dict[PairKey, Outcome] = {}
        self.edges: dict[PairKey, Edge] = {}
        self.map_edges: dict[str, Edge] = {}

    # ---- the scans by themselves

    def describe(self, unusable: dict[str, str]) -> None:
        """Every scan on the common grid: where its points lie, and how similar it is to the others.

        Args:
            unusable: scans that are known to be so, by name, and why.

        Raises:
            InputError: fewer than two scans can be used.
            ConfigError, CheckpointError, DependencyError: as `Registrar`.
        """
        registrar = Registrar(self.config, cache=open_cache(self.labour.cache))
        features: dict[int, Float32Array] = {}
        nowhere = Shape(np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros(3))
        for number, scan in enumerate(self.scans):
            self.shapes.append(nowhere)
            try:
                if scan.name in unusable:
                    raise InputError(unusable[scan.name])
                cloud = load_points(scan.path)
                view = find_viewpoints(cloud, cloud, self.config.preparation.viewpoint)[0]
                described = registrar.describe_cloud(cloud, self.voxel_size, view, StageClock())
            except GeoMoE3DError as error:
                self.unusable[number] = str(error)
                continue
            assert described.features is not None
            features[number] = described.features
            self.shapes[number] = Shape.of(described.points, described.origin, described.viewpoint)
            self.surfaces[number] = Surface.of(described)
        if len(features) < 2:
            raise InputError(f"fewer than 2 scans can be used: {'; '.join(self.unusable.values())}")
        points = {number: surface.points for number, surface in self.surfaces.items()}
        self.overlaps = Overlaps(points, seed=self.config.seed)
        sensors = {k: self.shapes[k].sensor for k, surface in self.surfaces.items() if surface.signed}
        self.free_space = FreeSpace(points, sensors, self.voxel_size, seed=self.config.seed)
        self.similarity = np.full((len(self.scans), len(self.scans)), -np.inf)
        usable = list(features)
        between = scan_similarity([features[k] for k in usable], seed=self.config.seed)
        self.similarity[np.ix_(usable, usable)] = between
        np.fill_diagonal(self.similarity, -np.inf)

    def usable(self) -> list[int]:
        """Numbers of the scans that can be registered."""
        return [k for k in range(len(self.scans)) if k not in self.unusable]

    # ---- which pairs

    def first_pairs(self, everything: bool, neighbors: int) -> list[PairKey]:
        """Pairs to begin with: those known already, and all, or the most similar ones of every scan.

        Args:
            everything: all pairs of usable scans.
            neighbors: otherwise so many per scan, but none between scans that have pairs already.
        """
        usable = self.usable()
        known = self._known()
        if everything:
            return sorted({(i, j) for j in usable for i in usable if i < j})
        settled = {scan for pair in known for scan in pair}
        wanted = set(known)
        for scan in usable:
            for other in most_similar(self.similarity, scan, usable, neighbors):
                if scan not in settled or other not in settled:
                    wanted.add(_key(scan, other))
        return sorted(wanted)

    def further_pairs(self, groups: list[Group], neighbors: int, *, closing: bool) -> list[PairKey]:
        """Pairs not tried yet that could tie loose scans and groups, or, if wanted, close loops.

        Args:
            groups: as they stand, the largest first.
            neighbors: how many are proposed per scan that is not in the largest group.
            closing: also pairs within a group whose poses say that they overlap.
        """
        more: set[PairKey] = set()
        largest = set(groups[0].poses)
        for group in groups:
            if set(group.poses) == largest or not set(group.poses) <= set(self.usable()):
                continue
            outside = [k for k in self.usable() if k not in group.poses]
            for scan in group.poses:
                untried = [k for k in outside if _key(scan, k) not in self.outcomes]
                found = most_similar(self.similarity, scan, untried, neighbors)
                more |= {_key(scan, other) for other in found}
        for group in groups if closing else []:
            more |= self._closing_pairs(group)
        return sorted(more)

    def _closing_pairs(self, group: Group) -> set[PairKey]:
        """Of every scan, the untried pairs that the poses say to overlap most."""
        chosen: set[PairKey] = set()
        scans = sorted(group.poses)
        for j in scans:
            found = []
            for i in scans:
                if i < j and (i, j) not in self.outcomes:
                    overlap = self.overlaps.of(j, i, predicted_motion(j, i, group.poses))
                    if overlap > _CLOSING_OVERLAP:
                        found.append((-overlap, i))
            chosen |= {(i, j) for _, i in sorted(found)[:_CLOSING_PER_SCAN]}
        return chosen

    def map_pairs(self, groups: list[Group]) -> list[MapPair]:
        """Pairs of local maps that could tie groups which are still apart."""
        usable = [group for group in groups if set(group.poses) <= self.surfaces.keys()]
        return map_pairs(usable, self.heard(), self.similarity, self.overlaps)

    def _known(self) -> set[PairKey]:
        """Pairs in the journal whose scans and files are the same today."""
        number = {self._row((i, j)).id: (i, j) for j in self.usable() for i in self.usable() if i < j}
        known = set()
        for record in read_journal(self.store.folder / JOURNAL_FILE):
            pair = number.get(str(record.get("id")))
            if pair is not None and record.get("fingerprint") == self._row(pair).fingerprint():
                known.add(pair)
        return known

    def _ends(self, pair: PairKey) -> tuple[int, int]:
        """Source and target of a pair: by name, whatever the order in which scans are given."""
        a, b = sorted(pair, key=lambda k: (natural_key(self.scans[k].name), self.scans[k].path))
        return b, a

    def _row(self, pair: PairKey) -> PairRow:
        source, target = (self.scans[k].path for k in self._ends(pair))
        # Paths, not names: two pairs may have one name between them, and names grow as scans join.
        return PairRow(json.dumps([source, target], ensure_ascii=False), source, target)

    # ---- registering and grouping

    def register(self, pairs: list[PairKey]) -> None:
        """Register what is missing of the pairs."""
        rows = {pair: self._row(pair) for pair in pairs if pair not in self.outcomes}
        if not rows:
            return
        records, _ = work(
            list(rows.values()), self.store, self.config, self.labour, progress=self._count(), say=self.say
        )
        for pair, row in rows.items():
            outcome = self.store.outcome(records[row.id])
            self.outcomes[pair] = outcome
            edge = edge_of(outcome, *self._ends(pair), self.shapes)
            if edge is not None:
                self.edges[pair] = edge

    def _count(self) -> Callable[[int, int], None] | None:
        """Progress of one round, told as that of all pairs so far proposed."""
        tell, before = self.progress, len(self.outcomes)
        if tell is None:
            return None
        return lambda done, total: tell(before + done, before + total)

    def register_maps(self, pairs: list[MapPair], groups: list[Group]) -> None:
        """Register pairs of local maps; what they give are further edges between their anchors."""
        home = {scan: group.poses for group in groups for scan in group.poses}
        rows: dict[int, PairRow] = {}
        frames = {k: replace(shape, origin=-self._stand(k)) for k, shape in enumerate(self.shapes)}
        for number, pair in enumerate(pairs):
            source, target = (
                str(
                    write_map(
                        self.store.folder / MAPS_FOLDER,
                        members,
                        home[members[0]],
                        self.surfaces,
                        self._stand(members[0]),
                    ).resolve()
                )
                for members in pair.members
            )
            initial = None
            if pair.T_target_source is not None:
                ends = -self._stand(pair.source), -self._stand(pair.target)
                initial = tuple(float(x) for x in shift_frames(pair.T_target_source, *ends).ravel())
            rows[number] = PairRow(json.dumps([source, target], ensure_ascii=False), source, target, initial)
        unique = {row.id: row for row in rows.values()}
        records, _ = work(
            list(unique.values()), self.store, self.config, self.labour, progress=self._count(), say=self.say
        )
        for number, row in rows.items():
            pair, outcome = pairs[number], self.store.outcome(records[row.id])
            edge = edge_of(outcome, pair.source, pair.target, frames)
            if edge is not None:
                self.map_edges[row.id] = edge

    def _stand(self, scan: int) -> FloatArray:
        """(3,) where the sensor of a scan stood, or zero where that is not known; local coordinates."""
        known = scan in self.surfaces and self.surfaces[scan].signed
        return self.shapes[scan].sensor if known else np.zeros(3)

    def group(self) -> list[Group]:
        """Groups by all edges so far; a scan that cannot be used is a group of its own.

        What settling lets go may find its place among scans that are better aligned now, so groups are joined
        and settled again while that joins any.
        """
        edges = self.heard()
        groups = [Group({k: np.eye(4)}) for k in range(len(self.scans))]
        for turn in range(_MOST_SETTLINGS):
            grown = Growth(groups, edges, self.shapes, self.rules, self.witness).run()
            if turn and len(grown) == len(groups):
                break
            grown = [part for group in grown for part in reconsidered(group, edges, self.shapes, self.rules, self.witness)]
            groups = [
                part for group in grown for part in settle(group, edges, self.shapes, self.rules, self.align)
            ]
        return largest_first(groups)

    def heard(self) -> list[Edge]:
        """All edges so far, with what cycles say of them."""
        best = dict(self.edges)
        further: list[Edge] = []
        for edge in self.map_edges.values():
            pair = _key(edge.source, edge.target)
            one = best.get(pair)
            if one is None or not self._alike(one, edge):
                further.append(edge)
            elif edge.confidence > one.confidence:  # the same said twice is no second witness
                best[pair] = edge
        edges = [*(best[key] for key in sorted(best)), *further]
        return with_cycles(edges, self.shapes, self.rules.tolerance, self.rules.turn_deg)

    def _alike(self, one: Edge, other: Edge) -> bool:
        T = other.T_target_source if other.source == one.source else inverse(other.T_target_source)
        return agrees(
            one.T_target_source, T, self.shapes[one.source], self.rules.tolerance, self.rules.turn_deg
        )

    def witness(
        self, a: Mapping[int, FloatArray], b: Mapping[int, FloatArray], T_a_b: FloatArray
    ) -> tuple[FloatArray, float]:
        """What the scans say of joining two groups, see `geomoe3d.multiway.grouping.Witness`.

        Of two single scans nothing: registration asked them already.
        """
        if len(a) * len(b) == 1:
            return T_a_b, 0.0
        T_a_b = align_groups(a, b, T_a_b, self.surfaces, self.overlaps, self.voxel_size)
        silent = sum(self._silence(i, j, inverse(a[i]) @ T_a_b @ b[j]) for i, j in self._tried_between(a, b))
        return T_a_b, told_by(*self.free_space.between(a, b, T_a_b)) - _SHARED_SILENCE * silent

    def _tried_between(
        self, a: Mapping[int, FloatArray], b: Mapping[int, FloatArray]
    ) -> list[tuple[int, int]]:
        """Registered pairs (i in a, j in b) across two groups."""
        return [(i, j) for i in a for j in b if _key(i, j) in self.outcomes]

    def _silence(self, i: int, j: int, T_i_j: FloatArray) -> float:
        """Log-odds against a motion by a pair that would overlap under it, but was registered otherwise."""
        overlap = min(self.overlaps.of(j, i, T_i_j), self.overlaps.of(i, j, inverse(T_i_j)))
        told = next((odds for least, odds in _SILENCE if overlap >= least), 0.0)
        edge = self.edges.get(_key(i, j))
        if told == 0.0 or edge is None:
            return told
        T = T_i_j if edge.target == i else inverse(T_i_j)
        near = 2 * self.rules.tolerance, 2 * self.rules.turn_deg
        return 0.0 if agrees(T, edge.T_target_source, self.shapes[edge.source], *near) else told

    def align(self, poses: Poses) -> Poses:
        """The poses of a group laid on each other by the scans' surfaces; once, however often asked.

        Args:
            poses: T_group_scan (4, 4) in local coordinates, by number; so is what is returned.
        """
        key = tuple((scan, poses[scan].tobytes()) for scan in sorted(poses))
        if key not in self.aligned:
            self.aligned[key] = align_scans(
                poses, self.surfaces, self.overlaps, self.voxel_size, seed=self.config.seed
            )
        return dict(self.aligned[key])


def _key(a: int, b: int) -> PairKey:
    return (a, b) if a < b else (b, a)
