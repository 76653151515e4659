"""Every number that decides an answer and is nobody's setting: one section for each part, with unit, source and range.

`geomoe3d config --all` prints them, ``--set expert.scale.tolerated=0.02`` changes one, and each result holds those
that it was made with. Code that needs one asks `expert()`, which is the section of the configuration at work in this
thread: the doors into the package (`Registrar`, `CorrespondenceRegistrar`, `Map`, ...) put theirs in force, and
outside of these the defaults hold. So a fit of three lines need not be handed a configuration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar, cast

from geomoe3d.config.expert_clouds import LoadingExpert, PreparationExpert, ScatterExpert, ViewpointExpert
from geomoe3d.config.expert_confidence import ConfidenceExpert, RepeatExpert
from geomoe3d.config.expert_decision import (
    AccuracyExpert,
    CausesExpert,
    ParallelExpert,
    RemarksExpert,
    ScaleExpert,
    SelectionExpert,
    SharedSurfaceExpert,
    SimilarityExpert,
    TwinsExpert,
)
from geomoe3d.config.expert_maps import DetailExpert, LocatingExpert, MapsExpert, PlacesExpert
from geomoe3d.config.expert_multiway import ManyGroupsExpert, ManyPairsExpert, ManyPosesExpert
from geomoe3d.config.expert_proposing import (
    ConsensusExpert,
    CorrespondencesExpert,
    FeaturesExpert,
    KeypointAlignmentExpert,
    KeypointsExpert,
    RansacExpert,
    SurroundingsExpert,
)
from geomoe3d.config.expert_scoring import (
    AlignmentExpert,
    NetworkExpert,
    SurfaceNetworkExpert,
    SurfacesExpert,
)
from geomoe3d.config.section import Section

P = ParamSpec("P")
R = TypeVar("R")


class ExpertConfig(Section):
    """Constants of the method. The confidence was fitted with these values: change them to study the method."""

    correspondences: CorrespondencesExpert = CorrespondencesExpert()
    selection: SelectionExpert = SelectionExpert()
    twins: TwinsExpert = TwinsExpert()
    confidence: ConfidenceExpert = ConfidenceExpert()
    repeat: RepeatExpert = RepeatExpert()
    shared_surface: SharedSurfaceExpert = SharedSurfaceExpert()
    accuracy: AccuracyExpert = AccuracyExpert()
    parallel: ParallelExpert = ParallelExpert()
    scale: ScaleExpert = ScaleExpert()
    similarity: SimilarityExpert = SimilarityExpert()
    causes: CausesExpert = CausesExpert()
    remarks: RemarksExpert = RemarksExpert()
    features: FeaturesExpert = FeaturesExpert()
    keypoints: KeypointsExpert = KeypointsExpert()
    consensus: ConsensusExpert = ConsensusExpert()
    surroundings: SurroundingsExpert = SurroundingsExpert()
    keypoint_alignment: KeypointAlignmentExpert = KeypointAlignmentExpert()
    ransac: RansacExpert = RansacExpert()
    surfaces: SurfacesExpert = SurfacesExpert()
    network: NetworkExpert = NetworkExpert()
    surface_network: SurfaceNetworkExpert = SurfaceNetworkExpert()
    alignment: AlignmentExpert = AlignmentExpert()
    maps: MapsExpert = MapsExpert()
    places: PlacesExpert = PlacesExpert()
    locating: LocatingExpert = LocatingExpert()
    detail: DetailExpert = DetailExpert()
    loading: LoadingExpert = LoadingExpert()
    preparation: PreparationExpert = PreparationExpert()
    viewpoint: ViewpointExpert = ViewpointExpert()
    scatter: ScatterExpert = ScatterExpert()
    many_pairs: ManyPairsExpert = ManyPairsExpert()
    many_groups: ManyGroupsExpert = ManyGroupsExpert()
    many_poses: ManyPosesExpert = ManyPosesExpert()


_IN_FORCE: ContextVar[ExpertConfig] = ContextVar("expert constants in force")
_DEFAULTS = ExpertConfig()


def expert() -> ExpertConfig:
    """The constants in force in this thread."""
    return _IN_FORCE.get(_DEFAULTS)


@contextmanager
def in_force(constants: ExpertConfig) -> Iterator[None]:
    """Inside, `expert` gives these."""
    token = _IN_FORCE.set(constants)
    try:
        yield
    finally:
        _IN_FORCE.reset(token)


def expert_of_argument(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator of a function with a keyword ``config``, a `RegistrationConfig` or None: inside, its constants are in
    force."""

    @wraps(function)
    def inside(*args: P.args, **kwargs: P.kwargs) -> R:
        config: Any = kwargs.get("config")
        with in_force(_DEFAULTS if config is None else config.expert):
            return function(*args, **kwargs)

    return inside


class _Configured(Protocol):
    @property
    def config(self) -> Any:
        """A `RegistrationConfig`."""


Owner = TypeVar("Owner", bound=_Configured)


def expert_in_force(method: Callable[Concatenate[Owner, P], R]) -> Callable[Concatenate[Owner, P], R]:
    """Decorator of a method: inside, the constants of its object's ``config`` are in force."""

    @wraps(method)
    def inside(self: Owner, *args: P.args, **kwargs: P.kwargs) -> R:
        with in_force(self.config.expert):
            return method(self, *args, **kwargs)

    return cast(Callable[Concatenate[Owner, P], R], inside)
