"""One step of training: without a finite gradient it changes nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from training_runs import config_of

from geomoe3d.training.batches import training_loader
from geomoe3d.training.step import Updater
from geomoe3d.training.trainer import TrainingRun

pytestmark = pytest.mark.usefixtures("one_thread")


def test_step_without_finite_gradient_changes_nothing_and_is_counted(tmp_path: Path) -> None:
    run = TrainingRun(config_of(), tmp_path)
    updater = Updater(run.model, run.model, run.optimizer, run.config)
    batch = next(iter(training_loader(run.config, run.pairs, 0)))
    before = {k: v.clone() for k, v in run.model.state_dict().items()}
    batch.input.coordinates[0, 0, 0] = float("nan")
    updated, measures = updater.step(iter([batch]), 1.0, 1e-3, run.device)
    assert not updated
    assert not np.isfinite(measures["gradient_norm"])
    after = run.model.state_dict()
    same = [torch.equal(before[k], after[k]) for k in before if "num_batches" not in k]
    assert all(same)
    batch.input.coordinates[0, 0, 0] = 0.0
    updated, _ = updater.step(iter([batch]), 1.0, 1e-3, run.device)
    assert updated
