"""Training runs: exact resume, everything that was promised, skipped steps, notes and refusals."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from training_runs import TREE, Silent, assert_same_run, config_of

from geomoe3d.errors import CheckpointError, GeoMoE3DError, OutputError
from geomoe3d.networks.pretrained import load_pretrained
from geomoe3d.training.checkpoint import load_checkpoint, save_checkpoint
from geomoe3d.training.logs import read_csv
from geomoe3d.training.step import Updater
from geomoe3d.training.synthetic import SyntheticConfig, SyntheticPairs
from geomoe3d.training.trainer import TrainingRun

pytestmark = pytest.mark.usefixtures("one_thread")


def test_resumed_equals_uninterrupted_bit_for_bit(tmp_path: Path) -> None:
    config = config_of()
    whole = Silent()
    summary = TrainingRun(config, tmp_path / "a").train(whole)
    assert summary.finished
    assert whole.steps == [1, 2, 3, 4, 5, 6]
    assert whole.validations == [3, 6]
    first = TrainingRun(config, tmp_path / "b").train(Silent(), until=3)
    assert not first.finished
    # What a kill leaves behind after the checkpoint must vanish: rows of steps that are done again.
    with (tmp_path / "b" / "train.csv").open("a") as file:
        file.write("4,9,9,9,9,9,9,9,9,9,9,9,9,9,9\n5,1")
    rest = Silent()
    TrainingRun(config, tmp_path / "b").train(rest)
    assert rest.steps == [4, 5, 6]
    assert_same_run(tmp_path / "a", tmp_path / "b")


def test_finished_run_leaves_everything_that_was_promised(tmp_path: Path) -> None:
    summary = TrainingRun(config_of(), tmp_path).train(Silent())
    names = {path.name for path in tmp_path.iterdir()}
    wanted = {"config.yaml", "train.csv", "experts.csv", "validation.csv", "last.pt", "best.pt"}
    assert wanted | {"weights.safetensors", "weights.json", "curves.png"} <= names
    assert not [n for n in names if n.startswith(".")]
    assert [int(r["step"]) for r in read_csv(tmp_path / "train.csv")] == [2, 4, 6]
    usage = read_csv(tmp_path / "experts.csv")[-1]
    shares = [float(usage[f"layer1_moe1_expert{i}"]) for i in (1, 2, 3, 4)]
    assert sum(shares) == pytest.approx(1.0, abs=1e-5)
    assert summary.weights is not None
    model, card = load_pretrained(summary.weights)
    assert card.steps == summary.best_step
    assert card.metrics == summary.best
    assert card.training_data.startswith("synthetic:")
    best = load_checkpoint(tmp_path / "best.pt")
    assert all(torch.equal(v, best["model"][k]) for k, v in model.state_dict().items())
    assert best["commit"]
    assert json.loads(best["config"])["steps"] == 6


def test_run_that_is_asked_to_stop_ends_after_its_step_with_a_checkpoint(tmp_path: Path) -> None:
    class Stopper(Silent):
        def stepped(self, step: int, measures: dict[str, float], pairs_per_s: float, skipped: int) -> None:
            run.stop = step == 3

    run = TrainingRun(config_of(), tmp_path)
    summary = run.train(Stopper())
    assert not summary.finished
    assert summary.weights is None
    assert load_checkpoint(tmp_path / "last.pt")["step"] == 3


@pytest.mark.slow
def test_tensorboard_gets_every_scalar_once(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    config = config_of(logging={"every": 2, "tensorboard": True})
    TrainingRun(config, tmp_path).train(Silent(), until=4)
    TrainingRun(config, tmp_path).train(Silent())
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    tags = events.Tags()["scalars"]
    assert {"train/loss", "validation/registration_recall", "experts/layer2_moe2_entropy"} <= set(tags)
    assert [event.step for event in events.Scalars("train/loss")] == [2, 4, 6]
    rows = read_csv(tmp_path / "train.csv")
    for event, row in zip(events.Scalars("train/loss"), rows, strict=True):
        assert event.value == pytest.approx(float(row["loss"]), rel=1e-5)


def test_going_on_with_other_settings_or_data_is_refused(tmp_path: Path) -> None:
    TrainingRun(config_of(), tmp_path).train(Silent(), until=2)
    with pytest.raises(CheckpointError, match=r"optimizer\.learning_rate"):
        TrainingRun(config_of(optimizer={"learning_rate": 1e-3, "ema_decay": 0.9}), tmp_path)
    with pytest.raises(OutputError, match="holds a run"):
        TrainingRun(config_of(), tmp_path, fresh=True)
    TrainingRun(config_of(logging={"every": 1, "tensorboard": False}), tmp_path)
    last = tmp_path / "last.pt"
    last.write_bytes(last.read_bytes()[:2000])
    with pytest.raises(CheckpointError, match="cannot be read"):
        TrainingRun(config_of(), tmp_path)


def test_one_skipped_step_spoils_neither_the_log_nor_the_display(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from geomoe3d.cli import train_display
    from geomoe3d.runtime import progress

    monkeypatch.setattr(progress, "_LOG_SECONDS", 0.0)
    step = Updater.step
    calls = []

    def failing(self: Updater, *arguments: Any) -> tuple[bool, dict[str, float]]:
        updated, measures = step(self, *arguments)
        calls.append(updated)
        bad = len(calls) in (1, 4)
        return (False, dict.fromkeys(measures, float("nan"))) if bad else (updated, measures)

    monkeypatch.setattr(Updater, "step", failing)
    with train_display.Display() as display:
        TrainingRun(config_of(), tmp_path).train(display)
    (shown,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("6 of 6 steps")]
    assert "nan" not in shown and "loss" in shown
    rows = read_csv(tmp_path / "train.csv")
    assert [int(row["skipped"]) for row in rows] == [1, 2, 2]
    assert all(np.isfinite(float(row["loss"])) for row in rows)


def test_going_on_with_another_number_of_processes_is_refused(tmp_path: Path) -> None:
    run = TrainingRun(config_of(), tmp_path)
    run.train(Silent(), until=2)
    state = load_checkpoint(tmp_path / "last.pt")
    own = {k: v for k, v in state.items() if k not in {"format", "version", "config", "data", "commit"}}
    save_checkpoint(tmp_path / "last.pt", {**own, "world": 2}, run.config, run.pairs.identity())
    with pytest.raises(CheckpointError, match="by 2 processes, now 1"):
        TrainingRun(config_of(), tmp_path)


def test_run_of_skipped_steps_ends_with_a_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = TrainingRun(config_of(max_skipped_in_row=3), tmp_path)
    monkeypatch.setattr(Updater, "step", lambda *_: (False, {"loss": float("nan")}))
    with pytest.raises(GeoMoE3DError, match="3 steps in a row"):
        run.train(Silent())
    assert run.progress.skipped == 3


@pytest.mark.parametrize(
    "changes", [{"precision": "bf16"}, {"checkpoint_activations": True}, {"accumulation": 2}]
)
def test_other_ways_to_train_run_through(tmp_path: Path, changes: dict[str, object]) -> None:
    summary = TrainingRun(config_of(steps=2, **changes), tmp_path).train(Silent())
    assert summary.finished
    assert summary.skipped == 0


def test_run_starts_from_given_weights(tmp_path: Path) -> None:
    TrainingRun(config_of(steps=2), tmp_path / "a").train(Silent())
    weights = tmp_path / "a" / "weights.safetensors"
    run = TrainingRun(config_of(init_from=str(weights)), tmp_path / "b")
    model, _ = load_pretrained(weights)
    assert all(torch.equal(v, model.state_dict()[k]) for k, v in run.model.state_dict().items())
    wide = {**TREE["network"], "width": 32}  # type: ignore[dict-item]
    with pytest.raises(CheckpointError, match="another architecture"):
        TrainingRun(config_of(init_from=str(weights), network=wide), tmp_path / "c")
    run.train(Silent(), until=1)
    weights.unlink()  # a run that goes on no longer needs them
    assert TrainingRun(config_of(init_from=str(weights)), tmp_path / "b").progress.step == 1


def test_training_from_shards_with_workers(tmp_path: Path) -> None:
    from geomoe3d.training.pairs import write_shard

    source = SyntheticPairs(SyntheticConfig(correspondences=(50, 70), inlier_ratio=(0.2, 0.6)))
    write_shard(tmp_path / "s", [source[i] for i in range(5)])
    (tmp_path / "shards").mkdir()
    (tmp_path / "s").rename(tmp_path / "shards" / "s")
    data = {"train": str(tmp_path / "shards"), "validation": str(tmp_path / "shards"), "correspondences": 50}
    results = []
    for workers in (0, 1):
        folder = tmp_path / f"run{workers}"
        TrainingRun(config_of(data=data, workers=workers, steps=3), folder).train(Silent())
        results.append(read_csv(folder / "validation.csv"))
        _, card = load_pretrained(folder / "weights.safetensors")
        sizes = [source[i].voxel_size for i in range(5)]
        assert card.voxel_size is not None
        assert list(card.voxel_size) == [min(sizes), max(sizes)]
    for a, b in zip(*results, strict=True):
        assert {k: float(v) for k, v in a.items()} == pytest.approx(
            {k: float(v) for k, v in b.items()}, abs=0.05
        )


def test_validation_on_generated_pairs_only_is_said_when_training_is_on_others(tmp_path: Path) -> None:
    from geomoe3d.training.pairs import write_shard

    (tmp_path / "shards").mkdir()
    write_shard(tmp_path / "shards" / "a", [SyntheticPairs(SyntheticConfig())[0]])
    folder = str(tmp_path / "shards")
    said = TrainingRun(config_of(data={"train": folder}), tmp_path / "a").notes
    assert [note for note in said if "data.validation" in note]
    assert not TrainingRun(config_of(data={"train": folder, "validation": folder}), tmp_path / "b").notes
    assert not TrainingRun(config_of(), tmp_path / "c").notes
