"""From two loaded clouds to an answer: choose the grid, look, check, finish.

`Line._look` is the line itself: match, propose, score, refine, decide. A doubtful pair is looked at again, with the
matches of a second descriptor, with more matches, on coarser grids, and with normals turned to other sides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from geomoe3d.clouds.pair import Pair
from geomoe3d.clouds.viewpoint import check_both_known, known_viewpoints, seen_by_none, sign_breaks
from geomoe3d.clouds.voxel_size import bounded_voxel_size, own_voxel_sizes, round_size
from geomoe3d.config import RegistrationConfig, expert
from geomoe3d.correspondence_registration import between_clouds
from geomoe3d.decision.accuracy import measure_accuracy
from geomoe3d.decision.answer import Decision, failed_result, finished_result
from geomoe3d.decision.causes import Register, differing_units, is_sure, look_like_one_scene, mirrored_axes
from geomoe3d.decision.choosers import have_margin
from geomoe3d.decision.confidence import Judgement
from geomoe3d.decision.explanation import Explanation
from geomoe3d.decision.information import distance_under
from geomoe3d.decision.parallel import Parallel
from geomoe3d.decision.remarks import data_remarks, far_sensors, remarks
from geomoe3d.decision.repeat import joined
from geomoe3d.decision.scale import UNITS_DIFFER, Scale, measure_scale
from geomoe3d.decision.selection import Selection, surfaces_of
from geomoe3d.decision.shared_surface import SharedSurface
from geomoe3d.features.base import mirrored
from geomoe3d.geometry.se3 import inverse
from geomoe3d.pipeline import Clouds, Pipeline, Places, Sides
from geomoe3d.runtime.threads import beside, each, single_blas_thread
from geomoe3d.runtime.timing import StageClock
from geomoe3d.scoring.base import PairScorer
from geomoe3d.scoring.network import NETWORK, opinion_of
from geomoe3d.types import Accuracy, FilterOutput, FloatArray, Hypothesis, PointCloud


class Look(NamedTuple):
    """What one look at a pair gave: the clouds and matches that were judged, what the filter said, the decision, and
    what makes its transforms parallel."""

    pair: Pair
    weighed: FilterOutput
    decision: Decision
    parallel: Parallel

    def scale(self) -> Scale | None:
        """See `measure_scale`."""
        return measure_scale(self.decision.T_target_source, self.parallel.shared)

    def accuracy(self) -> Accuracy | None:
        """See `measure_accuracy`."""
        T, shared = self.decision.T_target_source, self.parallel.shared
        return measure_accuracy(T, shared, self.pair.matched, self.pair.inlier_threshold)


@dataclass
class Line:
    """What becomes of one pair.

    Attributes:
        pipeline: the parts.
        config: that the result says it was made with.
        clock: told of the stages.
        initial: a user's first guess (4, 4), file coordinates, or None.
        given: (N, 6) a user's own matches, file coordinates, which then take the place of ours, or None.
        again: registers two clouds, to find what is wrong with a pair that is not ok; None: that is not asked.
        once: whether the first look is all.
    """

    pipeline: Pipeline
    config: RegistrationConfig
    clock: StageClock
    initial: FloatArray | None = None
    given: FloatArray | None = None
    again: Register | None = None
    once: bool = False

    def explain(
        self,
        data: tuple[Any, Any],
        clouds: tuple[PointCloud, PointCloud],
        exchanged: bool,
    ) -> Explanation:
        """The answer, with what led to it, for clouds in the order of the line.

        Args:
            data: source and target as the user gave them.
            clouds: the same, loaded, in the order of the line.
            exchanged: whether the user calls the second of them the source.
        """
        config, clock = self.config, self.clock
        clock("preprocess")
        wanted = config.voxel_size
        if wanted is None:
            sizes = own_voxel_sizes(*clouds, config.preparation.voxel_points)
            if self.given is None and self._is_map(sizes):
                if sizes[0] <= sizes[1]:
                    return self._in_map(clouds, self.initial)
                back = None if self.initial is None else inverse(self.initial)
                return self._in_map(clouds[::-1], back).exchanged()
            wanted = round_size(max(sizes))
        check_both_known(clouds)
        voxel_size = bounded_voxel_size(*clouds, wanted, config.preparation.max_points)
        rule = config.preparation.viewpoint
        # Known places, not guessed ones: the network was trained on true ones, or none.
        places = known_viewpoints(*clouds, rule)
        sides: Sides = "centroid" if seen_by_none(clouds) else "sensor"
        prepared = self.pipeline.prepare_both(clouds, voxel_size, places or (None, None), clock, sides)
        look = self._best(clouds, prepared, places, sides)
        if self._is_sought_again(look):
            look = self._sought_again(look, clouds, places, sides)
        clock("decide")
        decision, agreeing = look.decision, self._mirrored_agreement(prepared, places)
        # What features say of the mirrored source says nothing of a user's own matches of the source as it is.
        asks_mirrored = config.second_look.mirror and self.again is not None and self.given is None
        # None of these needs the others, so they are had side by side.
        tasks: list[Callable[[], Any]] = []
        if decision.answer is not None:
            tasks = [look.scale, partial(self._made_parallel, look)]
        if asks_mirrored and not is_sure(decision.judgement):
            tasks.append(agreeing)
        with single_blas_thread():
            found = each(lambda task: task(), tasks)
        if decision.answer is not None:
            decision = found[1].with_scale(found[0], (clouds[0].name, clouds[1].name), exchanged=exchanged)
        if decision.judgement.status != "ok":
            units = self._units(clouds[::-1] if exchanged else clouds)
            decision = decision if units is None else decision.with_note(units, first=True)
        if asks_mirrored and not is_sure(decision.judgement):
            mirrored = self._mirrored(prepared, places, decision, agreeing)
            decision = decision if mirrored is None else decision.doubted(mirrored)
        told_of = remarks(
            data, look.pair.clouds, wanted, places is not None, config.preparation, decision.judgement
        )
        causes = () if decision.judgement.status == "ok" else data_remarks(clouds, wanted, config.preparation)
        for remark in (*clouds[0].notes, *clouds[1].notes, *far_sensors(clouds), *causes, *told_of):
            decision = decision.with_note(remark)
        return self._finished(look._replace(decision=decision), clouds)

    def _best(
        self, clouds: tuple[PointCloud, PointCloud], prepared: Clouds, places: Places, first: Sides
    ) -> Look:
        """The surest look at two clouds, prepared with their sensors at ``places``, believed ones or None."""
        best = self._look(prepared, places, first)
        others = iter(()) if first == "centroid" else self._other_sides(prepared, places)
        while best.decision.judgement.status != "ok" and (sides := next(others, None)) is not None:
            if sides == "centroid":
                size = prepared[0].voxel_size
                prepared = self.pipeline.prepare_both(clouds, size, (None, None), self.clock, sides)
            other = self._look(prepared, None, sides, best.decision)
            surer = other.decision.judgement.confidence > best.decision.judgement.confidence
            # Without sensors less speaks against a wrong answer, so it is taken only where it is sure, and never where
            # it lays believed ones on each other: this look could not see that what matches is their own pattern.
            sure = other.decision.judgement.status == "ok" and not _on_each_other(places, other)
            if surer and (sides == "flipped" or sure):
                best = other
        return best

    def _is_sought_again(self, look: Look) -> bool:
        """Whether an answer is to be found once more, on a shifted grid."""
        if self.again is None or self.given is not None or not self.pipeline.scorers:
            return False  # that is not asked, or nothing would be other
        below, judgement = self.config.second_look.repeat_below, look.decision.judgement
        few = expert().repeat.few_matches
        unsure = judgement.confidence < below or (
            below > 0 and self._may_be_wrong(look.pair, look.decision, few)
        )
        return unsure and judgement.status != "failed"

    def _sought_again(
        self, look: Look, clouds: tuple[PointCloud, PointCloud], places: Places, sides: Sides
    ) -> Look:
        """The surer of a look and another one on a shifted grid, judged by both."""
        line = replace(self, pipeline=self.pipeline.on_another_grid())
        size = look.pair.voxel_size
        prepared = line.pipeline.prepare_both(clouds, size, places or (None, None), self.clock, sides)
        other = line._best(clouds, prepared, places, sides)
        if other.decision.answer is None:
            nothing = "registered once more on a shifted grid, no transform was found"
            return look._replace(decision=look.decision.doubted(nothing))
        decisions, wanted = (look.decision, other.decision), self.config.decision
        agree = not look.parallel.differ(*(decision.T_target_source for decision in decisions))
        least = max(wanted.min_confidence, self.config.second_look.min_confidence)
        decision, taken = joined(*decisions, agree, least, wanted.prior)
        return (other if taken else look)._replace(decision=decision)

    def _mirrored_agreement(self, prepared: Clouds, places: Places) -> Callable[[], float]:
        """Which share of matches of the mirrored source the best of a few motions brings together; asked once."""
        return cache(lambda: self.pipeline.agreeing(*self._mirror(prepared, places), StageClock()))

    def _mirror(self, prepared: Clouds, places: Places) -> tuple[Clouds, Places]:
        """Both clouds, the source mirrored, and their sensors."""
        source, target = mirrored(prepared[0], self.pipeline.descriptor), prepared[1]
        believed = None if places is None or source.viewpoint is None else (source.viewpoint, places[1])
        return (source, target), believed

    def _mirrored(
        self, prepared: Clouds, places: Places, decision: Decision, agreeing: Callable[[], float]
    ) -> str | None:
        """A sentence where the clouds fit clearly better with the source mirrored; see `mirrored_axes`."""

        def look() -> Decision:
            alone = replace(self, clock=StageClock(), initial=None, given=None, again=None, once=True)
            return alone._look(*self._mirror(prepared, places)).decision

        return mirrored_axes(decision, prepared[0].name, agreeing, look, self.clock)

    def _look(
        self,
        prepared: Clouds,
        places: Places,
        sides: Sides = "sensor",
        rivals: Decision | None = None,
    ) -> Look:
        """From clouds with features to a decision; a doubtful one with hypotheses of another descriptor and of coarser
        grids too.

        Args:
            prepared: both clouds on one grid.
            places: where the sensors are believed to have stood, local coordinates.
            sides: where normals point, on every grid.
            rivals: what an earlier look decided; this one's answer must beat what was found before, as in
                repeated structure.
        """
        line, clock, look, given = self.pipeline, self.clock, self.config.second_look, self.given
        clouds = line.flipped(prepared, clock) if sides == "flipped" else prepared
        matched = None if given is None else between_clouds(given, prepared)
        pair = line.match(clouds, places, clock) if matched is None else line.pair(clouds, matched, places)
        polish = line.refiner.about(pair)  # whatever matches: the clouds stay the same

        def select(pair: Pair, proposed: list[Hypothesis], known: PairScorer | None = None) -> Selection:
            again = known is None
            config = stricter if again else self.config
            choosing = line.second_scorers if again else {}
            refine = polish if line.refiner.needs_clouds else line.refiner.about(pair)
            selection = Selection(pair, line.scorers, refine, config, clock, choosing, known, parallel)
            selection.add(proposed)
            if rivals is not None:
                selection.add(rivals.transforms())
            if self.initial is not None:
                selection.add_guess(self.initial)
            return selection

        least = max(self.config.decision.min_confidence, look.min_confidence)
        decide = self.config.decision.model_copy(update={"min_confidence": least})
        stricter = self.config.model_copy(update={"decision": decide})

        def needed_later() -> tuple[PairScorer, Parallel]:
            surfaces, parallel = surfaces_of(pair, line.scorers), self._parallel(pair)
            if parallel.wanted:
                parallel.shared.directions  # noqa: B018 - kept there
            return surfaces, parallel

        # Proposing keeps one thread busy most of the time.
        (weighed, proposed), (surfaces, parallel) = beside(lambda: line.propose(pair, clock), needed_later)
        with single_blas_thread():
            selection, looks = select(pair, proposed, surfaces), [pair]
            decision = selection.decide()
            if given is None and sides == "sensor" and self._is_described_again(pair, decision):
                described = line.described_again(pair.clouds, clock)
                if decision.judgement.status == "ok":
                    seen = line.pair(described, pair.matched, places)
                    decision = selection.check(decision, line.second_scorers, seen, decide, look.num_checked)
                if decision.judgement.status != "ok":
                    again, pair = line.matched_again(pair, described, places, clock)
                    looks.append(again)
                    proposed = [*(h.anew() for h in proposed), *line.propose(again, clock)[1]]
                    weighed, selection = line.weigh(pair), select(pair, proposed)
                    decision = selection.decide(look.num_refined, look.num_judged)
            if self._is_doubtful(decision.judgement):
                if given is None:
                    more = line.more_matches(looks, places, clock)
                    if len(looks) > 1:
                        pair = line.together([*more, looks[0], looks[1]], places)
                        proposed = [h.anew() for h in proposed]
                        weighed, selection = line.weigh(pair), select(pair, proposed)
                    coarser = line.coarser_pairs(prepared, places, clock, sides, len(looks) > 1)
                    for further in chain(more, coarser):
                        selection.add(line.propose(further, clock)[1])
                decision = selection.decide(look.num_refined, look.num_judged)
        return Look(pair, weighed, decision, parallel)

    def _is_described_again(self, pair: Pair, decision: Decision) -> bool:
        """Whether the second descriptor is to be asked: of an answer that is not ok, or may be wrong all the same."""
        if self.pipeline.second_descriptor is None or not self.pipeline.scorers or self.once:
            return False
        asked = have_margin(self.pipeline.second_scorers)
        few = expert().confidence.plain_matches
        return decision.judgement.status != "ok" or (asked and self._may_be_wrong(pair, decision, few))

    def _may_be_wrong(self, pair: Pair, decision: Decision, few: int) -> bool:
        """Whether an answer that is ok is so by little, and has a rival or ``few`` matches that agree."""
        if decision.judgement.confidence >= self.config.second_look.checked_below:
            return False
        agreeing = decision.residuals(pair.matched) < pair.inlier_threshold
        return decision.lead < expert().confidence.most_lead or int(agreeing.sum()) < few

    def _is_doubtful(self, judgement: Judgement) -> bool:
        """Whether a second look is to be taken, at more matches and on coarser grids."""
        look = self.config.second_look
        doubtful = judgement.status != "ok" and judgement.confidence < look.below
        wanted = bool(look.grids) or look.max_correspondences > 0
        return doubtful and bool(self.pipeline.scorers) and wanted and not self.once

    def _other_sides(self, prepared: Clouds, places: Places) -> Iterator[Sides]:
        """Which other sides of normals a pair that is not ok is asked with.

        Where no sensor is known, the source's turned over: a guessed sensor may stand on the wrong side of
        everything, and then no feature of one scan is like the other's. Then all turned to the centroid, as suits
        objects, meshes and merged scans, which no sensor saw as a whole; where sensors are believed, only if the
        normals that follow from that contradict themselves.
        """
        if not self.config.second_look.flip or not self.pipeline.scorers or self.once:
            return
        if places is None:
            yield "flipped"
        automatic, most = self.config.preparation.viewpoint == "auto", expert().viewpoint.most_sign_breaks
        if automatic and (places is None or max(map(sign_breaks, prepared)) > most):
            yield "centroid"

    def _finished(self, look: Look, clouds: tuple[PointCloud, PointCloud]) -> Explanation:
        """The result of a look, with what led to it."""
        pair, weighed, decision, _ = look
        if decision.answer is not None and decision.accuracy is None:
            decision = replace(decision, accuracy=look.accuracy())
        if NETWORK in self.pipeline.scorers:
            opinion = opinion_of(decision.answer)
            said = None if opinion is None else opinion.output
            weighed = said or decision.agreement(pair.matched, pair.inlier_threshold)
        result = finished_result(pair, decision, self.config, self.clock.stop())
        inliers = decision.residuals(pair.matched) < pair.inlier_threshold
        return Explanation(result, *clouds, pair.matched, weighed, inliers, decision.hypotheses)

    def _parallel(self, pair: Pair) -> Parallel:
        """What makes transforms of a pair parallel, where that is wanted."""
        wanted = self.config.refinement
        clouds = wanted.parallel and wanted.name in ("gicp", "icp")
        return Parallel(SharedSurface(*pair.clouds), pair.inlier_threshold, clouds)

    def _made_parallel(self, look: Look) -> Decision:
        """The decision with its answer made parallel, where that is wanted, and how accurate it then is."""
        look = look._replace(decision=look.decision.moved(look.parallel))
        return replace(look.decision, accuracy=look.accuracy())

    def _units(self, clouds: tuple[PointCloud, PointCloud]) -> str | None:
        return None if self.again is None else differing_units(clouds, self.again, self.clock)

    def _is_map(self, sizes: tuple[float, float]) -> bool:
        """Whether one cloud is so much larger or sparser than the other that what both share is a small part of it."""
        return self.again is not None and max(sizes) >= expert().maps.larger_grid * min(sizes)

    def _in_map(self, clouds: tuple[PointCloud, PointCloud], guess: FloatArray | None) -> Explanation:
        """The first cloud sought in the second, much larger one."""
        from geomoe3d.maps.larger import search_larger
        from geomoe3d.maps.location import nowhere

        early = self._units(clouds) if look_like_one_scene(clouds) else None
        if early is not None:  # no map: seen before it is described and searched
            return Explanation(failed_result(clouds, early, self.config, self.clock.stop()), *clouds)
        found = search_larger(*clouds, self.pipeline, guess, self.clock)
        if found is None or found.decision.answer is None:
            reason = nowhere(clouds[0], clouds[1].name)
            return Explanation(failed_result(clouds, reason, self.config, self.clock.stop()), *clouds)
        decision = found.decision
        judgement = decision.judgement
        named = any(reason.startswith(UNITS_DIFFER) for reason in judgement.reasons)
        # Where the larger cloud is one in another unit, not a map, its quick looks say nothing plain; the pair does.
        if judgement.status != "ok" and not named and (units := self._units(clouds)) is not None:
            decision = decision.with_note(units, first=True)
        for remark in clouds[1].notes:
            decision = decision.with_note(remark)
        weighed = FilterOutput(np.zeros(len(found.pair.matched)))
        return self._finished(Look(found.pair, weighed, decision, self._parallel(found.pair)), clouds)


def _on_each_other(places: Places, look: Look) -> bool:
    """Whether an answer lays sensors that are believed to have stood at ``places`` on each other."""
    if places is None:
        return False
    apart = distance_under(look.decision.T_target_source, *places)
    return apart < expert().confidence.near_sensors * look.pair.voxel_size
