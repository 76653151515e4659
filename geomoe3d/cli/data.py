"""``geomoe3d data``: look through, make and prepare training data."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING

import click

from geomoe3d.cli.errors import BAD_INPUT, HELP, traceback_option

if TYPE_CHECKING:
    from geomoe3d.data.check import CheckReport


@click.group(context_settings=HELP)
def command() -> None:
    """Look through, make and prepare training and test data."""


@command.command(context_settings=HELP)
@click.argument("root", type=click.Path())
@click.option("--quick", is_flag=True, help="List only; do not open the fragments.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")
@traceback_option
@click.pass_context
def check(context: click.Context, root: str, quick: bool, as_json: bool) -> None:
    """Say which layout ROOT has, what it holds against what was published, and name every broken file.

    Exit code 0 when every listed pair can be used, else 2.
    """
    from geomoe3d.data.check import check_folder

    with progress_bar("fragments", quiet=as_json) as advance:
        report = check_folder(root, open_files=not quick, progress=advance)
    if as_json:
        click.echo(json.dumps({**asdict(report), "usable": report.usable}, default=str))
    else:
        _print(report)
    context.exit(0 if report.usable else BAD_INPUT)


def _print(report: CheckReport) -> None:
    click.echo(f"{report.root}: layout {report.layout}")
    pairs = ", ".join(f"{count} {group}" for group, count in report.num_pairs.items()) or "no pairs"
    click.echo(f"{report.num_scenes} scenes, {report.num_fragments} fragments, {pairs}")
    for row in report.scenes:
        split = f" [{row['split']}]" if row["split"] else ""
        published = f" of {row['published_fragments']}" if row["published_fragments"] else ""
        counts = ", ".join(f"{count} {group}" for group, count in row["pairs"].items())
        click.echo(
            f"  {row['scene']}{split}: {row['fragments']}{published} fragments; {counts or 'no pairs'}"
        )
    for title, lines in (("broken", report.broken), ("missing", report.missing), ("note", report.notes)):
        for line in lines:
            click.echo(f"{title}: {line}")
    click.echo("usable" if report.usable else "not usable as it is")


@contextmanager
def progress_bar(unit: str, *, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """A bar with count and time left on stderr; a line now and then where stderr is no terminal.

    Yields:
        Call it with (done, all).
    """
    if quiet:
        yield lambda done, total: None
        return
    if not sys.stderr.isatty():
        yield _lines(unit)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn(unit), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(unit, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _lines(unit: str) -> Callable[[int, int], None]:
    import time

    start = said = time.monotonic()
    first: list[int] = []

    def say(done: int, total: int) -> None:
        nonlocal said
        first.append(done) if not first else None
        now = time.monotonic()
        if now - said < 15 and done < total:
            return
        said = now
        rate = (done - first[0]) / max(now - start, 1e-9)
        left = f", about {(total - done) / rate:.0f} s left" if rate > 0 and done < total else ""
        click.echo(f"{done} of {total} {unit}{left}", err=True)

    return say
