"""From findings in local frames to the result a user holds: file coordinates, counts and provenance."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from geomoe3d.config import RegistrationConfig
from geomoe3d.decision.confidence import Information, Judgement
from geomoe3d.filters.base import FilterOutput
from geomoe3d.geometry.se3 import motions_apart, residuals, shift_frames
from geomoe3d.result import Alternative, CloudReport, RegistrationResult
from geomoe3d.scoring.surfaces import Evidence
from geomoe3d.types import Correspondences, FloatArray, Hypothesis, PointCloud, PreparedCloud

_DECIDING_LIBRARIES = ("numpy", "scipy", "open3d-cpu", "open3d", "small_gicp", "trimesh", "torch")


@dataclass(frozen=True)
class Findings:
    """What solving, verifying, refining and judging found, in local frames.

    Attributes:
        T_target_source: (4, 4) the answer, or NaN where there was no hypothesis.
        alternative: the best clearly different motion, or None.
        lead: score of the answer over that of the alternative, see `judge.lead_over`.
        evidence, information, judgement: see their classes; evidence None where there was no hypothesis.
        weighed: what a network said of the correspondences under the answer, or None without one.
    """

    T_target_source: FloatArray
    alternative: Hypothesis | None
    lead: float
    evidence: Evidence | None
    information: Information
    judgement: Judgement
    weighed: FilterOutput | None = None

    @classmethod
    def nothing(cls, reason: str) -> Findings:
        """No hypothesis at all."""
        nothing = Information(np.full((6, 6), np.nan), np.full(3, np.nan), 0.0, 0)
        return cls(np.full((4, 4), np.nan), None, np.inf, None, nothing, Judgement("failed", (reason,), 0.0))

    def motions(self) -> list[Hypothesis]:
        """The answer and the alternative, as far as there are any."""
        answer = [] if self.evidence is None else [Hypothesis(self.T_target_source, 0.0, 0)]
        return answer if self.alternative is None else [*answer, replace(self.alternative, verdict=None)]

    def with_note(self, note: str) -> Findings:
        """The same findings with one more sentence among the reasons."""
        return replace(self, judgement=replace(self.judgement, reasons=(*self.judgement.reasons, note)))

    def residuals(self, matched: Correspondences) -> FloatArray:
        """|R p + t - q| of every correspondence (N,); infinite without a transform."""
        if self.evidence is None:
            return np.full(len(matched), np.inf)
        return residuals(self.T_target_source, matched.source, matched.target)


def finished_result(
    prepared: tuple[PreparedCloud, PreparedCloud],
    matched: Correspondences,
    findings: Findings,
    config: RegistrationConfig,
    threshold: float,
    seconds: dict[str, float],
) -> RegistrationResult:
    """The result of a pair that went through the whole pipeline; see `RegistrationResult`."""
    source, target = prepared
    T = shift_frames(findings.T_target_source, source.origin, target.origin)
    return RegistrationResult(
        T_target_source=T,
        status=findings.judgement.status,
        reasons=findings.judgement.reasons,
        confidence=findings.judgement.confidence,
        overlap=findings.evidence.overlap if findings.evidence else 0.0,
        evidence=_evidence(findings.evidence, findings.information) if findings.evidence else {},
        num_correspondences=len(matched),
        num_inliers=int((findings.residuals(matched) < threshold).sum()),
        inlier_threshold=threshold,
        voxel_size=source.voxel_size,
        alternative=_alternative(findings, source, target),
        information_matrix=findings.information.matrix,
        information_center=findings.information.center + target.origin,
        source=_report(source),
        target=_report(target),
        seconds=seconds,
        seed=config.seed,
        versions=library_versions(),
        config=config.model_dump(mode="json"),
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


def _evidence(evidence: Evidence, information: Information) -> dict[str, float]:
    """Their numbers by name; without a network there is no verdict."""
    values = {name: value for name, value in asdict(evidence).items() if value is not None}
    return {
        **values,
        "surface_score": evidence.surface_score,
        "score": evidence.score,
        "observability": information.observability,
        "looseness": information.looseness,
    }


def _alternative(findings: Findings, source: PreparedCloud, target: PreparedCloud) -> Alternative | None:
    if findings.alternative is None:
        return None
    T = findings.alternative.T_target_source
    shift, turn = motions_apart(findings.T_target_source, T, source.points.mean(0))
    return Alternative(
        T_target_source=shift_frames(T, source.origin, target.origin),
        relative_score=1 / findings.lead if findings.lead > 0 else 1.0,
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
