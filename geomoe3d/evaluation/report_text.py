"""Scores as tables for the terminal, as Markdown and as JSON."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence

from geomoe3d.evaluation.compare import Comparison
from geomoe3d.evaluation.records import RunScore
from geomoe3d.evaluation.report_words import (
    COLUMNS,
    LEGEND,
    comparison_rows,
    groups_of,
    interval_text,
    main_row,
    number_text,
    pairs_text,
    provenance,
    recall_of,
    shared_provenance,
    value_and_interval,
    value_text,
    warnings,
    with_intervals,
)
from geomoe3d.evaluation.summary import title
from geomoe3d.runtime.plain import plain
from geomoe3d.runtime.words import counted

# ---- the terminal ---------------------------------------------------------------------------------


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

    # Where nobody says how wide, as wide as all columns need.
    console = Console(width=width or 118, color_system="standard" if color else None)
    with console.capture() as captured:
        for (benchmark, track), runs in groups_of(scores).items():
            sizes = {pairs_text(run) for run in runs}
            size = f", {sizes.pop()}" if len(sizes) == 1 else ""
            console.print(Text(f"{benchmark}, track {track}{size}", style="bold"))
            for columns in _columns(console.width):
                table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
                table.add_column("run", overflow="fold")
                for heading in list(COLUMNS.values())[columns]:
                    table.add_column(Text(heading), justify="right", no_wrap=True)
                for run in runs:
                    recall = interval_text(run.measures.get("recall_15"), gap=" ")
                    cells = [f"{main_row(run)[0]}\n{recall}".rstrip(), *main_row(run)[1:]]
                    first = Text(run.info.label if size else f"{run.info.label}\n{pairs_text(run)}")
                    table.add_row(first, *(Text(cell) for cell in cells[columns]))
                console.print(table)
            for run in runs:
                for warning in warnings(run):
                    console.print(Text(f"WARNING: {warning}", style="bold red"))
            console.print()
        console.print(Text(LEGEND))
        console.print()
        for name, value in shared_provenance(scores):
            console.print(Text(f"{name}: {value}"), soft_wrap=True)
    return captured.get().rstrip("\n")


def terminal_comparison(a: RunScore, b: RunScore, found: Comparison) -> str:
    """Two runs against each other, and below what they came from.

    Args:
        a: the first run.
        b: the second run.
        found: what `compare` says of them.
    """
    names = found.a.label, found.b.label
    if names[0] == names[1]:  # one method at two commits, say
        names = f"first {names[0]}", f"second {names[1]}"
    rows = comparison_rows(found, names)
    width = max(len(name) for name, _ in rows)
    lines = [
        f"{names[0]} against {names[1]} on {found.a.benchmark}, track {found.a.track}",
        "(values with their 95 % intervals over pairs and over scenes)",
        *(f"  {name:{width}}  {value}" for name, value in rows),
        *(f"NOTE: {note}" for note in found.notes),
    ]
    for who, ids in zip(names, (found.a_only_right, found.b_only_right), strict=True):
        lines += ["", f"only {who} right:", *(f"  {name}" for name in ids)] if ids else []
    return "\n".join([*lines, "", *(f"{name}: {value}" for name, value in shared_provenance([a, b]))])


def _columns(width: int) -> list[slice]:
    # A table of all columns needs 110 characters.
    return [slice(None)] if width >= 110 else [slice(0, 6), slice(6, None)]


# ---- Markdown -------------------------------------------------------------------------------------


def to_markdown(scores: Sequence[RunScore], comparisons: Sequence[Comparison] = ()) -> str:
    """Everything as Markdown: the main tables, comparisons, then every run with all its measures."""
    lines = ["# Evaluation", ""]
    for (benchmark, track), runs in groups_of(scores).items():
        lines += [f"## {benchmark}, track {track}", "", *_warning_lines(runs)]
        lines += _main_lines({f"{_plain(run.info.label)} ({pairs_text(run)})": run for run in runs})
    lines += [LEGEND[0].upper() + LEGEND[1:], ""]
    for comparison in comparisons:
        lines += _comparison_lines(comparison)
    for run in scores:
        lines += _run_lines(run)
    return "\n".join(lines).rstrip() + "\n"


def benchmark_tables(scores: Sequence[RunScore]) -> str:
    """The tables of docs/benchmark.md: one per benchmark and track, best recall first; the calibration."""
    lines: list[str] = []
    for (benchmark, track), runs in groups_of(scores).items():
        ranked = sorted(runs, key=recall_of, reverse=True)
        lines += [f"### {benchmark}, track {track}: {pairs_text(ranked[0])}", "", *_warning_lines(ranked)]
        if all(run.measures.get("recall_15") is None for run in ranked):
            rows = [
                [_plain(run.info.label), value_and_interval(run.measures.get("accepted"))] for run in ranked
            ]
            lines += markdown_table(["run", "accepted, %"], rows)
        else:
            lines += _main_lines({_plain(run.info.label): run for run in ranked})
    lines += [LEGEND[0].upper() + LEGEND[1:], ""]
    rows = [
        [
            _plain(run.info.label),
            f"{run.info.benchmark}, {run.info.track}",
            *map(value_and_interval, (found.auroc, found.calibration_error, found.accepted)),
        ]
        for run, found in ((run, run.calibration) for run in scores)
        if found is not None
    ]
    if rows:
        lines += ["### Confidence", ""]
        lines += markdown_table(
            ["run", "benchmark", "AUROC of success", "calibration error", "accepted, %"], rows
        )
    said = (
        [f"Commit {run.info.commit or 'unknown'}" for run in scores],
        [run.info.hardware for run in scores],
        [f"{run.info.workers} worker(s) of {run.info.threads} thread(s)" for run in scores],
        [f"seed {run.info.seed}" for run in scores],
    )
    return "\n".join([*lines, "; ".join("; ".join(dict.fromkeys(values)) for values in said) + ".", ""])


def _warning_lines(runs: Sequence[RunScore]) -> list[str]:
    return [f"**Warning: {_plain(warning)}**\n" for run in runs for warning in warnings(run)]


def _main_lines(runs: Mapping[str, RunScore]) -> list[str]:
    """The main table; the first number has its interval beside it."""
    rows = [
        [name, value_and_interval(run.measures.get("recall_15")), *main_row(run)[1:]]
        for name, run in runs.items()
    ]
    return markdown_table(["run", *(heading.replace("\n", " ") for heading in COLUMNS.values())], rows)


def _comparison_lines(found: Comparison) -> list[str]:
    a, b = _plain(found.a.label), _plain(found.b.label)
    lines = [
        f"## {a} against {b} on {found.a.benchmark}, track {found.a.track}",
        "",
        f"{counted(found.num_pairs, 'pair')} answered by both; {found.num_only_in_a:,} by {a} only, "
        f"{found.num_only_in_b:,} by {b} only.",
        "",
        *(f"- {_plain(note)}\n" for note in found.notes),
        *markdown_table(["", "value [95 % over pairs] [over scenes]"], comparison_rows(found, (a, b))),
    ]
    for who, ids in ((a, found.a_only_right), (b, found.b_only_right)):
        if ids:
            lines += [f"Only {who} right: {', '.join(map(_plain, ids))}", ""]
    return lines


def _run_lines(run: RunScore) -> list[str]:
    lines = [f"## Run {_plain(run.info.label)} ({_plain(run.info.method)})", "", *_warning_lines([run])]
    for name, value in provenance(run):
        lines.append(f"- {name}: {_code(value) if name == 'command' else _plain(value)}")
    lines += ["", f"identity: {_code(json.dumps(plain(run.info.identity), sort_keys=True))}", ""]
    head = ["measure", "key", "value", "unit", "95 % over pairs", "over scenes", "pairs"]
    rows = [
        [
            _plain(title(name)),
            f"`{name}`",
            value_text(found),
            found.unit,
            interval_text(found) or "-",
            interval_text(found, over_scenes=True) or "-",
            f"{found.count:,}",
        ]
        for name, found in run.measures.items()
    ]
    lines += markdown_table(head, rows)
    names = list(dict.fromkeys(name for measures in run.scenes.values() for name in measures))
    rows = [
        [
            _plain(scene),
            f"{max((found.count for found in measures.values()), default=0):,}",
            *(value_and_interval(measures.get(name)) for name in names),
        ]
        for scene, measures in run.scenes.items()
    ]
    lines += markdown_table(["scene", "pairs", *(f"`{name}`" for name in names)], rows)
    for curve in run.curves.values():
        rows = [
            [f"{low:g} to {high:g}", f"{found.count:,}", value_and_interval(found)]
            for low, high, found in zip(curve.edges[:-1], curve.edges[1:], curve.measures, strict=True)
        ]
        lines += markdown_table([curve.quantity, "pairs", "recall 15/0.30, % [95 % over pairs]"], rows)
    if run.calibration is not None:
        error, auroc = map(with_intervals, (run.calibration.calibration_error, run.calibration.auroc))
        lines += [f"Confidence: expected calibration error {error}, AUROC {auroc}.", ""]
        rows = [
            [
                f"{b.low:.1f} to {b.high:.1f}",
                f"{b.count:,}",
                number_text(b.confidence, 3),
                number_text(b.success, 3),
            ]
            for b in run.calibration.bins
        ]
        lines += markdown_table(["confidence", "pairs", "mean confidence", "share right"], rows)
    return lines


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table and an empty one behind it; none where there are no rows."""
    rule = ["---", *("---:" for _ in head[1:])]
    return [*("| " + " | ".join(row) + " |" for row in (head, rule, *rows)), ""] if rows else []


def _plain(text: str) -> str:
    """Text that Markdown shows as it is, also inside a table."""
    return " ".join(re.sub(r"[\\`*_\[\]<>|]", r"\\\g<0>", text).split())


def _code(text: str) -> str:
    """Code in Markdown, whatever backticks it holds."""
    text = " ".join(text.split())
    longest = max(map(len, re.findall("`+", text)), default=0)
    return f"{'`' * (longest + 1)} {text} {'`' * (longest + 1)}" if longest else f"`{text}`"


# ---- JSON -----------------------------------------------------------------------------------------

FORMAT = "geomoe3d evaluation 1"


def to_json(scores: Sequence[RunScore], comparisons: Sequence[Comparison] = ()) -> str:
    """Everything as strict JSON with keys as in the records; numbers that are not finite become null."""
    document = {
        "format": FORMAT,
        "runs": plain(scores),
        "comparisons": plain(comparisons),
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"
