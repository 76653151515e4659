"""The method on one screen: load, prepare, features, match, propose, score, refine, decide.

`Registrar._look` is the line; each of its words is a room. For correspondences without clouds there is
`geomoe3d.correspondence_registration`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from copy import copy
from dataclasses import replace
from itertools import chain
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.loading import without_missing
from geomoe3d.clouds.order import in_order
from geomoe3d.clouds.pair import Pair
from geomoe3d.clouds.prepare import (
    bounded_voxel_size,
    check_cloud,
    own_voxel_sizes,
    robust_extent,
    round_size,
    scale_mismatch,
)
from geomoe3d.clouds.viewpoint import MOST_SIGN_BREAKS, find_viewpoints, known_viewpoints, sign_breaks
from geomoe3d.config import RegistrationConfig, build_config
from geomoe3d.correspondence_registration import CorrespondenceRegistrar, between_clouds, check_rows
from geomoe3d.decision.accuracy import measure_accuracy
from geomoe3d.decision.answer import Decision, failed_result, finished_result
from geomoe3d.decision.confidence import Judgement
from geomoe3d.decision.explanation import Explanation
from geomoe3d.decision.remarks import data_remarks, remarks
from geomoe3d.decision.scale import likely_unit_ratio, measure_scale, seeming_units
from geomoe3d.decision.selection import Selection
from geomoe3d.decision.similarity import as_similarity, find_similarity, mirrored_cloud, scaled_cloud
from geomoe3d.errors import ConfigError, EmptyCloudError, InputError
from geomoe3d.features.cache import FeatureCache
from geomoe3d.geometry.se3 import check_motion, inverse
from geomoe3d.pipeline import Clouds, Pipeline, Places, Sides, resolved, with_weights
from geomoe3d.result import RegistrationResult
from geomoe3d.runtime.threads import single_blas_thread
from geomoe3d.runtime.timing import Progress, StageClock
from geomoe3d.scoring.network import NETWORK, opinion_of
from geomoe3d.types import FilterOutput, FloatArray, Hypothesis, PointCloud

_LARGER = 3.0
"""Ratio of the voxel sizes that two clouds would get by themselves from which the larger is taken for a map; of 1,941
pairs of scans measured the largest was 2.6, of a depth camera's view in its room three to four."""
_SURE = 0.99
_CLEARLY_BETTER = 3.0  # times the score


class Registrar:
    """Registers pairs of clouds with one configuration; keep it to load weights only once.

    Args:
        config: complete configuration; None takes the defaults.
        cache: keeps features of clouds that are in many pairs; answers are the same without it.

    Raises:
        ConfigError: an unknown part, or settings that it does not take.
        CheckpointError: trained weights are missing, broken or do not fit.
        DependencyError: a library that a part needs is not installed.
    """

    _names_units, _looks_once = True, False

    def __init__(
        self, config: RegistrationConfig | None = None, *, cache: FeatureCache | None = None
    ) -> None:
        self.config = resolved(config)
        self.pipeline = Pipeline(self.config, cache)
        self.pipeline.warm_up()

    @classmethod
    def from_pretrained(cls, name_or_path: str, config: RegistrationConfig | None = None) -> Registrar:
        """A registrar with a trained network: as scorer, or as outlier filter where it weighs correspondences.

        Args:
            name_or_path: a .safetensors file with its card, or the name of shipped weights.
            config: the rest of the configuration; None takes the defaults.

        Raises:
            CheckpointError: the weights are missing, broken or do not fit.
        """
        return cls(with_weights(config or RegistrationConfig(), str(name_or_path)))

    def register(
        self,
        source: Any,
        target: Any,
        *,
        initial: ArrayLike | None = None,
        correspondences: ArrayLike | None = None,
        progress: Progress | None = None,
    ) -> RegistrationResult:
        """The transform that maps source into target; see `geomoe3d.register`."""
        given: dict[str, Any] = {"initial": initial, "correspondences": correspondences}
        return self.explain(source, target, **given, progress=progress).result

    @overload
    def register_many(self, pairs: Iterable[tuple[Any, Any]]) -> Iterator[RegistrationResult]: ...
    @overload
    def register_many(
        self, pairs: Iterable[tuple[Any, Any]], *, on_error: Literal["raise"]
    ) -> Iterator[RegistrationResult]: ...
    @overload
    def register_many(
        self, pairs: Iterable[tuple[Any, Any]], *, on_error: Literal["return"]
    ) -> Iterator[RegistrationResult | InputError]: ...
    def register_many(
        self, pairs: Iterable[tuple[Any, Any]], *, on_error: Literal["raise", "return"] = "raise"
    ) -> Iterator[RegistrationResult | InputError]:
        """One result per (source, target), in order, as they are finished.

        Args:
            pairs: of anything that `register` takes.
            on_error: what becomes of a pair with a cloud that cannot be used: ``raise`` ends it as `register`
                does, ``return`` gives the error in place of the result and goes on.

        Raises:
            InputError: as `register`, with ``raise``; or another word for ``on_error``.
        """
        if on_error not in ("raise", "return"):
            raise InputError(f"on_error is '{on_error}'; choose raise or return")
        for source, target in pairs:
            try:
                yield self.register(source, target)
            except InputError as error:
                if on_error == "raise":
                    raise
                yield error

    def filter(self, correspondences: ArrayLike, *, voxel_size: float) -> FloatArray:
        """Weights (N,) in [0, 1] for anybody's correspondences (N, 6) = [source xyz, target xyz].

        A sensor is believed to have stood at zero where that can be, see `geomoe3d.clouds.viewpoint`.

        Args:
            correspondences: (N, 6) in one unit of length.
            voxel_size: the scale of the points' noise, same unit: the grid they came from.

        Raises:
            InputError: wrong shape, non-finite numbers, or no positive length.
        """
        return CorrespondenceRegistrar.of(self.pipeline).weigh(correspondences, voxel_size).weights

    def explain(
        self,
        source: Any,
        target: Any,
        *,
        initial: ArrayLike | None = None,
        correspondences: ArrayLike | None = None,
        progress: Progress | None = None,
    ) -> Explanation:
        """`register` with what led to the answer.

        Arguments and errors are those of `geomoe3d.register`.
        """
        if self.config.scale == "estimate":
            return self._explain_scaled(source, target, initial, correspondences, progress)
        config, seed, clock = self.config, self.config.seed, StageClock(progress)
        if initial is not None and not config.scoring.scorers:
            raise ConfigError(
                "a first guess is weighed against the hypotheses by scorers, but scoring.scorers is empty; leave "
                "one of the two out"
            )
        clock("load")
        loaded = _load(source, "source", seed), _load(target, "target", seed)
        clouds = without_missing(loaded[0]), without_missing(loaded[1])
        for cloud in clouds:
            check_cloud(cloud)
        rows = None if correspondences is None else check_rows(correspondences)
        guess = None if initial is None else check_motion(initial)
        mismatch = scale_mismatch(*clouds)
        if mismatch is not None:
            reason = self._units(clouds, clock) or mismatch
            failed = failed_result(clouds, reason, config, clock.stop())
            return Explanation(failed, *loaded).remembering(source, target)
        exchanged = not in_order(*clouds)
        if exchanged:
            clouds = clouds[1], clouds[0]
            guess = None if guess is None else inverse(guess)
            rows = None if rows is None else np.roll(rows, 3, axis=1)
        found = self._explained((source, target), clouds, clock, guess, rows, exchanged)
        found = found.exchanged() if exchanged else found
        return replace(found, source=loaded[0], target=loaded[1]).remembering(source, target)

    def _explained(
        self,
        data: tuple[Any, Any],
        clouds: tuple[PointCloud, PointCloud],
        clock: StageClock,
        initial: FloatArray | None,
        correspondences: FloatArray | None,
        exchanged: bool,
    ) -> Explanation:
        """`explain` for clouds in the order of the line; ``exchanged``: the caller calls the second one the source."""
        config = self.config
        clock("prepare")
        wanted = config.voxel_size
        if wanted is None:
            sizes = own_voxel_sizes(*clouds, config.preparation.voxel_points)
            if correspondences is None and self._is_map(sizes):
                if sizes[0] <= sizes[1]:
                    return self._in_map(clouds, initial, clock)
                back = None if initial is None else inverse(initial)
                return self._in_map(clouds[::-1], back, clock).exchanged()
            wanted = round_size(max(sizes))
        voxel_size = bounded_voxel_size(*clouds, wanted, config.preparation.max_points)
        views = find_viewpoints(*clouds, config.preparation.viewpoint)
        prepared = self.pipeline.prepare_both(clouds, voxel_size, views, clock)
        # Known places, not guessed ones: the network was trained on true ones, or none.
        places = known_viewpoints(*clouds, config.preparation.viewpoint)
        asked: dict[str, Any] = {"initial": initial, "given": correspondences}
        pair, weighed, decision = self._look(prepared, places, clock, **asked)
        for sides in self._other_sides(prepared, places):
            if decision.judgement.status == "ok":
                break
            if sides == "centroid":
                prepared = self.pipeline.prepare_both(clouds, voxel_size, (None, None), clock, sides)
            other = self._look(prepared, None, clock, **asked, sides=sides, rivals=decision)
            surer = other[2].judgement.confidence > decision.judgement.confidence
            # Without sensors less speaks against a wrong answer, so it is taken only where it is sure.
            if surer and (sides == "flipped" or other[2].judgement.status == "ok"):
                pair, weighed, decision = other
        clock("decide")
        if decision.answer is not None:
            scale = measure_scale(decision.T_target_source, *pair.clouds)
            decision = decision.with_scale(scale, exchanged=exchanged)
            decision = _with_accuracy(decision, pair)
        if decision.judgement.status != "ok":
            units = self._units(clouds[::-1] if exchanged else clouds, clock)
            if units is not None:
                decision = decision.with_note(units, first=True)
        mirrored = self._mirrored(clouds, decision, clock)
        if mirrored is not None:
            decision = decision.doubted(mirrored)
        read = data, pair.clouds, wanted, places is not None
        told_of = remarks(*read, config.preparation, decision.judgement)
        causes = () if decision.judgement.status == "ok" else data_remarks(clouds, wanted, config.preparation)
        for remark in (*clouds[0].notes, *clouds[1].notes, *causes, *told_of):
            decision = decision.with_note(remark)
        if NETWORK in self.pipeline.scorers:
            opinion = opinion_of(decision.answer)
            said = None if opinion is None else opinion.output
            weighed = said or FilterOutput(np.zeros(len(pair.matched)))
        result = finished_result(pair, decision, config, clock.stop())
        inliers = decision.residuals(pair.matched) < pair.inlier_threshold
        return Explanation(result, *clouds, pair.matched, weighed, inliers, decision.hypotheses)

    def _is_map(self, sizes: tuple[float, float]) -> bool:
        """Whether one cloud is so much larger or sparser than the other that what both share is a small part of it."""
        one_scale = self._names_units  # not a ratio that is tried
        return one_scale and max(sizes) >= _LARGER * min(sizes) and bool(self.pipeline.scorers)

    def _in_map(
        self, clouds: tuple[PointCloud, PointCloud], guess: FloatArray | None, clock: StageClock
    ) -> Explanation:
        """The first cloud sought in the second, much larger one."""
        from geomoe3d.maps.map import NOWHERE, search_larger

        scan, world = clouds
        found = search_larger(scan, world, self.pipeline, guess, clock)
        if found is None or found.decision.answer is None:
            failed = failed_result(clouds, NOWHERE, self.config, clock.stop())
            return Explanation(failed, *clouds)
        pair, decision = found.pair, _with_accuracy(found.decision, found.pair)
        if decision.judgement.status != "ok" and (units := self._units(clouds, clock)) is not None:
            decision = decision.with_note(units, first=True)
        for remark in world.notes:
            decision = decision.with_note(remark)
        result = finished_result(pair, decision, self.config, clock.stop())
        opinion = opinion_of(decision.answer)
        said = None if opinion is None else opinion.output
        weighed = said or FilterOutput(np.zeros(len(pair.matched)))
        inliers = decision.residuals(pair.matched) < pair.inlier_threshold
        return Explanation(result, *clouds, pair.matched, weighed, inliers, decision.hypotheses)

    def _explain_scaled(
        self,
        source: Any,
        target: Any,
        initial: ArrayLike | None,
        correspondences: ArrayLike | None,
        progress: Progress | None,
    ) -> Explanation:
        """`explain` where the ratio of lengths is unknown: a search over rigid answers."""
        if initial is not None:
            raise ConfigError(
                "a first guess is a rigid motion and says nothing of the scale that is to be estimated (scale: "
                "estimate); leave one of the two out"
            )
        clock = StageClock(progress)
        clock("load")
        clouds = _load(source, "source", self.config.seed), _load(target, "target", self.config.seed)
        for cloud in clouds:
            check_cloud(cloud)
        rows = None if correspondences is None else check_rows(correspondences)
        quick, thorough = self._rigid(second_look=False), self._rigid(second_look=True)

        def attempt(ratio: float, thoroughly: bool) -> Explanation:
            clock("scale")
            shrunk = None if rows is None else rows / ([ratio] * 3 + [1.0] * 3)
            smaller = scaled_cloud(clouds[0], 1 / ratio)
            registrar = thorough if thoroughly else quick
            return registrar.explain(smaller, clouds[1], correspondences=shrunk, progress=progress)

        best = find_similarity(*clouds, attempt)
        if best is None:
            extents = [robust_extent(cloud.points) for cloud in clouds]
            reason = (
                f"the extents of '{clouds[0].name}' and '{clouds[1].name}' are {extents[0]:.4g} and {extents[1]:.4g}; "
                "a scale between 1/1000 and 1000 is sought, so bring them nearer to one unit first"
            )
            failed = failed_result(clouds, reason, self.config, clock.stop())
            return Explanation(failed, *clouds).remembering(source, target)
        found, ratio = best
        stages = {**found.result.seconds, **clock.stop()}
        result = replace(found.result, config=self.config.model_dump(mode="json"), seconds=stages)
        return as_similarity(found, ratio, clouds[0], result).remembering(source, target)

    def _rigid(self, *, second_look: bool) -> Registrar:
        """This registrar for one scale: it asks about no units, and without ``second_look`` looks once."""
        rigid = copy(self)
        rigid.config = self.config.model_copy(update={"scale": "fixed"})
        rigid._names_units, rigid._looks_once = False, not second_look
        return rigid

    def _look(
        self,
        prepared: Clouds,
        places: Places,
        clock: StageClock,
        initial: FloatArray | None,
        given: FloatArray | None,
        sides: Sides = "sensor",
        rivals: Decision | None = None,
    ) -> tuple[Pair, FilterOutput, Decision]:
        """From clouds with features to a decision; a doubtful one with hypotheses of another descriptor and of coarser
        grids too.

        Args:
            prepared: both clouds on one grid.
            places: where the sensors are believed to have stood, local coordinates.
            clock: told of the stages.
            initial: a user's first guess, or None.
            given: a user's own matches, which then take the place of ours, or None.
            sides: where normals point, on every grid.
            rivals: what an earlier look decided; this one's answer must beat what was found before, as in
                repeated structure.
        """
        line, look = self.pipeline, self.config.second_look
        clouds = line.flipped(prepared, clock) if sides == "flipped" else prepared
        matched = None if given is None else between_clouds(given, prepared)
        pair = line.match(clouds, places, clock) if matched is None else line.pair(clouds, matched, places)
        weighed, proposed = line.propose(pair, clock)

        def select(pair: Pair, proposed: list[Hypothesis], config: RegistrationConfig) -> Selection:
            selection = Selection(pair, line.scorers, line.refiner, config, clock)
            selection.add(proposed)
            if rivals is not None:
                selection.add(rivals.transforms())
            if initial is not None:
                selection.add_guess(initial)
            return selection

        least = max(self.config.decision.min_confidence, look.min_confidence)
        decide = self.config.decision.model_copy(update={"min_confidence": least})
        stricter = self.config.model_copy(update={"decision": decide})
        with single_blas_thread():
            selection, looks = select(pair, proposed, self.config), [pair]
            decision = selection.decide()
            if given is None and sides == "sensor" and self._is_described_again(decision.judgement):
                again, pair = line.described_again(pair, places, clock)
                looks.append(again)
                proposed = [*(h.anew() for h in proposed), *line.propose(again, clock)[1]]
                weighed, selection = line.weigh(pair), select(pair, proposed, stricter)
                decision = selection.decide(look.num_refined, look.num_judged)
            if self._is_doubtful(decision.judgement):
                if given is None:
                    more = line.more_matches(looks, places, clock)
                    if len(looks) > 1:
                        pair = line.together([*more, looks[0], looks[1]], places)
                        proposed = [h.anew() for h in proposed]
                        weighed, selection = line.weigh(pair), select(pair, proposed, stricter)
                    coarser = line.coarser_pairs(prepared, places, clock, sides, len(looks) > 1)
                    for further in chain(more, coarser):
                        selection.add(line.propose(further, clock)[1])
                decision = selection.decide(look.num_refined, look.num_judged)
        return pair, weighed, decision

    def _units(self, clouds: tuple[PointCloud, PointCloud], clock: StageClock) -> str | None:
        """A sentence where the clouds fit once the source is brought to the unit that the extents suggest.

        One more registration, of pairs alone that are not ok and whose extents differ by about such a ratio.
        """
        source, target = clouds
        ratio = likely_unit_ratio((robust_extent(source.points), robust_extent(target.points)))
        if ratio is None or not self.pipeline.scorers or not self._names_units:
            return None
        clock("units")
        try:
            fits = self.register(scaled_cloud(source, 1 / ratio), target).ok
        except EmptyCloudError:  # next to nothing is left of it on the grid that was asked for
            return None
        if not fits:
            return None
        return (
            f"units differ: with all lengths of '{source.name}' divided by {ratio:.6g} the clouds fit"
            f"{seeming_units(ratio)}; bring both to one unit, a rigid motion cannot change scale"
        )

    def _is_described_again(self, judgement: Judgement) -> bool:
        """Whether the second descriptor is to be asked."""
        known = self.pipeline.second_descriptor is not None and bool(self.pipeline.scorers)
        return known and judgement.status != "ok" and not self._looks_once

    def _mirrored(
        self, clouds: tuple[PointCloud, PointCloud], decision: Decision, clock: StageClock
    ) -> str | None:
        """A sentence where the clouds fit clearly better once the source is mirrored.

        One more registration, a quick one, where the answer is not quite sure.
        """
        judgement, look = decision.judgement, self.config.second_look
        wanted = look.mirror and self._names_units and bool(self.pipeline.scorers)
        if not wanted or (judgement.status == "ok" and judgement.confidence > _SURE):
            return None
        clock("mirrored")
        turned = mirrored_cloud(clouds[0])
        found = self._rigid(second_look=False).register(turned, clouds[1])
        score = 0.0 if decision.answer is None else decision.answer.score
        if not found.ok or found.evidence["score"] < _CLEARLY_BETTER * score:
            return None
        return (
            f"mirrored: with x of '{clouds[0].name}' the other way round the clouds fit (confidence "
            f"{found.confidence:.2f}); a rigid motion cannot mirror, so bring both to right-handed axes (often two "
            "axes are exchanged)"
        )

    def _is_doubtful(self, judgement: Judgement) -> bool:
        """Whether a second look is to be taken, at more matches and on coarser grids."""
        look = self.config.second_look
        doubtful = judgement.status != "ok" and judgement.confidence < look.below
        wanted = bool(look.grids) or look.max_correspondences > 0
        return doubtful and bool(self.pipeline.scorers) and wanted and not self._looks_once

    def _other_sides(self, prepared: Clouds, places: Places) -> Iterator[Sides]:
        """Which other sides of normals a pair that is not ok is asked with.

        Where no sensor is known, the source's turned over: a guessed sensor may stand on the wrong side of
        everything, and then no feature of one scan is like the other's. Then all turned to the centroid, as suits
        objects, meshes and merged scans, which no sensor saw as a whole; where sensors are believed, only if the
        normals that follow from that contradict themselves.
        """
        if not self.config.second_look.flip or not self.pipeline.scorers or self._looks_once:
            return
        if places is None:
            yield "flipped"
        automatic = self.config.preparation.viewpoint == "auto"
        if automatic and (places is None or max(map(sign_breaks, prepared)) > MOST_SIGN_BREAKS):
            yield "centroid"


def register(
    source: Any,
    target: Any,
    *,
    config: RegistrationConfig | None = None,
    initial: ArrayLike | None = None,
    correspondences: ArrayLike | None = None,
    progress: Progress | None = None,
    **overrides: Any,
) -> RegistrationResult:
    """The rigid transform p_target = R p_source + t that maps source into target; no first guess is needed.

    With ``scale="estimate"`` a similarity, p_target = scale R p_source + t.

    Args:
        source: path, (N, 3) array or tensor, Open3D or trimesh cloud or mesh, or `PointCloud`.
        target: likewise, in the same unit of length unless the scale is estimated.
        config: complete configuration; None takes the defaults.
        initial: (4, 4) a first guess in the files' coordinates, or None; scored like all others, not trusted.
        correspondences: (N, 6) matches of your own, rows [source xyz, target xyz] in the files' coordinates,
            which take the place of ours, or None; the clouds score, refine and decide.
        progress: called with the name of each stage as it begins.
        overrides: top-level configuration keys such as ``voxel_size=0.05`` or ``seed=1``.

    Where one cloud is much larger than the other it is taken for a map, in which the smaller one is sought; see
    `geomoe3d.Map`, which keeps the map for further scans.

    Returns:
        The answer with status, confidence and reasons; look at ``result.ok`` before using the transform.

    Raises:
        InputError: a cloud that cannot be read or has too few usable points, a guess that is no rigid
            transform, or correspondences that are no (N, 6) finite numbers.
        ConfigError: an unknown or invalid override, or a guess where nothing scores or the scale is estimated.
    """
    if overrides:
        tree = (config or RegistrationConfig()).model_dump()
        config = build_config(RegistrationConfig, {**tree, **overrides}, "register(...)")
    given: dict[str, Any] = {"initial": initial, "correspondences": correspondences, "progress": progress}
    return Registrar(config).register(source, target, **given)


def _with_accuracy(decision: Decision, pair: Pair) -> Decision:
    """The same decision, which has an answer, with its accuracy."""
    T = decision.T_target_source
    return replace(decision, accuracy=measure_accuracy(T, *pair.clouds, pair.matched, pair.inlier_threshold))


def _load(data: Any, role: str, seed: int) -> PointCloud:
    named = isinstance(data, (str, os.PathLike, PointCloud))
    return load_points(data, seed=seed, name=None if named else role)
