"""Training in processes of its own: killed and started again, two as one, under torchrun."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from training_runs import TREE, assert_same_run, environment, write_yaml

from geomoe3d.errors import ConfigError
from geomoe3d.training.checkpoint import load_checkpoint
from geomoe3d.training.distributed import Process, choose_device


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
            "--output",
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
from geomoe3d.networks.geomoe import GeoMoE
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
del wrapped, updater
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
        "geomoe3d.cli.main", "train", str(path), "--output", str(tmp_path / "run"), "--quiet",
    ]  # fmt: skip
    for _ in range(2):
        done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        assert done.stdout.count("best at step") == 1
    assert load_checkpoint(tmp_path / "run" / "last.pt")["step"] == 4


@pytest.mark.parametrize("name", ["gpu", "mps", "cuda", "cuda:3"])
def test_a_device_that_is_not_there_is_refused_by_name(name, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match=f"device is '{name[:4]}"):
        choose_device(name, Process())


def test_cuda_alone_means_the_gpu_of_the_process(monkeypatch):
    chosen = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "set_device", chosen.append)
    for name in ("cuda", "auto"):
        assert choose_device(name, Process(rank=1, world=2, local_rank=1)) == torch.device("cuda:1")
    assert chosen == [torch.device("cuda:1")] * 2
    assert choose_device("cpu", Process()) == torch.device("cpu")
