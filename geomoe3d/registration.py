"""Two clouds in, one answer out: `register` and `Registrar`. What becomes of a pair stands in `geomoe3d.line`.

For correspondences without clouds there is `geomoe3d.correspondence_registration`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from copy import copy
from dataclasses import replace
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from geomoe3d.clouds.loading import load_both, without_missing
from geomoe3d.clouds.order import in_order
from geomoe3d.clouds.prepare import check_cloud
from geomoe3d.clouds.viewpoint import Sensors, with_sensors
from geomoe3d.clouds.voxel_size import scale_mismatch
from geomoe3d.config import RegistrationConfig, build_config, expert_in_force
from geomoe3d.correspondence_registration import CorrespondenceRegistrar, check_rows
from geomoe3d.decision.answer import failed_result
from geomoe3d.decision.causes import differing_units
from geomoe3d.decision.explanation import Explanation
from geomoe3d.decision.similarity import explain_similarity
from geomoe3d.errors import ConfigError, InputError
from geomoe3d.features.cache import FeatureCache
from geomoe3d.geometry.se3 import check_motion, inverse
from geomoe3d.line import Line
from geomoe3d.pipeline import Pipeline, resolved, with_weights
from geomoe3d.result import RegistrationResult
from geomoe3d.runtime.timing import Progress, StageClock
from geomoe3d.types import FloatArray


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
        sensors: Sensors = (None, None),
        progress: Progress | None = None,
    ) -> RegistrationResult:
        """The transform that maps source into target; see `geomoe3d.register`."""
        given: dict[str, Any] = {"initial": initial, "correspondences": correspondences, "sensors": sensors}
        return self.explain(source, target, **given, progress=progress).result

    @overload
    def register_many(
        self, pairs: Iterable[tuple[Any, Any]], *, on_error: Literal["raise"] = "raise"
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
        for number, pair in enumerate(pairs, start=1):
            try:
                source, target = () if isinstance(pair, (str, bytes)) else pair
            except (TypeError, ValueError):
                raise InputError(f"pair {number} must be (source, target), found {pair!r:.60}") from None
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

    @expert_in_force
    def explain(
        self,
        source: Any,
        target: Any,
        *,
        initial: ArrayLike | None = None,
        correspondences: ArrayLike | None = None,
        sensors: Sensors = (None, None),
        progress: Progress | None = None,
    ) -> Explanation:
        """`register` with what led to the answer.

        Arguments and errors are those of `geomoe3d.register`.
        """
        config, seed, clock = self.config, self.config.seed, StageClock(progress)
        if initial is not None:
            _check_guess_is_wanted(config)
        clock("load")
        loaded = with_sensors(load_both(source, target, seed), sensors, config.preparation.viewpoint)
        clouds = without_missing(loaded[0]), without_missing(loaded[1])
        for cloud in clouds:
            check_cloud(cloud)
        rows = None if correspondences is None else check_rows(correspondences)
        guess = None if initial is None else check_motion(initial)
        if config.scale == "estimate":
            quick, thorough = (self._rigid(second_look=look).explain for look in (False, True))
            found = explain_similarity(loaded, rows, config, quick, thorough, clock, progress)
            return found.remembering(source, target)
        asks_causes = self._names_units and bool(self.pipeline.scorers)
        again = self.register if asks_causes else None
        mismatch = scale_mismatch(*clouds)
        if mismatch is not None:
            units = None if again is None else differing_units(clouds, again, clock)
            failed = failed_result(clouds, units or mismatch, config, clock.stop())
            return Explanation(failed, *loaded).remembering(source, target)
        exchanged = not in_order(*clouds)
        if exchanged:
            clouds = clouds[1], clouds[0]
            guess = None if guess is None else inverse(guess)
            rows = None if rows is None else np.roll(rows, 3, axis=1)
        # Most doubtful pairs are of one unit; so the first look is all that another one gets.
        once = None if again is None else self._rigid(second_look=False).register
        line = Line(self.pipeline, config, clock, guess, rows, once, once=self._looks_once)
        found = line.explain((source, target), clouds, exchanged)
        found = found.exchanged() if exchanged else found
        return replace(found, source=loaded[0], target=loaded[1]).remembering(source, target)

    def _rigid(self, *, second_look: bool) -> Registrar:
        """This registrar for one scale: it asks about no units, and without ``second_look`` looks once."""
        rigid = copy(self)
        rigid.config = self.config.model_copy(update={"scale": "fixed"})
        rigid._names_units, rigid._looks_once = False, not second_look
        return rigid


def register(
    source: Any,
    target: Any,
    *,
    config: RegistrationConfig | None = None,
    initial: ArrayLike | None = None,
    correspondences: ArrayLike | None = None,
    sensors: Sensors = (None, None),
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
        sensors: of source and target each (3,) where the sensor stood, in the file's coordinates; ``"none"`` where no
            one sensor saw the cloud; None leaves it to the evidence.
        progress: called with the name of each stage as it begins.
        overrides: top-level configuration keys such as ``voxel_size=0.05`` or ``seed=1``.

    Where one cloud is much larger than the other it is taken for a map, in which the smaller one is sought; see
    `geomoe3d.Map`, which keeps the map for further scans.

    Returns:
        The answer with status, confidence and reasons; look at ``result.ok`` before using the transform.

    Raises:
        InputError: a cloud that cannot be read or has too few usable points, a guess that is no rigid
            transform, correspondences that are no (N, 6) finite numbers, a sensor that is no place, or the place of
            one sensor where that of the other is not known.
        ConfigError: an unknown or invalid override, a guess where nothing scores or the scale is estimated, or a sensor
            where ``preparation.viewpoint`` is not auto.
    """
    if overrides:
        tree = (config or RegistrationConfig()).model_dump()
        config = build_config(RegistrationConfig, {**tree, **overrides}, "register(...)")
    given: dict[str, Any] = {"initial": initial, "correspondences": correspondences, "sensors": sensors}
    return Registrar(config).register(source, target, **given, progress=progress)


def _check_guess_is_wanted(config: RegistrationConfig) -> None:
    if config.scale == "estimate":
        raise ConfigError(
            "--initial (a first guess) and --estimate-scale (scale: estimate) do not go together: a guess is rigid and "
            "says nothing of the scale. Leave --initial out, or bring both clouds to one unit and leave "
            "--estimate-scale out"
        )
    if not config.scoring.scorers:
        raise ConfigError(
            "--initial (a first guess) is weighed against what is found by scorers, but scoring.scorers is empty; "
            "leave --initial out, or name a scorer (--scorer surfaces)"
        )
