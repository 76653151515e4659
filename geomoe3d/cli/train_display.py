"""What ``geomoe3d train`` shows while it runs: the bar of all verbs with smoothed measures; validations."""

from __future__ import annotations

import math
from contextlib import ExitStack
from typing import TYPE_CHECKING

import click

from geomoe3d.cli.progress import progress_bar

if TYPE_CHECKING:
    from geomoe3d.training.config import TrainConfig

_SHOWN = ("loss", "classification", "regression", "balance", "precision", "recall", "f1")


class Display:
    """The reporter of a training run on stderr; a context manager.

    Args:
        quiet: shows nothing.
    """

    def __init__(self, quiet: bool = False) -> None:
        self._quiet = quiet
        self._open = ExitStack()
        self._steps = 0
        self._means: dict[str, float] = {}

    def __enter__(self) -> Display:
        self._advance = self._open.enter_context(progress_bar("steps", quiet=self._quiet))
        return self

    def __exit__(self, *error: object) -> None:
        self._open.close()

    def started(self, config: TrainConfig, first_step: int, notes: list[str]) -> None:
        """Remember the length of the run; say how it begins."""
        self._steps = config.steps
        self._say(*notes)
        self._advance(first_step, self._steps)

    def stepped(self, step: int, measures: dict[str, float], pairs_per_s: float, skipped: int) -> None:
        """Show smoothed measures and throughput."""
        for name in _SHOWN:
            old, new = self._means.get(name, math.nan), measures[name]
            if math.isfinite(new):  # a skipped step must not blot out all later means
                old = new if math.isnan(old) else old
                kept = 0.95  # of the mean at every step
                new = kept * old + (1 - kept) * new
            self._means[name] = new if math.isfinite(new) else old
        shown = "  ".join(f"{name} {value:.3f}" for name, value in self._means.items())
        self._advance(step, self._steps, f"{shown}  {pairs_per_s:.1f} pairs/s  {skipped} skipped")

    def validated(self, step: int, measures: dict[str, float], best: bool) -> None:
        """Show a validation."""
        shown = "  ".join(f"{name.replace('_', ' ')} {value:.3f}" for name, value in measures.items())
        self._say(f"validation at step {step}: {shown}{'  (best)' if best else ''}")

    def _say(self, *lines: str) -> None:
        if not self._quiet:
            for line in lines:
                click.echo(line, err=True)
