"""What goes to stderr while a verb works: a bar or the stage at work, or a line now and then in a log.

Nothing goes to stdout. Open3D's native code prints warnings there, over which a program that reads
``--json`` would stumble; `stdout_to_stderr` sends them the other way.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout

from geomoe3d.runtime.progress import duration as duration
from geomoe3d.runtime.progress import on_terminal, rich_progress
from geomoe3d.runtime.progress import progress_bar as progress_bar


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
    if quiet or not on_terminal():
        yield lambda stage: None
        return
    from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

    with rich_progress(SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn()) as progress:
        task = progress.add_task("start", total=None)
        # drawn at once: stages can be shorter than the time between two drawings
        yield lambda stage: progress.update(task, description=stage, refresh=True)
