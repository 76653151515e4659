"""Learning one batch by heart: if a network and its losses cannot do that, nothing else will work."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import torch

from geomoe3d.networks.build import build_network
from geomoe3d.training.batches import first_batch
from geomoe3d.training.config import RULES, TrainConfig
from geomoe3d.training.distributed import Process, choose_device
from geomoe3d.training.step import Updater


def overfit_one_batch(
    config: TrainConfig,
    max_steps: int = 400,
    report: Callable[[int, dict[str, float]], None] | None = None,
    learning_rate: float = 1e-3,
) -> tuple[int, float]:
    """Train on the run's first batch alone until its F1 exceeds 0.99.

    Args:
        config: network, losses and data of a run; the schedule is level, and the
            geometric term is on from the start.
        max_steps: give up after so many.
        report: called with step and measures after each.
        learning_rate: of every step.

    Returns:
        Steps taken and the last F1 on the batch (in training mode), also if the target was not reached.
    """
    device = choose_device(config.device, Process())
    batch = first_batch(config)
    torch.manual_seed(config.seed)  # the loader draws a number of its own
    model = build_network(config.network).to(device).train()
    optimizer = torch.optim.AdamW(model.parameters(), lr=learning_rate, weight_decay=0.0)
    updater = Updater(model, model, optimizer, config.model_copy(update={"accumulation": 1}))
    f1 = 0.0
    for step in range(1, max_steps + 1):
        _, measures = updater.step(itertools.repeat(batch), 1.0, learning_rate, device)
        f1 = measures["f1"]
        if report is not None:
            report(step, measures)
        if f1 > RULES.learnt_f1:
            return step, f1
    return max_steps, f1
