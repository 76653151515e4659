"""What goes to the screen while a verb works: the stage or a bar on stderr, nothing on stdout.

Open3D's native code prints warnings to stdout, where a program that reads ``--json`` would stumble over
them; `stdout_to_stderr` sends them the other way.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout

import click


@contextmanager
def stdout_to_stderr() -> Iterator[None]:
    """Whatever is printed inside, by Python or by native code, goes to stderr."""
    sys.stdout.flush()
    try:
        kept = os.dup(1)
    except OSError:  # the process was started without a stdout
        kept = -1
    try:
        if kept >= 0:
            os.dup2(2, 1)
        with redirect_stdout(sys.stderr):
            yield
    finally:
        if kept >= 0:
            os.dup2(kept, 1)
            os.close(kept)


@contextmanager
def stage_display(quiet: bool) -> Iterator[Callable[[str], None]]:
    """A line on stderr with the stage at work and the time it has taken; gone when done.

    Args:
        quiet: shows nothing. Neither is anything shown where stderr is no terminal.

    Yields:
        Call it with the name of each stage as it begins.
    """
    if quiet or not sys.stderr.isatty() or os.environ.get("TERM") == "dumb":
        yield lambda stage: None
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    with Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=True,
        redirect_stdout=False,
        redirect_stderr=False,
    ) as progress:
        task = progress.add_task("start", total=None)
        # drawn at once: stages can be shorter than the time between two drawings
        yield lambda stage: progress.update(task, description=stage, refresh=True)


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
