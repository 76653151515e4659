"""What goes to stderr while a verb works: a bar or the stage at work, or a line now and then in a log.

Nothing goes to stdout. Open3D's native code prints warnings there, over which a program that reads
``--json`` would stumble; `stdout_to_stderr` sends them the other way.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import Any

import click

_LOG_SECONDS = 30.0


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
    """A line with the stage at work and the time it has taken; gone when done.

    Args:
        quiet: shows nothing. Neither is anything shown where stderr is no terminal.

    Yields:
        Call it with the name of each stage as it begins.
    """
    if quiet or not _on_terminal():
        yield lambda stage: None
        return
    from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

    with _rich(SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn()) as progress:
        task = progress.add_task("start", total=None)
        # drawn at once: stages can be shorter than the time between two drawings
        yield lambda stage: progress.update(task, description=stage, refresh=True)


@contextmanager
def progress_bar(what: str, *, quiet: bool = False) -> Iterator[Callable[..., None]]:
    """A display of work that is counted, with the time it will take.

    Args:
        what: is counted, such as ``pairs``.
        quiet: shows nothing.

    Yields:
        Call it with (done, in all) and, if wanted, a few words on how it goes; the first call says how much
        was done before.
    """
    if quiet:
        yield lambda done, total, words="": None
    elif not _on_terminal():
        yield _LogLines(what)
    else:
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"))
        with _rich(
            TextColumn(what), *columns, TimeRemainingColumn(), TextColumn("{task.fields[words]}")
        ) as progress:
            task = progress.add_task(what, total=None, words="")
            yield lambda done, total, words="": progress.update(
                task, completed=done, total=total, words=words
            )


def duration(seconds: float) -> str:
    """Seconds for the eye: 42 s, 12 min, 3.4 h."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


class _LogLines:
    """A line at the beginning, at the end, and every half a minute."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._begin: tuple[float, int] | None = None
        self._said = 0.0

    def __call__(self, done: int, total: int, words: str = "") -> None:
        now = time.monotonic()
        if self._begin is None:
            self._begin = now, done
            kept = f", {done:,} of them done before" if done else ""
            click.echo(f"{total:,} {self._what}{kept}", err=True)
            self._said = now
            return
        if now - self._said < _LOG_SECONDS and done < total:
            return
        self._said = now
        since, before = self._begin
        left = (now - since) / max(done - before, 1) * (total - done)
        rest = f", {duration(left)} left" if done < total else f" after {duration(now - since)}"
        click.echo(f"{done:,} of {total:,} {self._what}{rest}{'  ' * bool(words)}{words}", err=True)


def _on_terminal() -> bool:
    return sys.stderr.isatty() and os.environ.get("TERM") != "dumb"


def _rich(*columns: Any) -> Any:
    from rich.console import Console
    from rich.progress import Progress

    return Progress(
        *columns,
        console=Console(stderr=True),
        transient=True,
        redirect_stdout=False,
    )
