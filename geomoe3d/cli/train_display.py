"""What ``geomoe3d train`` shows while it runs: a live panel on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import math
import sys
import time
from types import TracebackType
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from geomoe3d.training.config import TrainConfig

_SHOWN = ("loss", "classification", "regression", "balance", "precision", "recall", "f1")
_PLAIN_EVERY_S = 30.0


class Display:
    """The reporter of a training run on stderr; a context manager.

    Args:
        quiet: shows nothing.
    """

    def __init__(self, quiet: bool = False) -> None:
        self._quiet = quiet
        self._live: Any = None
        self._steps = 0
        self._means: dict[str, float] = {}
        self._validations: list[tuple[int, dict[str, float], bool]] = []
        self._printed = 0.0
        self._begin, self._begin_step = 0.0, -1
        self._now = 0.0
        self._last = (0, 0.0, 0)

    def __enter__(self) -> Display:
        if not self._quiet and sys.stderr.isatty():
            from rich.console import Console
            from rich.live import Live

            self._live = Live(console=Console(stderr=True), refresh_per_second=4)
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def started(self, config: TrainConfig, first_step: int, notes: list[str]) -> None:
        """Remember the length of the run; say how it begins."""
        self._steps = config.steps
        if not self._quiet:
            for note in notes:
                click.echo(note, err=True)

    def stepped(self, step: int, measures: dict[str, float], pairs_per_s: float, skipped: int) -> None:
        """Show smoothed measures, throughput and time left."""
        if self._quiet:
            return
        for name in _SHOWN:
            old, new = self._means.get(name, math.nan), measures[name]
            if math.isfinite(new):  # a skipped step must not blot out all later means
                self._means[name] = 0.95 * old + 0.05 * new if math.isfinite(old) else new
            else:
                self._means.setdefault(name, math.nan)
        self._pace(step)
        self._last = (step, pairs_per_s, skipped)
        if self._live is not None:
            self._live.update(self._panel(*self._last))
        elif time.monotonic() - self._printed > _PLAIN_EVERY_S:
            self._printed = time.monotonic()
            shown = "  ".join(f"{name} {value:.3f}" for name, value in self._means.items())
            click.echo(
                f"step {step}/{self._steps}  {shown}  {pairs_per_s:.1f} pairs/s  left {self._left(step)}",
                err=True,
            )

    def validated(self, step: int, measures: dict[str, float], best: bool) -> None:
        """Show a validation."""
        self._validations.append((step, measures, best))
        if self._live is not None:
            self._live.update(self._panel(*self._last))
        if not self._quiet and self._live is None:
            shown = "  ".join(f"{name.replace('_', ' ')} {value:.3f}" for name, value in measures.items())
            click.echo(f"validation at step {step}: {shown}{'  (best)' if best else ''}", err=True)

    def _pace(self, step: int) -> None:
        self._now = time.monotonic()
        if self._begin_step < 0:
            self._begin, self._begin_step = self._now, step

    def _left(self, step: int) -> str:
        done = step - self._begin_step
        if done < 1:
            return "?"
        seconds = int((self._now - self._begin) / done * (self._steps - step))
        return f"{seconds // 3600}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"

    def _panel(self, step: int, pairs_per_s: float, skipped: int) -> Any:
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        head = Text(
            f"step {step} of {self._steps}   {pairs_per_s:.1f} pairs/s   left {self._left(step)}   "
            f"skipped {skipped}"
        )
        table = Table(box=None, pad_edge=False)
        names = list(self._validations[-1][1]) if self._validations else ["precision", "recall", "f1"]
        table.add_column("")
        for name in names:
            table.add_column(name.replace("_", " "), justify="right")
        known = [self._means.get(name) for name in names]
        table.add_row("training", *("" if value is None else f"{value:.3f}" for value in known))
        for at, measures, best in self._validations[-5:]:
            row = [f"{measures[name]:.3f}" for name in names]
            table.add_row(f"validation {at}", *row, style="bold" if best else "")
        losses = "   ".join(f"{n} {self._means[n]:.4f}" for n in _SHOWN[:4])
        return Group(head, ProgressBar(total=self._steps, completed=step, width=60), Text(losses), table)
