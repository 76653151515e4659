"""From a decision in local frames to the result a user holds: file coordinates, counts and provenance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from geomoe3d.clouds.pair import Pair
from geomoe3d.config import RegistrationConfig, expert
from geomoe3d.decision.confidence import Judgement
from geomoe3d.decision.information import Information
from geomoe3d.decision.scale import Scale
from geomoe3d.geometry.se3 import inverse, motions_apart, residuals, shift_frames, transform_points
from geomoe3d.result import RegistrationResult, Status
from geomoe3d.scoring.network import opinion_of
from geomoe3d.scoring.surfaces import Evidence, evidence_of
from geomoe3d.types import (
    Accuracy,
    Alternative,
    CloudReport,
    Correspondences,
    FilterOutput,
    FloatArray,
    Hypothesis,
    PointCloud,
    PreparedCloud,
)

_DECIDING_LIBRARIES = ("numpy", "scipy", "open3d-cpu", "open3d", "small_gicp", "trimesh", "torch")


@dataclass(frozen=True)
class Repeat:
    """What two answers of one pair said, each by itself, and whether they agree; see `joined`."""

    first: float
    second: float
    agree: bool


@dataclass(frozen=True)
class Decision:
    """What was decided about a pair, in local frames.

    Attributes:
        answer: the best hypothesis, refined; None where there was none.
        alternative: the best clearly different one, or None.
        lead: score of the answer over that of the alternative, see `lead_over`.
        information, judgement: see their classes.
        margin: by how much the scorers of a second look prefer the answer, see `judge`; None: nobody was asked.
        repeat: what both answers said where the pair was registered on two grids.
        hypotheses: all that were considered, best first, before refinement.
        scale: how large the source is beside the target under the answer, where that was measured.
        accuracy: how closely the clouds lie on each other, where that was measured.
    """

    answer: Hypothesis | None
    alternative: Hypothesis | None
    lead: float
    information: Information
    judgement: Judgement
    hypotheses: tuple[Hypothesis, ...] = ()
    scale: Scale | None = None
    accuracy: Accuracy | None = None
    margin: float | None = None
    repeat: Repeat | None = None

    @classmethod
    def failed(cls, reason: str) -> Decision:
        """No hypothesis at all."""
        nothing = Information(np.full((6, 6), np.nan), np.full(3, np.nan), 0.0, 0)
        return cls(None, None, np.inf, nothing, Judgement("failed", (reason,), 0.0))

    @property
    def T_target_source(self) -> FloatArray:
        """(4, 4) of the answer, or NaN."""
        return np.full((4, 4), np.nan) if self.answer is None else self.answer.T_target_source

    @property
    def evidence(self) -> Evidence | None:
        """What the clouds say of the answer, or None."""
        return None if self.answer is None else evidence_of(self.answer)

    def transforms(self) -> list[Hypothesis]:
        """The answer and the alternative, as far as there are any, to be scored by others."""
        both = (h for h in (self.answer, self.alternative) if h is not None)
        return [h.anew() for h in both]

    def moved(self, parallel: Callable[[FloatArray], FloatArray]) -> Decision:
        """The same decision, answer and alternative made parallel; what was said of them stays."""
        answer, other = (
            None if h is None else replace(h, T_target_source=parallel(h.T_target_source))
            for h in (self.answer, self.alternative)
        )
        return replace(self, answer=answer, alternative=other)

    def with_note(self, note: str, *, first: bool = False) -> Decision:
        """The same decision with one more sentence among the reasons, at their end or before them."""
        reasons = self.judgement.reasons
        told = (note, *reasons) if first else (*reasons, note)
        return replace(self, judgement=replace(self.judgement, reasons=told))

    def with_scale(self, scale: Scale | None, names: tuple[str, str], *, exchanged: bool = False) -> Decision:
        """The same decision with the scale measured: never ok where it differs, and then that is said first.

        Of an answer that is hardly believed nothing is said: its surfaces are not those of one body.

        Args:
            scale: of the first cloud beside the second.
            names: of both clouds.
            exchanged: the user calls the second of them the source.
        """
        was = self.judgement
        if scale is None or not scale.differs or was.confidence < expert().causes.least_believed:
            return replace(self, scale=scale)
        said = scale.exchanged().sentence(*names[::-1]) if exchanged else scale.sentence(*names)
        return replace(self, scale=scale).doubted(said)

    def doubted(self, reason: str) -> Decision:
        """The same decision, never ok, for a reason that is said first and stands for a mere lack of confidence."""
        was = self.judgement
        others = (r for r in was.reasons if r != was.unspecific)
        status: Status = "low_confidence" if was.status == "ok" else was.status
        confidence = min(was.confidence, expert().causes.most_doubted)
        return replace(self, judgement=Judgement(status, (reason, *others), confidence))

    def residuals(self, matched: Correspondences) -> FloatArray:
        """|R p + t - q| of every correspondence (N,); infinite without a transform."""
        if self.answer is None:
            return np.full(len(matched), np.inf)
        return residuals(self.T_target_source, matched.source, matched.target)

    def agreement(self, matched: Correspondences, threshold: float) -> FilterOutput:
        """Weights of the correspondences by their residuals alone, 1/2 at the threshold; zero without a transform."""
        off = (self.residuals(matched) / threshold) ** 2
        return FilterOutput(1 / (1 + off), 1 - off)


def finished_result(
    pair: Pair, decision: Decision, config: RegistrationConfig, seconds: dict[str, float]
) -> RegistrationResult:
    """The result of a pair that went through the whole pipeline; see `RegistrationResult`."""
    source, target = pair.clouds
    matched, threshold = pair.matched, pair.inlier_threshold
    T = shift_frames(decision.T_target_source, source.origin, target.origin)
    return RegistrationResult(
        T_target_source=T,
        status=decision.judgement.status,
        reasons=decision.judgement.reasons,
        confidence=decision.judgement.confidence,
        overlap=decision.evidence.overlap if decision.evidence else 0.0,
        evidence=_evidence(decision, pair),
        num_correspondences=len(matched),
        num_inliers=int((decision.residuals(matched) < threshold).sum()),
        inlier_threshold=threshold,
        voxel_size=source.voxel_size,
        alternative=_alternative(decision, source, target),
        information_matrix=decision.information.matrix,
        information_center=decision.information.center + target.origin,
        source=_report(source),
        target=_report(target),
        seconds=seconds,
        seed=config.seed,
        versions=library_versions(),
        config=config.model_dump(mode="json"),
        accuracy=decision.accuracy,
    )


def failed_result(
    clouds: tuple[PointCloud, PointCloud], reason: str, config: RegistrationConfig, seconds: dict[str, float]
) -> RegistrationResult:
    """The result of a pair that was given up before preparation, with a NaN transform."""
    reports = [
        CloudReport(
            name=cloud.name,
            num_input=len(cloud) + cloud.num_non_finite,
            num_non_finite=cloud.num_non_finite,
            num_duplicates=0,
            num_isolated=0,
            num_points=0,
            origin=_triple(cloud.origin),
        )
        for cloud in clouds
    ]
    nan = float("nan")
    return RegistrationResult(
        T_target_source=np.full((4, 4), nan),
        status="failed",
        reasons=(reason,),
        confidence=0.0,
        overlap=0.0,
        evidence={},
        num_correspondences=0,
        num_inliers=0,
        inlier_threshold=nan,
        voxel_size=nan,
        alternative=None,
        information_matrix=np.full((6, 6), nan),
        information_center=np.full(3, nan),
        source=reports[0],
        target=reports[1],
        seconds=seconds,
        seed=config.seed,
        versions=library_versions(),
        config=config.model_dump(mode="json"),
    )


def library_versions() -> dict[str, str]:
    """Versions of geomoe3d and of the installed libraries that decide numbers."""
    return dict(_library_versions())


@lru_cache(maxsize=1)
def _library_versions() -> tuple[tuple[str, str], ...]:
    """Read once: asking the installation takes some 20 ms."""
    from geomoe3d import __version__

    versions = {"geomoe3d": __version__}
    for name in _DECIDING_LIBRARIES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return tuple(versions.items())


def _evidence(decision: Decision, pair: Pair) -> dict[str, float]:
    """Numbers of the answer by name; without a network there is no verdict."""
    evidence, opinion, scale = decision.evidence, opinion_of(decision.answer), decision.scale
    if evidence is None or decision.answer is None:
        return {}
    return {
        **asdict(evidence),
        "overlap_target": _overlap_target(decision.answer.T_target_source, pair),
        **({} if opinion is None else {"verdict": opinion.verdict}),
        "surface_score": evidence.surface_score,
        "score": decision.answer.score,
        **({} if decision.margin is None else {"margin": decision.margin}),
        **_repeat(decision.repeat),
        "observability": decision.information.observability,
        "looseness": decision.information.looseness,
        **({} if scale is None else {"scale_ratio": scale.ratio, "scale_sigma": scale.sigma}),
    }


def _repeat(repeat: Repeat | None) -> dict[str, float]:
    if repeat is None:
        return {}
    return {
        "confidence_first": repeat.first,
        "confidence_second": repeat.second,
        "answers_agree": float(repeat.agree),
    }


def _overlap_target(T_target_source: FloatArray, pair: Pair) -> float:
    """Share of the target's points with a source point within the threshold."""
    source, target = pair.clouds
    back = transform_points(inverse(T_target_source), target.points)
    distance, _ = source.tree.query(back, distance_upper_bound=pair.inlier_threshold)
    return float(np.isfinite(distance).mean())


def _alternative(decision: Decision, source: PreparedCloud, target: PreparedCloud) -> Alternative | None:
    if decision.alternative is None:
        return None
    T = decision.alternative.T_target_source
    shift, turn = motions_apart(decision.T_target_source, T, source.center)
    return Alternative(
        T_target_source=shift_frames(T, source.origin, target.origin),
        relative_score=1 / decision.lead if decision.lead > 0 else 1.0,
        rotation_difference_deg=turn,
        translation_difference=shift,
    )


def _report(cloud: PreparedCloud) -> CloudReport:
    return CloudReport(
        name=cloud.name,
        num_input=cloud.num_input,
        num_non_finite=cloud.num_non_finite,
        num_duplicates=cloud.num_duplicates,
        num_isolated=cloud.num_isolated,
        num_points=len(cloud),
        origin=_triple(cloud.origin),
    )


def _triple(values: FloatArray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
