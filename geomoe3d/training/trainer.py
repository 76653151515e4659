"""A training run: one folder, one configuration, exact to the bit when interrupted and resumed on a CPU.

    run = TrainingRun(config, "runs/faithful")
    summary = run.train(reporter)

The folder holds config.yaml, train.csv, experts.csv, validation.csv, TensorBoard events, last.pt, best.pt
and, at the end, weights.safetensors with its card and curves.png. Started again in the same folder it goes
on from last.pt. Under torchrun every process runs this; the first one writes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch.nn.parallel import DistributedDataParallel

from geomoe3d.config import yaml_text
from geomoe3d.errors import CheckpointError, GeoMoE3DError, OutputError
from geomoe3d.networks.build import Network, build_network
from geomoe3d.networks.pretrained import load_network, save_pretrained
from geomoe3d.networks.weight_files import WeightCard
from geomoe3d.runtime.files import make_folder, write_text
from geomoe3d.runtime.provenance import source_commit
from geomoe3d.runtime.words import counted
from geomoe3d.training.batches import Batch, open_training, training_loader, validation_samples
from geomoe3d.training.checkpoint import check_same_run, load_checkpoint, save_checkpoint
from geomoe3d.training.config import TrainConfig
from geomoe3d.training.distributed import Process, choose_device, join
from geomoe3d.training.logs import draw_curves
from geomoe3d.training.measures import evaluate
from geomoe3d.training.reporting import Rate, Reporter, RunLogs, Summary
from geomoe3d.training.schedule import learning_rate
from geomoe3d.training.step import AveragedWeights, Updater


@dataclass
class _Progress:
    """All that a checkpoint holds besides tensors."""

    step: int = 0
    skipped: int = 0
    skipped_in_row: int = 0
    best_step: int = 0
    best: dict[str, float] = field(default_factory=dict)
    meters: dict[str, list[float]] = field(default_factory=dict)


class TrainingRun:
    """One run in one folder.

    Args:
        config: everything that decides it.
        folder: created if missing; with a ``last.pt`` in it the run goes on from there.
        fresh: refuse to go on: the folder must hold no run.

    Raises:
        CheckpointError: the folder's run has other settings or data, or is damaged.
        OutputError: the folder cannot be used, or holds a run and ``fresh`` is set.
    """

    def __init__(self, config: TrainConfig, folder: str | Path, *, fresh: bool = False) -> None:
        self.config = config
        self.folder = Path(folder)
        self.process: Process = join()
        self.device = choose_device(config.device, self.process)
        self.stop = False
        self.notes: list[str] = []
        self._open_folder(fresh)
        self.pairs = open_training(config)
        if config.data.validation == "synthetic" != config.data.train:
            self.notes.append("the best weights are chosen on generated pairs: give data.validation as well")
        torch.manual_seed(config.seed)
        self.model = build_network(config.network)
        if config.init_from is not None and not self.last_path.exists():
            self._start_from(config.init_from)
        self.model.checkpoint_activations = config.checkpoint_activations
        self.model.to(self.device).train()
        self.averaged = (
            AveragedWeights(self.model, config.optimizer.ema_decay) if config.optimizer.ema_decay else None
        )
        self.optimizer = torch.optim.AdamW(
            self.model.parameters(),
            lr=config.optimizer.learning_rate,
            weight_decay=config.optimizer.weight_decay,
            fused=True,
        )
        self.progress = _Progress()
        if self.last_path.exists():
            self._resume()
        elif self.process.is_first:
            write_text(self.folder / "config.yaml", yaml_text(config), force=True)
        self.process.wait()

    @property
    def last_path(self) -> Path:
        """Checkpoint that a restart goes on from."""
        return self.folder / "last.pt"

    @property
    def best_path(self) -> Path:
        """Weights of the best validation."""
        return self.folder / "best.pt"

    def train(self, reporter: Reporter, until: int | None = None) -> Summary:
        """Train to the end of the schedule, to step ``until``, or until ``stop`` is set. Raises
        GeoMoE3DError: too many steps in a row had no finite gradient."""
        config, progress = self.config, self.progress
        last_step = config.steps if until is None else min(until, config.steps)
        wrapped: torch.nn.Module = self.model
        if self.process.world > 1:
            wrapped = DistributedDataParallel(self.model)
        updater = Updater(self.model, wrapped, self.optimizer, config)
        loader = training_loader(
            config, self.pairs, progress.step, self.process.rank, self.process.world, self.device
        )
        batches: Iterator[Batch] = iter(loader)
        logs = RunLogs(self.folder, config, progress.step) if self.process.is_first else None
        if logs is not None and logs.board.missing:
            self.notes.append("TensorBoard is not installed (pip install tensorboard): CSV logs only")
        if self.process.is_first:
            reporter.started(config, progress.step, self.notes)
        samples = validation_samples(config) if self.process.is_first else []
        pairs_per_step = config.batch_size * config.accumulation * self.process.world
        rate = Rate(pairs_per_step)
        while progress.step < last_step and not self.stop:
            along = progress.step / config.steps
            lr = learning_rate(config.optimizer, along)
            updated, measures = updater.step(batches, along, lr, self.device)
            progress.step += 1
            self._count(updated)
            if updated and self.averaged is not None:
                self.averaged.update(self.model)
            rate.tick()
            for name, value in measures.items():
                if math.isfinite(value):  # else a skipped step, which is counted, would hide the others
                    total = progress.meters.setdefault(name, [0.0, 0.0])
                    total[0] += value
                    total[1] += 1
            done = progress.step >= config.steps
            if self.process.is_first:
                reporter.stepped(progress.step, measures, rate.value, progress.skipped)
            if progress.step % config.logging.every == 0 or done:
                means = {name: total / count for name, (total, count) in progress.meters.items()}
                progress.meters = {}
                if logs is not None:
                    extra = {"learning_rate": lr, "skipped": progress.skipped, "pairs_per_s": rate.value}
                    logs.training(progress.step, means | extra)
            if progress.step % config.validation.every == 0 or done:
                if logs is not None:
                    self._validate(samples, logs, reporter)
                    rate.pause()
                self.process.wait()
            if progress.step % config.checkpoint_every == 0 or done:
                self._save()
        finished = progress.step >= config.steps
        if not finished:
            self._save()
        if logs is not None:
            logs.board.close()
        weights = self._finish() if finished and self.process.is_first else None
        return Summary(
            progress.step,
            progress.skipped,
            progress.best_step,
            dict(progress.best),
            finished,
            weights,
            rate.value,
        )

    @property
    def shipped(self) -> Network:
        """The network that is validated and exported: averaged weights if they are kept."""
        return self.model if self.averaged is None else self.averaged.model

    def _count(self, updated: bool) -> None:
        progress = self.progress
        progress.skipped_in_row = 0 if updated else progress.skipped_in_row + 1
        progress.skipped += not updated
        if progress.skipped_in_row >= self.config.max_skipped_in_row:
            raise GeoMoE3DError(
                f"{progress.skipped_in_row} steps in a row had no finite gradient (step {progress.step}); "
                f"lower optimizer.learning_rate, or train in float32; last.pt holds the run before"
            )

    def _validate(self, samples: list[Any], logs: RunLogs, reporter: Reporter) -> None:
        progress, config = self.progress, self.config
        measures = evaluate(self.shipped, samples, self.device)
        key = _BEST_MEASURE[config.validation.best_metric]
        # Ties in a small validation set are common; F1 decides between equal recalls.
        rank = (measures[key], measures["f1"])
        best = not progress.best or rank > (progress.best[key], progress.best["f1"])
        if best:
            progress.best, progress.best_step = measures, progress.step
            state = {"step": progress.step, "model": self.shipped.state_dict(), "metrics": measures}
            save_checkpoint(self.best_path, state, config, self.pairs.identity())
        logs.validation(progress.step, measures | {"best": int(best)})
        reporter.validated(progress.step, measures, best)

    def _save(self) -> None:
        if self.process.is_first:
            progress = self.progress
            state = {
                "step": progress.step,
                "world": self.process.world,
                "skipped": progress.skipped,
                "skipped_in_row": progress.skipped_in_row,
                "best_step": progress.best_step,
                "best": progress.best,
                "meters": progress.meters,
                "model": self.model.state_dict(),
                "optimizer": self.optimizer.state_dict(),
                "averaged": None if self.averaged is None else self.averaged.state(),
                "random_state": torch.get_rng_state(),
            }
            save_checkpoint(self.last_path, state, self.config, self.pairs.identity())
        self.process.wait()

    def _resume(self) -> None:
        state = load_checkpoint(self.last_path)
        check_same_run(state, self.config, self.pairs.identity(), self.last_path)
        if (world := state.get("world", self.process.world)) != self.process.world:
            raise CheckpointError(
                f"'{self.last_path}' was trained by {counted(world, 'process', 'processes')}, now "
                f"{self.process.world}: each step would see another number of pairs; start as many as before"
            )
        self.model.load_state_dict(state["model"])
        self.optimizer.load_state_dict(state["optimizer"])
        if self.averaged is not None:
            self.averaged.restore(state["averaged"])
        torch.set_rng_state(state["random_state"])
        names = ("step", "skipped", "skipped_in_row", "best_step", "best", "meters")
        self.progress = _Progress(**{name: state[name] for name in names})
        self.notes.append(f"goes on from step {self.progress.step} of '{self.last_path}'")

    def _start_from(self, path: str) -> None:
        model, _ = load_network(path)
        if model.config != self.config.network:
            raise CheckpointError(
                f"'{path}' holds another architecture than the configuration asks for: "
                f"{model.config.model_dump_json()}"
            )
        self.model.load_state_dict(model.state_dict())

    def _finish(self) -> Path:
        best = load_checkpoint(self.best_path)
        model = build_network(self.config.network)
        model.load_state_dict(best["model"])
        card = WeightCard(
            architecture={},
            voxel_size=self.pairs.voxel_sizes(),
            training_data=self.pairs.identity(),
            steps=int(best["step"]),
            metrics=best["metrics"],
            commit=source_commit(),
        )
        path = self.folder / "weights.safetensors"
        save_pretrained(path, model, card, force=True)
        draw_curves(self.folder)
        return path

    def _open_folder(self, fresh: bool) -> None:
        make_folder(self.folder)
        if fresh and self.last_path.exists():
            raise OutputError(f"'{self.folder}' holds a run already; give another folder, or leave out --new")
        if not self.last_path.exists() and (self.folder / "weights.safetensors").exists():
            raise OutputError(f"'{self.folder}' holds weights but no run to go on with; give another folder")


_BEST_MEASURE = {"recall": "registration_recall", "f1": "f1", "verdict": "verdict_recall"}
