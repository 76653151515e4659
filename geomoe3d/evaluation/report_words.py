"""The words and the rounding that all forms of a report share, so that no two of them differ."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from geomoe3d.evaluation.records import Measure, RunInfo, RunScore

HEADINGS = (
    "recall\n15/0.30",
    "recall\n20/0.30",
    "scene\nmean",
    "RMSE\nrecall",
    "rotation\ndeg",
    "transl.\ncm",
    "F1 by\nmotion",
    "called\nok",
    "right\nof ok",
    "median\nms",
)
LEGEND = (
    "recall: % of pairs below 15 (20) deg and 0.30 m, mean over pairs with its 95 % interval; scene mean: "
    "mean over scenes of the former; RMSE recall: at most 0.20 m, pairs not consecutive; rotation, "
    "translation: medians over right pairs; F1: inliers by the motion, mean over pairs, %; called ok: % of "
    "pairs; right of ok: % of those; -: not defined."
)
MAIN_MEASURES = (
    "recall_15",
    "recall_20",
    "recall_15_scene_mean",
    "rmse_recall",
    "rotation_median",
    "translation_median",
    "verified_f1",
    "accepted",
    "accepted_right",
    "time_median",
)
"""Columns of the main table, one for each of the headings."""


def main_row(run: RunScore) -> list[str]:
    """The cells of the main table without the name of the run; ``-`` where a measure is not defined."""
    return [value_text(run.measures.get(name)) for name in MAIN_MEASURES]


def warnings(run: RunScore) -> list[str]:
    """What a reader must know before the numbers: missing pairs, errors, the truth taken raw."""
    found = []
    if run.num_missing:
        found.append(
            f"'{run.info.label}' has not answered {run.num_missing:,} of {run.num_pairs:,} pairs; its "
            f"numbers are over the other {run.num_pairs - run.num_missing:,} and not those of the benchmark"
        )
    errors = sum(score.error is not None for score in run.pairs)
    if errors:
        found.append(
            f"'{run.info.label}' ended with an error on {errors:,} of {len(run.pairs):,} pairs; they count "
            "as not right"
        )
    if run.raw_truth:
        found.append(
            f"'{run.info.label}' is scored against the truth as published, whose rotations are not all "
            "orthonormal: its rotation errors have a floor of up to 1.4 deg"
        )
    return found


def groups_of(scores: Sequence[RunScore]) -> dict[tuple[str, str], list[RunScore]]:
    """Runs by benchmark and track, in order of first appearance."""
    groups: dict[tuple[str, str], list[RunScore]] = {}
    for run in scores:
        groups.setdefault((run.info.benchmark, run.info.track), []).append(run)
    return groups


def thinning(info: RunInfo) -> int:
    """n where a run was made on every n-th pair of its benchmark, else 1."""
    given = info.identity.get("pairs")
    every = given.get("every") if isinstance(given, dict) else None
    return every if isinstance(every, int) else 1


def pairs_text(run: RunScore) -> str:
    """How many pairs the run is over, and whether these are a share of the benchmark only."""
    text = f"{len(run.pairs):,} of {run.num_pairs:,} pairs" if run.num_missing else f"{run.num_pairs:,} pairs"
    every = thinning(run.info)
    return text + (f", 1 in {every} of the benchmark" if every > 1 else "")


def provenance(run: RunScore) -> list[tuple[str, str]]:
    """What a run came from, as names and values."""
    info = run.info
    return [
        ("benchmark", f"{info.benchmark}, track {info.track}, {pairs_text(run)}"),
        ("commit", info.commit or "unknown"),
        ("hardware", f"{info.hardware}; workers {info.workers}, threads of each {info.threads}"),
        ("seed", str(info.seed)),
        ("created", info.created),
        ("command", info.command),
    ]


def number_text(value: float, digits: int) -> str:
    """A number with so many digits; ``-`` for NaN."""
    if math.isnan(value):
        return "-"
    return f"{value:.{digits}f}" if math.isfinite(value) else "inf"


def value_text(measure: Measure | None) -> str:
    """The value of a measure, rounded as its unit asks; ``-`` where there is none."""
    return "-" if measure is None else number_text(measure.value, _digits(measure))


def interval_text(measure: Measure | None, *, over_scenes: bool = False, gap: str = ", ") -> str:
    """``[low, high]``, empty where it is not defined."""
    if measure is None:
        return ""
    ends = measure.scene_interval if over_scenes else measure.interval
    if any(math.isnan(end) for end in ends):
        return ""
    return f"[{gap.join(number_text(end, _digits(measure)) for end in ends)}]"


def with_intervals(measure: Measure, *, signed: bool = False) -> str:
    """Value, interval over pairs, interval over scenes, as far as they are defined."""
    value = f"{measure.value:+.{_digits(measure)}f}" if signed else value_text(measure)
    return " ".join(
        part for part in (value, interval_text(measure), interval_text(measure, over_scenes=True)) if part
    )


def finite(value: Any) -> Any:
    """Plain JSON: tuples as lists, numpy's numbers as Python's, what is not finite as None."""
    if isinstance(value, dict):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    if isinstance(value, (bool, int, str)) or value is None:
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    plain: Callable[[], Any] | None = getattr(value, "tolist", None)
    return finite(plain()) if plain is not None else str(value)


def _digits(measure: Measure) -> int:
    return {"%": 1, "points": 2, "deg": 2, "cm": 2, "ms": 1, "MiB": 0}.get(measure.unit, 3)
