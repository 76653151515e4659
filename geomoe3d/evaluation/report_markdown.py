"""Scores and comparisons as Markdown: the full report, one comparison, the tables of docs/benchmark.md."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from geomoe3d.evaluation.compare import Comparison
from geomoe3d.evaluation.records import Calibration, Curve, Measure, RunScore
from geomoe3d.evaluation.report_words import (
    HEADINGS,
    LEGEND,
    comparison_rows,
    finite,
    groups_of,
    interval_text,
    main_row,
    number_text,
    pairs_text,
    provenance,
    value_text,
    warnings,
    with_intervals,
)
from geomoe3d.evaluation.summary import title


def to_markdown(scores: Sequence[RunScore], comparisons: Sequence[Comparison] = ()) -> str:
    """Everything as Markdown: the main tables, comparisons, then every run with all its measures."""
    lines = ["# Evaluation", ""]
    for (benchmark, track), runs in groups_of(scores).items():
        lines += [f"## {benchmark}, track {track}", ""]
        for run in runs:
            lines += [f"**Warning: {_escaped(warning)}**\n" for warning in warnings(run)]
        rows = []
        for run in runs:
            cells = main_row(run)
            cells[0] = f"{cells[0]} {interval_text(run.measures.get('recall_15'))}".rstrip()
            rows.append([f"{_escaped(run.info.label)} ({pairs_text(run)})", *cells])
        lines += _table(["run", *(heading.replace("\n", " ") for heading in HEADINGS)], rows)
    lines += [LEGEND[0].upper() + LEGEND[1:], ""]
    for comparison in comparisons:
        lines += _comparison(comparison)
    for run in scores:
        lines += _run(run)
    return "\n".join(lines).rstrip() + "\n"


def benchmark_tables(scores: Sequence[RunScore]) -> str:
    """The tables of docs/benchmark.md: one per benchmark and track, best recall first; the calibration."""
    lines: list[str] = []
    for (benchmark, track), runs in groups_of(scores).items():
        ranked = sorted(runs, key=_recall, reverse=True)
        lines += [f"### {benchmark}, track {track}: {pairs_text(ranked[0])}", ""]
        for run in ranked:
            lines += [f"**Warning: {_escaped(warning)}**\n" for warning in warnings(run)]
        if all(run.measures.get("recall_15") is None for run in ranked):
            rows = [[_escaped(run.info.label), _with_interval(run, "accepted")] for run in ranked]
            lines += _table(["run", "called ok, %"], rows)
            continue
        rows = []
        for run in ranked:
            cells = main_row(run)
            cells[0] = f"{cells[0]} {interval_text(run.measures.get('recall_15'))}".rstrip()
            rows.append([_escaped(run.info.label), *cells])
        lines += _table(["run", *(heading.replace("\n", " ") for heading in HEADINGS)], rows)
    lines += [LEGEND[0].upper() + LEGEND[1:], ""]
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
    return f"{value_text(measure)} {interval_text(measure)}".rstrip()


def _calibration_row(run: RunScore, found: Calibration) -> list[str]:
    return [
        _escaped(run.info.label),
        f"{run.info.benchmark}, {run.info.track}",
        f"{value_text(found.auroc)} {interval_text(found.auroc)}".rstrip(),
        f"{value_text(found.calibration_error)} {interval_text(found.calibration_error)}".rstrip(),
        f"{value_text(found.accepted)} {interval_text(found.accepted)}".rstrip(),
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


def _comparison(found: Comparison) -> list[str]:
    a, b = _escaped(found.a.label), _escaped(found.b.label)
    lines = [
        f"## {a} against {b} on {found.a.benchmark}, track {found.a.track}",
        "",
        f"{found.num_pairs:,} pairs answered by both; {found.num_only_in_a:,} by {a} only, "
        f"{found.num_only_in_b:,} by {b} only.",
        "",
    ]
    lines += [f"- {_escaped(note)}" for note in found.notes] + ([""] if found.notes else [])
    rows = [list(row) for row in comparison_rows(found, (a, b))]
    lines += _table(["", "value [95 % over pairs] [over scenes]"], rows)
    for who, ids in ((a, found.a_only_right), (b, found.b_only_right)):
        if ids:
            lines += [f"Only {who} right: {', '.join(_escaped(name) for name in ids)}", ""]
    return lines


def _run(run: RunScore) -> list[str]:
    lines = [f"## Run {_escaped(run.info.label)} ({_escaped(run.info.method)})", ""]
    lines += [f"**Warning: {_escaped(warning)}**\n" for warning in warnings(run)]
    for name, value in provenance(run):
        lines.append(f"- {name}: {_code(value) if name == 'command' else _escaped(value)}")
    lines += ["", f"identity: {_code(json.dumps(finite(run.info.identity), sort_keys=True))}", ""]
    rows = [
        [_escaped(title(name)), f"`{name}`", *_measure_cells(measure)]
        for name, measure in run.measures.items()
    ]
    lines += _table(["measure", "key", "value", "unit", "95 % over pairs", "over scenes", "pairs"], rows)
    lines += _scene_table(run.scenes)
    for curve in run.curves.values():
        lines += _curve_table(curve)
    if run.calibration is not None:
        lines += _calibration(run.calibration)
    return lines


def _scene_table(scenes: Mapping[str, Mapping[str, Measure]]) -> list[str]:
    names = list(dict.fromkeys(name for measures in scenes.values() for name in measures))
    rows = []
    for scene, measures in scenes.items():
        count = max((measure.count for measure in measures.values()), default=0)
        cells = [
            f"{value_text(measures.get(name))} {interval_text(measures.get(name))}".strip() for name in names
        ]
        rows.append([_escaped(scene), f"{count:,}", *cells])
    return _table(["scene", "pairs", *(f"`{name}`" for name in names)], rows)


def _curve_table(curve: Curve) -> list[str]:
    rows = [
        [f"{low:g} to {high:g}", f"{found.count:,}", f"{value_text(found)} {interval_text(found)}".strip()]
        for low, high, found in zip(curve.edges[:-1], curve.edges[1:], curve.measures, strict=True)
    ]
    return _table([curve.quantity, "pairs", "recall 15/0.30, % [95 % over pairs]"], rows)


def _calibration(found: Calibration) -> list[str]:
    lines = [
        f"Confidence: expected calibration error {with_intervals(found.calibration_error)}, AUROC "
        f"{with_intervals(found.auroc)}.",
        "",
    ]
    rows = [
        [
            f"{b.low:.1f} to {b.high:.1f}",
            f"{b.count:,}",
            number_text(b.confidence, 3),
            number_text(b.success, 3),
        ]
        for b in found.bins
    ]
    return lines + _table(["confidence", "pairs", "mean confidence", "share right"], rows)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    if not rows:
        return []
    rule = ["---", *("---:" for _ in head[1:])]
    return [*("| " + " | ".join(row) + " |" for row in (head, rule, *rows)), ""]


def _measure_cells(measure: Measure) -> list[str]:
    intervals = (interval_text(measure), interval_text(measure, over_scenes=True))
    return [value_text(measure), measure.unit, *(text or "-" for text in intervals), f"{measure.count:,}"]


def _escaped(text: str) -> str:
    """Text that Markdown shows as it is, also inside a table."""
    for sign in "\\`*_[]<>|":
        text = text.replace(sign, f"\\{sign}")
    return " ".join(text.split())


def _code(text: str) -> str:
    """Code in Markdown, whatever backticks it holds."""
    text = " ".join(text.split())
    fence = "`"
    while fence in text:
        fence += "`"
    return f"{fence} {text} {fence}" if "`" in text else f"`{text}`"
