"""Small training runs: their configuration, a silent display, and whether two runs are the same."""

from __future__ import annotations

import os
from pathlib import Path

import torch

from geomoe3d.config import build_config
from geomoe3d.training.checkpoint import load_checkpoint
from geomoe3d.training.config import TrainConfig
from geomoe3d.training.logs import read_csv

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


def environment(**extra: str) -> dict[str, str]:
    root = str(Path(__file__).parents[1])
    return {**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE", **extra}


def write_yaml(path: Path, tree: dict[str, object]) -> Path:
    import yaml

    path.write_text(yaml.safe_dump(tree))
    return path
