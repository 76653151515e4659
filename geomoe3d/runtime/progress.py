"""What is shown while something counted takes long: a bar on a terminal or in a notebook, else a line now and then.

Everything goes to stderr. Work that is done within a second shows nothing.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from typing import Any, Literal, ParamSpec, TypeVar

from geomoe3d.runtime.words import counted

_LOG_SECONDS = 30.0
_PATIENCE_S = 1.0

Watch = Callable[[int, int], None] | Literal[False] | None
"""Who is told of progress: a function of (done, in all), nobody, or, with None, whoever looks at the screen."""

P = ParamSpec("P")
R = TypeVar("R")


def shows_progress(what: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator: a function whose keyword ``progress`` is a `Watch` shows a bar where it is None.

    Args:
        what: is counted, such as ``pairs``.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def shown(*args: P.args, **kwargs: P.kwargs) -> R:
            if kwargs.get("progress") is not None:
                return function(*args, **kwargs)
            with _patient_bar(what) as progress:
                kwargs["progress"] = progress
                return function(*args, **kwargs)

        return shown

    return decorate


@contextmanager
def _patient_bar(what: str) -> Iterator[Callable[..., None]]:
    """A `progress_bar` that appears only when the work has taken a second."""
    begin = time.monotonic()
    first: list[int] = []
    with ExitStack() as stack:
        bars: list[Callable[..., None]] = []

        def tell(done: int, total: int, words: str = "") -> None:
            if not first:
                first.append(done)
            if not bars and done < total and time.monotonic() - begin > _PATIENCE_S:
                bars.append(stack.enter_context(progress_bar(what)))
                bars[0](first[0], total)
            for bar in bars:
                bar(done, total, words)

        yield tell


@contextmanager
def progress_bar(what: str, *, quiet: bool = False) -> Iterator[Callable[..., None]]:
    """A display of work that is counted, with the time it will take.

    Args:
        what: is counted, such as ``pairs``; one is without the s.
        quiet: shows nothing.

    Yields:
        Call it with (done, in all) and, if wanted, a few words on how it goes; the first call says how much
        was done before.
    """
    if quiet:
        yield lambda done, total, words="": None
    elif not on_terminal():
        yield _LogLines(what)
    else:
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        columns = (BarColumn(), TextColumn("{task.fields[count]}"), TimeElapsedColumn(), TextColumn("left"))
        with rich_progress(
            TextColumn(what), *columns, TimeRemainingColumn(), TextColumn("{task.fields[words]}")
        ) as progress:
            task = progress.add_task(what, total=None, words="", count="starting")
            yield lambda done, total, words="": progress.update(
                task, completed=done, total=total, words=words, count=f"{done:,}/{total:,}"
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
            _say(f"{counted(total, self._what[:-1])}{kept}")
            self._said = now
            return
        if now - self._said < _LOG_SECONDS and done < total:
            return
        self._said = now
        since, before = self._begin
        left = (now - since) / max(done - before, 1) * (total - done)
        rest = f", {duration(left)} left" if done < total else f" after {duration(now - since)}"
        _say(f"{done:,} of {counted(total, self._what[:-1])}{rest}{'  ' * bool(words)}{words}")


def on_terminal() -> bool:
    """Whether stderr is shown to somebody on a terminal that can redraw a line, or in a notebook."""
    return _in_notebook() or (sys.stderr.isatty() and os.environ.get("TERM") != "dumb")


def _in_notebook() -> bool:
    """Whether a notebook's kernel runs this program; that the package of kernels was imported says nothing."""
    if "ipykernel" not in sys.modules or "IPython" not in sys.modules:
        return False
    shell = sys.modules["IPython"].get_ipython()
    return shell is not None and hasattr(shell, "kernel")


def rich_progress(*columns: Any) -> Any:
    """A display of rich that draws on stderr and vanishes when done."""
    from rich.console import Console
    from rich.progress import Progress

    return Progress(
        *columns,
        console=Console(stderr=True),
        transient=True,
        redirect_stdout=False,
    )


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
