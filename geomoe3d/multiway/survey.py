"""A survey: the scans of one model with what is known so far, the pairs to try next, the groups."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from geomoe3d.batch.folder import JOURNAL_FILE
from geomoe3d.batch.run import Labour, work
from geomoe3d.batch.store import BatchStore, Outcome
from geomoe3d.batch.table import PairRow
from geomoe3d.batch.task import open_cache
from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.viewpoint import find_viewpoints
from geomoe3d.clouds.voxel_size import bounded_voxel_size, robust_extent
from geomoe3d.config import RegistrationConfig, expert
from geomoe3d.decision.scale import likely_unit_ratio
from geomoe3d.decision.similarity import scaled_cloud
from geomoe3d.errors import FormatError, GeoMoE3DError, InputError
from geomoe3d.geometry.se3 import inverse, shift_frames
from geomoe3d.multiway.alignment import Surface
from geomoe3d.multiway.edges import Edge, Shape, edge_of
from geomoe3d.multiway.free_space import FreeSpace
from geomoe3d.multiway.initial import InitialPoses
from geomoe3d.multiway.maps import MAPS_FOLDER, MapPair, map_pairs, whole_pairs, write_map
from geomoe3d.multiway.overlaps import Overlaps
from geomoe3d.multiway.pose_graph import Library
from geomoe3d.multiway.proposals import most_similar, scan_similarity
from geomoe3d.multiway.rules import Group, GroupingRules
from geomoe3d.multiway.scans import Scan
from geomoe3d.registration import Registrar
from geomoe3d.runtime.journal import read_journal
from geomoe3d.runtime.timing import StageClock
from geomoe3d.runtime.words import counted, natural_key
from geomoe3d.types import Float32Array, FloatArray, PointCloud

PairKey = tuple[int, int]
"""Two numbers of scans, the smaller first."""


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
        sequence: whether the scans are given in the order in which they were taken.
        initial: poses of all scans from elsewhere, as of odometry; implies a sequence.
        optimizer: the library that fits poses to edges.

    Attributes:
        scans, config, store, labour, progress, say, sequence, initial: as given.
        voxel_size: edge of the common grid.
        rules: when groups are joined and edges kept.
        unusable: why a scan cannot be registered, by number.
        shapes: of every scan, where its points lie in local coordinates; of an unusable one all zeros.
        surfaces: voxel points and normals (N, 3) in local coordinates, by number, of the usable scans.
        overlaps: predicts how much two usable scans overlap.
        similarity: (K, K) cosine of the descriptions of the scans as wholes, of an unusable one in the unit that
            makes it as large as the others; -inf where one has no description, and between a scan and itself.
        outcomes: what became of every pair asked for so far, with motions in file coordinates.
        edges: those of them that gave a transform, with motions (4, 4) in local coordinates.
        map_edges: edges between scans that local maps about them gave, by the pair's id.
        free_space: tells what the sensors saw through.
    """

    def __init__(
        self,
        scans: list[Scan],
        config: RegistrationConfig,
        store: BatchStore,
        labour: Labour,
        progress: Callable[[int, int], None] | None,
        say: Callable[[str], None],
        *,
        sequence: bool = False,
        initial: InitialPoses | None = None,
        optimizer: Library = "open3d",
    ) -> None:
        self.scans, self.config, self.store, self.labour = scans, config, store, labour
        self.progress, self.say = progress, say
        self.sequence, self.initial = sequence or initial is not None, initial
        self.voxel_size = float(config.voxel_size or 0.0)
        joined, near, kept, error = np.array(expert().many_poses.tolerances) * self.voxel_size
        self.rules = GroupingRules(joined, near, kept, error, optimizer=optimizer)
        self.unusable: dict[int, str] = {}
        self.shapes: list[Shape] = []
        self.surfaces: dict[int, Surface] = {}
        self.overlaps = Overlaps({}, self.voxel_size)
        self.free_space = FreeSpace({}, {}, self.voxel_size)
        self.similarity: FloatArray = np.zeros((0, 0))
        self.outcomes: dict[PairKey, Outcome] = {}
        self.edges: dict[PairKey, Edge] = {}
        self.map_edges: dict[str, Edge] = {}
        self._done = 0  # pairs, those of maps too

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
        odd: dict[int, PointCloud] = {}
        nowhere = Shape(np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros(3))
        for number, scan in enumerate(self.scans):
            self.shapes.append(nowhere)
            try:
                if scan.name in unusable:
                    raise InputError(unusable[scan.name])
                cloud = load_points(scan.path)
                view = find_viewpoints(cloud, cloud, self.config.preparation.viewpoint)[0]
                odd[number] = cloud
                # A scan far larger than the others, or in a smaller unit, must not make the grid of all coarser.
                most = self.config.preparation.max_points
                size = bounded_voxel_size(cloud, cloud, self.voxel_size, most)
                described = registrar.pipeline.prepare(cloud, size, view, StageClock())
            except GeoMoE3DError as error:
                self.unusable[number] = str(error)
                continue
            del odd[number]
            assert described.features is not None
            features[number] = described.features
            self.shapes[number] = Shape.of(described.points, described.origin, described.viewpoint)
            self.surfaces[number] = Surface.of(described)
        if len(features) < 2:
            raise InputError(f"fewer than 2 scans can be used: {'; '.join(self.unusable.values())}")
        points = {number: surface.points for number, surface in self.surfaces.items()}
        extent = float(np.median([robust_extent(some) for some in points.values()]))
        for number, cloud in odd.items():
            try:
                features[number] = self._features_in_unit(registrar, cloud, extent)
            except GeoMoE3DError:  # it stays unlike all others
                continue
        self.overlaps = Overlaps(points, self.voxel_size, seed=self.config.seed)
        sensors = {k: self.shapes[k].sensor for k, surface in self.surfaces.items() if surface.signed}
        self.free_space = FreeSpace(points, sensors, self.voxel_size, seed=self.config.seed)
        self.similarity = np.full((len(self.scans), len(self.scans)), -np.inf)
        known = sorted(features)
        between = scan_similarity([features[k] for k in known], seed=self.config.seed)
        self.similarity[np.ix_(known, known)] = between
        np.fill_diagonal(self.similarity, -np.inf)

    def _features_in_unit(self, registrar: Registrar, cloud: PointCloud, extent: float) -> Float32Array:
        """Features of a scan that is of no use as it is, in the unit in which it is about as large as the others.

        Raises:
            GeoMoE3DError: it is of no use in that unit either, or its extent is not that of another unit.
        """
        ratio = likely_unit_ratio((robust_extent(cloud.points), extent))
        if ratio is None:
            raise InputError(f"'{cloud.name}' is not of another unit")
        features = registrar.pipeline.prepare(
            scaled_cloud(cloud, 1 / ratio), self.voxel_size, None, StageClock()
        ).features
        assert features is not None
        return features

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
        settled = {scan for pair in known for scan in pair}
        if self.sequence:
            known |= {key_of(i, j) for i, j in pairwise(usable) if j == i + 1}
        if everything:
            return sorted({(i, j) for j in usable for i in usable if i < j})
        wanted = set(known)
        for scan in usable:
            for other in most_similar(self.similarity, scan, usable, neighbors):
                if scan not in settled or other not in settled:
                    wanted.add(key_of(scan, other))
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
                untried = [k for k in outside if key_of(scan, k) not in self.outcomes]
                found = most_similar(self.similarity, scan, untried, neighbors)
                more |= {key_of(scan, other) for other in found}
        for group in groups if closing else []:
            more |= self._closing_pairs(group)
        return sorted(more)

    def _closing_pairs(self, group: Group) -> set[PairKey]:
        """Of every scan, the untried pairs that the poses say to overlap most."""
        limits, found = expert().many_pairs, dict[int, list[tuple[float, int]]]()
        shared = self.overlaps.between(group.poses, group.poses, limits.closing_overlap)
        for (j, i), overlap in shared.items():
            if i < j and (i, j) not in self.outcomes and overlap > limits.closing_overlap:
                found.setdefault(j, []).append((-overlap, i))
        return {(i, j) for j, some in found.items() for _, i in sorted(some)[: limits.closing_per_scan]}

    def map_pairs(self, groups: list[Group], edges: Sequence[Edge]) -> list[MapPair]:
        """Pairs of local maps that could tie groups which are still apart.

        Args:
            groups: as they stand, the largest first.
            edges: all so far, with what cycles say of them.
        """
        return map_pairs(
            self._described(groups), edges, self.similarity, self.overlaps, sequence=self.sequence
        )

    def whole_pairs(self, groups: list[Group]) -> list[MapPair]:
        """Pairs of the merged models of whole groups that are still apart, the largest first."""
        return whole_pairs(self._described(groups))

    def _described(self, groups: list[Group]) -> list[Group]:
        return [group for group in groups if set(group.poses) <= self.surfaces.keys()]

    def _known(self) -> set[PairKey]:
        """Pairs in the journal whose scans are the same today, wherever they lie."""
        stored = {record.get("fingerprint") for record in read_journal(self.store.folder / JOURNAL_FILE)}
        pairs = [(i, j) for j in self.usable() for i in self.usable() if i < j] if stored else []
        return {pair for pair in pairs if self._row(pair).fingerprint(self.store.contents) in stored}

    def _ends(self, pair: PairKey) -> tuple[int, int]:
        """Source and target of a pair: by name, whatever the order in which scans are given."""
        a, b = sorted(pair, key=lambda k: (natural_key(self.scans[k].name), self.scans[k].path))
        return b, a

    def _row(self, pair: PairKey) -> PairRow:
        source, target = (self.scans[k].path for k in self._ends(pair))
        # Paths, not names: two pairs may have one name between them, and names grow as scans join.
        return PairRow(json.dumps([source, target], ensure_ascii=False), source, target, self._guess(pair))

    def _guess(self, pair: PairKey) -> tuple[float, ...] | None:
        """The motion of a pair by the given poses, by rows, where they say that it overlaps."""
        if self.initial is None:
            return None
        source, target = self._ends(pair)
        T = inverse(self.initial.poses[target]) @ self.initial.poses[source]
        local = shift_frames(T, -self.shapes[source].origin, -self.shapes[target].origin)
        if self.overlaps.of(source, target, local) < expert().many_pairs.guessed_overlap:
            return None
        return tuple(float(value) for value in T.ravel())

    # ---- registering and grouping

    def register(self, pairs: list[PairKey]) -> None:
        """Register what is missing of the pairs."""
        rows = {pair: self._row(pair) for pair in pairs if pair not in self.outcomes}
        outcomes = self._registered(rows.values())
        for pair, row in rows.items():
            self.outcomes[pair] = outcomes[row.id]
            edge = edge_of(outcomes[row.id], *self._ends(pair), self.shapes)
            if edge is not None:
                self.edges[pair] = edge

    def _registered(self, rows: Iterable[PairRow]) -> dict[str, Outcome]:
        """Outcomes by the id of the row."""
        unique = {row.id: row for row in rows}
        if not unique:
            return {}
        records, _ = work(
            list(unique.values()), self.store, self.config, self.labour,
            progress=self._count() or False, say=self.say,
        )  # fmt: skip
        self._done += len(unique)
        return {name: self.store.outcome(records[name]) for name in unique}

    def register_apart(
        self, pairs: list[PairKey], config: RegistrationConfig, place: str
    ) -> dict[PairKey, Outcome]:
        """Outcomes of pairs by another configuration, kept in a folder of their own beside the others.

        Where that folder cannot be used this is said, and they are had anew each time. Raises GeoMoE3DError: they
        cannot be had at all.
        """
        if not pairs:
            return {}
        rows = {pair: self._row(pair) for pair in pairs}

        def outcomes(folder: Path) -> dict[PairKey, Outcome]:
            store = _replacing_store(folder, config)
            records, _ = work(list(rows.values()), store, config, self.labour, progress=False, say=self.say)
            return {pair: store.outcome(records[row.id]) for pair, row in rows.items()}

        folder = self.store.folder / place
        try:
            return outcomes(folder)
        except GeoMoE3DError as error:
            self.say(
                f"what '{folder}' holds of {counted(len(rows), 'doubtful pair')} cannot be used, so they are looked at "
                f"again and not kept; delete that folder to keep them next time: {error}"
            )
        with TemporaryDirectory() as spare:
            return outcomes(Path(spare) / place)

    def _count(self) -> Callable[[int, int], None] | None:
        """Progress of one round, told as that of all pairs so far proposed."""
        tell, before = self.progress, self._done
        if tell is None:
            return None
        return lambda done, total: tell(before + done, before + total)

    def register_maps(self, pairs: list[MapPair], groups: list[Group]) -> None:
        """Register pairs of local maps; what they give are further edges between their anchors."""
        home = {scan: group.poses for group in groups for scan in group.poses}
        frames = {k: replace(shape, origin=-self._stand(k)) for k, shape in enumerate(self.shapes)}
        folder, rows = self.store.folder / MAPS_FOLDER, []
        for pair in pairs:
            source, target = (
                str(write_map(folder, some, home[some[0]], self.surfaces, self._stand(some[0])).resolve())
                for some in pair.members
            )
            rows.append(PairRow(json.dumps([source, target], ensure_ascii=False), source, target))
        outcomes = self._registered(rows)
        for pair, row in zip(pairs, rows, strict=True):
            edge = edge_of(outcomes[row.id], pair.source, pair.target, frames)
            if edge is not None:
                self.map_edges[row.id] = replace(edge, of_maps=True)

    def odometry(self) -> list[Edge]:
        """Edges between scans taken one after the other, as the given poses have them; none without such."""
        return [] if self.initial is None else self.initial.edges(self.usable(), self.shapes)

    def _stand(self, scan: int) -> FloatArray:
        """(3,) where the sensor of a scan stood, or zero where that is not known; local coordinates."""
        known = scan in self.surfaces and self.surfaces[scan].signed
        return self.shapes[scan].sensor if known else np.zeros(3)


def _replacing_store(folder: Path, config: RegistrationConfig) -> BatchStore:
    """A store that begins anew where the folder holds pairs of another configuration. Raises FormatError: its files
    are damaged; else as `BatchStore`."""
    try:
        return BatchStore(folder, config)
    except FormatError:
        raise
    except InputError:  # of an earlier model, which this one replaces
        return BatchStore(folder, config, fresh=True)


def key_of(a: int, b: int) -> PairKey:
    """The key of a pair of scans."""
    return (a, b) if a < b else (b, a)
