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

from geomoe3d.config import Section, yaml_text
from geomoe3d.errors import CheckpointError
from geomoe3d.features.learned import LEARNED, load_tensors
from geomoe3d.runtime.files import make_folder, write_atomically, write_text
from geomoe3d.runtime.provenance import differences, in_words
from geomoe3d.training.descriptor_network import DescriptorNetwork
from geomoe3d.training.descriptor_pairs import ContrastBatch, ContrastPairs
from geomoe3d.training.distributed import Process, choose_device

_FREE_KEYS = {"device", "save_every"}  # may differ when a run goes on


class DescriptorTrainConfig(Section):
    """One run."""

    data: tuple[str, ...] = Field(("runs/training-set/features",), description="folders of shards")
    seed: int = Field(0, ge=0)
    steps: int = Field(8000, ge=1, description="updates of the weights")
    batch_size: int = Field(2, ge=1, description="pairs per step")
    device: str = Field("auto", description="auto, cpu, cuda, cuda:1")
    init_from: str | None = Field(None, description="weights to start from (learned.safetensors)")
    width: int = Field(64, ge=4, description="channels")
    learning_rate: float = Field(2e-3, gt=0, description="the largest of the schedule")
    weight_decay: float = Field(1e-3, ge=0)
    leave_out: int = Field(3, ge=0, description="scenes, the first by name, kept for validation")
    num_shared: int = Field(300, ge=1, description="corresponding points asked of each fragment, at most")
    num_random: int = Field(500, ge=0, description="further points asked of each")
    validation_pairs: int = Field(24, ge=1)
    save_every: int = Field(250, ge=1, description="steps")


def contrast(
    features: Tensor, apart: Tensor, scale: Tensor, *, right_to: float = 2.0, wrong_from: float = 3.0
) -> tuple[Tensor, Tensor]:
    """How far the shared points are from finding each other among all points asked, and how many do.

    -log of the softmax weight of all that is right, against all that is wrong, mean over all of them.

    Args:
        features: (2 P, q, D) of P pairs, source and target in turn, unit length.
        apart: (2 P, m, q), see `ContrastBatch`.
        scale: similarity counts so many times.
        right_to: voxels; a match so near is right, as in registration.
        wrong_from: voxels; one farther off is wrong; those between count as neither.

    Returns:
        The loss, and the share of shared points whose most similar point is right.

    Source: the loss of contrastive predictive coding (van den Oord et al., 2018) with several right answers.
    """
    pairs, q, width = features.shape
    other = features.view(pairs // 2, 2, q, width).flip(1).flatten(0, 1)
    logit = scale * features[:, : apart.shape[1]] @ other.transpose(1, 2)
    never = -1e4
    right = logit.masked_fill(apart > right_to, never).logsumexp(2)
    wrong = logit.masked_fill(apart < wrong_from, never).logsumexp(2)
    best = apart.gather(2, logit.detach().argmax(2, keepdim=True))
    return (torch.logaddexp(right, wrong) - right).mean(), (best <= right_to).float().mean()


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
        make_folder(folder)
        torch.manual_seed(config.seed)
        self.device = choose_device(config.device, Process())
        self.network = DescriptorNetwork(config.width).to(self.device)
        if config.init_from is not None:
            self._start_from(Path(config.init_from))
        self.averaged = DescriptorNetwork(config.width).to(self.device).requires_grad_(False)
        self.averaged.load_state_dict(self.network.state_dict())
        self.log_scale = torch.nn.Parameter(torch.tensor(3.2, device=self.device))
        self.optimizer = torch.optim.AdamW(
            [*self.network.parameters(), self.log_scale],
            lr=config.learning_rate,
            weight_decay=config.weight_decay,
        )
        self.step = 0
        if self.last_path.exists():
            self._resume()
        else:
            write_text(folder / "config.yaml", yaml_text(config), force=True)

    @property
    def last_path(self) -> Path:
        """Checkpoint that a restart goes on from."""
        return self.folder / "last.pt"

    def train(self, report: Callable[[str], None] = print, until: int | None = None) -> Path | None:
        """To the end of the schedule, then the weights' path; or to step ``until``, then None."""
        config = self.config
        pairs = self._pairs(config.seed, config.leave_out)
        validation = self._pairs(config.seed + 1, -config.leave_out) if config.leave_out else None
        sums = torch.zeros(2, device=self.device)
        since = self.step
        last = min(until or config.steps, config.steps)
        while self.step < last:
            sums += self._update(pairs.batch(self.step, config.batch_size))
            if self.step % config.save_every == 0 or self.step == last:
                self._save()
                loss, share = (sums / (self.step - since)).tolist()
                sums, since = torch.zeros_like(sums), self.step
                found = math.nan if validation is None else self.validate(validation)
                line = f"{self.step},{loss:.4f},{share:.4f},{found:.4f},{time.time():.0f}"
                with (self.folder / "log.csv").open("a") as log:
                    log.write(line + "\n")
                report(f"step, loss, found, found in validation, time: {line}")
        return self._finish() if self.step == config.steps else None

    @torch.no_grad()
    def validate(self, pairs: ContrastPairs) -> float:
        """Share of shared points found by the averaged weights in pairs of scenes left out."""
        found = [self._loss(self.averaged, pairs.batch(k, 1))[1] for k in range(self.config.validation_pairs)]
        return float(torch.stack(found).mean())

    def _pairs(self, seed: int, leave_out: int) -> ContrastPairs:
        config = self.config
        counts = {"num_shared": config.num_shared, "num_random": config.num_random}
        return ContrastPairs(list(config.data), seed, self.device, leave_out=leave_out, **counts)

    def _update(self, batch: ContrastBatch) -> Tensor:
        """One step; loss and share found."""
        falling = 0.03 + 0.97 * 0.5 * (1 + math.cos(math.pi * self.step / self.config.steps))
        rate = min(1.0, (self.step + 1) / 100) * falling
        for group in self.optimizer.param_groups:
            group["lr"] = rate * self.config.learning_rate
        self.optimizer.zero_grad()
        loss, share = self._loss(self.network, batch)
        torch.autograd.backward(loss)
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()
        keep = min(0.995, self.step / (self.step + 50))
        torch._foreach_lerp_(list(self.averaged.parameters()), list(self.network.parameters()), 1 - keep)
        self.step += 1
        return torch.stack([loss.detach(), share])

    def _loss(self, network: DescriptorNetwork, batch: ContrastBatch) -> tuple[Tensor, Tensor]:
        features = network(batch.view).view(len(batch.apart), -1, LEARNED)
        return contrast(features, batch.apart, self.log_scale.exp())

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

    def _start_from(self, path: Path) -> None:
        tensors = {name: torch.from_numpy(tensor) for name, tensor in load_tensors(path).items()}
        try:
            self.network.load_state_dict(tensors)
        except RuntimeError as error:
            raise CheckpointError(f"'{path}' does not fit width {self.config.width}: {error}") from None

    def _resume(self) -> None:
        try:
            state = torch.load(self.last_path, map_location=self.device, weights_only=True)
            before = DescriptorTrainConfig.model_validate_json(state["config"])
        except Exception as error:  # torch names no common class for what a damaged file raises
            raise CheckpointError(f"checkpoint '{self.last_path}' cannot be read: {error}") from None
        there, now = (one.model_dump(mode="json", exclude=_FREE_KEYS) for one in (before, self.config))
        if there != now:
            raise CheckpointError(
                f"'{self.last_path}' was made with other settings; set them back, or train into another folder. "
                f"They differ in {in_words(differences(there, now))}"
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

    tensors = {name: tensor.half().cpu().contiguous() for name, tensor in network.state_dict().items()}
    write_atomically(path, lambda temporary: save_file(tensors, temporary), force=True)
