"""Scores as tables for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from geomoe3d.evaluation.compare import Comparison
from geomoe3d.evaluation.records import RunScore
from geomoe3d.evaluation.report_words import (
    HEADINGS,
    LEGEND,
    comparison_rows,
    groups_of,
    interval_text,
    main_row,
    pairs_text,
    shared_provenance,
    warnings,
)

NATURAL_WIDTH = 118
_SPLIT_WIDTH = 110


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
        for (benchmark, track), runs in groups_of(scores).items():
            sizes = {pairs_text(run) for run in runs}
            size = f", {sizes.pop()}" if len(sizes) == 1 else ""
            console.print(Text(f"{benchmark}, track {track}{size}", style="bold"))
            for columns in _columns(console.width):
                table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
                table.add_column("run", overflow="fold")
                for heading in HEADINGS[columns]:
                    table.add_column(Text(heading), justify="right", no_wrap=True)
                for run in runs:
                    cells = main_row(run)
                    cells[0] = f"{cells[0]}\n{interval_text(run.measures.get('recall_15'), gap=' ')}".rstrip()
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
    return [slice(None)] if width >= _SPLIT_WIDTH else [slice(0, 6), slice(6, None)]
