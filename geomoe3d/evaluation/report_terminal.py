"""Scores as tables for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from geomoe3d.evaluation.records import RunScore
from geomoe3d.evaluation.report_words import (
    HEADINGS,
    LEGEND,
    groups_of,
    interval_text,
    main_row,
    pairs_text,
    provenance,
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
            console.print(Text(f"{benchmark}, track {track}", style="bold"))
            for columns in _columns(console.width):
                table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
                table.add_column("run", overflow="fold")
                for heading in HEADINGS[columns]:
                    table.add_column(Text(heading), justify="right", no_wrap=True)
                for run in runs:
                    cells = main_row(run)
                    cells[0] = f"{cells[0]}\n{interval_text(run.measures.get('recall_15'), gap=' ')}".rstrip()
                    first = Text(f"{run.info.label}\n{pairs_text(run)}")
                    table.add_row(first, *(Text(cell) for cell in cells[columns]))
                console.print(table)
            for run in runs:
                for warning in warnings(run):
                    console.print(Text(f"WARNING: {warning}", style="bold red"))
            console.print()
        console.print(Text(LEGEND))
        for run in scores:
            console.print()
            console.print(Text(run.info.label, style="bold"), Text(f"({run.info.method})"))
            for name, value in provenance(run):
                console.print(Text(f"  {name}: {value}"), soft_wrap=True)
    return captured.get().rstrip("\n")


def _columns(width: int) -> list[slice]:
    return [slice(None)] if width >= _SPLIT_WIDTH else [slice(0, 6), slice(6, None)]
