"""Words and rounding of all forms of a report: terminal, Markdown, JSON, page and figures."""

from __future__ import annotations

import math
from collections.abc import Sequence

from geomoe3d.data.threedmatch import BENCHMARKS
from geomoe3d.evaluation.benchmarks import UNRELATED
from geomoe3d.evaluation.compare import Comparison
from geomoe3d.evaluation.records import Measure, RunInfo, RunScore
from geomoe3d.runtime.words import counted

COLUMNS = {
    "recall_15": "recall\n15/0.30",
    "recall_20": "recall\n20/0.30",
    "recall_15_scene_mean": "scene\nmean",
    "rmse_recall": "RMSE\nrecall",
    "rotation_median": "rotation\ndeg",
    "translation_median": "transl.\ncm",
    "verified_f1": "inlier\nF1",
    "accepted": "accepted\n%",
    "accepted_right": "precision\nof ok",
    "time_median": "median\nms",
}
"""Measures of the main table and their headings."""
LEGEND = (
    "recall: % of pairs below 15 (20) deg and 0.30 m, mean over pairs with its 95 % interval; scene mean: "
    "mean over scenes of the former; RMSE recall: at most 0.20 m, pairs not consecutive; rotation, "
    "translation: medians over right pairs; inlier F1: labels by the transform, mean over pairs, %; "
    "accepted: % of pairs with status ok; precision: % of those that are right; -: not defined."
)


def main_row(run: RunScore) -> list[str]:
    """The cells of the main table without the name of the run; ``-`` where a measure is not defined."""
    return [value_text(run.measures.get(name)) for name in COLUMNS]


def warnings(run: RunScore) -> list[str]:
    """What a reader must know before the numbers: missing pairs, errors, the truth taken raw."""
    found = []
    if run.num_missing:
        found.append(
            f"'{run.info.label}' has not answered {run.num_missing:,} of {counted(run.num_pairs, 'pair')}; its "
            f"numbers are over the other {run.num_pairs - run.num_missing:,} and not those of the benchmark"
        )
    errors = [score.error for score in run.pairs if score.error is not None]
    if errors:
        first = " ".join(errors[0].split())
        found.append(
            f"'{run.info.label}' ended with an error on {len(errors):,} of {counted(len(run.pairs), 'pair')}; they "
            f"count as not right; the first: {first[:300]}{'...' * (len(first) > 300)}"
        )
    if run.raw_truth:
        found.append(
            f"'{run.info.label}' is scored against the truth as published, whose rotations are not all "
            "orthonormal: its rotation errors have a floor of up to 1.4 deg"
        )
    return found


def groups_of(scores: Sequence[RunScore]) -> dict[tuple[str, str], list[RunScore]]:
    """Runs by benchmark and track: published benchmarks first, unrelated scans last, tracks as they come."""
    groups: dict[tuple[str, str], list[RunScore]] = {}
    for run in sorted(scores, key=lambda run: benchmark_rank(run.info.benchmark)):
        groups.setdefault((run.info.benchmark, run.info.track), []).append(run)
    return groups


def benchmark_rank(name: str) -> int:
    """Place of a benchmark in a report: 3DMatch, 3DLoMatch, folders, unrelated scans."""
    return BENCHMARKS.index(name) if name in BENCHMARKS else len(BENCHMARKS) + (name == UNRELATED)


def thinning(info: RunInfo) -> int:
    """n where a run was made on every n-th pair of its benchmark, else 1."""
    given = info.identity.get("pairs")
    every = given.get("every") if isinstance(given, dict) else None
    return every if isinstance(every, int) else 1


def pairs_text(run: RunScore) -> str:
    """How many pairs the run is over, and whether these are a share of the benchmark only."""
    text = (
        f"{len(run.pairs):,} of {counted(run.num_pairs, 'pair')}"
        if run.num_missing
        else counted(run.num_pairs, "pair")
    )
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


def shared_provenance(runs: Sequence[RunScore]) -> list[tuple[str, str]]:
    """What several runs came from; what they have in common once, else with the names of the runs."""
    rows = {run_key(run.info): dict(provenance(run)) for run in runs}
    found: list[tuple[str, str]] = []
    for name in ("commit", "hardware", "seed", "created", "command"):
        values: dict[str, list[str]] = {}
        for run, row in rows.items():
            values.setdefault(row[name], []).append(run)
        if name == "created" and len(values) > 1:
            found.append((name, f"{min(values)} to {max(values)}"))
            continue
        for value, named in values.items():
            found.append((name, value if len(values) == 1 else f"{value} ({', '.join(named)})"))
    return found


def run_key(info: RunInfo) -> str:
    """What tells a run from every other of a report: label, track, benchmark, and the share of its pairs."""
    every = thinning(info)
    return f"{info.label}.{info.track}.{info.benchmark}" + (f".every{every}" if every > 1 else "")


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


def value_and_interval(measure: Measure | None) -> str:
    """The value with its interval over pairs, as far as there are any."""
    return f"{value_text(measure)} {interval_text(measure)}".rstrip()


def recall_of(run: RunScore) -> float:
    """Recall over pairs in %, to sort by; -1 where there is none."""
    measure = run.measures.get("recall_15")
    return -1.0 if measure is None or math.isnan(measure.value) else measure.value


def with_intervals(measure: Measure, *, signed: bool = False) -> str:
    """Value, interval over pairs, interval over scenes, as far as they are defined."""
    value = f"{measure.value:+.{_digits(measure)}f}" if signed else value_text(measure)
    return " ".join(
        part for part in (value, interval_text(measure), interval_text(measure, over_scenes=True)) if part
    )


def comparison_rows(found: Comparison, names: tuple[str, str]) -> list[tuple[str, str]]:
    """What two runs come to against each other, as names and values; unrelated scans have times alone."""
    a, b = names
    rows = [("pairs answered by both", f"{found.num_pairs:,}")]
    if found.recall_difference is not None and found.mcnemar_p is not None:
        rows += [
            ("both right", f"{found.num_both_right:,}"),
            (f"only {a} right", f"{len(found.a_only_right):,}"),
            (f"only {b} right", f"{len(found.b_only_right):,}"),
            ("neither right", f"{found.num_neither_right:,}"),
            ("exact McNemar p", f"{found.mcnemar_p:.3g}"),
            (f"recall of {a} minus {b}, points", with_intervals(found.recall_difference, signed=True)),
        ]
    return [
        *rows,
        (f"median time of {a} over that of {b}", with_intervals(found.time_ratio)),
        (f"median of time of {a} over time of {b}", with_intervals(found.pair_time_ratio)),
    ]


def _digits(measure: Measure) -> int:
    return {"%": 1, "points": 2, "deg": 2, "cm": 2, "ms": 1, "MiB": 0}.get(measure.unit, 3)
