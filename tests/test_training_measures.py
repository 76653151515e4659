"""Measures of validation: labels by hand, motions found or not, a model left as it was."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from training_runs import config_of

from geomoe3d.training.batches import make_sample
from geomoe3d.training.measures import best_of_pair, evaluate, label_measures, motion_found
from geomoe3d.training.synthetic import SyntheticConfig, SyntheticPairs
from geomoe3d.training.trainer import TrainingRun

pytestmark = pytest.mark.usefixtures("one_thread")


def test_measures_by_hand() -> None:
    logits = torch.tensor([[1.0, 1, -1, -1], [-1, -1, -1, -1], [1, 1, 1, 1]])
    labels = torch.tensor([[True, False, True, False], [True, False, False, False], [False] * 4])
    values = label_measures(logits, labels, None)
    assert values["precision"].tolist() == [0.5, 0, 0]
    assert values["recall"].tolist() == [0.5, 0, 0]
    assert values["f1"].tolist() == [0.5, 0, 0]
    mask = torch.tensor([[True, False, True, True]] * 3)
    assert label_measures(logits, labels & mask, mask)["precision"].tolist() == [1.0, 0, 0]


def test_motion_is_found_by_true_weights_and_not_by_none() -> None:
    from geomoe3d.networks.architecture import NetworkConfig

    network = NetworkConfig()
    config = SyntheticConfig(inlier_ratio=(0.2, 0.5), noise=(0.1, 0.2))
    samples = [make_sample(SyntheticPairs(config)[i], network) for i in range(4)]
    coordinates = torch.stack([s.inputs[0].coordinates for s in samples])
    truth = torch.stack([s.truth for s in samples])
    labels = torch.stack([s.labels for s in samples])
    logits = torch.where(labels, 2.0, -2.0)
    assert motion_found(logits, coordinates, truth, 20.0).all()
    assert not motion_found(-torch.ones_like(logits), coordinates, truth, 20.0).any()
    inverted = torch.linalg.inv(truth)
    assert not motion_found(logits, coordinates, inverted, 20.0).any()
    # The limits are strict and in voxels: 6 voxels are 0.3 network units.
    for offset, found in ((0.25, True), (0.35, False)):
        moved = truth.clone()
        moved[:, 0, 3] += offset
        assert motion_found(logits, coordinates, moved, 20.0).all() == found


def test_evaluation_leaves_the_model_in_training_mode(tmp_path: Path) -> None:
    run = TrainingRun(config_of(), tmp_path)
    pairs = SyntheticPairs(run.config.data.synthetic, 5)
    samples = [make_sample(pairs[i], run.config.network) for i in range(3)]
    before = {k: v.clone() for k, v in run.model.state_dict().items()}
    together = evaluate(run.model, samples, run.device, batch_size=3)
    alone = evaluate(run.model, samples, run.device, batch_size=1)
    assert together == pytest.approx(alone, abs=1e-6)
    assert run.model.training
    assert all(torch.equal(v, before[k]) for k, v in run.model.state_dict().items())


def test_the_best_of_each_pair() -> None:
    best = best_of_pair(torch.tensor([0.0, 5.0, 1.0, 7.0, 7.0]), torch.tensor([0, 0, 1, 1, 1]))
    assert best.tolist() == [1, 3]
