"""How far long work has come and how long it will take, on stderr: a bar, or a line now and then in a log."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import click

_LOG_SECONDS = 30.0


@contextmanager
def count_display(what: str, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """A display of work that is counted.

    Args:
        what: is counted, such as ``pairs``.
        quiet: shows nothing.

    Yields:
        Call it with (done, in all); the first call says how much was done before.
    """
    if quiet:
        yield lambda done, total: None
    elif not sys.stderr.isatty() or os.environ.get("TERM") == "dumb":
        yield _LogLines(what)
    else:
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        with Progress(
            TextColumn(what),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            redirect_stdout=False,
            redirect_stderr=False,
        ) as progress:
            task = progress.add_task(what, total=None)
            yield lambda done, total: progress.update(task, completed=done, total=total)


class _LogLines:
    """A line at the beginning, at the end, and every half a minute."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._begin: tuple[float, int] | None = None
        self._said = 0.0

    def __call__(self, done: int, total: int) -> None:
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
        click.echo(f"{done:,} of {total:,} {self._what}{rest}", err=True)


def duration(seconds: float) -> str:
    """Seconds for the eye: 42 s, 12 min, 3.4 h."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
