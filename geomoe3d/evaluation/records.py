"""The nouns of evaluation: a pair with its truth, what a method sees of it, its answer, and the scores.

Everything here is plain data. Place: at the bottom of the package; benchmarks make pairs, methods turn
inputs into answers, predict stores answers, measures turn stored answers into scores, reports show them.
Lengths are metres, angles degrees, times seconds, frames as in `geomoe3d.types`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from geomoe3d.types import BoolArray, FloatArray

INLIER_THRESHOLD = 0.10
"""Metres; a correspondence with a smaller residual under the true transform is an inlier (benchmark rule)."""
VOXEL_SIZE = 0.05
"""Metres; the grid of the benchmark's protocol."""


@dataclass(frozen=True)
class EvaluationPair:
    """Two scans of which the true relation is known.

    Attributes:
        id: unique inside its benchmark, e.g. ``redkitchen/4-0``.
        benchmark: 3DMatch, 3DLoMatch, unrelated, or a folder's name.
        scene: scene of the source.
        source: file of the source fragment.
        target: file of the target fragment.
        T_target_source: (4, 4) true transform; None for unrelated scans, which have none.
        raw_T_target_source: (4, 4) the same as the published file has it, its rotation not projected onto
            SO(3); None where it does not differ.
        overlap: share of the source seen in the target, or None where not listed.
        information: (6, 6) matrix of gt.info in the published direction (target into source), or None.
        consecutive: True for fragments recorded one after the other, which the RMSE recall leaves out.
    """

    id: str
    benchmark: str
    scene: str
    source: Path
    target: Path
    T_target_source: FloatArray | None
    raw_T_target_source: FloatArray | None = None  # noqa: N815
    overlap: float | None = None
    information: FloatArray | None = None
    consecutive: bool = False


@dataclass(frozen=True)
class MethodInput:
    """What a method is given: correspondences or clouds, never the truth.

    Attributes:
        pair: id of the pair, for messages.
        correspondences: (N, 6) rows [source xyz, target xyz], metres; None on the track ``clouds``.
        source: (n, 3) points of the source; None on the correspondence tracks.
        target: (m, 3) points of the target; None on the correspondence tracks.
        voxel_size: grid of the protocol, metres.
        inlier_threshold: residual limit of an inlier, metres.
        seed: decides every random choice.
    """

    pair: str
    correspondences: FloatArray | None = None
    source: FloatArray | None = None
    target: FloatArray | None = None
    voxel_size: float = VOXEL_SIZE
    inlier_threshold: float = INLIER_THRESHOLD
    seed: int = 0


@dataclass(frozen=True)
class Answer:
    """What a method says of one pair.

    Attributes:
        T_target_source: (4, 4) p_target = R p_source + t, or None where the method gives no transform.
        confidence: in [0, 1], or None for methods that do not say.
        status: ok, low_confidence, ambiguous, failed; None for methods that do not say.
        hypotheses: further transforms (4, 4) that the method considered, best first.
        correspondences: (N, 6) what the method weighed; None means those that it was given.
        weights: (N,) in [0, 1], or None.
        inliers: (N,) the method's own classification, or None where it makes none.
        stages: seconds per stage where the method knows them.
    """

    T_target_source: FloatArray | None
    confidence: float | None = None
    status: str | None = None
    hypotheses: tuple[FloatArray, ...] = ()
    correspondences: FloatArray | None = None
    weights: FloatArray | None = None
    inliers: BoolArray | None = None
    stages: dict[str, float] = field(default_factory=dict)


class Method(Protocol):
    """Anything that registers pairs: ours, a peer, a user's function."""

    name: str
    """As given on the command line."""
    inputs: frozenset[str]
    """``correspondences``, ``clouds`` or both: what it can be given."""

    def identity(self) -> dict[str, Any]:
        """Everything that decides the answers, as plain JSON: parameters, library versions, code."""
        ...

    def absent(self) -> str | None:
        """Why the method cannot run here and how to install it, or None where it can."""
        ...

    def __call__(self, given: MethodInput) -> Answer:
        """Register one pair. Raises GeoMoE3DError: the pair cannot be registered; counted as a pair without
        an answer."""
        ...


@dataclass(frozen=True)
class Labels:
    """N correspondences of a pair, each judged in three ways.

    Attributes:
        true: (N,) residual under the true transform below the threshold; all False for unrelated scans.
        kept: (N,) the method's own classification, or None.
        verified: (N,) residual under the method's transform below the threshold; all False without a transform.
    """

    true: BoolArray
    kept: BoolArray | None
    verified: BoolArray


@dataclass(frozen=True)
class Prediction:
    """An answer as it lies in the cache.

    Attributes:
        pair: id of the pair.
        T_target_source, confidence, status, hypotheses: as in `Answer`.
        labels: what became of the correspondences; None where the method shows none.
        weights: (N,) as in `Answer`, half precision, or None.
        seconds: wall time of the call; NaN where its process died over it.
        stages: wall time per stage, may be empty.
        peak_memory: highest resident size of the process during the call, bytes, or None.
        error: what the method said instead of an answer, or None.
    """

    pair: str
    T_target_source: FloatArray | None
    confidence: float | None
    status: str | None
    hypotheses: tuple[FloatArray, ...]
    labels: Labels | None
    weights: FloatArray | None
    seconds: float
    stages: dict[str, float]
    peak_memory: int | None
    error: str | None = None


@dataclass(frozen=True)
class RunInfo:
    """What a set of predictions came from; every report names it.

    Attributes:
        label: name of the run, unique in its study.
        method: name of the method.
        track: 1k, all or clouds.
        benchmark: name of the benchmark.
        identity: everything that decides the predictions, `Method.identity` included.
        commit: of the code, ``-dirty`` where it had local changes; outside a checkout the installed version.
        hardware: processor, cores, memory.
        seed: of the method.
        command: the command line that made it.
        created: UTC, ISO 8601.
        workers: processes at work at the same time.
        threads: threads that each of them may use.
    """

    label: str
    method: str
    track: str
    benchmark: str
    identity: dict[str, Any]
    commit: str | None
    hardware: str
    seed: int
    command: str
    created: str
    workers: int = 1
    threads: int = 1


@dataclass(frozen=True)
class PairScore:
    """The measures of one pair. None: not defined for it (no truth, no labels, a consecutive pair).

    Attributes:
        pair: id.
        scene: scene of the source.
        overlap: as listed.
        inlier_ratio: share of true correspondences.
        rotation_error_deg: angle to the true rotation; infinite without an answer, None without a truth.
        translation_error: metres, likewise.
        right: rotation error < 15 deg and translation error < 0.30 m, strict; False without an answer and
            for unrelated scans.
        right_20: the same with 20 deg.
        rmse: the benchmark's error (facts of gt.info), metres; None for consecutive pairs.
        any_right: whether the answer or any hypothesis is right.
        precision, recall, f1: of the method's own classification; 0 where undefined, None without labels.
        verified_precision, verified_recall, verified_f1: of the labels that the transform gives.
        confidence, status, seconds, stages, peak_memory, error: as in `Prediction`.
    """

    pair: str
    scene: str
    overlap: float | None
    inlier_ratio: float | None
    rotation_error_deg: float | None
    translation_error: float | None
    right: bool
    right_20: bool
    rmse: float | None
    any_right: bool
    precision: float | None
    recall: float | None
    f1: float | None
    verified_precision: float | None
    verified_recall: float | None
    verified_f1: float | None
    confidence: float | None
    status: str | None
    seconds: float
    stages: dict[str, float]
    peak_memory: int | None
    error: str | None = None


@dataclass(frozen=True)
class Measure:
    """One number of a report with its unit, count and 95 % intervals.

    Attributes:
        value: NaN where nothing was counted.
        unit: ``%``, ``points`` (of percent), ``deg``, ``cm``, ``ms``, ``MiB`` or empty.
        count: pairs that entered.
        interval: bootstrap over pairs; (NaN, NaN) where it is not defined.
        scene_interval: bootstrap over scenes, pairs with them; (NaN, NaN) for fewer than two scenes.
    """

    value: float
    unit: str
    count: int
    interval: tuple[float, float]
    scene_interval: tuple[float, float]


@dataclass(frozen=True)
class Curve:
    """A measure against a quantity in bins.

    Attributes:
        quantity: what the bins are over, for the axis.
        edges: (B + 1,) increasing.
        measures: one per bin.
    """

    quantity: str
    edges: tuple[float, ...]
    measures: tuple[Measure, ...]


@dataclass(frozen=True)
class ReliabilityBin:
    """Pairs of similar confidence.

    Attributes:
        low, high: limits of the confidence.
        count: pairs inside.
        confidence: their mean confidence, NaN for an empty bin.
        success: share of them that are right, NaN for an empty bin.
    """

    low: float
    high: float
    count: int
    confidence: float
    success: float


@dataclass(frozen=True)
class Calibration:
    """How far a method's confidence can be believed.

    Attributes:
        bins: the reliability diagram.
        calibration_error: expected calibration error, count-weighted over the bins.
        auroc: probability that a right pair has the higher confidence, ties count half; NaN where all are
            right or all are wrong.
        risk_coverage: (coverage, share wrong among the covered) as confidence falls, one entry per pair.
        accepted: share of pairs with status ok.
        accepted_right: share of right ones among the accepted; NaN where none is accepted.
    """

    bins: tuple[ReliabilityBin, ...]
    calibration_error: Measure
    auroc: Measure
    risk_coverage: tuple[tuple[float, float], ...]
    accepted: Measure
    accepted_right: Measure


@dataclass(frozen=True)
class RunScore:
    """Everything that reports show of one run.

    Attributes:
        info: what it came from.
        num_pairs: pairs of the benchmark; those without prediction are counted in ``num_missing``.
        num_missing: pairs not predicted (an unfinished run); they are in no measure.
        raw_truth: True where rotations of the truth were taken as published.
        pairs: one score per predicted pair.
        measures: by name, in the order of a report.
        scenes: scene -> the main measures of its pairs.
        curves: by name, e.g. recall against overlap.
        calibration: None for methods without confidence.
    """

    info: RunInfo
    num_pairs: int
    num_missing: int
    raw_truth: bool
    pairs: tuple[PairScore, ...]
    measures: dict[str, Measure]
    scenes: dict[str, dict[str, Measure]]
    curves: dict[str, Curve]
    calibration: Calibration | None
