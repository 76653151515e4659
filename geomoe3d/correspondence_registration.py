"""Bare correspondences in, a transform out: the line without clouds to score anything on.

Place: beside `registration`, for whoever has features and matches of their own. Outlier rejection and proposing
are the same; a network scores the first few hypotheses, drawn closer by the keypoints; what follows in
registration, scoring by the clouds and with it the confidence, needs them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from geomoe3d.clouds.pair import Pair
from geomoe3d.clouds.recentre import choose_origin
from geomoe3d.clouds.viewpoint import believed_viewpoints
from geomoe3d.config import RegistrationConfig, expert, expert_in_force
from geomoe3d.errors import ConfigError, InputError
from geomoe3d.estimators.keypoint_alignment import KeypointAligner
from geomoe3d.estimators.proposals import propose
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.geometry.se3 import residuals, shift_frames
from geomoe3d.pipeline import Pipeline, resolved
from geomoe3d.runtime.threads import beside, single_blas_thread
from geomoe3d.runtime.timing import StageClock
from geomoe3d.runtime.words import counted
from geomoe3d.scoring.network import NETWORK, opinion_of
from geomoe3d.types import BoolArray, Correspondences, FilterOutput, FloatArray, Hypothesis, PreparedCloud


@dataclass(frozen=True)
class CorrespondenceResult:
    """The transform that correspondences speak for. Whether it is right, only the clouds can say.

    Attributes:
        T_target_source: (4, 4), p_target = R p_source + t, in the coordinates given; NaN where nothing was
            found, never the identity as a stand-in.
        inliers: (N,) True where |R p + t - q| is below ``inlier_threshold``.
        inlier_threshold: in the unit given.
        weighed: what the filter said of the correspondences.
        others: further transforms (4, 4) that were considered, best first.
        seconds: wall time of each stage and ``total``.
    """

    T_target_source: FloatArray
    inliers: BoolArray
    inlier_threshold: float
    weighed: FilterOutput
    others: tuple[FloatArray, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def found(self) -> bool:
        """Whether there is a transform at all."""
        return bool(np.isfinite(self.T_target_source).all())

    @property
    def weights(self) -> FloatArray:
        """(N,) in [0, 1] the filter's weights."""
        return self.weighed.weights

    @property
    def num_inliers(self) -> int:
        """How many correspondences agree with the transform."""
        return int(self.inliers.sum())


class CorrespondenceRegistrar:
    """Registers bare correspondences with one configuration; keep it to load weights only once.

    Args:
        config: complete configuration; None takes the defaults.

    Raises:
        ConfigError: an unknown part, or settings that it does not take.
        CheckpointError: trained weights are missing, broken or do not fit.
        DependencyError: a library that a part needs is not installed.
    """

    def __init__(self, config: RegistrationConfig | None = None) -> None:
        self.pipeline = Pipeline(resolved(config))
        self.pipeline.warm_up()

    @property
    def config(self) -> RegistrationConfig:
        """That of the parts."""
        return self.pipeline.config

    @classmethod
    def of(cls, pipeline: Pipeline) -> CorrespondenceRegistrar:
        """With parts that somebody has made already."""
        made = cls.__new__(cls)
        made.pipeline = pipeline
        return made

    @expert_in_force
    def __call__(
        self,
        correspondences: ArrayLike | Correspondences,
        *,
        voxel_size: float,
        inlier_threshold: float | None = None,
        seed: int | None = None,
    ) -> CorrespondenceResult:
        """One pair; see `register_correspondences`.

        Args:
            correspondences: (N, 6).
            voxel_size: cloud units.
            inlier_threshold: cloud units; None takes that of the configuration.
            seed: None takes that of the configuration.
        """
        config, clock = self.config, StageClock()
        rows = check_rows(correspondences)
        voxel_size = check_length(voxel_size, "voxel_size")
        threshold = config.estimator.inlier_threshold * voxel_size
        if inlier_threshold is not None:
            threshold = check_length(inlier_threshold, "inlier_threshold")
        nothing = np.full((4, 4), np.nan), np.zeros(len(rows), dtype=np.bool_), threshold
        if len(rows) < 3:
            return CorrespondenceResult(*nothing, FilterOutput(np.zeros(len(rows))))
        matched, origins = localised(rows)
        pair = Pair(matched, voxel_size, threshold, config.seed if seed is None else seed)
        found, weighed = self.hypotheses(pair, clock)
        if found and not self.pipeline.refiner.needs_clouds:
            clock("refine")
            refined, _ = self.pipeline.refiner.about(pair)(found[0])
            found = [] if refined is None else [Hypothesis(refined)]
        seconds = clock.stop()
        if not found:
            return CorrespondenceResult(*nothing, weighed, seconds=seconds)
        inliers = residuals(found[0].T_target_source, matched.source, matched.target) < threshold
        motions = [shift_frames(hypothesis.T_target_source, *origins) for hypothesis in found]
        return CorrespondenceResult(motions[0], inliers, threshold, weighed, tuple(motions[1:]), seconds)

    @expert_in_force
    def weigh(self, correspondences: ArrayLike | Correspondences, voxel_size: float) -> FilterOutput:
        """What the outlier filter, or a network under the best transform, says of correspondences (N, 6)."""
        config = self.config
        rows, voxel_size = check_rows(correspondences), check_length(voxel_size, "voxel_size")
        matched = localised(rows)[0] if len(rows) else Correspondences(rows)
        pair = Pair(matched, voxel_size, config.estimator.inlier_threshold * voxel_size, config.seed)
        if NETWORK in self.pipeline.scorers:
            return self.hypotheses(pair, StageClock())[1]
        return self.pipeline.weigh(pair)

    @expert_in_force
    @single_blas_thread()
    def hypotheses(self, pair: Pair, clock: StageClock) -> tuple[list[Hypothesis], FilterOutput]:
        """Best first, and weights of the correspondences: of the filter, or of the network under the best."""
        line, matched = self.pipeline, pair.matched
        network = line.scorers.get(NETWORK)
        if line.filter is not None:
            clock("filter")
        weighed = line.weigh(pair)
        clock("propose")
        if network is None:
            return propose(line.estimator, pair, weighed.weights, line.config.estimator), weighed
        settings = line.config.estimator
        num_aligned = settings.num_aligned if matched.normals is None else 0
        estimate = line.estimator.with_less_effort() if num_aligned else line.estimator
        # Only those that the network looks at are drawn closer, below.
        unaligned = settings.model_copy(update={"num_aligned": 0})
        known = expert().correspondences
        few = likeliest_rows(matched, known.most_rows, pair.inlier_threshold, pair.seed)
        surfaces = pair.keypoint_surfaces if few is matched else None  # both of these ask for them
        found, say = beside(
            lambda: propose(estimate, pair, weighed.weights, unaligned),
            lambda: network.about(pair if few is matched else replace(pair, matched=few)),
        )
        if not found:
            return [], FilterOutput(np.zeros(len(matched)))
        clock("score")
        aligner = KeypointAligner(matched.points, pair.inlier_threshold, surfaces)
        looked_at: list[Hypothesis] = []
        for lot in (found[: known.first_looked_at], found[known.first_looked_at : known.most_looked_at]):
            if lot and all(_verdict(h) < known.convinced for h in looked_at):
                count = max(num_aligned - len(looked_at), 0)
                lot = aligner.hypotheses(lot[:count]) + lot[count:]
                for hypothesis, said in zip(lot, say(_transforms(lot)), strict=True):
                    hypothesis.scores[NETWORK] = said
                looked_at += lot
        ranked = sorted(looked_at, key=lambda h: -_verdict(h))
        if few is not matched:  # scored on some rows, weighed on all
            (ranked[0].scores[NETWORK],) = network.about(pair)(_transforms(ranked[:1]))
        opinion = opinion_of(ranked[0])
        output = None if opinion is None else opinion.output
        return [*ranked, *found[len(looked_at) :]], output or weighed


def register_correspondences(
    correspondences: ArrayLike | Correspondences,
    *,
    voxel_size: float,
    config: RegistrationConfig | None = None,
) -> CorrespondenceResult:
    """The rigid transform p_target = R p_source + t that anybody's correspondences speak for.

    For features and matches of your own; with the clouds at hand, `geomoe3d.register` is right more often and
    says how sure it is. Many outliers are expected. A sensor is believed to have stood at zero where that can
    be, see `geomoe3d.clouds.viewpoint`.

    Args:
        correspondences: (N, 6) rows [source xyz, target xyz] in one unit of length, in any frames.
        voxel_size: the scale of the points' noise, same unit: the grid they came from. Correspondences that
            miss by more than two of it count as outliers (``estimator.inlier_threshold``).
        config: complete configuration; None takes the defaults.

    Returns:
        The transform, which correspondences agree with it, and their weights. Look at ``found`` first.

    Raises:
        InputError: no (N, 6) of finite numbers, or a voxel size that is not a positive length.
        ConfigError: the scale is to be estimated, which needs the clouds.
        ConfigError, CheckpointError, DependencyError: as `CorrespondenceRegistrar`.
    """
    if config is not None and config.scale != "fixed":
        raise ConfigError(
            f"scale: {config.scale} needs the clouds; correspondences alone give a rigid transform"
        )
    return CorrespondenceRegistrar(config)(correspondences, voxel_size=voxel_size)


def localised(rows: FloatArray) -> tuple[Correspondences, tuple[FloatArray, FloatArray]]:
    """Rows (N, 6), N >= 1, in local coordinates with the sensors believed, and the origin of each half."""
    origins = choose_origin(rows[:, :3]), choose_origin(rows[:, 3:])
    local = rows - np.concatenate(origins)
    return Correspondences(local, viewpoints=believed_viewpoints(local, origins)), origins


def between_clouds(
    correspondences: ArrayLike | Correspondences, clouds: tuple[PreparedCloud, PreparedCloud]
) -> Correspondences:
    """A user's rows (N, 6), file coordinates, in the clouds' local ones, with the normals of the nearest
    points. Raises InputError: no (N, 6) of finite numbers."""
    from scipy.spatial import cKDTree

    rows = check_rows(correspondences)
    local = rows - np.concatenate([cloud.origin for cloud in clouds])
    source, target = clouds
    nearest = [
        np.asarray(cKDTree(cloud.points).query(side)[1], dtype=np.int64)
        for cloud, side in zip(clouds, np.hsplit(local, 2), strict=True)
    ]
    return replace(Correspondences.between(source, target, *nearest), points=local)


def _transforms(hypotheses: list[Hypothesis]) -> FloatArray:
    return np.array([h.T_target_source for h in hypotheses])


def _verdict(hypothesis: Hypothesis) -> float:
    opinion = opinion_of(hypothesis)
    return -np.inf if opinion is None else opinion.verdict


def likeliest_rows(correspondences: Correspondences, limit: int, cell: float, seed: int) -> Correspondences:
    """At most ``limit`` correspondences in their order: mutual ones first, a seeded choice among equals, by cells.

    The same object where there are no more.
    """
    if len(correspondences) <= limit:
        return correspondences
    points, mutual = correspondences.points, correspondences.mutual
    return correspondences.take(drawn_rows(points, cell, limit, seed, first=mutual))


def check_rows(correspondences: ArrayLike | Correspondences) -> FloatArray:
    """(N, 6) finite float64. Raises InputError: something else."""
    if isinstance(correspondences, Correspondences):
        correspondences = correspondences.points
    try:
        rows = np.asarray(correspondences, dtype=np.float64)
    except (TypeError, ValueError):
        kind = type(correspondences).__name__
        raise InputError(f"correspondences must be numbers of shape (N, 6), found a {kind}") from None
    if rows.ndim != 2 or rows.shape[1] != 6:
        raise InputError(f"correspondences must have shape (N, 6), found {rows.shape}")
    bad = ~np.isfinite(rows).all(axis=1)
    if bad.any():
        raise InputError(
            f"{int(bad.sum())} of {counted(len(rows), 'correspondence')} hold NaN or infinities, first in row "
            f"{int(bad.argmax())}; leave them out"
        )
    return rows


def check_length(value: float, name: str) -> float:
    """A positive finite length. Raises InputError: something else."""
    try:
        length = float(value)
    except (TypeError, ValueError):
        raise InputError(f"{name} must be a positive length, found {value!r}") from None
    if not (np.isfinite(length) and length > 0):
        raise InputError(f"{name} must be a positive length, found {value}")
    return length
