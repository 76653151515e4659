"""A large cloud in which small scans are found: `Map`, and what it answers: `Location`."""

from __future__ import annotations

import math
import os
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.prepare import check_cloud
from geomoe3d.clouds.recentre import choose_origin
from geomoe3d.clouds.viewpoint import with_sensor
from geomoe3d.clouds.voxel_size import robust_extent, round_size, typical_spacing
from geomoe3d.config import RegistrationConfig, build_config, expert, expert_in_force
from geomoe3d.decision.answer import Decision, failed_result, finished_result
from geomoe3d.decision.remarks import flatness
from geomoe3d.decision.scale import ratios_to_metres, units_differ
from geomoe3d.decision.similarity import scaled_cloud
from geomoe3d.errors import EmptyCloudError, InputError
from geomoe3d.geometry.se3 import check_motion, shift_frames, transform_points
from geomoe3d.maps.finding import Finder
from geomoe3d.maps.found import Found
from geomoe3d.maps.level import Level
from geomoe3d.maps.location import Location, Place, nowhere
from geomoe3d.maps.pieces import pieces
from geomoe3d.maps.store import Source, load, save
from geomoe3d.maps.voxels import VoxelSums
from geomoe3d.pipeline import Pipeline, resolved
from geomoe3d.runtime.timing import Progress, StageClock
from geomoe3d.types import FloatArray, PointCloud

_PIECE = 1_000_000


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
        self._larger: tuple[Level, ...] = ()  # never asked first, so that no answer hangs on earlier scans
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
            cloud: anything `load_points` takes; LAS, LAZ, binary PLY and E57 are read in pieces, so that memory is
                bounded by what the map keeps: four million voxels at most, on a grid twice as wide where that is not
                enough.
            sensor: (3,) where the one sensor stood, file coordinates; None takes what the file itself says, and none
                where it says nothing, as merged clouds do; of an E57 file, what each of its scans says. The origin of
                a map is never taken for one.
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
            InputError: a cloud that cannot be read or has no usable points, one that seems to be in another unit than
                the map, or no rigid transform; as `StaleMapError` a file whose content is another one than when it was
                read into the map, or a cloud that is in the map at another place.
        """
        tell = progress or (lambda stage: None)
        tell("load")
        T = np.eye(4) if T_map_cloud is None else check_motion(T_map_cloud)
        read = pieces(cloud, _PIECE)
        told = None if sensor is None else np.asarray(sensor, dtype=np.float64)
        if any(source.holds(read, T) for source in self.sources):
            return self
        voxels, count = self._voxels, 0
        corners = np.array([np.full(3, np.inf), np.full(3, -np.inf)])
        for points, seen_from in read.points:
            eye = seen_from if told is None else told
            place = None if eye is None else transform_points(T, eye[None])[0]
            moved = points if T_map_cloud is None else transform_points(T, points)
            corners = np.stack([np.minimum(corners[0], moved.min(0)), np.maximum(corners[1], moved.max(0))])
            if not len(voxels):
                voxels = _first(moved, read.name, read.origin if T_map_cloud is None else None)
            voxels = voxels.added(moved, place)
            while len(voxels) > expert().maps.most_voxels:
                voxels = voxels.coarser()
            count += len(points)
        if len(self._voxels):
            self._check_added(read.name, float(np.linalg.norm(corners[1] - corners[0])))
        name = self.name if self.sources else read.name
        rows = None if T_map_cloud is None else tuple(tuple(row) for row in T.tolist())
        sources = (*self.sources, Source(read.name, read.sha256, count, read.path, rows))
        return Map(voxels, (), sources, config=self.config, name=name, line=self._line)

    @expert_in_force
    def describe(self, voxel_size: float | None = None, *, progress: Progress | None = None) -> None:
        """Describe the map now, so that the first scan need not wait for it.

        Args:
            voxel_size: of one grid, cloud units, at least that of the map's voxels; None takes that of the
                configuration, or a grid on which the map has one in twenty of its points, 30,000 to a million, and two
                coarser ones, which take a third of its time together.
            progress: called with the name of the stage.

        Raises:
            EmptyCloudError: no points, or fewer than 3 that have neighbours there.
            InputError: all points lie in one plane or on one line.
        """
        if not len(self._voxels):
            raise EmptyCloudError("the map holds no points yet; add a cloud first: map.with_cloud(...)")
        flat = flatness(self.name, self._voxels.points)
        if flat is not None:
            raise InputError(f"{flat}; no scan can be found in such a map")
        if progress is not None:
            progress("describe")
        known, wanted = expert().maps, voxel_size or self.config.voxel_size
        sizes = [] if wanted is None else [wanted]
        if wanted is None:
            usual = min(max(known.usual_points, self.num_points // known.usual_share), known.most_points)
            finest = max(self._voxels.edge_for(usual), known.finest * self._voxels.edge)
            coarsest = self._voxels.edge_for(known.least_described)
            sizes = [
                round_size(times * finest) for times in (1, 2, 4) if times * finest < coarsest or times == 1
            ]
        for size in sizes:
            if not any(size / known.finer <= x.voxel_size <= size for x in self._levels):
                self._described(size)

    @property
    def num_points(self) -> int:
        """Points that the map was made of."""
        return int(self._voxels.counts.sum())

    @property
    def voxel_sizes(self) -> tuple[float, ...]:
        """Grids on which the map is described, cloud units; scans that want another one get it once."""
        return tuple(sorted(level.voxel_size for level in (*self._levels, *self._larger)))

    @expert_in_force
    def locate(
        self,
        scan: Any,
        *,
        k: int = 3,
        near: ArrayLike | None = None,
        within: float | None = None,
        initial: ArrayLike | None = None,
        sensor: ArrayLike | Literal["none"] | None = None,
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
            sensor: (3,) where the scan's sensor stood, file coordinates of the scan; ``"none"`` where no one sensor saw
                it; None leaves it to the evidence, as `geomoe3d.register` does.
            progress: called with the name of each stage as it begins.

        Raises:
            InputError: a scan that cannot be read or has too few usable points, a guess that is no rigid transform, a
                sensor's place that is none, or one of ``near`` and ``within`` without the other.
            ConfigError: a sensor's place, and a ``preparation.viewpoint`` that decides it too.
        """
        if not len(self._voxels):
            raise EmptyCloudError("the map holds no points yet; add a cloud first: map.with_cloud(...)")
        asked = _near(near, within, k)
        guesses = [] if initial is None else [check_motion(initial)]
        clock = StageClock(progress)
        clock("load")
        named = isinstance(scan, (str, os.PathLike, PointCloud))
        cloud = load_points(scan, seed=self.config.seed, name=None if named else "scan")
        cloud = with_sensor(cloud, sensor, self.config.preparation.viewpoint)
        check_cloud(cloud)
        refused = self._refused(cloud)
        if refused is not None:
            return self._nowhere(cloud, self._in_other_unit(cloud, clock) or refused, clock)
        local = None if asked is None else (asked[0] - self._voxels.origin, asked[1])
        best, ranked = self._finder(cloud, scan, guesses, local, max(k, expert().maps.candidates), clock)
        if best is None or best.decision.answer is None:
            return self._nowhere(cloud, nowhere(cloud, self.name), clock)
        decision = self._told(best, cloud, clock)
        result = finished_result(best.pair, decision, self.config, clock.stop())
        origins, top = (cloud.origin, self._voxels.origin), best.decision.answer.score
        places = tuple(
            Place(shift_frames(h.T_target_source, *origins), min(h.score / top, 1.0) if top > 0 else 1.0)
            for h in ranked[:k]
        )
        return Location(result, places)

    def _told(self, found: Found, cloud: PointCloud, clock: StageClock) -> Decision:
        """What was decided, with the unit in which the scan would be found where it fits nowhere as it is."""
        units = None if found.stood else self._in_other_unit(cloud, clock)
        return found.decision if units is None else found.decision.with_note(units, first=True)

    def _in_other_unit(self, cloud: PointCloud, clock: StageClock) -> str | None:
        """A sentence where a scan that is not found lies in the map once it is brought to another unit, else None."""
        clock("units")
        for ratio in ratios_to_metres():
            scaled = scaled_cloud(cloud, 1 / ratio)
            if self._refused(scaled) is None and self._finder.is_plainly_in(scaled, self._levels):
                return units_differ(ratio, cloud.name, self.name)
        return None

    @property
    def _finder(self) -> Finder:
        if self._line is None:
            self._line = Pipeline(self.config)
            self._line.warm_up()
        return Finder(self._line, self._voxels, self._level, self.name)

    @cached_property
    def extent(self) -> float:
        """Diagonal of the box that holds the central 98 % of it along each axis, cloud units."""
        return robust_extent(self._voxels.points)

    def _level(self, size: float, coarsest: float, most: int) -> Level:
        """The level for a scan that has this grid by itself, at most so coarse; made if there is none.

        What is made for a scan is no finer than a stated number of points allows, unless the grid is given.
        """
        finer, last = expert().maps.finer, most > expert().maps.asked_points
        known = (*self._levels, *self._larger) if last else self._levels
        fitting = [x for x in known if size / finer <= x.voxel_size <= coarsest]
        if not fitting and self.config.voxel_size is None:
            size = max(size, self._voxels.edge_for(most))
            fitting = [x for x in known if size / finer <= x.voxel_size <= finer * size]
        if not fitting:
            return self._described(size, last)
        return min(fitting, key=lambda level: abs(math.log(level.voxel_size / size)))

    def _described(self, size: float, last: bool = False) -> Level:
        """A new level; ``last``: only for what is asked in the end."""
        made = Level.of(self._voxels, max(size, self._voxels.edge), self.config.preparation, self.name)
        if last:
            self._larger = (*self._larger, made)
            return made
        self._levels = tuple(sorted((*self._levels, made), key=_size))
        return made

    def _check_added(self, name: str, extent: float) -> None:
        """Refuse a further cloud that would ruin the map."""
        most = expert().preparation.most_extent_ratio
        if extent > most * self.extent or extent < 5 * self._voxels.edge:
            raise InputError(
                f"'{name}' has an extent of {extent:.4g}, the map one of {self.extent:.4g} on voxels of "
                f"{self._voxels.edge:.4g}: at most {most} times the map's extent and at least 5 of its voxels can be "
                "added; bring both to one unit, or index the larger cloud first"
            )

    def _refused(self, cloud: PointCloud) -> str | None:
        """A sentence where scan and map cannot belong together."""
        extents = robust_extent(cloud.points), self.extent
        if extents[0] > expert().maps.largest_scan * extents[1]:
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
        raise InputError(
            "near and within (--near, --within) belong together: a place X,Y,Z and how far off it may be"
        )
    if near is None or within is None:
        return None
    place = np.asarray(near, dtype=np.float64)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise InputError(f"near must be three finite numbers, found {np.asarray(near).tolist()}")
    if not (math.isfinite(within) and within > 0):
        raise InputError(f"within is {within}, expected a positive length")
    return place, float(within)
