"""The parts that a configuration names, made once, and the steps from clouds to hypotheses that they take."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import replace
from functools import reduce
from typing import Any, Literal

import numpy as np

from geomoe3d.clouds.pair import Pair
from geomoe3d.clouds.prepare import prepare
from geomoe3d.config import (
    DescriptorConfig,
    PartConfig,
    PreparationConfig,
    RegistrationConfig,
    ScoringConfig,
    expert,
)
from geomoe3d.errors import ConfigError, EmptyCloudError
from geomoe3d.estimators.base import Estimator, estimator
from geomoe3d.estimators.proposals import propose
from geomoe3d.features.base import Descriptor, descriptor, with_features, with_normals_flipped
from geomoe3d.features.cache import FeatureCache, feature_identity
from geomoe3d.filters.base import OutlierFilter, outlier_filter
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.matching.base import Matcher, matcher
from geomoe3d.networks.weight_files import DEFAULT_WEIGHTS, judges_transforms, packaged_names
from geomoe3d.parts import Part, Registry
from geomoe3d.refinement.base import Refiner, refiner
from geomoe3d.runtime.sources import library_versions, source_closure, source_hash
from geomoe3d.runtime.threads import each
from geomoe3d.runtime.timing import StageClock
from geomoe3d.scoring.base import Scorer, make_scorers, scorer
from geomoe3d.types import Correspondences, FilterOutput, FloatArray, Hypothesis, PointCloud, PreparedCloud

_LINE = ("geomoe3d.registration", "geomoe3d.line", "geomoe3d.correspondence_registration")


REGISTRIES: dict[str, Registry[Any]] = {
    "descriptor": descriptor,
    "matcher": matcher,
    "filter": outlier_filter,
    "estimator": estimator,
    "scorer": scorer,
    "refiner": refiner,
}
"""The parts of every kind, by the kind's name."""

Clouds = tuple[PreparedCloud, PreparedCloud]
Places = tuple[FloatArray, FloatArray] | None
Sides = Literal["sensor", "flipped", "centroid"]
"""Where normals point: to the sensor, known or guessed; the same with the source's turned over; to the centroid."""


class Pipeline:
    """One part of every kind, and the steps that lead from clouds to hypotheses.

    Args:
        config: complete and resolved.
        cache: keeps features of clouds that are in many pairs; answers are the same without it.

    Attributes:
        descriptor, matcher, estimator, refiner: see their kinds.
        second_descriptor: what describes the clouds of a doubtful answer once more, or None.
        filter: outlier rejection, or None without any.
        scorers: by name, in the order in which they are asked.
        second_scorers: those that are asked about refined hypotheses of clouds that were described again.

    Raises:
        ConfigError: an unknown part, or settings that it does not take.
        CheckpointError: trained weights are missing, broken or do not fit.
        DependencyError: a library that a part needs is not installed.
    """

    def __init__(self, config: RegistrationConfig, cache: FeatureCache | None = None) -> None:
        self.config, self._cache = config, cache
        self.descriptor: Descriptor = descriptor.make(config.descriptor)
        self.second_descriptor = _second_descriptor(config)
        self.matcher: Matcher = matcher.make(config.matching)
        _check_weights_are_wanted(config)
        made = outlier_filter.make(config.filter)  # also none, which takes no options
        self.filter: OutlierFilter | None = None if config.filter.name == "none" else made
        self.estimator: Estimator = estimator.make(config.estimator)
        self.scorers: dict[str, Scorer] = make_scorers(config.scoring)
        self.second_scorers = _second_scorers(config, self.second_descriptor)
        self.refiner: Refiner = refiner.make(config.refinement)

    def prepare(
        self,
        cloud: PointCloud,
        voxel_size: float,
        viewpoint: FloatArray | None,
        clock: StageClock,
        sides: Sides = "sensor",
    ) -> PreparedCloud:
        """One cloud on the grid, with normals and features, or as the cache holds it."""
        config, viewpoint = self._preparation(viewpoint, sides)
        seed, describe = self.config.seed, self.descriptor

        def make() -> PreparedCloud:
            clock("preprocess")
            made = prepare(cloud, voxel_size, config, viewpoint=viewpoint, seed=seed)
            clock("features")
            return with_features(made, describe)

        if self._cache is None:
            return make()
        return self._cache.fetch(cloud, feature_identity(voxel_size, viewpoint, config, describe, seed), make)

    def _preparation(
        self, viewpoint: FloatArray | None, sides: Sides
    ) -> tuple[PreparationConfig, FloatArray | None]:
        """Settings, and the place of the sensor, with which normals point to the sides that are wanted."""
        config = self.config.preparation
        return (
            (config.model_copy(update={"viewpoint": "centroid"}), None)
            if sides == "centroid"
            else (config, viewpoint)
        )

    def prepare_both(
        self,
        clouds: tuple[PointCloud, PointCloud],
        voxel_size: float,
        views: tuple[FloatArray | None, FloatArray | None],
        clock: StageClock,
        sides: Sides = "sensor",
    ) -> Clouds:
        """`prepare` for source and target, side by side where nothing is cached."""
        both = list(zip(clouds, views, strict=True))
        if self._cache is not None:
            first, second = (self.prepare(cloud, voxel_size, view, clock, sides) for cloud, view in both)
            return first, second

        def on_grid(one: tuple[PointCloud, FloatArray | None]) -> PreparedCloud:
            config, viewpoint = self._preparation(one[1], sides)
            return prepare(one[0], voxel_size, config, viewpoint=viewpoint, seed=self.config.seed)

        clock("preprocess")
        made = each(on_grid, both)
        clock("features")
        first, second = (with_features(cloud, self.descriptor) for cloud in made)
        return first, second

    def on_another_grid(self) -> Pipeline:
        """The same parts, on a shifted grid and with other draws."""
        step, config, other = expert().repeat, self.config, copy(self)
        shift = (config.preparation.grid_shift + step.shift) % 1
        preparation = config.preparation.model_copy(update={"grid_shift": shift})
        other.config = config.model_copy(
            update={"preparation": preparation, "seed": config.seed + step.seed_step}
        )
        return other

    def match(
        self, clouds: Clouds, places: Places, clock: StageClock, limit: int | None = None, draw: int = 0
    ) -> Pair:
        """Putative correspondences; at most ``limit``, None takes what the configuration says.

        ``draw``: which of several independent ones.
        """
        clock("match")
        needs = frozenset() if self.filter is None else self.filter.needs
        matched = self.matcher(
            *clouds,
            limit=limit or self.config.matching.max_correspondences,
            seed=self.config.seed + draw,
            with_ratio="ratio" in needs,
        )
        return self.pair(clouds, matched, places)

    def pair(self, clouds: Clouds, matched: Correspondences, places: Places) -> Pair:
        """Both clouds and what is matched between them, with the threshold of this grid."""
        voxel_size = clouds[0].voxel_size
        threshold = self.config.estimator.inlier_threshold * voxel_size
        return Pair(replace(matched, viewpoints=places), voxel_size, threshold, self.config.seed, *clouds)

    def weigh(self, pair: Pair) -> FilterOutput:
        """What the outlier filter says of the correspondences; all ones without one."""
        if self.filter is None:
            return FilterOutput(np.ones(len(pair.matched)))
        return self.filter(pair.matched, voxel_size=pair.voxel_size, seed=pair.seed)

    def propose(self, pair: Pair, clock: StageClock) -> tuple[FilterOutput, list[Hypothesis]]:
        """What the outlier filter, if there is one, says of the correspondences, and the hypotheses."""
        if self.filter is not None:
            clock("filter")
        weighed = self.weigh(pair)
        clock("propose")
        return weighed, propose(self.estimator, pair, weighed.weights, self.config.estimator)

    def agreeing(self, clouds: Clouds, places: Places, clock: StageClock) -> float:
        """Which share of some hundred matches the best of a few motions brings together; a look with least effort."""
        pair = self.match(clouds, places, clock, expert().causes.mirrored_matches)
        quick = self.estimator.with_least_effort()
        found = propose(quick, pair, np.ones(len(pair.matched)), self.config.estimator)
        return max((h.proposal_score for h in found), default=0.0) / max(len(pair.matched), 1)

    def flipped(self, clouds: Clouds, clock: StageClock) -> Clouds:
        """Both clouds with the normals of the first turned over, and without sensors."""
        clock("features")
        source = with_normals_flipped(clouds[0], self.descriptor)
        return source, replace(clouds[1], viewpoint=None)

    def described_again(self, clouds: Clouds, clock: StageClock) -> Clouds:
        """Both clouds with what the second descriptor says of them. Raises ValueError: there is no second
        descriptor."""
        if self.second_descriptor is None:
            raise ValueError("there is no second descriptor")
        clock("features")
        second, first = self.second_descriptor, self.descriptor
        source, target = each(lambda cloud: with_features(cloud, second, first), clouds)
        return source, target

    def matched_again(
        self, pair: Pair, described: Clouds, places: Places, clock: StageClock
    ) -> tuple[Pair, Pair]:
        """The pair with ``described`` clouds, with their matches alone, and with those of both."""
        own = self.match(described, places, clock, draw=1)  # other points than the first one's
        return own, self.together((pair, own), places)

    def more_matches(self, looks: Sequence[Pair], places: Places, clock: StageClock) -> list[Pair]:
        """All matches of the grid, by each descriptor that was asked and had more than it gave."""
        usual, most = self.config.matching.max_correspondences, self.config.second_look.max_correspondences
        asked = [look for look in looks if len(look.matched) >= usual and most > usual]
        return [self.match(look.clouds, places, clock, most) for look in asked]

    def together(self, looks: Sequence[Pair], places: Places) -> Pair:
        """The last look with the matches of all, mutual ones first, no more than two descriptors give at first."""
        found = reduce(Correspondences.with_others, (look.matched for look in looks))
        limit = 2 * self.config.matching.max_correspondences
        drawn = drawn_rows(found.source, looks[0].voxel_size, limit, self.config.seed, first=found.mutual)
        return self.pair(looks[-1].clouds, found.take(drawn), places)

    def coarser_pairs(
        self, prepared: Clouds, places: Places, clock: StageClock, sides: Sides, again: bool
    ) -> Iterator[Pair]:
        """The same scans on coarser grids; ``again``: described by the second descriptor."""
        for factor in self.config.second_look.grids:
            size = factor * prepared[0].voxel_size
            bare = tuple(PointCloud(cloud.points, cloud.origin, name=cloud.name) for cloud in prepared)
            views = prepared[0].viewpoint, prepared[1].viewpoint
            try:
                coarse = self.prepare_both((bare[0], bare[1]), size, views, clock, sides)
            except EmptyCloudError:  # a cloud is too small for this grid
                continue
            coarse = self.flipped(coarse, clock) if sides == "flipped" else coarse
            if again and self.second_descriptor is not None:
                coarse = self.described_again(coarse, clock)
            yield self.match(coarse, places, clock)

    def warm_up(self) -> None:
        """Load weights now, and say now what is wrong with them."""
        for part in self._parts().values():
            part.warm_up()

    def identity(self) -> dict[str, Any]:
        """What decides an answer beside the configuration: code of the line, every part's own identity, and
        versions of the libraries that they use. Nothing heavy is loaded for it."""
        parts = self._parts()
        modules = {*_LINE, *(type(part).__module__ for part in parts.values())}
        return {
            "code": {module: source_hash(module) for module in _LINE},
            "parts": {kind: part.identity() for kind, part in parts.items()},
            "versions": dict(library_versions(frozenset().union(*map(source_closure, modules)))),
        }

    def _parts(self) -> dict[str, Part]:
        one = {"descriptor": self.descriptor, "matcher": self.matcher, "filter": self.filter}
        one["second descriptor"] = self.second_descriptor
        rest = {"estimator": self.estimator, **self.scorers, **self.second_scorers, "refiner": self.refiner}
        return {kind: part for kind, part in {**one, **rest}.items() if part is not None}


def resolved(config: RegistrationConfig | None) -> RegistrationConfig:
    """The configuration, None for the defaults, with ``auto`` replaced by what it means on this machine.
    Raises ConfigError: something else than a configuration."""
    config = RegistrationConfig() if config is None else config
    if not isinstance(config, RegistrationConfig):
        raise ConfigError(
            f"config is a {type(config).__name__}, expected a RegistrationConfig; load_config(path, "
            f"['key=value', ...]) makes one"
        )
    return config.model_copy(update={"scoring": _resolved_scoring(config.scoring)})


def with_weights(config: RegistrationConfig, name_or_path: str) -> RegistrationConfig:
    """The configuration with trained weights in the place where they belong, as their card says.

    A network that scores transforms becomes the scorer, one that weighs correspondences the outlier filter.

    Raises:
        CheckpointError: no such weights.
        ConfigError: a filter is named that takes none.
    """
    named = config.filter.model_copy(update={"weights": str(name_or_path)})
    if named.name != "none":
        _check_weights_are_wanted(config.model_copy(update={"filter": named}))
    if judges_transforms(name_or_path):
        scoring = config.scoring.model_copy(
            update={"scorers": ("surfaces", "network"), "weights": str(name_or_path)}
        )
        return config.model_copy(update={"scoring": scoring})
    if named.name == "none":
        named = named.model_copy(update={"name": "geomoe"})
    scoring = config.scoring
    if scoring.scorers == "auto":
        scoring = scoring.model_copy(update={"scorers": ("surfaces",)})
    return config.model_copy(update={"filter": named, "scoring": scoring})


def _second_descriptor(config: RegistrationConfig) -> Descriptor | None:
    first, name = config.descriptor, config.second_look.descriptor
    return None if name in ("none", first.name) else descriptor.make(DescriptorConfig(name=name))


def _second_scorers(config: RegistrationConfig, descriptor: Descriptor | None) -> dict[str, Scorer]:
    if "network" not in config.scoring.scorers or descriptor is None:
        return {}  # who leaves one network out wants no other
    options = config.scoring.options
    names = config.second_look.scorers
    return {name: scorer.make(PartConfig(name=name, options=options.get(name, {}))) for name in names}


def _check_weights_are_wanted(config: RegistrationConfig) -> None:
    name, weights = config.filter.name, config.filter.weights
    if weights is not None and not outlier_filter.find(name).takes_weights:
        raise ConfigError(f"weights '{weights}' are given, but the filter '{name}' takes none")


def _resolved_scoring(config: ScoringConfig) -> ScoringConfig:
    """The network is taken where weights are given or ship with the package."""
    if config.scorers != "auto":
        return config
    usable = config.weights is not None or DEFAULT_WEIGHTS in packaged_names()
    return config.model_copy(update={"scorers": ("surfaces", "network") if usable else ("surfaces",)})
