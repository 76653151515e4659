"""One update of the weights, and what it says about itself.

A step with a non-finite gradient changes nothing: neither weights nor the running statistics that its
forward pass touched.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import nullcontext
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from geomoe3d.networks.build import Network, build_network
from geomoe3d.networks.geomoe import GeoMoEOutput
from geomoe3d.training.batches import Batch
from geomoe3d.training.config import TrainConfig
from geomoe3d.training.losses import Losses, total_loss
from geomoe3d.training.measures import label_measures


def forward(model: nn.Module, batch: Batch, config: TrainConfig) -> GeoMoEOutput:
    """The network on a batch, in bf16 where configured (losses are always float32)."""
    device = batch.labels.device.type
    with torch.autocast(device, torch.bfloat16, enabled=config.precision == "bf16"):
        inputs = batch.input
        output: GeoMoEOutput = model(inputs.coordinates, inputs.channels, inputs.neighbors, inputs.mask)
    return output


def batch_loss(output: GeoMoEOutput, batch: Batch, config: TrainConfig, progress: float) -> Losses:
    """All losses of a batch."""
    inputs = batch.input
    return total_loss(
        output,
        inputs.coordinates,
        batch.labels,
        batch.truth,
        inputs.mask,
        config.loss,
        progress,
        batch.right,
        batch.pair,
    )


class Updater:
    """Accumulates gradients over micro-batches and updates the weights if they are finite."""

    def __init__(
        self, model: Network, wrapped: nn.Module, optimizer: torch.optim.Optimizer, config: TrainConfig
    ) -> None:
        self.model = model
        self.wrapped = wrapped
        self.optimizer = optimizer
        self.config = config
        self._buffers = [b for b in model.buffers() if b.is_floating_point()]
        self._saved = [b.clone() for b in self._buffers]

    def step(
        self, batches: Iterator[Batch], progress: float, rate: float, device: torch.device
    ) -> tuple[bool, dict[str, float]]:
        """Run one step.

        Args:
            batches: as many as ``accumulation`` are taken.
            progress: share of the schedule behind us.
            rate: learning rate.
            device: where the model is.

        Returns:
            Whether the weights were updated, and the measures of the step (mean over micro-batches).
        """
        config = self.config
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        torch._foreach_copy_(self._saved, self._buffers)
        self.optimizer.zero_grad(set_to_none=True)
        measures: dict[str, float] = {}
        for micro in range(config.accumulation):
            batch = next(batches).to(device)
            last = micro == config.accumulation - 1
            alone = isinstance(self.wrapped, DistributedDataParallel) and not last
            with self.wrapped.no_sync() if alone else nullcontext():  # type: ignore[operator]
                output = forward(self.wrapped, batch, config)
                losses = batch_loss(output, batch, config, progress)
                torch.autograd.backward(losses.total / config.accumulation)
            for name, value in _measures(output, losses, batch).items():
                measures[name] = measures.get(name, 0.0) + value / config.accumulation
        norm = _gradient_norm(self.model)
        measures["gradient_norm"] = norm
        if not math.isfinite(norm):
            torch._foreach_copy_(self._buffers, self._saved)
            return False, measures
        if config.optimizer.max_gradient_norm is not None and norm > config.optimizer.max_gradient_norm:
            factor = config.optimizer.max_gradient_norm / norm
            torch._foreach_mul_([p.grad for p in self.model.parameters() if p.grad is not None], factor)
        self.optimizer.step()
        return True, measures


class AveragedWeights:
    """Exponential moving average of parameters; running statistics are copied."""

    def __init__(self, model: Network, decay: float) -> None:
        self.decay = decay
        self.model = build_network(model.config).to(next(model.parameters()).device)
        self.model.load_state_dict(model.state_dict())
        self.model.eval().requires_grad_(False)
        self.num_updates = 0

    @torch.no_grad()
    def update(self, model: Network) -> None:
        """After a step; young averages forget faster."""
        self.num_updates += 1
        decay = min(self.decay, (1 + self.num_updates) / (10 + self.num_updates))
        torch._foreach_lerp_(list(self.model.parameters()), list(model.parameters()), 1 - decay)
        for mine, theirs in zip(self.model.buffers(), model.buffers(), strict=True):
            mine.copy_(theirs)

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"model": self.model.state_dict(), "num_updates": self.num_updates}

    def restore(self, state: dict[str, Any]) -> None:
        """From a checkpoint."""
        self.model.load_state_dict(state["model"])
        self.num_updates = int(state["num_updates"])


def expert_measures(output: GeoMoEOutput) -> dict[str, float]:
    """Usage of every expert and router entropy, per layer and F-MoE; empty without experts."""
    if output.usage is None or output.entropy is None:
        return {}
    values: dict[str, float] = {}
    for layer, (usage, entropy) in enumerate(
        zip(output.usage.tolist(), output.entropy.tolist(), strict=True)
    ):
        for place, (shares, spread) in enumerate(zip(usage, entropy, strict=True)):
            where = f"layer{layer + 1}_moe{place + 1}"
            values[f"{where}_entropy"] = spread
            values |= {f"{where}_expert{i + 1}": share for i, share in enumerate(shares)}
    return values


def _measures(output: GeoMoEOutput, losses: Losses, batch: Batch) -> dict[str, float]:
    labels = label_measures(output.logits[-1].detach(), batch.labels, batch.input.mask)
    values = {
        "loss": losses.total,
        "classification": losses.classification,
        "regression": losses.regression,
        "balance": losses.balance,
        "verdict": losses.verdict,
        "unsolved": losses.num_unsolved,
        **{name: x.mean() for name, x in labels.items()},
        "kept_fraction": output.kept_fraction[-1],
    }
    if output.entropy is not None:
        values["router_entropy"] = output.entropy.mean()
    stacked: list[float] = torch.stack([v.detach().double().cpu() for v in values.values()]).tolist()
    return dict(zip(values, stacked, strict=True)) | expert_measures(output)


def _gradient_norm(model: nn.Module) -> float:
    gradients: list[Tensor] = [p.grad for p in model.parameters() if p.grad is not None]
    return float(torch.stack(torch._foreach_norm(gradients)).norm())
