"""Bare correspondences in, a motion out: filter and estimator without clouds to verify anything on.

Place: beside `registration`, for whoever has features and matches of their own. The stages weigh and solve
are the same; what follows them there, verification and with it the confidence, needs the clouds.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from geomoe3d.clouds.recentre import choose_origin
from geomoe3d.clouds.viewpoint import believed_viewpoints
from geomoe3d.config import RegistrationConfig
from geomoe3d.errors import InputError
from geomoe3d.estimators.base import Estimator, make_estimator
from geomoe3d.estimators.proposals import solve
from geomoe3d.filters.base import Filter, make_filter, resolved
from geomoe3d.geometry.se3 import residuals, shift_frames
from geomoe3d.runtime.timing import StageClock
from geomoe3d.types import BoolArray, Correspondences, FilterOutput, FloatArray


@dataclass(frozen=True)
class CorrespondenceResult:
    """The motion that correspondences speak for. Whether it is right, only the clouds can say.

    Attributes:
        T_target_source: (4, 4), p_target = R p_source + t, in the coordinates given; NaN where nothing was
            found, never the identity as a stand-in.
        inliers: (N,) True where |R p + t - q| is below ``inlier_threshold``.
        inlier_threshold: in the unit given.
        weighed: what the filter said of the correspondences.
        others: further motions (4, 4) that were considered, best first.
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
        """Whether there is a motion at all."""
        return bool(np.isfinite(self.T_target_source).all())

    @property
    def weights(self) -> FloatArray:
        """(N,) in [0, 1] the filter's weights."""
        return self.weighed.weights

    @property
    def num_inliers(self) -> int:
        """How many correspondences agree with the motion."""
        return int(self.inliers.sum())


class CorrespondenceSolver:
    """The filter and the estimator of a configuration; keep it to load weights only once.

    Args:
        config: complete configuration; None takes the defaults.

    Raises:
        ConfigError: an unknown filter or estimator.
        CheckpointError: trained weights are missing, broken or do not fit.
        DependencyError: a library that the filter needs is not installed.
    """

    def __init__(self, config: RegistrationConfig | None = None) -> None:
        self.config = resolved(config)
        chosen = self.config.filter
        self.filter: Filter = make_filter(chosen.name, chosen.weights, self.config.estimator)
        self._estimator: Estimator = make_estimator(self.config.estimator)

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
        rows = check_rows(correspondences)
        voxel_size = check_length(voxel_size, "voxel_size")
        threshold = self.config.estimator.inlier_threshold * voxel_size
        if inlier_threshold is not None:
            threshold = check_length(inlier_threshold, "inlier_threshold")
        seed = self.config.seed if seed is None else seed
        nothing = np.full((4, 4), np.nan), np.zeros(len(rows), dtype=np.bool_), threshold
        if len(rows) < 3:
            return CorrespondenceResult(*nothing, FilterOutput(np.zeros(len(rows))))
        clock = StageClock()
        clock("weigh")
        matched, origins = localised(rows)
        weighed = self.filter(matched, voxel_size=voxel_size, seed=seed)
        clock("solve")
        estimator = self.config.estimator
        found = solve(self._estimator, matched, weighed, estimator, inlier_threshold=threshold, seed=seed)
        seconds = clock.stop()
        if not found:
            return CorrespondenceResult(*nothing, weighed, seconds=seconds)
        inliers = residuals(found[0].T_target_source, matched.source, matched.target) < threshold
        motions = [shift_frames(hypothesis.T_target_source, *origins) for hypothesis in found]
        return CorrespondenceResult(motions[0], inliers, threshold, weighed, tuple(motions[1:]), seconds)


def register_correspondences(
    correspondences: ArrayLike | Correspondences,
    *,
    voxel_size: float,
    config: RegistrationConfig | None = None,
) -> CorrespondenceResult:
    """The rigid motion p_target = R p_source + t that anybody's correspondences speak for.

    For features and matches of your own; with the clouds at hand, `geomoe3d.register` is right more often and
    says how sure it is. Many outliers are expected. A sensor is believed to have stood at zero where that can
    be, see `geomoe3d.clouds.viewpoint`.

    Args:
        correspondences: (N, 6) rows [source xyz, target xyz] in one unit of length, in any frames.
        voxel_size: the scale of the points' noise, same unit: the grid they came from. Correspondences that
            miss by more than two of it count as outliers (``estimator.inlier_threshold``).
        config: complete configuration; None takes the defaults.

    Returns:
        The motion, which correspondences agree with it, and their weights. Look at ``found`` first.

    Raises:
        InputError: no (N, 6) of finite numbers, or a voxel size that is not a positive length.
        ConfigError, CheckpointError, DependencyError: as `CorrespondenceSolver`.
    """
    return CorrespondenceSolver(config)(correspondences, voxel_size=voxel_size)


def localised(rows: FloatArray) -> tuple[Correspondences, tuple[FloatArray, FloatArray]]:
    """Rows (N, 6), N >= 1, in local coordinates with the sensors believed, and the origin of each half."""
    origins = choose_origin(rows[:, :3]), choose_origin(rows[:, 3:])
    local = rows - np.concatenate(origins)
    return Correspondences(local, viewpoints=believed_viewpoints(local, origins)), origins


def check_rows(correspondences: ArrayLike | Correspondences) -> FloatArray:
    """(N, 6) finite float64.

    Raises:
        InputError: something else.
    """
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
            f"{int(bad.sum())} of {len(rows)} correspondences hold NaN or infinities, first in row "
            f"{int(bad.argmax())}; leave them out"
        )
    return rows


def check_length(value: float, name: str) -> float:
    """A positive finite length.

    Raises:
        InputError: something else.
    """
    try:
        length = float(value)
    except (TypeError, ValueError):
        raise InputError(f"{name} must be a positive length, found {value!r}") from None
    if not (np.isfinite(length) and length > 0):
        raise InputError(f"{name} must be a positive length, found {value}")
    return length
