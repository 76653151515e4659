"""The method on one screen: load, prepare, describe, match, weigh, solve, verify, refine, judge.

A network that judges motions weighs after the clouds have verified what was proposed, see `_shows_motions`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.prepare import (
    bounded_voxel_size,
    check_cloud,
    choose_voxel_size,
    prepare,
    scale_mismatch,
)
from geomoe3d.clouds.viewpoint import find_viewpoints, known_viewpoints
from geomoe3d.config import RegistrationConfig, build_config
from geomoe3d.correspondence_registration import check_length, check_rows, localised
from geomoe3d.decision.answer import Findings, failed_result, finished_result
from geomoe3d.decision.confidence import Judgement
from geomoe3d.decision.remarks import remarks
from geomoe3d.decision.selection import Chooser
from geomoe3d.errors import ConfigError, EmptyCloudError
from geomoe3d.estimators.base import Estimator, make_estimator
from geomoe3d.estimators.proposals import solve
from geomoe3d.features.cache import DescriptionCache
from geomoe3d.features.fpfh import describe, flip_pair
from geomoe3d.filters.base import Filter, FilterOutput, make_filter, resolved
from geomoe3d.matching.nearest import match
from geomoe3d.result import RegistrationResult
from geomoe3d.runtime.threads import single_blas_thread
from geomoe3d.runtime.timing import Progress, StageClock
from geomoe3d.types import BoolArray, Correspondences, FloatArray, Hypothesis, PointCloud, PreparedCloud

if TYPE_CHECKING:
    from geomoe3d.filters.motion_judge import Judged, PairJudge


@dataclass(frozen=True)
class Explanation:
    """A result with what led to it, for pictures and for curious users.

    Attributes:
        result: the answer.
        source, target: the clouds as loaded, full resolution, local coordinates.
        correspondences: what was given to the estimator, local coordinates; empty where it never came to it.
        weighed: what the filter said of them, in the same order; of a network that judges motions, what it
            said under the answer, all zero where there was none.
        inliers: (K,) True where a correspondence agrees with the answer.
    """

    result: RegistrationResult
    source: PointCloud
    target: PointCloud
    correspondences: Correspondences = field(default_factory=lambda: Correspondences(np.zeros((0, 6))))
    weighed: FilterOutput = field(default_factory=lambda: FilterOutput(np.zeros(0)))
    inliers: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))

    @property
    def weights(self) -> FloatArray:
        """(K,) the filter's weights."""
        return self.weighed.weights


class _Look(NamedTuple):
    """What a pair was seen as, and what was found in it."""

    described: tuple[PreparedCloud, PreparedCloud]
    matched: Correspondences
    weighed: FilterOutput
    findings: Findings


class Registrar:
    """Registers pairs of clouds with one configuration; keep it to load weights only once.

    Args:
        config: complete configuration; None takes the defaults.
        cache: keeps described clouds, for clouds that are in many pairs; answers are the same without it.

    Raises:
        ConfigError: an unknown filter or estimator.
        CheckpointError: trained weights are missing, broken or do not fit.
        DependencyError: a library that the filter needs is not installed.
    """

    def __init__(
        self, config: RegistrationConfig | None = None, *, cache: DescriptionCache | None = None
    ) -> None:
        self.config = resolved(config)
        self._cache = cache
        self._filter: Filter = make_filter(
            self.config.filter.name, self.config.filter.weights, self.config.estimator
        )
        network = getattr(self._filter, "config", None)
        self._wants_ratio = "ratio" in getattr(network, "extra_channels", ())
        self._judge: Callable[..., PairJudge] | None = getattr(self._filter, "about", None)
        self._estimator: Estimator = make_estimator(self.config.estimator)

    @classmethod
    def from_pretrained(cls, name_or_path: str, config: RegistrationConfig | None = None) -> Registrar:
        """A registrar whose correspondences are weighed by a trained network.

        Args:
            name_or_path: a .safetensors file with its card, or the name of shipped weights.
            config: the rest of the configuration; None takes the defaults.

        Raises:
            CheckpointError: the weights are missing, broken or do not fit.
        """
        tree = (config or RegistrationConfig()).model_dump()
        tree["filter"] = {"name": "geomoe", "weights": str(name_or_path)}
        return cls(build_config(RegistrationConfig, tree, "Registrar.from_pretrained"))

    def register(
        self,
        source: Any,
        target: Any,
        *,
        initial: ArrayLike | None = None,
        progress: Progress | None = None,
    ) -> RegistrationResult:
        """The rigid motion that lays source on target; see `geomoe3d.register`."""
        return self.explain(source, target, initial=initial, progress=progress).result

    def register_many(self, pairs: Iterable[tuple[Any, Any]]) -> Iterator[RegistrationResult]:
        """One result per (source, target), in order, as they are finished.

        A cloud that cannot be used raises as in `register` and ends it; `geomoe3d.register_pairs` goes on.
        """
        for source, target in pairs:
            yield self.register(source, target)

    def filter(self, correspondences: ArrayLike, *, voxel_size: float) -> FloatArray:
        """Weights (N,) in [0, 1] for anybody's correspondences (N, 6) = [source xyz, target xyz].

        A sensor is believed to have stood at zero where that can be, see `geomoe3d.clouds.viewpoint`.

        Args:
            correspondences: (N, 6) in one unit of length.
            voxel_size: the scale of the points' noise, same unit: the grid they came from.

        Raises:
            InputError: wrong shape, non-finite numbers, or no positive length.
        """
        rows, voxel_size = check_rows(correspondences), check_length(voxel_size, "voxel_size")
        given = localised(rows)[0] if len(rows) else Correspondences(rows)
        return self._filter(given, voxel_size=voxel_size, seed=self.config.seed).weights

    def explain(
        self,
        source: Any,
        target: Any,
        *,
        initial: ArrayLike | None = None,
        progress: Progress | None = None,
    ) -> Explanation:
        """`register` with the correspondences and weights behind the answer."""
        config, seed, clock = self.config, self.config.seed, StageClock(progress)
        if initial is not None and not config.verification.enabled:
            raise ConfigError(
                "verification weighs a first guess against the hypotheses, but verification.enabled is "
                "false; leave one of the two out"
            )
        clock("load")
        clouds = _load(source, "source", seed), _load(target, "target", seed)
        for cloud in clouds:
            check_cloud(cloud)
        mismatch = scale_mismatch(*clouds)
        if mismatch is not None:
            return Explanation(failed_result(clouds, mismatch, config, clock.stop()), *clouds)
        clock("prepare")
        wanted = config.voxel_size or choose_voxel_size(*clouds, config.preparation.voxel_points)
        voxel_size = bounded_voxel_size(*clouds, wanted, config.preparation.max_points)
        threshold = config.estimator.inlier_threshold * voxel_size
        described = self.describe(*clouds, voxel_size, clock)
        # Known places, not guessed ones: the network was trained on true ones, or none.
        viewpoints = known_viewpoints(*clouds, config.preparation.viewpoint)
        seen = self._look(described, viewpoints, initial, clock)
        if viewpoints is None and self._asks_flipped(seen.findings.judgement):
            clock("describe")
            other = self._look(described, None, initial, clock, rivals=seen.findings)
            if other.findings.judgement.confidence > seen.findings.judgement.confidence:
                seen = other
        described, matched, weighed, findings = seen
        given = (source, target), described, wanted, viewpoints is not None
        for remark in remarks(*given, config.preparation, findings.judgement):
            findings = findings.with_note(remark)
        if self._shows_motions:  # nothing weighs anything where no motion was found
            weighed = findings.weighed or FilterOutput(np.zeros(len(matched)))
        result = finished_result(described, matched, findings, config, threshold, clock.stop())
        inliers = findings.residuals(matched) < threshold
        return Explanation(result, *clouds, matched, weighed, inliers)

    def _look(
        self,
        described: tuple[PreparedCloud, PreparedCloud],
        viewpoints: tuple[FloatArray, FloatArray] | None,
        initial: ArrayLike | None,
        clock: StageClock,
        *,
        rivals: Findings | None = None,
    ) -> _Look:
        """From described clouds to a judged answer; a doubtful one with hypotheses of coarser grids too.

        ``rivals``: what an earlier look found. This one then turns the source's normals over, on every grid,
        and its answer must beat what was found before, as in repeated structure.
        """
        config, voxel_size, as_seen = self.config, described[0].voxel_size, described
        flipped = rivals is not None
        if flipped:
            described = flip_pair(as_seen, config.preparation)
        threshold = config.estimator.inlier_threshold * voxel_size
        matched, weighed, hypotheses = self.propose(described, clock, viewpoints)
        with single_blas_thread():
            chooser = Chooser(
                described, matched, threshold, config, clock, self._ask_about(matched, voxel_size)
            )
            chooser.consider(hypotheses)
            if rivals is not None:
                chooser.consider(rivals.motions())
            if initial is not None:
                chooser.consider_guess(initial)
            findings = chooser.conclude()
            if self._is_doubtful(findings.judgement):
                chooser.consider(self.propose_from_more(described, len(matched), clock, viewpoints))
                for grid in config.second_look.grids:
                    size = grid * voxel_size
                    more = self.propose_on_grid(size, as_seen, clock, viewpoints, flipped=flipped)
                    chooser.consider(more)
                findings = chooser.conclude(config.second_look.num_refined, config.second_look.num_judged)
        return _Look(described, matched, weighed, findings)

    def describe(
        self, source: PointCloud, target: PointCloud, voxel_size: float, clock: StageClock
    ) -> tuple[PreparedCloud, PreparedCloud]:
        """Both clouds on one voxel grid, with normals turned by one rule and features."""
        views = find_viewpoints(source, target, self.config.preparation.viewpoint)
        return (
            self.describe_cloud(source, voxel_size, views[0], clock),
            self.describe_cloud(target, voxel_size, views[1], clock),
        )

    def describe_cloud(
        self, cloud: PointCloud, voxel_size: float, viewpoint: FloatArray | None, clock: StageClock
    ) -> PreparedCloud:
        """One cloud prepared and described, or as the cache holds it."""
        config, seed = self.config.preparation, self.config.seed

        def make() -> PreparedCloud:
            clock("prepare")
            prepared = prepare(cloud, voxel_size, config, viewpoint=viewpoint, seed=seed)
            clock("describe")
            return describe(prepared, config)

        if self._cache is None:
            return make()
        return self._cache.fetch(cloud, voxel_size, viewpoint, config, seed=seed, make=make)

    def propose(
        self,
        described: tuple[PreparedCloud, PreparedCloud],
        clock: StageClock,
        viewpoints: tuple[FloatArray, FloatArray] | None = None,
        most: int | None = None,
    ) -> tuple[Correspondences, FilterOutput, list[Hypothesis]]:
        """Match, weigh and solve.

        Args:
            described: both clouds.
            clock: told of the stages.
            viewpoints: where the sensors are believed to have stood, local coordinates.
            most: matches used; None takes what the configuration says.
        """
        config, voxel_size = self.config, described[0].voxel_size
        clock("match")
        matching = config.matching
        if most is not None:
            matching = matching.model_copy(update={"max_correspondences": most})
        matched = match(*described, matching, seed=config.seed, with_ratio=self._wants_ratio)
        matched = replace(matched, viewpoints=viewpoints)
        clock("weigh")
        if self._shows_motions:  # that comes later: those that the clouds like best
            weighed = FilterOutput(np.ones(len(matched)))
        else:
            weighed = self._filter(matched, voxel_size=voxel_size, seed=config.seed)
        clock("solve")
        threshold = config.estimator.inlier_threshold * voxel_size
        found = solve(
            self._estimator, matched, weighed, config.estimator, inlier_threshold=threshold, seed=config.seed
        )
        return matched, weighed, found

    def propose_from_more(
        self,
        described: tuple[PreparedCloud, PreparedCloud],
        known: int,
        clock: StageClock,
        viewpoints: tuple[FloatArray, FloatArray] | None = None,
    ) -> list[Hypothesis]:
        """Hypotheses from more matches of the same grid than the ``known`` ones.

        None where there are no more.
        """
        usual, most = self.config.matching.max_correspondences, self.config.second_look.max_correspondences
        if known < usual or most <= usual:
            return []
        return self.propose(described, clock, viewpoints, most)[2]

    def propose_on_grid(
        self,
        voxel_size: float,
        described: tuple[PreparedCloud, PreparedCloud],
        clock: StageClock,
        viewpoints: tuple[FloatArray, FloatArray] | None = None,
        *,
        flipped: bool = False,
    ) -> list[Hypothesis]:
        """Hypotheses from the same clouds on a coarser grid of this edge, where features see more.

        None where a cloud is too small for the grid. ``flipped``: with the source's normals turned over.
        """
        clouds = [PointCloud(cloud.points, cloud.origin, name=cloud.name) for cloud in described]
        views = [cloud.viewpoint for cloud in described]
        try:
            source = self.describe_cloud(clouds[0], voxel_size, views[0], clock)
            target = self.describe_cloud(clouds[1], voxel_size, views[1], clock)
        except EmptyCloudError:
            return []
        pair = flip_pair((source, target), self.config.preparation) if flipped else (source, target)
        return self.propose(pair, clock, viewpoints)[2]

    def _is_doubtful(self, judgement: Judgement) -> bool:
        """Whether a second look is to be taken, at more matches and on coarser grids."""
        look = self.config.second_look
        doubtful = judgement.status != "ok" and judgement.confidence < look.below
        wanted = len(look.grids) > 0 or look.max_correspondences > 0
        return doubtful and self.config.verification.enabled and wanted

    def _asks_flipped(self, judgement: Judgement) -> bool:
        """Whether, no sensor being known, the pair is asked again with the source's normals turned over.

        A guessed sensor may stand on the wrong side of everything, as behind a wall, and then no feature of
        one scan is like any of the other.
        """
        return judgement.status != "ok" and self.config.second_look.flip and self.config.verification.enabled

    @property
    def _shows_motions(self) -> bool:
        """Whether a network is shown motions after they are proposed and verified, not before as a filter.

        Least squares needs its weights, and without verification nothing says which motions to show.
        """
        return (
            self._judge is not None
            and self.config.verification.enabled
            and self.config.estimator.name != "svd"
        )

    def _ask_about(
        self, matched: Correspondences, voxel_size: float
    ) -> Callable[[FloatArray], list[Judged]] | None:
        """The network's opinion of motions of these correspondences, or None without a network for that."""
        judge = self._judge
        if judge is None or not self._shows_motions:
            return None
        of_pair: list[PairJudge] = []

        def ask(motions: FloatArray) -> list[Judged]:
            if not of_pair:  # not before it is needed, and then once
                of_pair.append(judge(matched, voxel_size=voxel_size))
            return of_pair[0](motions)

        return ask


def register(
    source: Any,
    target: Any,
    *,
    config: RegistrationConfig | None = None,
    initial: ArrayLike | None = None,
    progress: Progress | None = None,
    **overrides: Any,
) -> RegistrationResult:
    """The rigid motion p_target = R p_source + t that lays source on target; no first guess is needed.

    Args:
        source: path, (N, 3) array or tensor, Open3D or trimesh cloud or mesh, or `PointCloud`.
        target: likewise, in the same unit of length.
        config: complete configuration; None takes the defaults.
        initial: (4, 4) a first guess in the files' coordinates, or None; it is verified against the clouds
            beside the hypotheses found, not trusted.
        progress: called with the name of each stage as it begins.
        overrides: top-level configuration keys such as ``voxel_size=0.05`` or ``seed=1``.

    Returns:
        The answer with status, confidence and reasons; look at ``result.ok`` before using the transform.

    Raises:
        InputError: a cloud that cannot be read or has too few usable points, or a guess that is no motion.
        ConfigError: an unknown or invalid override, or a guess where verification is switched off.
    """
    if overrides:
        tree = (config or RegistrationConfig()).model_dump()
        config = build_config(RegistrationConfig, {**tree, **overrides}, "register(...)")
    return Registrar(config).register(source, target, initial=initial, progress=progress)


def _load(data: Any, role: str, seed: int) -> PointCloud:
    named = isinstance(data, (str, os.PathLike, PointCloud))
    return load_points(data, seed=seed, name=None if named else role)
