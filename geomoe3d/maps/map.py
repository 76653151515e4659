"""A large cloud in which small scans are found: `Map`, and what it answers: `Location`."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.prepare import (
    bounded_voxel_size,
    check_cloud,
    choose_voxel_size,
    prepare,
    robust_extent,
    round_size,
    typical_spacing,
)
from geomoe3d.clouds.recentre import choose_origin
from geomoe3d.clouds.viewpoint import find_viewpoints
from geomoe3d.config import RegistrationConfig, build_config, expert_in_force
from geomoe3d.decision.answer import failed_result, finished_result
from geomoe3d.decision.remarks import remarks
from geomoe3d.errors import EmptyCloudError, InputError
from geomoe3d.geometry.se3 import check_motion, motions_apart, shift_frames, transform_points
from geomoe3d.maps.level import Level, described
from geomoe3d.maps.locate import Found, Search, likely
from geomoe3d.maps.pieces import pieces
from geomoe3d.maps.store import Source, load, save
from geomoe3d.maps.voxels import VoxelSums
from geomoe3d.pipeline import Pipeline, resolved
from geomoe3d.result import RegistrationResult, Status
from geomoe3d.runtime.timing import Progress, StageClock
from geomoe3d.types import FloatArray, Hypothesis, PointCloud, PreparedCloud

_MOST_VOXELS = 4_000_000
_USUAL_POINTS = (
    150_000  # at least, where it holds so many: of the grid on which a map is described before any scan
)
_USUAL_SHARE = 20  # points of the map for each of that grid
_MOST_POINTS = 1_000_000  # of any grid: 50 s of processor time, and 150 MB
_PIECE = 1_000_000
_FINER, _COARSER = (
    1.3,
    2.0,
)  # a level whose voxels are so many times as small or large as the scan's own serves it
_CANDIDATES = 4
Look = Literal["quick", "more", "finer"]
"""At the likeliest windows; at more of them with more matches; around what was found, on the scan's own grid."""
NOWHERE = "no place in the map was found at which the scan could lie"
_LARGER = 3.0  # times the map's extent from which a scan is no part of it


@dataclass(frozen=True, eq=False)
class Place:
    """One place of a scan in a map.

    Attributes:
        T_map_scan: (4, 4), p_map = R p_scan + t, file coordinates.
        relative_score: its score over that of the answer; 1 means as good.
    """

    T_map_scan: FloatArray
    relative_score: float


@dataclass(frozen=True, eq=False)
class Location:
    """Where a scan lies in a map.

    Attributes:
        result: the answer as of a pair, the scan being the source and the map the target.
        places: the best clearly different places, the answer first; empty where there is none.
    """

    result: RegistrationResult
    places: tuple[Place, ...]

    @property
    def ok(self) -> bool:
        """True only for status ok."""
        return self.result.ok

    @property
    def status(self) -> Status:
        """ok | low_confidence | ambiguous | failed, as of a pair."""
        return self.result.status

    @property
    def T_map_scan(self) -> FloatArray:
        """(4, 4), p_map = R p_scan + t, file coordinates; NaN where nothing was found, never the identity."""
        return self.result.T_target_source

    def to_json(self, indent: int | None = 2) -> str:
        """The result's JSON with ``places``."""
        told = json.loads(self.result.to_json())
        told["places"] = [
            {
                "T_map_scan": place.T_map_scan.tolist(),
                "relative_score": place.relative_score if math.isfinite(place.relative_score) else None,
            }
            for place in self.places
        ]
        return json.dumps(told, indent=indent, allow_nan=False)


class Map:
    """A large cloud, described once, in which scans are found; make one with `from_cloud` or `open`.

    Attributes:
        name: what to call it in messages.
        sources: what it was made of.
    """

    def __init__(
        self,
        voxels: VoxelSums,
        levels: tuple[Level, ...] = (),
        sources: tuple[Source, ...] = (),
        *,
        config: RegistrationConfig | None = None,
        name: str = "map",
        line: Pipeline | None = None,
    ) -> None:
        self._voxels, self._levels = voxels, levels
        self.sources, self.name = sources, name
        self.config = resolved(config)
        self._line = line

    @classmethod
    def empty(cls, *, config: RegistrationConfig | None = None, **overrides: Any) -> Map:
        """A map of nothing yet, to which `with_cloud` adds; arguments and errors as of `from_cloud`."""
        return cls(VoxelSums.empty(1.0, np.zeros(3)), config=_with(config, overrides))

    @classmethod
    def from_cloud(
        cls,
        cloud: Any,
        *,
        sensor: ArrayLike | None = None,
        config: RegistrationConfig | None = None,
        progress: Progress | None = None,
        **overrides: Any,
    ) -> Map:
        """Describe a cloud as a map.

        Args:
            cloud: anything `load_points` takes; LAS and LAZ files are read in pieces, so that memory is bounded by
                what the map keeps: four million voxels at most, on a grid twice as wide where that is not enough.
            sensor: (3,) where the one sensor stood, file coordinates; None takes what the file itself says, and none
                where it says nothing, as merged clouds do. The origin of a map is never taken for one.
            config: of the registrations; None takes the defaults.
            progress: called with the name of each stage as it begins.
            overrides: top-level configuration keys, as of `geomoe3d.register`; ``voxel_size`` is the grid on which
                scans are sought, None lets each scan choose.

        Raises:
            InputError: a cloud that cannot be read or has too few usable points.
            ConfigError: an unknown or invalid override.
        """
        made = cls.empty(config=config, **overrides).with_cloud(cloud, sensor=sensor, progress=progress)
        made.describe(progress=progress)
        return made

    @classmethod
    def open(
        cls, path: str | os.PathLike[str], *, config: RegistrationConfig | None = None, **overrides: Any
    ) -> Map:
        """Read a map that `save` or ``geomoe3d index`` wrote.

        Raises:
            InputError: no such file.
            FormatError: no map, of a later version, or damaged.
            ConfigError: an unknown or invalid override.
        """
        sources, voxels, levels = load(path)
        return cls(voxels, levels, sources, config=_with(config, overrides), name=Path(path).name)

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write the map, with all grids on which it has been described so far, as one file.

        A map that is not described yet is written as it is: with its voxels alone, to be added to or described later.

        Args:
            path: such as ``building.map``.
            force: replace a file that exists.

        Raises:
            OutputError: the file exists and ``force`` is False, or it cannot be written.
        """
        save(path, self.sources, self._voxels, self._levels, force=force)

    @expert_in_force
    def with_cloud(
        self,
        cloud: Any,
        *,
        T_map_cloud: ArrayLike | None = None,
        sensor: ArrayLike | None = None,
        progress: Progress | None = None,
    ) -> Map:
        """The map with one more cloud, not described yet; a cloud that is in it already changes nothing.

        Args:
            cloud: as of `from_cloud`.
            T_map_cloud: (4, 4), p_map = R p_cloud + t, file coordinates; None: they are the map's.
            sensor: (3,) as of `from_cloud`, file coordinates of the cloud.
            progress: as of `from_cloud`.

        Raises:
            InputError: a cloud that cannot be read or has no usable points, or no rigid motion.
        """
        tell = progress or (lambda stage: None)
        tell("load")
        T = np.eye(4) if T_map_cloud is None else check_motion(T_map_cloud)
        read = pieces(cloud, _PIECE)
        told = read.sensor if sensor is None else np.asarray(sensor, dtype=np.float64)
        place = None if told is None else transform_points(T, told[None])[0]
        if any(read.sha256 == source.sha256 for source in self.sources):
            return self
        voxels, count = self._voxels, 0
        for points in read.points():
            moved = points if T_map_cloud is None else transform_points(T, points)
            if not len(voxels):
                voxels = _first(moved, read.name, read.origin if T_map_cloud is None else None)
            voxels = voxels.added(moved, place)
            while len(voxels) > _MOST_VOXELS:
                voxels = voxels.coarser()
            count += len(points)
        name = self.name if self.sources else read.name
        sources = (*self.sources, Source(read.name, read.sha256, count))
        return Map(voxels, (), sources, config=self.config, name=name, line=self._line)

    @expert_in_force
    def describe(self, voxel_size: float | None = None, *, progress: Progress | None = None) -> None:
        """Describe the map on a grid now, so that the first scan need not wait for it.

        Args:
            voxel_size: cloud units, at least that of the map's voxels; None takes that of the configuration, or one on
                which the map has some 200,000 points at most.
            progress: called with the name of the stage.

        Raises:
            EmptyCloudError: no points, or fewer than 3 that have neighbours there.
        """
        if not len(self._voxels):
            raise EmptyCloudError("the map holds no points yet; add a cloud first: map.with_cloud(...)")
        if progress is not None:
            progress("describe")
        wanted = voxel_size or self.config.voxel_size
        if wanted is None:
            usual = min(max(_USUAL_POINTS, self.num_points // _USUAL_SHARE), _MOST_POINTS)
            wanted = round_size(max(self._voxels.edge_for(usual), 1.25 * self._voxels.edge))
        self._level(wanted, 1.0)

    @property
    def num_points(self) -> int:
        """Points that the map was made of."""
        return int(self._voxels.counts.sum())

    @property
    def voxel_sizes(self) -> tuple[float, ...]:
        """Grids on which the map is described, cloud units; scans that want another one get it once."""
        return tuple(level.voxel_size for level in self._levels)

    @expert_in_force
    def locate(
        self,
        scan: Any,
        *,
        k: int = 3,
        near: ArrayLike | None = None,
        within: float | None = None,
        initial: ArrayLike | None = None,
        progress: Progress | None = None,
    ) -> Location:
        """Where a scan lies in the map.

        The grid follows the scan. Places that look like it are proposed, the best are compared with it as pairs of
        scans are, and clearly different places are rivals: where two fit about as well, as identical rooms do, the
        status is ``ambiguous``.

        Args:
            scan: anything `geomoe3d.register` takes, in the map's unit.
            k: at most so many places are given.
            near: (3,) where the scan's sensor is believed to be (its middle where that is not known), file
                coordinates of the map. Looked at first; the whole map follows where nothing sure is found there.
            within: how far off that may be, cloud units; needed with ``near``.
            initial: (4, 4) a first guess of T_map_scan; scored like all others, not trusted.
            progress: called with the name of each stage as it begins.

        Raises:
            InputError: a scan that cannot be read or has too few usable points, a guess that is no rigid motion, or
                one of ``near`` and ``within`` without the other.
        """
        if not len(self._voxels):
            raise EmptyCloudError("the map holds no points yet; add a cloud first: map.with_cloud(...)")
        asked = _near(near, within, k)
        guesses = [] if initial is None else [check_motion(initial)]
        clock = StageClock(progress)
        clock("load")
        named = isinstance(scan, (str, os.PathLike, PointCloud))
        cloud = load_points(scan, seed=self.config.seed, name=None if named else "scan")
        check_cloud(cloud)
        refused = self._refused(cloud)
        if refused is not None:
            return self._nowhere(cloud, refused, clock)
        local = None if asked is None else (asked[0] - self._voxels.origin, asked[1])
        best, ranked = self._search(cloud, scan, guesses, local, max(k, _CANDIDATES), clock)
        if best is None or best.decision.answer is None:
            return self._nowhere(cloud, NOWHERE, clock)
        result = finished_result(best.pair, best.decision, self.config, clock.stop())
        origins, top = (cloud.origin, self._voxels.origin), best.decision.answer.score
        places = tuple(
            Place(shift_frames(h.T_target_source, *origins), h.score / top if top > 0 else 1.0)
            for h in ranked[:k]
        )
        return Location(result, places)

    def _search(
        self,
        cloud: PointCloud,
        given: Any,
        guesses: Sequence[FloatArray],
        near: tuple[FloatArray, float] | None,
        count: int,
        clock: StageClock,
    ) -> tuple[Found | None, list[Hypothesis]]:
        """What was decided of a scan, None without any candidate, and the distinct answers, best first.

        Args:
            cloud: the scan, as loaded.
            given: the same as the caller gave it.
            guesses: (4, 4) of T_map_scan, file coordinates.
            near: as of `Search.candidates`.
            count: places that are looked at closely, at most.
            clock: told of the stages.
        """
        clock("prepare")
        rule = self.config.preparation.viewpoint
        view = find_viewpoints(cloud, cloud, rule)[0]
        local = [shift_frames(T, -cloud.origin, -self._voxels.origin) for T in guesses]
        own = self.config.voxel_size or choose_voxel_size(cloud, cloud, self.config.preparation.voxel_points)
        own = bounded_voxel_size(cloud, cloud, own, self.config.preparation.max_points)
        level = self._level(own, _COARSER if self.config.voxel_size is None else _FINER)
        search = self._begun(cloud, view, level, clock)
        known: list[FloatArray] = []
        best: Found | None = None
        ranked: list[Hypothesis] = []
        for look, where in self._looks(near):
            if look == "finer":
                finer = self._around(search, known[:count], own)
                if finer is None:
                    break
                search = self._begun(cloud, view, finer, clock)
            candidates = search.candidates(more=look != "quick", near=where, given=[*local, *known])
            known = [h.T_target_source for _, h in candidates]
            found = [search.look(h, fully=look != "quick") for h in likely(candidates, count)]
            if not found:
                continue
            latest, others = search.decide(found)
            if best is None or latest.sure or latest.confidence > best.confidence:
                best, ranked = latest, others
            if latest.sure:
                break
        if best is None or best.decision.answer is None:
            return None, []
        decision = best.decision
        read = (given, self.name), best.pair.clouds, search.level.voxel_size, view is not None
        told_of = remarks(*read, self.config.preparation, decision.judgement)
        prior = self._prior_notes(search, decision.T_target_source, near, local)
        for sentence in (*cloud.notes, *prior, *told_of):
            decision = decision.with_note(sentence)
        return replace(best, decision=decision), ranked

    def _begun(self, cloud: PointCloud, view: FloatArray | None, level: Level, clock: StageClock) -> Search:
        """The search for a scan on a level."""
        clock("prepare")
        bare = prepare(
            cloud, level.voxel_size, self.config.preparation, viewpoint=view, seed=self.config.seed
        )
        clock("features")
        scan, compared = described(bare, self._pipeline.descriptor)
        return Search(self._pipeline, scan, compared, level, self._part(level), clock)

    @cached_property
    def _extent(self) -> float:
        return robust_extent(self._voxels.points)

    @property
    def _pipeline(self) -> Pipeline:
        if self._line is None:
            self._line = Pipeline(self.config)
            self._line.warm_up()
        return self._line

    def _level(self, size: float, coarser: float = _COARSER) -> Level:
        """The level for a scan whose own grid has this edge, at most so many times as coarse; made if there is none."""
        fitting = [x for x in self._levels if size / _FINER <= x.voxel_size <= coarser * size]
        if not fitting:
            size = max(size, self._voxels.edge, self._voxels.edge_for(_MOST_POINTS))
            fitting = [x for x in self._levels if size / _FINER <= x.voxel_size <= size]
        if not fitting:
            fitting = [Level.of(self._voxels, size, self.config.preparation)]
            self._levels = tuple(sorted((*self._levels, *fitting), key=_size))
        return min(fitting, key=lambda level: abs(math.log(level.voxel_size / size)))

    def _part(self, level: Level) -> PreparedCloud:
        nothing = np.zeros((0, 3))
        origin, count = self._voxels.origin, self.num_points
        size = level.voxel_size
        return PreparedCloud(nothing, nothing, None, size, None, origin, self.name, count, scanned=False)

    def _around(self, search: Search, motions: Sequence[FloatArray], size: float) -> Level | None:
        """The map around some places, on a scan's own grid; None where that is no finer than the search's."""
        if search.level.voxel_size <= _FINER * size or not motions:
            return None
        centers = [transform_points(T, search.center[None])[0] for T in motions]
        around = self._voxels.within(np.array(centers), 2 * search.reach)
        try:
            return Level.of(around, max(size, around.edge), self.config.preparation)
        except EmptyCloudError:
            return None

    def _looks(
        self, near: tuple[FloatArray, float] | None
    ) -> Iterator[tuple[Look, tuple[FloatArray, float] | None]]:
        """How closely to look, and where, until something sure is found."""
        if near is not None:
            yield "quick", near
        yield "quick", None
        if self.config.second_look.grids or self.config.second_look.max_correspondences:
            yield "more", None
            yield "finer", None

    def _refused(self, cloud: PointCloud) -> str | None:
        """A sentence where scan and map cannot belong together."""
        extents = robust_extent(cloud.points), self._extent
        if extents[0] > _LARGER * extents[1]:
            return (
                f"the scan is larger than the map (extents {extents[0]:.4g} and {extents[1]:.4g}): give them the other "
                "way round, or bring both to one unit"
            )
        if 5 * self._voxels.edge > extents[0]:
            return (
                f"the map's voxels of {self._voxels.edge:.4g} are too coarse for a scan of extent {extents[0]:.4g}: "
                "bring both to one unit, or index a part of the map"
            )
        return None

    def _nowhere(self, cloud: PointCloud, reason: str, clock: StageClock) -> Location:
        target = PointCloud(self._voxels.points, self._voxels.origin, name=self.name)
        return Location(failed_result((cloud, target), reason, self.config, clock.stop()), ())

    def _prior_notes(
        self, search: Search, T: FloatArray, near: tuple[FloatArray, float] | None, guesses: list[FloatArray]
    ) -> list[str]:
        """Sentences where the answer lies elsewhere than the caller said."""
        notes = []
        if near is not None:
            away = float(np.linalg.norm(transform_points(T, search.eye[None])[0] - near[0]))
            if away > near[1]:
                said = f"it lies {away:.3g} away, more than {near[1]:.3g}"
                notes.append(f"the place that was given is not the answer: {said}")
        for guess in guesses:
            shift, turn = motions_apart(T, guess, search.center)
            if shift > search.reach or turn > 45:
                notes.append(
                    f"the first guess is not the answer: it lies {turn:.1f} deg and {shift:.3g} away"
                )
        return notes


def _size(level: Level) -> float:
    return level.voxel_size


def _with(config: RegistrationConfig | None, overrides: dict[str, Any]) -> RegistrationConfig | None:
    if not overrides:
        return config
    tree = (config or RegistrationConfig()).model_dump()
    return build_config(RegistrationConfig, {**tree, **overrides}, "Map(...)")


def _first(points: FloatArray, name: str, origin: FloatArray | None) -> VoxelSums:
    """An empty grid that suits the first points of a map: at least twice their typical spacing."""
    cloud = PointCloud(points, name=name)
    check_cloud(cloud)
    origin = choose_origin(points) if origin is None else origin
    spacing = 2 * typical_spacing(points - origin)
    edge = max(spacing, robust_extent(points) / 10_000)
    if not edge > 0:
        raise InputError(f"'{name}': its points do not fill any grid; give a cloud with surfaces")
    return VoxelSums.empty(float(f"{edge:.2g}"), origin)


def _near(near: ArrayLike | None, within: float | None, k: int) -> tuple[FloatArray, float] | None:
    if k < 1:
        raise InputError(f"k is {k}, expected at least 1 place")
    if (near is None) != (within is None):
        raise InputError("near and within belong together: a place (x, y, z) and how far off it may be")
    if near is None or within is None:
        return None
    place = np.asarray(near, dtype=np.float64)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise InputError(f"near must be three finite numbers, found {np.asarray(near).tolist()}")
    if not (math.isfinite(within) and within > 0):
        raise InputError(f"within is {within}, expected a positive length")
    return place, float(within)


def search_larger(
    scan: PointCloud, world: PointCloud, line: Pipeline, guess: FloatArray | None, clock: StageClock
) -> Found | None:
    """One cloud sought in a much larger one: what `geomoe3d.line` does with such a pair.

    Args:
        scan: the smaller cloud, as loaded.
        world: the larger one, as loaded; its sensor is not asked for.
        line: parts of the configuration.
        guess: (4, 4) of T_world_scan, file coordinates, or None.
        clock: told of the stages.

    Returns:
        The scan and the part of the larger cloud around the answer, in the clouds' local coordinates, and what was
        decided; None where there was no candidate.
    """
    clock("index")
    nothing = VoxelSums.empty(1.0, np.zeros(3))
    made = Map(nothing, config=line.config, line=line).with_cloud(replace(world, sensor=None))
    guesses = [] if guess is None else [guess]
    return made._search(scan, scan, guesses, None, _CANDIDATES, clock)[0]
