"""How a scan is sought in a map: on which grids, how closely, and when to stop.

Coarse grids find more, and sooner; the scan's own grid is then asked around what was found, where the answer is not
sure yet. That costs what is around, whatever the size of the map.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from typing import Any, Literal

import numpy as np

from geomoe3d.clouds.prepare import prepare
from geomoe3d.clouds.viewpoint import find_viewpoints, seen_by_none
from geomoe3d.clouds.voxel_size import bounded_voxel_size, voxel_sizes_of
from geomoe3d.config import PreparationConfig, expert
from geomoe3d.decision.remarks import remarks
from geomoe3d.errors import EmptyCloudError
from geomoe3d.geometry.se3 import motions_apart, shift_frames, transform_points
from geomoe3d.maps.detail import Detail, Fitting
from geomoe3d.maps.found import Found
from geomoe3d.maps.level import Level, compared_rows, described
from geomoe3d.maps.locate import Search, likely
from geomoe3d.maps.places import Cells, radius_of
from geomoe3d.maps.voxels import VoxelSums
from geomoe3d.pipeline import Pipeline
from geomoe3d.runtime.threads import beside
from geomoe3d.runtime.timing import StageClock
from geomoe3d.types import FloatArray, Hypothesis, PointCloud, PreparedCloud

Look = Literal["quick", "more", "other", "finer"]
"""At the likeliest windows; at more, with more matches; that on another grid; on the scan's, where it was found and
where it fits best in detail."""

FITS_BETTER = (
    "in detail the scan fits better at another place of the map, which was not found to be its place either"
)


@dataclass(frozen=True)
class Finder:
    """Finds scans in a map.

    Attributes:
        line: parts of the configuration.
        voxels: of the map.
        level_for: gives the level for a scan whose own grid has an edge, and the coarsest one that serves it; what is
            made has so many points at most.
        name: of the map.
    """

    line: Pipeline
    voxels: VoxelSums
    level_for: Callable[[float, float, int], Level]
    name: str

    def __call__(
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
        clock("preprocess")
        rule = self.line.config.preparation.viewpoint
        view = find_viewpoints(cloud, cloud, rule)[0]
        local = [shift_frames(T, -cloud.origin, -self.voxels.origin) for T in guesses]
        own, coarsest = self._grids(cloud)
        whole = self._begun(cloud, view, self.level_for(own, coarsest, expert().maps.asked_points), clock)
        search, twinned = whole, False
        many = whole.has_many_places
        detail: Detail | None = None
        fitting: Fitting = []
        known: list[FloatArray] = []
        times = max(1.0, count / expert().maps.candidates)
        best: Found | None = None
        ranked: list[Hypothesis] = []
        for look, where in self._looks(near):
            if look == "more" and many and detail is None:
                detail, fitting = self._in_detail(cloud, view, search, own, count, clock)
                best_fit = [Hypothesis(T) for _, T in fitting[:1]]
                if twinned and not all(search.differ(h, Hypothesis(T)) for h in best_fit for T in known):
                    detail, fitting = None, []  # a copy that is known fits best, and which of them is chance
            # Once places that are alike are known, or what fits in detail, only a finer grid may tell them apart.
            if (twinned or detail is not None) and look in ("more", "other"):
                continue
            if look == "other":
                level = self._other(search, cloud, own)
            elif look == "finer":
                best_fits = expert().detail.close * fitting[0][0] if fitting else 0.0
                fits = [T for score, T in fitting if score >= best_fits]
                # Few places, for a fine grid, unless more are asked for than usual.
                if not fits or times > 1.0:
                    known = [*fits, *known, *(T for first in known[:1] for T in whole.twins(first, count))]
                else:
                    known = list(fits)
                if best is not None and best.decision.answer is not None:
                    known.append(best.decision.T_target_source)
                most = expert().maps.around_points
                if fits:
                    most = min(most, int(times * expert().detail.around_points))
                level = self._around(search, known, own, most)
                # Where what surrounds them has too many points for a finer grid, what fits is looked at on this one.
                level = search.level if level is None and fits else level
            else:
                level = search.level
            if level is None:
                continue
            if level is not search.level:
                try:
                    search = self._begun(cloud, view, level, clock, whole.level if look == "finer" else None)
                except EmptyCloudError:  # too sparse for this grid: what the others say stands
                    continue
            more = look != "quick"
            candidates = search.candidates(more=more, near=where, given=[*local, *known], times=times)
            asked, known = known, [h.T_target_source for h in likely(candidates, count)]
            if look == "finer":
                known += [T for T in asked if all(search.differ(Hypothesis(T), Hypothesis(x)) for x in known)]
            found = [search.look(Hypothesis(T), fully=more) for T in known]
            if not found:
                continue
            first = max(found, key=attrgetter("score"))
            if first.stood and look != "finer":
                answers = [f.decision.answer for f in found if f.decision.answer is not None]
                T = first.decision.T_target_source
                twins, measured = beside(partial(whole.twins, T, count), first.measured)
                found = [measured if f is first else f for f in found]
                twins = [T for T in twins if all(whole.differ(Hypothesis(T), answer) for answer in answers)]
                if where is not None:  # of rooms that are alike, the caller says in which the scan is
                    twins = [T for T in twins if search.is_near(T, where)]
                found += [search.look(Hypothesis(T), fully=more) for T in twins]
                known += twins
                twinned = twinned or sum(f.stood for f in found) > 1
            latest, others = search.decide(found)
            if look == "finer" and detail is not None and not latest.sure:
                latest, others = detail.ordered(search, latest, others)
            # The last look has seen the answers before it, and more of the scan than they did.
            if best is None or latest.sure or look == "finer" or latest.confidence > best.confidence:
                # Where it is not sure either, what they found follows what it found.
                before = [] if latest.sure or look != "finer" else ranked
                differs = [h for h in before if all(search.differ(h, other) for other in others)]
                best, ranked = latest, [*others, *differs]
            if not latest.sure:
                continue
            beyond_doubt = latest.confidence >= expert().locating.checked_below or where is not None
            if beyond_doubt or not many:
                break
            if detail is None:
                detail, fitting = self._in_detail(cloud, view, search, own, count, clock)
            if detail is None or not detail.fits_better(search, latest.decision.T_target_source, fitting):
                break
            best = replace(latest, decision=latest.decision.doubted(FITS_BETTER))
        if best is None or best.decision.answer is None:
            return None, []
        decision = best.decision
        if times > 1.0 and decision.judgement.status != "ok":
            ranked = _with_twins(whole, ranked, count)
        read = (given, self.name), best.pair.clouds, best.pair.clouds[0].voxel_size, view is not None
        told_of = remarks(*read, self.line.config.preparation, decision.judgement)
        prior = self._prior_notes(search, decision.T_target_source, near, local)
        for sentence in (*cloud.notes, *prior, *told_of):
            decision = decision.with_note(sentence)
        return replace(best, decision=decision), ranked

    def is_plainly_in(self, cloud: PointCloud, levels: Sequence[Level]) -> bool:
        """Whether one quick look finds a scan, on the first of some grids that serves it; False where none does."""
        own, coarsest = self._grids(cloud)
        level = next((x for x in levels if own / expert().maps.finer <= x.voxel_size <= coarsest), None)
        if level is None:
            return False
        view = find_viewpoints(cloud, cloud, self.line.config.preparation.viewpoint)[0]
        try:
            search = self._begun(cloud, view, level, StageClock())
        except EmptyCloudError:
            return False
        if len(search.scan) < expert().maps.least_voxels:
            return False
        found = [search.look(h) for h in likely(search.candidates(), expert().maps.candidates)]
        return bool(found) and search.decide(found)[0].decision.judgement.status == "ok"

    def _grids(self, cloud: PointCloud) -> tuple[float, float]:
        """Edges of the grid that suits a scan, and of the coarsest one that serves it."""
        preparation, given = self.line.config.preparation, self.line.config.voxel_size
        if given is not None:
            own = bounded_voxel_size(cloud, cloud, given, preparation.max_points)
            return own, expert().maps.finer * own
        own, coarsest = voxel_sizes_of(cloud, preparation.voxel_points, expert().maps.least_voxels)
        own = bounded_voxel_size(cloud, cloud, own, preparation.max_points)
        return own, max(own, coarsest)

    def _begun(
        self,
        cloud: PointCloud,
        view: FloatArray | None,
        level: Level,
        clock: StageClock,
        sight: Level | None = None,
    ) -> Search:
        """The search for a scan on a level; ``sight`` as of `Search`."""
        clock("preprocess")
        config, seed = self._prepared_as(cloud), self.line.config.seed
        bare = prepare(cloud, level.voxel_size, config, viewpoint=view, seed=seed)
        clock("features")
        rows = compared_rows(bare)
        (scan, compared), cells = beside(
            lambda: described(bare, self.line.descriptor, rows),
            lambda: Cells.of(level.compared, radius_of(bare.points[rows])),
        )
        return Search(self.line, scan, compared, level, self._part(level), clock, sight, cells)

    def _part(self, level: Level) -> PreparedCloud:
        nothing = np.zeros((0, 3))
        origin, count = self.voxels.origin, int(self.voxels.counts.sum())
        size = level.voxel_size
        return PreparedCloud(nothing, nothing, None, size, None, origin, self.name, count, scanned=False)

    def _other(self, search: Search, cloud: PointCloud, own: float) -> Level | None:
        """The map on a grid that shows less of a large scan, or more of a small one; None where the search's is near
        it or a finer one takes too many points."""
        if self.line.config.voxel_size is not None:
            return None
        was, finer = search.level.voxel_size, expert().maps.finer
        sought = max(own, *voxel_sizes_of(cloud, expert().maps.sought_voxels))
        if max(sought / was, was / sought) <= finer:
            return None
        level = self.level_for(sought, finer * sought, expert().maps.most_points)
        return None if level is search.level else level

    def _around(self, search: Search, motions: Sequence[FloatArray], size: float, most: int) -> Level | None:
        """The map around some places, on a scan's own grid or one of so many points at most; None where that is no
        finer than the search's."""
        if search.level.voxel_size <= expert().maps.finer * size or not motions:
            return None
        centers = [transform_points(T, search.center[None])[0] for T in motions]
        around = self.voxels.within(np.array(centers), 2 * search.reach)
        size = max(size, around.edge, around.edge_for(most))
        if search.level.voxel_size <= expert().maps.finer * size:
            return None
        try:
            return Level.of(around, size, self.line.config.preparation)
        except EmptyCloudError:
            return None

    def _in_detail(
        self,
        cloud: PointCloud,
        view: FloatArray | None,
        search: Search,
        own: float,
        count: int,
        clock: StageClock,
    ) -> tuple[Detail | None, Fitting]:
        """The scan in detail, and where in the map it fits best; None where that is no finer than the search's grid.

        Motions are proposed on a finer grid of the whole map where the scan asks for one: on a coarse one a small scan
        has some twenty points to match, and of its place nothing is proposed.
        """
        size = max(own, expert().detail.finest * self.voxels.edge)
        if search.level.voxel_size <= expert().maps.finer * size:
            return None, []
        other = self._other(search, cloud, own)
        if other is not None and other.voxel_size < search.level.voxel_size:
            search = self._begun(cloud, view, other, clock)
        clock("detail")
        fine = prepare(cloud, size, self._prepared_as(cloud), viewpoint=view, seed=self.line.config.seed)
        detail = Detail.of(fine, self.voxels, search, self.line.config.seed)
        return detail, detail.widely(search, count)

    def _prepared_as(self, cloud: PointCloud) -> PreparationConfig:
        config = self.line.config.preparation
        return config.model_copy(update={"viewpoint": "centroid"}) if seen_by_none((cloud, cloud)) else config

    def _looks(
        self, near: tuple[FloatArray, float] | None
    ) -> Iterator[tuple[Look, tuple[FloatArray, float] | None]]:
        """How closely to look, and where, until something sure is found."""
        if near is not None:
            yield "quick", near
        yield "quick", None
        if self.line.config.second_look.grids or self.line.config.second_look.max_correspondences:
            yield "more", None
            yield "other", None
            yield "finer", None

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


def _with_twins(search: Search, ranked: Sequence[Hypothesis], count: int) -> list[Hypothesis]:
    """Places, best first, each followed by those where the map is as it is there, so many together: in a copy of a room
    the scan fits as well, and which of the copies came first is chance."""
    listed: list[Hypothesis] = []
    for place in ranked:
        if len(listed) < count and all(search.differ(place, other) for other in listed):
            listed.append(place)
            for T in search.twins(place.T_target_source, count):
                twin = replace(place, T_target_source=T)
                known = next((h for h in ranked if not search.differ(h, twin)), twin)
                if all(search.differ(known, other) for other in listed):
                    listed.append(known)
    return listed[:count]
