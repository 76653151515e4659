"""A training run of the learned descriptor: contrast between corresponding points and all others of a pair.

    python scripts/train_descriptor.py runs/descriptor data="[runs/training-set/features]" steps=8000

The folder holds config.yaml, log.csv, last.pt and, at the end, learned.safetensors, which the configuration
of a registration takes as ``descriptor.options={weights: FILE}``. Started again it goes on from last.pt.
Which pairs a step sees depends on the seed and its number alone. About 0.25 s per step of two pairs on one
core.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from pydantic import Field
from torch import Tensor

from geomoe3d.config import Section
from geomoe3d.errors import CheckpointError, OutputError
from geomoe3d.runtime.files import write_atomically, write_text
from geomoe3d.training.descriptor_network import WIDTH, DescriptorNetwork, View
from geomoe3d.training.descriptor_pairs import ContrastPair, ContrastPairs

_RIGHT = 2.0  # voxels: a match so near is right, as in registration
_WRONG = 3.0  # voxels: one farther off is wrong; those between count as neither
_NEVER = -1e4
_AVERAGE_DECAY = 0.995


class DescriptorTrainConfig(Section):
    """One run."""

    data: tuple[str, ...] = Field(("runs/training-set/features",), description="folders of shards")
    seed: int = Field(0, ge=0)
    steps: int = Field(8000, ge=1, description="updates of the weights")
    batch_size: int = Field(2, ge=1, description="pairs per step")
    width: int = Field(WIDTH, ge=4, description="channels")
    learning_rate: float = Field(2e-3, gt=0, description="the largest of the schedule")
    weight_decay: float = Field(1e-3, ge=0)
    leave_out: int = Field(3, ge=0, description="scenes, the first by name, kept for validation")
    num_shared: int = Field(300, ge=1, description="corresponding points asked of each fragment, at most")
    num_random: int = Field(500, ge=0, description="further points asked of each")
    validation_pairs: int = Field(24, ge=1)
    save_every: int = Field(250, ge=1, description="steps")


def contrast(
    features: tuple[Tensor, Tensor], apart: tuple[Tensor, Tensor], scale: Tensor
) -> tuple[Tensor, float]:
    """How far the shared points are from finding each other among all points asked, and how many do.

    -log of the softmax weight of all that is right, against all that is wrong, mean over both directions.

    Args:
        features: (q, D) of source and target, unit length.
        apart: see `ContrastPair`.
        scale: similarity counts so many times.

    Returns:
        The loss, and the share of shared points whose most similar point is right.

    Source: the loss of contrastive predictive coding (van den Oord et al., 2018) with several right answers.
    """
    losses, found = [], []
    for a, b, distance in ((*features, apart[0]), (features[1], features[0], apart[1])):
        logit = scale * a[: len(distance)] @ b.T
        right = logit.masked_fill(distance > _RIGHT, _NEVER).logsumexp(1)
        wrong = logit.masked_fill(distance < _WRONG, _NEVER).logsumexp(1)
        losses.append((torch.logaddexp(right, wrong) - right).mean())
        best = distance.gather(1, logit.detach().argmax(1, keepdim=True))
        found.append(float((best <= _RIGHT).float().mean()))
    return torch.stack(losses).mean(), sum(found) / 2


class DescriptorRun:
    """One run in one folder.

    Args:
        config: everything that decides it.
        folder: created if missing; with a ``last.pt`` in it the run goes on from there.

    Raises:
        CheckpointError: the folder's run has other settings, or is damaged.
        OutputError: the folder cannot be used.
    """

    def __init__(self, config: DescriptorTrainConfig, folder: Path) -> None:
        self.config, self.folder = config, folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot use '{folder}' as run folder: {error.strerror}") from None
        torch.manual_seed(config.seed)
        self.network = DescriptorNetwork(config.width)
        self.averaged = DescriptorNetwork(config.width).requires_grad_(False)
        self.averaged.load_state_dict(self.network.state_dict())
        self.log_scale = torch.nn.Parameter(torch.tensor(2.7))
        self.optimizer = torch.optim.AdamW(
            [*self.network.parameters(), self.log_scale],
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
        )
        self.step = 0
        if self.last_path.exists():
            self._resume()
        else:
            import yaml

            text = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)
            write_text(folder / "config.yaml", text, force=True)

    @property
    def last_path(self) -> Path:
        """Checkpoint that a restart goes on from."""
        return self.folder / "last.pt"

    def train(self, report: Callable[[str], None] = print, until: int | None = None) -> Path | None:
        """To the end of the schedule, then the weights' path; or to step ``until``, then None."""
        config = self.config
        pairs = self._pairs(config.seed, config.leave_out)
        losses: list[tuple[float, float]] = []
        last = min(until or config.steps, config.steps)
        while self.step < last:
            first = self.step * config.batch_size
            losses.append(self._update([pairs[first + k] for k in range(config.batch_size)]))
            if self.step % config.save_every == 0 or self.step == last:
                self._save()
                loss, share = (sum(column) / len(losses) for column in zip(*losses, strict=True))
                losses = []
                line = f"{self.step},{loss:.4f},{share:.4f},{self.validate():.4f},{time.time():.0f}"
                with (self.folder / "log.csv").open("a") as log:
                    log.write(line + "\n")
                report(f"step, loss, found, found in validation, time: {line}")
        return self._finish() if self.step == config.steps else None

    @torch.no_grad()
    def validate(self) -> float:
        """Share of shared points found, averaged weights, scenes left out; NaN where none is."""
        config = self.config
        if config.leave_out == 0:
            return math.nan
        pairs = self._pairs(config.seed + 1, -config.leave_out)
        found = [_loss(self.averaged, pairs[k], self.log_scale)[1] for k in range(config.validation_pairs)]
        return sum(found) / len(found)

    def _pairs(self, seed: int, leave_out: int) -> ContrastPairs:
        config = self.config
        counts = {"num_shared": config.num_shared, "num_random": config.num_random}
        return ContrastPairs(list(config.data), seed, leave_out=leave_out, **counts)

    def _update(self, batch: list[ContrastPair]) -> tuple[float, float]:
        """One step; mean loss and share found."""
        done = self.step / self.config.steps
        rate = min(1.0, (self.step + 1) / 100) * (0.03 + 0.97 * 0.5 * (1 + math.cos(math.pi * done)))
        for group in self.optimizer.param_groups:
            group["lr"] = rate * self.config.learning_rate
        self.optimizer.zero_grad()
        measures = []
        for pair in batch:
            loss, share = _loss(self.network, pair, self.log_scale)
            torch.autograd.backward(loss / len(batch))
            measures.append((float(loss.detach()), share))
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()
        keep = min(_AVERAGE_DECAY, self.step / (self.step + 50))
        torch._foreach_lerp_(list(self.averaged.parameters()), list(self.network.parameters()), 1 - keep)
        self.step += 1
        return sum(m[0] for m in measures) / len(batch), sum(m[1] for m in measures) / len(batch)

    def _save(self) -> None:
        state: dict[str, Any] = {
            "config": self.config.model_dump_json(),
            "step": self.step,
            "network": self.network.state_dict(),
            "averaged": self.averaged.state_dict(),
            "log_scale": self.log_scale.detach(),
            "optimizer": self.optimizer.state_dict(),
        }
        write_atomically(self.last_path, lambda temporary: torch.save(state, temporary), force=True)

    def _resume(self) -> None:
        try:
            state = torch.load(self.last_path, weights_only=True)
            before = DescriptorTrainConfig.model_validate_json(state["config"])
        except Exception as error:  # torch names no common class for what a damaged file raises
            raise CheckpointError(f"checkpoint '{self.last_path}' cannot be read: {error}") from None
        if before != self.config:
            raise CheckpointError(
                f"'{self.last_path}' was made with other settings: {before.model_dump_json()}; set them "
                "back, or train into another folder"
            )
        self.network.load_state_dict(state["network"])
        self.averaged.load_state_dict(state["averaged"])
        self.optimizer.load_state_dict(state["optimizer"])
        with torch.no_grad():
            self.log_scale.copy_(state["log_scale"])
        self.step = int(state["step"])

    def _finish(self) -> Path:
        path = self.folder / "learned.safetensors"
        save_tensors(self.averaged, path)
        return path


def save_tensors(network: DescriptorNetwork, path: Path) -> None:
    """Write the weights in half precision, as `features.learned` reads them; an old file is replaced."""
    from safetensors.torch import save_file

    tensors = {name: tensor.half().contiguous() for name, tensor in network.state_dict().items()}
    write_atomically(path, lambda temporary: save_file(tensors, temporary), force=True)


def _loss(network: DescriptorNetwork, pair: ContrastPair, log_scale: Tensor) -> tuple[Tensor, float]:
    views = (View.of(levels, rows) for levels, rows in zip(pair.levels, pair.queries, strict=True))
    source, target = (network(view) for view in views)
    apart = torch.from_numpy(pair.apart[0]), torch.from_numpy(pair.apart[1])
    return contrast((source, target), apart, log_scale.exp())
