"""Training runs: exact resume, two processes as one, skipped steps, overfitting, the train verb."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from geomoe3d.config import build_config
from geomoe3d.errors import CheckpointError, GeoMoE3DError, OutputError
from geomoe3d.filters.pretrained import load_pretrained
from geomoe3d.training.batches import make_sample, training_loader
from geomoe3d.training.checkpoint import check_same_run, load_checkpoint, save_checkpoint
from geomoe3d.training.config import TrainConfig
from geomoe3d.training.logs import CsvLog, read_csv
from geomoe3d.training.measures import evaluate, label_measures, motion_found
from geomoe3d.training.overfit import overfit_one_batch
from geomoe3d.training.step import Updater
from geomoe3d.training.synthetic import SyntheticConfig, SyntheticPairs
from geomoe3d.training.trainer import TrainingRun

TREE = {
    "steps": 6,
    "batch_size": 2,
    "checkpoint_every": 2,
    "network": {"num_layers": 2, "width": 16, "num_sub_fields": 6, "num_heads": 2, "expert_width": 4},
    "data": {"correspondences": 60, "synthetic": {"correspondences": [50, 70], "inlier_ratio": [0.2, 0.6]}},
    "optimizer": {"learning_rate": 2e-3, "ema_decay": 0.9},
    "validation": {"every": 3, "num_pairs": 4},
    "logging": {"every": 2, "tensorboard": False},
}


def config_of(**changes: object) -> TrainConfig:
    return build_config(TrainConfig, {**TREE, **changes})


pytestmark = pytest.mark.usefixtures("one_thread")


class Silent:
    def __init__(self) -> None:
        self.steps: list[int] = []
        self.validations: list[int] = []

    def started(self, config: TrainConfig, first_step: int, notes: list[str]) -> None:
        pass

    def stepped(self, step: int, measures: dict[str, float], pairs_per_s: float, skipped: int) -> None:
        self.steps.append(step)

    def validated(self, step: int, measures: dict[str, float], best: bool) -> None:
        self.validations.append(step)


def tensors(folder: Path) -> dict[str, torch.Tensor]:
    state = load_checkpoint(folder / "last.pt")
    flat = {f"model.{k}": v for k, v in state["model"].items()}
    flat |= {f"averaged.{k}": v for k, v in state["averaged"]["model"].items()}
    for i, moments in state["optimizer"]["state"].items():
        flat |= {f"optimizer.{i}.{k}": torch.as_tensor(v) for k, v in moments.items()}
    return flat


def assert_same_run(a: Path, b: Path) -> None:
    left, right = tensors(a), tensors(b)
    assert left.keys() == right.keys()
    different = [name for name in left if not torch.equal(left[name], right[name])]
    assert not different
    for name in ("train.csv", "experts.csv", "validation.csv"):
        rows = [
            [{k: v for k, v in r.items() if k != "pairs_per_s"} for r in read_csv(f / name)] for f in (a, b)
        ]
        assert rows[0] == rows[1], name
    assert (a / "weights.safetensors").read_bytes() == (b / "weights.safetensors").read_bytes()


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


def test_one_skipped_step_spoils_neither_the_log_nor_the_display(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from geomoe3d.cli import train_display

    monkeypatch.setattr(train_display, "_PLAIN_EVERY_S", 0.0)
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
    (shown,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("step 6/6")]
    assert "nan" not in shown
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


def test_checkpoint_with_settings_of_another_version_is_refused_by_name(tmp_path: Path) -> None:
    config = config_of()
    state = {"config": json.dumps({**config.model_dump(), "network": {"num_towers": 3}}), "data": ""}
    with pytest.raises(CheckpointError, match=r"another version.*network\.num_towers"):
        check_same_run(state, config, "", tmp_path / "last.pt")


def test_run_of_skipped_steps_ends_with_a_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = TrainingRun(config_of(max_skipped_in_row=3), tmp_path)
    monkeypatch.setattr(Updater, "step", lambda *_: (False, {"loss": float("nan")}))
    with pytest.raises(GeoMoE3DError, match="3 steps in a row"):
        run.train(Silent())
    assert run.progress.skipped == 3


def test_one_batch_is_learnt_by_heart() -> None:
    config = config_of(
        batch_size=3,
        network={**TREE["network"], "width": 32, "extra_channels": ["compatibility"],  # type: ignore[dict-item]
                 "knn_space": "compatibility"},
    )  # fmt: skip
    steps, f1 = overfit_one_batch(config, 300)
    assert f1 > 0.99
    assert steps < 300


@pytest.mark.slow
def test_faithful_form_learns_one_batch_by_heart() -> None:
    network = {**TREE["network"], "width": 64, "num_sub_fields": 12}  # type: ignore[dict-item]
    _, f1 = overfit_one_batch(config_of(batch_size=2, network=network), 400)
    assert f1 > 0.99


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
    from geomoe3d.filters.architecture import NetworkConfig

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


def test_csv_log_survives_a_torn_line(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    log = CsvLog(path, ["a", "b"], 0)
    log.add(1, {"a": 0.5, "b": 1})
    log.add(2, {"a": 0.25})
    with path.open("a") as file:
        file.write("3,0.")
    CsvLog(path, ["a", "b"], 2).add(3, {"b": 7})
    assert [(r["step"], r["a"], r["b"]) for r in read_csv(path)] == [
        ("1", "0.5", "1"),
        ("2", "0.25", ""),
        ("3", "", "7"),
    ]


# -- whole processes ---------------------------------------------------------------------------------------


def environment(**extra: str) -> dict[str, str]:
    root = str(Path(__file__).parents[1])
    return {**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE", **extra}


def write_yaml(path: Path, tree: dict[str, object]) -> Path:
    import yaml

    path.write_text(yaml.safe_dump(tree))
    return path


@pytest.mark.slow
def test_killed_at_any_moment_and_started_again_gives_the_same_run(tmp_path: Path) -> None:
    path = write_yaml(tmp_path / "c.yaml", {**TREE, "steps": 24, "checkpoint_every": 4})

    def start(folder: Path) -> subprocess.Popen[bytes]:
        command = [
            sys.executable,
            "-m",
            "geomoe3d.cli.main",
            "train",
            str(path),
            "--out",
            str(folder),
            "--quiet",
        ]
        return subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE)

    process = start(tmp_path / "killed")
    deadline = time.monotonic() + 120
    while not (tmp_path / "killed" / "last.pt").exists() and time.monotonic() < deadline:
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert load_checkpoint(tmp_path / "killed" / "last.pt")["step"] < 24
    for folder in ("killed", "whole"):
        process = start(tmp_path / folder)
        _, errors = process.communicate(timeout=240)
        assert process.returncode == 0, errors.decode()
    assert_same_run(tmp_path / "killed", tmp_path / "whole")


_WORKER = """
import sys, torch
from geomoe3d.config import build_config
from geomoe3d.training.config import TrainConfig
from geomoe3d.training.distributed import join, leave
from geomoe3d.training.batches import open_training, training_loader
from geomoe3d.training.step import Updater
from geomoe3d.filters.geomoe import GeoMoE
import json
tree = json.loads(sys.argv[1])
config = build_config(TrainConfig, tree)
process = join()
torch.manual_seed(0)
model = GeoMoE(config.network).train()
wrapped = torch.nn.parallel.DistributedDataParallel(model) if process.world > 1 else model
loader = training_loader(config, open_training(config), 0, process.rank, process.world)
updater = Updater(model, wrapped, torch.optim.SGD(model.parameters(), lr=0.0), config)
updated, measures = updater.step(iter(loader), 1.0, 0.0, torch.device("cpu"))
assert updated
if process.is_first:
    torch.save({n: p.grad for n, p in model.named_parameters()}, sys.argv[2])
leave()
"""


@pytest.mark.slow
def test_two_gloo_processes_give_the_gradients_of_one_with_accumulation(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])

    def start(rank: int, world: int, accumulation: int, out: Path) -> subprocess.Popen[bytes]:
        tree = json.dumps({**TREE, "accumulation": accumulation})
        extra = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "RANK": str(rank), "WORLD_SIZE": str(world)}
        command = [sys.executable, "-c", _WORKER, tree, str(out)]
        return subprocess.Popen(command, env=environment(**extra), stderr=subprocess.PIPE)

    jobs = [start(rank, 2, 1, tmp_path / "two.pt") for rank in range(2)]
    jobs.append(start(0, 1, 2, tmp_path / "one.pt"))
    for job in jobs:
        _, errors = job.communicate(timeout=240)
        assert job.returncode == 0, errors.decode()
    one, two = torch.load(tmp_path / "one.pt"), torch.load(tmp_path / "two.pt")
    assert one.keys() == two.keys()
    for name in one:
        torch.testing.assert_close(two[name], one[name], atol=1e-6, rtol=1e-4)
    assert sum(float(g.abs().sum()) for g in one.values()) > 1


@pytest.mark.slow
def test_torchrun_trains_and_resumes(tmp_path: Path) -> None:
    path = write_yaml(tmp_path / "c.yaml", {**TREE, "steps": 4, "validation": {"every": 2, "num_pairs": 2}})
    command = [
        sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", "-m",
        "geomoe3d.cli.main", "train", str(path), "--out", str(tmp_path / "run"), "--quiet",
    ]  # fmt: skip
    for _ in range(2):
        done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        assert done.stdout.count("best at step") == 1
    assert load_checkpoint(tmp_path / "run" / "last.pt")["step"] == 4


@pytest.mark.slow
def test_train_verb_says_what_is_wrong_and_overfits(tmp_path: Path) -> None:
    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "geomoe3d.cli.main", "train", *arguments]
        return subprocess.run(
            command, env=environment(), capture_output=True, text=True, timeout=300, cwd=tmp_path
        )

    path = str(write_yaml(tmp_path / "c.yaml", TREE))
    wrong = call(path, "network.num_layer=3")
    assert wrong.returncode == 2
    assert "network.num_layers" in wrong.stderr
    assert not (tmp_path / "runs").exists()
    shown = call(path, "steps=7", "--show")
    assert shown.returncode == 0
    assert "steps: 7" in shown.stdout
    network = {"num_layers": 2, "width": 32, "num_sub_fields": 6, "num_heads": 2}
    network |= {"knn_space": "compatibility", "extra_channels": ["compatibility"]}
    learnt = call(path, "--overfit", "--quiet", f"network={json.dumps(network)}")
    assert learnt.returncode == 0, learnt.stderr
    assert "F1" in learnt.stdout
