"""One scan in a map: candidate places, the ordinary line at the best of them, one decision.

A map has no one sensor, so its surfaces have no front. Under a motion the scan's sensor has a place in the map, and
what was matched was seen from there: the map around a candidate is cut out, turned to that place, described and
compared like another scan. Before that a quick look tells good candidates from bad ones: a scan lies in its map with
all of its surface, nothing of the map may stand where the scan's sensor looked through, and nothing of the scan where
those of the map did.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from geomoe3d.clouds.range_image import RangeImage
from geomoe3d.config import RegistrationConfig, expert
from geomoe3d.decision.confidence import Judgement, judge, lead_over
from geomoe3d.decision.selection import Selection, surfaces_of
from geomoe3d.geometry.se3 import inverse, make_transform, motions_apart, transform_points
from geomoe3d.maps.found import Found
from geomoe3d.maps.level import Compared, Level
from geomoe3d.maps.places import Cells, Query, Window, likest
from geomoe3d.maps.sight import Sight, seen_factor
from geomoe3d.maps.stranger import shown
from geomoe3d.pipeline import Pipeline
from geomoe3d.runtime.threads import ahead, beside, each, single_blas_thread
from geomoe3d.runtime.timing import StageClock
from geomoe3d.types import FloatArray, Hypothesis, PreparedCloud

ANOTHER_STANDS = (
    "at another place the scan would be ok too, were it not for this one: rooms may be copies of each other"
)


class Search:
    """Looks for one scan on one level of a map.

    Args:
        line: parts of the configuration.
        scan: on the level's grid, with the features of the line.
        compared: of the scan, with the features of the level.
        level: of the map.
        part: of what is cut out of the map: its name, origin and counts; its arrays are replaced.
        clock: told of the stages.
        sight: the map as a whole where ``level`` is a part of it: its sensors are asked there, since in the part alone
            they would seem to have looked through walls that were cut away. None: the level.
        cells: as of `Query`.
    """

    def __init__(
        self,
        line: Pipeline,
        scan: PreparedCloud,
        compared: Compared,
        level: Level,
        part: PreparedCloud,
        clock: StageClock,
        sight: Level | None = None,
        cells: Cells | None = None,
    ) -> None:
        self._sight = level if sight is None else sight
        self._line, self.level, self._part, self._clock = line, level, part, clock
        self.config: RegistrationConfig = line.config
        self.scan = scan
        self.center = scan.points.mean(0)
        self.eye = self.center if scan.viewpoint is None else scan.viewpoint
        reach = np.linalg.norm(scan.points - self.center, axis=1)
        self.reach = float(np.quantile(reach, expert().locating.reach))
        threshold = self.config.estimator.inlier_threshold * scan.voxel_size
        self.apart = expert().selection.different_shift * threshold
        margin = expert().locating.margin * scan.voxel_size
        self._box = scan.points.min(0) - margin, scan.points.max(0) + margin
        clock("places")
        self.query = Query(compared, level, seed=self.config.seed, cells=cells)
        rng = np.random.default_rng(self.config.seed)
        self._rows = np.sort(rng.permutation(len(scan))[: expert().locating.asked])
        self._order = rng.permutation(len(level.points))
        self._view = None if scan.viewpoint is None else RangeImage.of(scan.points, scan.viewpoint)

    @property
    def has_many_places(self) -> bool:
        """Whether the map has very many windows, of which the scan may look like several."""
        return self.query.num_windows >= expert().detail.many_places

    def candidates(
        self,
        *,
        more: bool = False,
        near: tuple[FloatArray, float] | None = None,
        given: Sequence[FloatArray] = (),
        times: float = 1.0,
    ) -> list[tuple[float, Hypothesis]]:
        """Distinct motions into the map with their quick scores, best first.

        Args:
            more: look into twice as many windows, with more matches.
            near: (3,) where the scan's sensor, or its middle where none is known, is said to be, local coordinates,
                and how far off at most.
            given: further motions (4, 4), local coordinates.
            times: so many times the usual number of windows and motions, where more places are asked for than usual.
        """
        self._clock("places")
        within = None if near is None else (near[0], near[1] + float(np.linalg.norm(self.eye - self.center)))
        known = expert().locating
        most = known.more_windows if more else known.windows
        windows = self.query.windows(math.ceil(times * most), within)
        self._clock("propose")
        scored = self._proposed(windows, near, given, times, more)
        scored.sort(key=lambda item: -item[0])
        chosen: list[tuple[float, Hypothesis]] = []
        for score, hypothesis in scored:
            if len(chosen) >= times * known.kept[more]:
                break
            if all(self.differ(hypothesis, other) for _, other in chosen):
                chosen.append((score, hypothesis))
        worth = [
            h.T_target_source
            for score, h in chosen[: math.ceil(times * known.polished[more])]
            if score >= known.worth_polishing * chosen[0][0]
        ]

        def closer(T: FloatArray) -> tuple[float, Hypothesis]:
            T = self.polished(T)
            return self.quick(T), Hypothesis(T)

        both = [*chosen, *each(closer, worth)]
        best: list[tuple[float, Hypothesis]] = []
        for score, hypothesis in sorted(both, key=lambda item: -item[0]):
            if all(self.differ(hypothesis, other) for _, other in best):
                best.append((score, hypothesis))
        return best

    def twins(self, T: FloatArray, count: int) -> list[FloatArray]:
        """Transforms (4, 4) that put the scan where the map is as it is around a place, best first: in rooms that are
        copies of one. The map's own surfaces are sought in it, which show more of a place than the scan does.

        Args:
            T: (4, 4) into the map, local coordinates: the place.
            count: at most so many.
        """
        self._clock("twins")
        level, known = self.level, expert().locating
        center, points = transform_points(T, self.center[None])[0], level.points[level.rows]
        away = np.linalg.norm(points - center, axis=1)
        near = np.flatnonzero(away < self.reach)
        if len(near) < expert().maps.least_twin:
            return []
        part = Compared(points[near], level.normals[level.rows[near]], level.features[near])
        voters = part.features[:: math.ceil(len(near) / known.twin_voters)]
        windows = self.query.windows(4 * count, voters=voters)
        drawn = np.random.default_rng(self.config.seed).permutation(len(near))[: known.twin_asked]
        query = Query(part.take(np.sort(drawn)), level, seed=self.config.seed)
        own, place = self.quick(T), Hypothesis(T)
        # A copy of a room repeats what lies around the place, too, which a piece of wall elsewhere does not.
        wider = np.flatnonzero(away < known.twin_apart * self.reach)
        wider = level.rows[wider[:: math.ceil(len(wider) / known.twin_asked)]]
        least, worth = known.close * own, known.worth_polishing * own

        def sought(window: Window) -> tuple[float, Hypothesis] | None:
            moved = [Hypothesis(h.T_target_source @ T) for h in query.motions(window, 3, mutual=True)]
            # Windows that reach the place hold its own points, too.
            moved = [h for h in moved if self.differ(place, h)]
            if not moved or self.quick(moved[0].T_target_source, worth) <= worth:
                return None
            twin = self.polished(moved[0].T_target_source)
            if self.quick(twin, least) <= least:
                return None
            moved_there = twin @ inverse(T)
            normals = level.normals[wider] @ moved_there[:3, :3].T
            _, same = level.met(transform_points(moved_there, level.points[wider]), normals)
            return float(same.mean()), Hypothesis(twin)

        alike = each(sought, likest(windows, center, self.reach, max(known.twin_windows, count)))
        found = [twin for twin in alike if twin is not None]
        distinct: list[Hypothesis] = []
        for _, h in sorted(found, key=lambda item: -item[0]):
            if len(distinct) < count and all(self.differ(h, other) for other in distinct):
                distinct.append(h)
        return [h.T_target_source for h in distinct]

    def _proposed(
        self,
        windows: Sequence[Window],
        near: tuple[FloatArray, float] | None,
        given: Sequence[FloatArray],
        times: float,
        more: bool,
    ) -> list[tuple[float, Hypothesis]]:
        """Motions into windows, and those that were given, with their quick scores; see `candidates`.

        Once one fits plainly, of the other windows only those are looked into that may hold another such place.
        """
        known = expert().locating
        scored = [(self.quick(T), Hypothesis(T)) for T in given]
        # What was known before did not convince, or it would not be asked again.
        plain = max([known.plain, *(known.better * score for score, _ in scored)]) if more else known.plain
        found: tuple[float, FloatArray] | None = None  # votes of its window, and where the scan's middle lies
        thorough = more or self.has_many_places
        motions = ahead(
            lambda w: self.query.motions(w, known.per_window[more], more=more, sparing=not thorough), windows
        )
        for number, window in enumerate(windows):
            if (
                number >= times * known.first_windows[thorough]
                and max((q for q, _ in scored), default=0.0) > plain
            ):
                break
            if found is not None and window.votes < known.rival_votes * found[0]:
                break
            if found is not None and np.linalg.norm(window.center - found[1]) < self.query.radius:
                continue
            proposed = motions(number)
            if near is not None:
                proposed = [h for h in proposed if self.is_near(h.T_target_source, near)]
            least = known.worth_polishing * max((q for q, _ in scored), default=0.0)
            quick = each(partial(self.quick, least=least), [h.T_target_source for h in proposed])
            fresh = list(zip(quick, proposed, strict=True))
            scored += fresh
            best = max(fresh, key=lambda item: item[0], default=None)
            if found is None and times == 1.0 and best is not None and best[0] > max(plain, known.plainest):
                found = window.votes, transform_points(best[1].T_target_source, self.center[None])[0]
        return scored

    def differ(self, a: Hypothesis, b: Hypothesis) -> bool:
        """Whether two motions are clearly different."""
        shift, turn = motions_apart(a.T_target_source, b.T_target_source, self.center)
        return shift > self.apart or turn > expert().selection.different_turn_deg

    def look(self, hypothesis: Hypothesis, *, fully: bool = False) -> Found:
        """The ordinary line on the scan and the map around where a motion puts it.

        ``fully``: with features of just what is around, in place of those that the map holds.
        """
        with single_blas_thread():
            T = hypothesis.T_target_source
            target = self._around(T, fully)
            self._clock("match")
            pair = self._line.match((self.scan, target), None, self._clock)
            # Proposing keeps one thread busy most of the time.
            (_, proposed), surfaces = beside(
                lambda: self._line.propose(pair, self._clock), lambda: surfaces_of(pair, self._line.scorers)
            )
            scorers = dict(self._line.scorers)
            if scorers and len(self._sight.sensors):
                scorers["sight"] = Sight(self._sight, self.scan.points[self._rows[::4]])
            polish = self._line.refiner.about(pair)
            selection = Selection(pair, scorers, polish, self.config, self._clock, surfaces=surfaces)
            selection.add([Hypothesis(T), *proposed])
            decision = selection.decide()
            return Found(pair, decision, stood=decision.judgement.status == "ok")

    def decide(self, found: Sequence[Found]) -> tuple[Found, list[Hypothesis]]:
        """The best of several places, judged beside all others, and the distinct answers of all, best first."""
        answers = [(f, f.decision.answer) for f in found if f.decision.answer is not None]
        if not answers:
            return found[0], []
        answers.sort(key=lambda item: -item[1].score)
        best, answer = answers[0]
        rivals = [h for f, own in answers for h in (own, f.decision.alternative) if h is not None]
        rivals.sort(key=lambda h: -h.score)
        distinct: list[Hypothesis] = [answer]
        for h in rivals:
            if all(self.differ(h, other) for other in distinct):
                distinct.append(h)
        rival = distinct[1] if len(distinct) > 1 else None
        lead = lead_over(answer.score, None if rival is None else rival.score)
        matched = best.pair.matched
        support = (
            float((best.decision.residuals(matched) < best.pair.inlier_threshold).mean())
            if len(matched)
            else 0.0
        )
        information = best.decision.information
        judgement = judge(answer, rival, lead, support, information, self.config.decision, len(matched))
        sure = judgement.status == "ok" and best.decision.judgement.status == "ok"
        if judgement.status == "ok":  # never where it was not sure before it had rivals
            judgement = best.decision.judgement
        if judgement.status == "ok" and any(f.stood and self.differ(answer, own) for f, own in answers[1:]):
            # Which of the two the map's scanner saw more of says nothing of where the scan lies.
            reasons = (ANOTHER_STANDS, *judgement.reasons)
            most = expert().confidence.most_doubted
            judgement = Judgement("ambiguous", reasons, min(judgement.confidence, most))
            sure = False
        decision = replace(best.decision, alternative=rival, lead=lead, judgement=judgement)
        pair = best.pair
        decision = shown(self._line, pair, decision, self._clock)
        sure = sure and decision.judgement.status == "ok"
        if answer.note is not None:
            decision = decision.with_note(answer.note)
        self._clock("decide")
        measures = best.measured().measures
        assert measures is not None  # there is an answer
        scale, told = measures
        if scale is not None:  # maps are bent where their scans were joined
            scale = replace(scale, sigma=expert().locating.scale_deviation * scale.sigma)
        decision = decision.with_scale(scale, (pair.clouds[0].name, pair.clouds[1].name))
        stood = best.decision.judgement.status == "ok"
        return Found(pair, replace(decision, accuracy=told), sure, stood, measures), distinct

    def is_near(self, T: FloatArray, near: tuple[FloatArray, float]) -> bool:
        """Whether a transform (4, 4) puts the scan's sensor where it is said to be; ``near`` as of `candidates`."""
        return float(np.linalg.norm(transform_points(T, self.eye[None])[0] - near[0])) <= near[1]

    def polished(self, T: FloatArray) -> FloatArray:
        """A motion drawn closer by a few steps of point-to-plane alignment on the points of the quick look."""
        from scipy.spatial.transform import Rotation

        level = self.level
        points, normals = self.scan.points[self._rows], self.scan.normals[self._rows]
        for reach in expert().locating.polishing:
            moved = transform_points(T, points)
            distance, nearest = level.tree.query(moved, distance_upper_bound=reach * level.voxel_size)
            hit = np.flatnonzero(np.isfinite(distance))
            there = level.normals[np.asarray(nearest)[hit]]
            hit_normals = normals[hit] @ T[:3, :3].T
            alike = np.abs(np.einsum("ij,ij->i", hit_normals, there)) > expert().surfaces.least_cosine
            hit, there = hit[alike], there[alike]
            if len(hit) < 6:
                return T
            center = moved[hit].mean(0)
            gaps = np.einsum("ij,ij->i", level.points[np.asarray(nearest)[hit]] - moved[hit], there)
            J = np.hstack([np.cross(moved[hit] - center, there), there])
            step = np.linalg.solve(J.T @ J + expert().locating.damping * np.eye(6), J.T @ gaps)
            turn = Rotation.from_rotvec(step[:3]).as_matrix()
            T = make_transform(turn, center + step[3:] - turn @ center) @ T
        return T

    def quick(self, T: FloatArray, least: float = 0.0) -> float:
        """Share of the scan's points that lie on the map with an agreeing plane, times exp(-10 v), v the share of map
        points that stand where the scan's sensor looked through, and the same of the scan and the map's sensors; that
        is not asked where the first is below ``least``.
        """
        level, voxel = self.level, self.level.voxel_size
        moved = transform_points(T, self.scan.points[self._rows])
        hit, same = level.met(moved, self.scan.normals[self._rows] @ T[:3, :3].T)
        agreement = float(same.mean())
        if agreement > least:
            agreement *= seen_factor(self._sight, moved[~hit], len(moved))
        if self._view is None or agreement <= least:
            return agreement
        near = level.tree.query_ball_point(transform_points(T, self.center[None])[0], self.reach)
        around = np.array(near, dtype=np.int64)  # also where there is none
        around = around[np.argsort(self._order[around])[: expert().locating.asked_back]]
        if not len(around):
            return 0.0
        margin, _ = self._view.margins(transform_points(inverse(T), level.points[around]))
        violation = float(
            (margin < -expert().locating.seen_through * voxel).sum()
            / (np.isfinite(margin).sum() + expert().locating.unseen * len(around))
        )
        return agreement * float(np.exp(-expert().surfaces.violation_weight * violation))

    def _around(self, T: FloatArray, fully: bool) -> PreparedCloud:
        """What the map holds within the scan's box, as seen from where the motion puts the scan's sensor."""
        level = self.level
        center, eye = transform_points(T, np.stack([self.center, self.eye]))
        near = level.tree.query_ball_point(
            center, self.reach + expert().locating.margin * level.voxel_size, return_sorted=True
        )
        rows = np.array(near, dtype=np.int64)
        there = transform_points(inverse(T), level.points[rows])
        rows = rows[((there > self._box[0]) & (there < self._box[1])).all(axis=1)]
        part = replace(self._part, viewpoint=None if self.scan.viewpoint is None else eye)
        self._clock("features")
        return level.seen_from(eye, rows, part, self._line.descriptor, fully)


def likely(candidates: Sequence[tuple[float, Hypothesis]], most: int) -> Iterator[Hypothesis]:
    """The best candidate, and those that come near it, at most so many."""
    for score, hypothesis in candidates[:most]:
        if score >= expert().locating.close * candidates[0][0]:
            yield hypothesis
