"""What a run tells: to whoever watches, to its log files, and at the end."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from geomoe3d.training.config import TrainConfig
from geomoe3d.training.logs import CsvLog, TensorBoardLog

_TRAIN_COLUMNS = [
    "loss", "classification", "regression", "balance", "precision", "recall", "f1", "kept_fraction",
    "router_entropy", "verdict", "unsolved", "gradient_norm", "learning_rate", "skipped", "pairs_per_s",
]  # fmt: skip
_VALIDATION_COLUMNS = ["precision", "recall", "f1", "registration_recall", "verdict_recall", "best"]


class Reporter(Protocol):
    """Where a run says what it does; the command line draws it live."""

    def started(self, config: TrainConfig, first_step: int, notes: list[str]) -> None:
        """Before the first step."""

    def stepped(self, step: int, measures: dict[str, float], pairs_per_s: float, skipped: int) -> None:
        """After every step."""

    def validated(self, step: int, measures: dict[str, float], best: bool) -> None:
        """After a validation."""


@dataclass
class Summary:
    """How a run ended.

    Attributes:
        step: steps done.
        skipped: steps whose gradient was not finite.
        best_step: step of the best validation, 0 if there was none.
        best: its measures.
        finished: False if it was asked to stop.
        weights: what was exported, or None if unfinished.
        pairs_per_s: training throughput of this process group.
    """

    step: int
    skipped: int
    best_step: int
    best: dict[str, float]
    finished: bool
    weights: Path | None
    pairs_per_s: float


class RunLogs:
    """The CSV files and TensorBoard of a run."""

    def __init__(self, folder: Path, config: TrainConfig, first_step: int) -> None:
        network = config.network
        experts = []
        if network.feed_forward == "moe":
            for layer in range(network.num_layers):
                for place in (1, 2):
                    where = f"layer{layer + 1}_moe{place}"
                    experts += [f"{where}_entropy"]
                    experts += [f"{where}_expert{i + 1}" for i in range(network.num_experts)]
        self._experts = experts
        self._train = CsvLog(folder / "train.csv", _TRAIN_COLUMNS, first_step)
        self._usage = CsvLog(folder / "experts.csv", experts, first_step) if experts else None
        columns = [c for c in _VALIDATION_COLUMNS if c != "verdict_recall" or network.judges_motions]
        self._validation = CsvLog(folder / "validation.csv", columns, first_step)
        self.board = TensorBoardLog(folder, first_step, config.logging.tensorboard)

    def training(self, step: int, values: dict[str, float]) -> None:
        """Means since the last call, experts included."""
        kept = {name: values[name] for name in _TRAIN_COLUMNS if name in values}
        usage = {name: values[name] for name in self._experts if name in values}
        self._train.add(step, kept)
        self.board.add(step, "train", kept)
        if self._usage is not None:
            self._usage.add(step, usage)
            self.board.add(step, "experts", usage)

    def validation(self, step: int, values: dict[str, float]) -> None:
        """Measures of a validation."""
        self._validation.add(step, values)
        self.board.add(step, "validation", values)


class Rate:
    """Pairs per second, smoothed over the last steps, pauses left out."""

    def __init__(self, pairs_per_step: int) -> None:
        self.pairs_per_step = pairs_per_step
        self.value = 0.0
        self._last: float | None = time.perf_counter()

    def tick(self) -> None:
        """After a step."""
        now = time.perf_counter()
        if self._last is not None:
            current = self.pairs_per_step / max(now - self._last, 1e-9)
            self.value = current if self.value == 0 else 0.9 * self.value + 0.1 * current
        self._last = now

    def pause(self) -> None:
        """After something that is no step."""
        self._last = time.perf_counter()
