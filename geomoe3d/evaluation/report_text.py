"""Scores as text: a table for the terminal, Markdown for documents, strict JSON for programs.

Every form names label, benchmark, track, pairs, commit, hardware, seed and command of every run, and says
aloud where a run has not answered all pairs. The table shows the interval of the recall alone, Markdown and
JSON have all of them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from geomoe3d.evaluation.compare import Comparison
from geomoe3d.evaluation.records import Calibration, Curve, Measure, RunScore
from geomoe3d.evaluation.summary import title

FORMAT = "geomoe3d evaluation 1"
NATURAL_WIDTH = 118
_SPLIT_WIDTH = 110
_HEADINGS = (
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
_LEGEND = (
    "recall: % of pairs below 15 (20) deg and 0.30 m, mean over pairs with its 95 % interval; scene mean: "
    "mean over scenes of the former; RMSE recall: at most 0.20 m, pairs not consecutive; rotation, "
    "translation: medians over right pairs; F1: inliers by the motion, mean over pairs, %; called ok: % of "
    "pairs; right of ok: % of those; -: not defined."
)


def terminal_table(scores: Sequence[RunScore], *, width: int | None = None, color: bool = False) -> str:
    """One table per benchmark and track, one row per run, and below what every run came from.

    Args:
        scores: runs, in the order of the rows.
        width: columns; None takes 118, which hold the whole table; below 110 it comes in two parts.
        color: True for terminal colours.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(width=width or NATURAL_WIDTH, color_system="standard" if color else None)
    with console.capture() as captured:
        for (benchmark, track), runs in _groups(scores).items():
            console.print(Text(f"{benchmark}, track {track}", style="bold"))
            for columns in _columns(console.width):
                table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
                table.add_column("run", overflow="fold")
                for heading in _HEADINGS[columns]:
                    table.add_column(Text(heading), justify="right", no_wrap=True)
                for run in runs:
                    cells = main_row(run)
                    cells[0] = f"{cells[0]}\n{_interval(run.measures.get('recall_15'), gap=' ')}".rstrip()
                    first = Text(f"{run.info.label}\n{_pairs(run)}")
                    table.add_row(first, *(Text(cell) for cell in cells[columns]))
                console.print(table)
            for run in runs:
                for warning in warnings(run):
                    console.print(Text(f"WARNING: {warning}", style="bold red"))
            console.print()
        console.print(Text(_LEGEND))
        for run in scores:
            console.print()
            console.print(Text(run.info.label, style="bold"), Text(f"({run.info.method})"))
            for name, value in _provenance(run):
                console.print(Text(f"  {name}: {value}"), soft_wrap=True)
    return captured.get().rstrip("\n")


def to_markdown(scores: Sequence[RunScore], comparisons: Sequence[Comparison] = ()) -> str:
    """Everything as Markdown: the main tables, comparisons, then every run with all its measures."""
    lines = ["# Evaluation", ""]
    for (benchmark, track), runs in _groups(scores).items():
        lines += [f"## {benchmark}, track {track}", ""]
        for run in runs:
            lines += [f"**Warning: {_escaped(warning)}**\n" for warning in warnings(run)]
        rows = []
        for run in runs:
            cells = main_row(run)
            cells[0] = f"{cells[0]} {_interval(run.measures.get('recall_15'))}".rstrip()
            rows.append([f"{_escaped(run.info.label)} ({_pairs(run)})", *cells])
        lines += _table(["run", *(heading.replace("\n", " ") for heading in _HEADINGS)], rows)
    lines += [_LEGEND[0].upper() + _LEGEND[1:], ""]
    for comparison in comparisons:
        lines += _comparison(comparison)
    for run in scores:
        lines += _run(run)
    return "\n".join(lines).rstrip() + "\n"


def to_json(scores: Sequence[RunScore], comparisons: Sequence[Comparison] = ()) -> str:
    """Everything as strict JSON with keys as in the records; numbers that are not finite become null."""
    document = {
        "format": FORMAT,
        "runs": [_finite(asdict(run)) for run in scores],
        "comparisons": [_finite(asdict(comparison)) for comparison in comparisons],
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def main_row(run: RunScore) -> list[str]:
    """The cells of the main table without the name of the run; ``-`` where a measure is not defined."""
    names = (
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
    return [_value(run.measures.get(name)) for name in names]


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


def _groups(scores: Sequence[RunScore]) -> dict[tuple[str, str], list[RunScore]]:
    groups: dict[tuple[str, str], list[RunScore]] = {}
    for run in scores:
        groups.setdefault((run.info.benchmark, run.info.track), []).append(run)
    return groups


def _columns(width: int) -> list[slice]:
    return [slice(None)] if width >= _SPLIT_WIDTH else [slice(0, 6), slice(6, None)]


def _pairs(run: RunScore) -> str:
    if run.num_missing:
        return f"{len(run.pairs):,} of {run.num_pairs:,} pairs"
    return f"{run.num_pairs:,} pairs"


def _provenance(run: RunScore) -> list[tuple[str, str]]:
    info = run.info
    return [
        ("benchmark", f"{info.benchmark}, track {info.track}, {_pairs(run)}"),
        ("commit", info.commit or "unknown"),
        ("hardware", f"{info.hardware}; workers {info.workers}, threads of each {info.threads}"),
        ("seed", str(info.seed)),
        ("created", info.created),
        ("command", info.command),
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
    rows = []
    if found.recall_difference is not None and found.mcnemar_p is not None:
        rows = [
            ["both right", f"{found.num_both_right:,}"],
            [f"only {a} right", f"{len(found.a_only_right):,}"],
            [f"only {b} right", f"{len(found.b_only_right):,}"],
            ["neither right", f"{found.num_neither_right:,}"],
            ["exact McNemar p", f"{found.mcnemar_p:.3g}"],
            [f"recall of {a} minus {b}, points", _with_intervals(found.recall_difference, signed=True)],
        ]
    rows += [
        [f"median time of {a} over that of {b}", _with_intervals(found.time_ratio)],
        [f"median of time of {a} over time of {b}", _with_intervals(found.pair_time_ratio)],
    ]
    lines += _table(["", "value [95 % over pairs] [over scenes]"], rows)
    for who, ids in ((a, found.a_only_right), (b, found.b_only_right)):
        if ids:
            lines += [f"Only {who} right: {', '.join(_escaped(name) for name in ids)}", ""]
    return lines


def _run(run: RunScore) -> list[str]:
    lines = [f"## Run {_escaped(run.info.label)} ({_escaped(run.info.method)})", ""]
    lines += [f"**Warning: {_escaped(warning)}**\n" for warning in warnings(run)]
    for name, value in _provenance(run):
        lines.append(f"- {name}: {_code(value) if name == 'command' else _escaped(value)}")
    lines += ["", f"identity: {_code(json.dumps(_finite(run.info.identity), sort_keys=True))}", ""]
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
        cells = [f"{_value(measures.get(name))} {_interval(measures.get(name))}".strip() for name in names]
        rows.append([_escaped(scene), f"{count:,}", *cells])
    return _table(["scene", "pairs", *(f"`{name}`" for name in names)], rows)


def _curve_table(curve: Curve) -> list[str]:
    rows = [
        [f"{low:g} to {high:g}", f"{found.count:,}", f"{_value(found)} {_interval(found)}".strip()]
        for low, high, found in zip(curve.edges[:-1], curve.edges[1:], curve.measures, strict=True)
    ]
    return _table([curve.quantity, "pairs", "recall 15/0.30, % [95 % over pairs]"], rows)


def _calibration(found: Calibration) -> list[str]:
    lines = [
        f"Confidence: expected calibration error {_with_intervals(found.calibration_error)}, AUROC "
        f"{_with_intervals(found.auroc)}.",
        "",
    ]
    rows = [
        [f"{b.low:.1f} to {b.high:.1f}", f"{b.count:,}", _number(b.confidence, 3), _number(b.success, 3)]
        for b in found.bins
    ]
    return lines + _table(["confidence", "pairs", "mean confidence", "share right"], rows)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    if not rows:
        return []
    rule = ["---", *("---:" for _ in head[1:])]
    return [*("| " + " | ".join(row) + " |" for row in (head, rule, *rows)), ""]


def _digits(measure: Measure) -> int:
    return {"%": 1, "points": 2, "deg": 2, "cm": 2, "ms": 1, "MiB": 0}.get(measure.unit, 3)


def _number(value: float, digits: int) -> str:
    if math.isnan(value):
        return "-"
    return f"{value:.{digits}f}" if math.isfinite(value) else "inf"


def _value(measure: Measure | None) -> str:
    return "-" if measure is None else _number(measure.value, _digits(measure))


def _interval(measure: Measure | None, *, over_scenes: bool = False, gap: str = ", ") -> str:
    """``[low, high]``, empty where it is not defined."""
    if measure is None:
        return ""
    ends = measure.scene_interval if over_scenes else measure.interval
    if any(math.isnan(end) for end in ends):
        return ""
    return f"[{gap.join(_number(end, _digits(measure)) for end in ends)}]"


def _with_intervals(measure: Measure, *, signed: bool = False) -> str:
    value = f"{measure.value:+.{_digits(measure)}f}" if signed else _value(measure)
    return " ".join(
        part for part in (value, _interval(measure), _interval(measure, over_scenes=True)) if part
    )


def _measure_cells(measure: Measure) -> list[str]:
    intervals = (_interval(measure), _interval(measure, over_scenes=True))
    return [_value(measure), measure.unit, *(text or "-" for text in intervals), f"{measure.count:,}"]


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


def _finite(value: Any) -> Any:
    """Plain JSON: tuples as lists, numpy's numbers as Python's, what is not finite as None."""
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, (bool, int, str)) or value is None:
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    plain: Callable[[], Any] | None = getattr(value, "tolist", None)
    return _finite(plain()) if plain is not None else str(value)
