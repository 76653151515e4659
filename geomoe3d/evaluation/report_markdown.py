"""Scores and comparisons as Markdown beyond the full report: a comparison alone, the tables of the docs."""

from __future__ import annotations

from collections.abc import Sequence

from geomoe3d.evaluation.compare import Comparison
from geomoe3d.evaluation.records import Calibration, RunScore
from geomoe3d.evaluation.report_text import (
    _HEADINGS,
    _LEGEND,
    _comparison,
    _escaped,
    _groups,
    _interval,
    _pairs,
    _table,
    _value,
    main_row,
    warnings,
)


def comparison_text(found: Comparison) -> str:
    """One comparison of two runs."""
    return "\n".join(_comparison(found)).rstrip()


def benchmark_tables(scores: Sequence[RunScore]) -> str:
    """The tables of docs/benchmark.md: one per benchmark and track, best recall first; the calibration."""
    lines: list[str] = []
    for (benchmark, track), runs in _groups(scores).items():
        ranked = sorted(runs, key=_recall, reverse=True)
        lines += [f"### {benchmark}, track {track}: {_pairs(ranked[0])}", ""]
        for run in ranked:
            lines += [f"**Warning: {_escaped(warning)}**\n" for warning in warnings(run)]
        if all(run.measures.get("recall_15") is None for run in ranked):
            rows = [[_escaped(run.info.label), _with_interval(run, "accepted")] for run in ranked]
            lines += _table(["run", "called ok, %"], rows)
            continue
        rows = []
        for run in ranked:
            cells = main_row(run)
            cells[0] = f"{cells[0]} {_interval(run.measures.get('recall_15'))}".rstrip()
            rows.append([_escaped(run.info.label), *cells])
        lines += _table(["run", *(heading.replace("\n", " ") for heading in _HEADINGS)], rows)
    lines += [_LEGEND[0].upper() + _LEGEND[1:], ""]
    calibrated = [(run, run.calibration) for run in scores if run.calibration is not None]
    if calibrated:
        lines += ["### Confidence", ""]
        rows = [_calibration_row(run, found) for run, found in calibrated]
        lines += _table(["run", "benchmark", "AUROC of success", "calibration error", "called ok, %"], rows)
    lines += _provenance_lines(scores)
    return "\n".join(lines)


def _recall(run: RunScore) -> float:
    measure = run.measures.get("recall_15")
    return -1.0 if measure is None else measure.value


def _with_interval(run: RunScore, name: str) -> str:
    measure = run.measures.get(name)
    return f"{_value(measure)} {_interval(measure)}".rstrip()


def _calibration_row(run: RunScore, found: Calibration) -> list[str]:
    return [
        _escaped(run.info.label),
        f"{run.info.benchmark}, {run.info.track}",
        f"{_value(found.auroc)} {_interval(found.auroc)}".rstrip(),
        f"{_value(found.calibration_error)} {_interval(found.calibration_error)}".rstrip(),
        f"{_value(found.accepted)} {_interval(found.accepted)}".rstrip(),
    ]


def _provenance_lines(scores: Sequence[RunScore]) -> list[str]:
    """What all runs came from; said once where it is the same."""

    def said(values: list[str]) -> str:
        return "; ".join(dict.fromkeys(values))

    return [
        f"Commit {said([run.info.commit or 'unknown' for run in scores])}; "
        f"{said([run.info.hardware for run in scores])}; "
        f"{said([f'{run.info.workers} worker(s) of {run.info.threads} thread(s)' for run in scores])}; "
        f"seed {said([str(run.info.seed) for run in scores])}.",
        "",
    ]
