"""From scans to one model: propose pairs, register, group and align what agrees, ask again where it is loose.

Place: above registration and batch. All pairs of up to 30 scans are registered; of more, those whose scans
look alike, then, for scans and groups still apart, their next most similar, and pairs that the poses found so
far say to overlap. Pairs are kept in OUT/pairs as a batch: an interrupted or extended model reuses every one.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.batch.run import Labour, work
from geomoe3d.batch.store import RUN_FILE, BatchStore, Outcome, remove_batch
from geomoe3d.batch.table import PairRow
from geomoe3d.batch.task import open_cache
from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.viewpoint import find_viewpoints
from geomoe3d.config import RegistrationConfig, build_config
from geomoe3d.errors import GeoMoE3DError, InputError
from geomoe3d.filters.base import resolved
from geomoe3d.geometry.se3 import inverse
from geomoe3d.journal import read_journal
from geomoe3d.multiway.alignment import Surface, align_scans
from geomoe3d.multiway.edges import Edge, Shape, agrees, edge_of, expected_error, predicted_motion
from geomoe3d.multiway.grouping import Group, GroupingRules, group_scans, settle
from geomoe3d.multiway.model import (
    EdgeReport,
    SceneGroup,
    SceneModel,
    check_folder,
    file_poses,
    write_model,
)
from geomoe3d.multiway.overlaps import Overlaps
from geomoe3d.multiway.proposals import scan_similarity
from geomoe3d.multiway.scans import Scan, choose_common_voxel_size, find_scans, natural_key
from geomoe3d.registration import Registrar
from geomoe3d.stages import StageClock
from geomoe3d.types import Float32Array, FloatArray

ALL_PAIRS_UP_TO = 30
NEIGHBORS = 10
MOST_ROUNDS = 3
_MOST_SETTLINGS = 3
_TOLERANCE = 4.0  # voxels; see GroupingRules
_NEAR_TOLERANCE = 2.5
_KEPT_TOLERANCE = 1.5
_KEPT_ERROR = 3.0
_CLOSING_OVERLAP = 0.3
_CLOSING_PER_SCAN = 1

PairKey = tuple[int, int]


def register_scans(
    scans: Iterable[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    config: RegistrationConfig | None = None,
    pairs: str = "auto",
    neighbors: int = NEIGHBORS,
    rounds: int = MOST_ROUNDS,
    merged_voxel_size: float | None = None,
    page: bool = True,
    workers: int | None = None,
    scheduler: str | None = None,
    cache: str | None = None,
    fresh: bool = False,
    progress: Callable[[int, int], None] | None = None,
    say: Callable[[str], None] | None = None,
) -> SceneModel:
    """Place many scans in one model, and say which could not be placed and why.

    Called again with more scans and the same folder, all pairs of earlier calls are reused.

    Args:
        scans: files, or folders that stand for the clouds in them; at least two.
        out: folder; made if missing. Gets ``poses.json``, per group ``groupN.tum.txt``, ``.kitti.txt``,
            ``.g2o`` and ``.ply``, ``page.html``, and the pairs as a batch in ``pairs``.
        config: of the pairs; a voxel size in it is that of all scans, None chooses one for all.
        pairs: ``all``, ``similar`` (what a cheap description of the scans proposes), or ``auto``: all for up
            to 30 scans.
        neighbors: pairs proposed per scan and round.
        rounds: how often further pairs are proposed for scans and groups that are still apart.
        merged_voxel_size: of the merged clouds, cloud units; None takes that of the registration.
        page: write a page to turn the model in.
        workers, scheduler, cache: as in `geomoe3d.register_pairs`.
        fresh: forget what the folder holds of an earlier model.
        progress: called with (pairs done, pairs in all so far proposed).
        say: called with sentences on what begins.

    Raises:
        InputError: fewer than two usable scans, an unknown choice of pairs, or a folder that holds pairs of
            another configuration, scans of this call, or files of the user's under the names of the model.
        OutputError: the folder cannot be written, or another process is writing it.
    """
    if pairs not in ("auto", "all", "similar"):
        raise InputError(f"pairs is '{pairs}'; choose auto, all or similar")
    if neighbors < 1:
        raise InputError(f"neighbors is {neighbors}, at least 1 pair per scan must be proposed")
    scans = list(scans)
    check_folder(Path(out), scans)
    say = say or (lambda text: None)
    clock = StageClock(say)
    found = find_scans(scans)
    folder = Path(out)
    if fresh:
        remove_batch(folder / "pairs")
    clock("look at the scans")
    config, unusable = _with_voxel_size(resolved(config), folder / "pairs", found)
    store = BatchStore(folder / "pairs", config)
    room = _Room(found, config, store, Labour(workers, scheduler, cache), progress, say)
    room.describe(unusable)
    clock("register pairs")
    room.register(
        room.first_pairs(pairs == "all" or (pairs == "auto" and len(found) <= ALL_PAIRS_UP_TO), neighbors)
    )
    clock("group scans")
    groups = room.group()
    for count in range(rounds):
        more = room.further_pairs(groups, neighbors, closing=count == 0)
        if not more:
            break
        clock("register further pairs")
        room.register(more)
        clock("group scans")
        groups = room.group()
    clock("write the model")
    model = room.model(folder, groups)
    write_model(model, merged_voxel_size)
    if page:
        from geomoe3d.multiway.page import save_model_page

        save_model_page(model, folder / "page.html")
    object.__setattr__(model, "seconds", clock.stop())
    return model


class _Room:
    """The scans of one call with what is known of them so far."""

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
        self.similarity: FloatArray = np.zeros((0, 0))
        self.outcomes: dict[PairKey, Outcome] = {}
        self.edges: dict[PairKey, Edge] = {}

    # ---- the scans by themselves

    def describe(self, unusable: dict[str, str]) -> None:
        """Every scan on the common grid: where its points lie, and how similar it is to the others."""
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
        """Pairs to begin with: those known already, and all, or the most similar ones of every scan."""
        usable = self.usable()
        known = self._known()
        if everything:
            return sorted({(i, j) for j in usable for i in usable if i < j})
        settled = {scan for pair in known for scan in pair}
        wanted = set(known)
        for scan in usable:
            for other in self._most_similar(scan, usable, neighbors):
                if scan not in settled or other not in settled:
                    wanted.add(_key(scan, other))
        return sorted(wanted)

    def further_pairs(self, groups: list[Group], neighbors: int, *, closing: bool) -> list[PairKey]:
        """Pairs not tried yet that could tie loose scans and groups, or, if wanted, close loops."""
        more: set[PairKey] = set()
        largest = set(groups[0].poses)
        for group in groups:
            if set(group.poses) == largest or not set(group.poses) <= set(self.usable()):
                continue
            outside = [k for k in self.usable() if k not in group.poses]
            for scan in group.poses:
                untried = [k for k in outside if _key(scan, k) not in self.outcomes]
                more |= {_key(scan, other) for other in self._most_similar(scan, untried, neighbors)}
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

    def _most_similar(self, scan: int, others: Iterable[int], count: int) -> list[int]:
        ranked = sorted((k for k in others if k != scan), key=lambda k: (-self.similarity[scan, k], k))
        return ranked[:count]

    def _known(self) -> set[PairKey]:
        """Pairs in the journal whose scans and files are the same today."""
        number = {self._row((i, j)).id: (i, j) for j in self.usable() for i in self.usable() if i < j}
        known = set()
        for record in read_journal(self.store.folder / "journal.jsonl"):
            pair = number.get(str(record.get("id")))
            if pair is not None and record.get("fingerprint") == self._row(pair).fingerprint():
                known.add(pair)
        return known

    def _ends(self, pair: PairKey) -> tuple[int, int]:
        """Source and target of a pair: by name, whatever the order in which scans are given."""
        a, b = sorted(pair, key=lambda k: (natural_key(self.scans[k].name), self.scans[k].path))
        return b, a

    def _row(self, pair: PairKey) -> PairRow:
        source, target = (self.scans[k] for k in self._ends(pair))
        return PairRow(f"{source.name}+{target.name}", source.path, target.path)

    # ---- registering and grouping

    def register(self, pairs: list[PairKey]) -> None:
        """Register what is missing of the pairs."""
        rows = {pair: self._row(pair) for pair in pairs if pair not in self.outcomes}
        if not rows:
            return
        records, _ = work(
            list(rows.values()), self.store, self.config, self.labour, progress=self.progress, say=self.say
        )
        for pair, row in rows.items():
            outcome = self.store.outcome(records[row.id])
            self.outcomes[pair] = outcome
            edge = edge_of(outcome, *self._ends(pair), self.shapes)
            if edge is not None:
                self.edges[pair] = edge

    def group(self) -> list[Group]:
        """Groups by all edges so far; a scan that cannot be used is a group of its own.

        What settling lets go may find its place among scans that are better aligned now, so groups are joined
        and settled again while that joins any.
        """
        edges = [self.edges[key] for key in sorted(self.edges)]
        groups: list[Group] | None = None
        for _ in range(_MOST_SETTLINGS):
            known = groups
            groups = group_scans(self.shapes, edges, self.rules, self.outcomes.keys(), self.overlaps, known)
            if known is not None and len(groups) == len(known):
                break
            groups = [part for group in groups for part in self.settle(group, edges)]
        return sorted(groups or [], key=lambda group: (-len(group.poses), min(group.poses)))

    def settle(self, group: Group, edges: list[Edge]) -> list[Group]:
        """The group, or what is left of it, aligned and held by edges that agree closely."""
        return settle(group, edges, self.shapes, self.rules, self.align)

    def align(self, poses: dict[int, FloatArray]) -> dict[int, FloatArray]:
        """The poses of a group laid on each other by the scans' surfaces; once, however often asked."""
        key = tuple((scan, poses[scan].tobytes()) for scan in sorted(poses))
        if key not in self.aligned:
            self.aligned[key] = align_scans(
                poses, self.surfaces, self.overlaps, self.voxel_size, seed=self.config.seed
            )
        return dict(self.aligned[key])

    # ---- the answer

    def model(self, folder: Path, groups: list[Group]) -> SceneModel:
        """The groups of two or more as a model, the rest with reasons."""
        origins = {k: shape.origin for k, shape in enumerate(self.shapes)}
        placed = [group for group in groups if len(group.poses) > 1]
        made = []
        for group in placed:
            reference, poses = file_poses(group.poses, self.scans, origins)
            made.append(SceneGroup(reference, poses, dict(group.poses), tuple(group.edges)))
        home = {scan: number for number, group in enumerate(placed) for scan in group.poses}
        kept = {id(edge) for group in placed for edge in group.edges}
        reports = [
            EdgeReport(
                self.scans[edge.source].name,
                self.scans[edge.target].name,
                id(edge) in kept,
                "" if id(edge) in kept else self._why_rejected(edge, home, placed),
                edge.confidence,
                self._file_motion(pair),
            )
            for pair, edge in sorted(self.edges.items())
        ]
        unplaced = {
            self.scans[k].name: self._why_unplaced(k) for k in range(len(self.scans)) if k not in home
        }
        return SceneModel(
            folder,
            self.voxel_size,
            tuple(self.scans),
            tuple(made),
            unplaced,
            tuple(reports),
            len(self.outcomes),
            {},
        )

    def _file_motion(self, pair: PairKey) -> FloatArray:
        result = self.outcomes[pair].result
        assert result is not None
        return result.T_target_source

    def _why_rejected(self, edge: Edge, home: dict[int, int], groups: list[Group]) -> str:
        a, b = home.get(edge.source), home.get(edge.target)
        if edge.worth <= self.rules.least_worth:
            return f"confidence {edge.confidence:.2f} is too low"
        if a is None or b is None or a != b:
            return "not enough speaks for it to tie its two scans"
        predicted = predicted_motion(edge.source, edge.target, groups[a].poses)
        shape, rules = self.shapes[edge.source], self.rules
        if agrees(predicted, edge.T_target_source, shape, rules.kept_tolerance, rules.kept_turn_deg):
            error = expected_error(edge, groups[a].poses, shape, rules.correlation)
            return f"what its two scans share holds them too loosely: the sensor may be {error:.2g} off"
        if agrees(predicted, edge.T_target_source, shape, rules.tolerance, rules.turn_deg):
            return "near the poses that the other pairs give, but not near enough"
        apart = float(
            np.linalg.norm(
                (inverse(predicted) @ edge.T_target_source @ np.append(shape.center, 1))[:3] - shape.center
            )
        )
        return f"it contradicts the poses that the other pairs give by {apart:.3g}"

    def _why_unplaced(self, scan: int) -> str:
        if scan in self.unusable:
            return self.unusable[scan]
        mine = [(edge, pair) for pair, edge in self.edges.items() if scan in pair]
        tried = sum(scan in pair for pair in self.outcomes)
        if not mine:
            return f"none of its {tried} pairs gave a motion"
        edge, pair = max(mine, key=lambda item: item[0].confidence)
        other = self.scans[pair[0] if pair[1] == scan else pair[1]].name
        surest = f"its surest of {tried} pairs, with '{other}', has confidence {edge.confidence:.3f}"
        voices = sum(edge.worth > self.rules.least_worth for edge, _ in mine)
        if voices > 1:
            return f"{surest}, but its {voices} pairs above 0.5 do not agree on one place clearly enough"
        return f"{surest}, and nothing agrees with it: one pair must be surer, or two must agree"


def _with_voxel_size(
    config: RegistrationConfig, folder: Path, scans: list[Scan]
) -> tuple[RegistrationConfig, dict[str, str]]:
    """The configuration with the voxel size of all scans: given, as in the folder, or chosen now."""
    if config.voxel_size is not None:
        return config, {}
    unusable: dict[str, str] = {}
    size = _stored_voxel_size(folder / RUN_FILE)
    if size is None:
        size, unusable = choose_common_voxel_size(scans, config.preparation)
    tree: dict[str, Any] = {**config.model_dump(), "voxel_size": size}
    return build_config(RegistrationConfig, tree), unusable


def _stored_voxel_size(path: Path) -> float | None:
    try:
        size = json.loads(path.read_text(encoding="utf-8"))["identity"]["config"]["voxel_size"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return float(size) if isinstance(size, (int, float)) else None


def _key(a: int, b: int) -> PairKey:
    return (a, b) if a < b else (b, a)
