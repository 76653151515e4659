"""Everything that decides a training run, typed; configs/train/*.yaml hold the same tree.

Durations are given in steps (one update of the weights) or as shares of the schedule, so that a shorter
run is the same run in small.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, model_validator

from geomoe3d.config import Section, build_config, read_yaml, set_keys
from geomoe3d.data.draw import DrawSettings
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.training.augment import AugmentationConfig
from geomoe3d.training.image_pairs import ImagePairsConfig
from geomoe3d.training.losses import LossConfig
from geomoe3d.training.synthetic import SyntheticConfig

# Keys that change neither the weights nor their order of updates: free to differ when a run goes on.
FREE_KEYS = ("logging", "validation", "checkpoint_every", "workers", "data.prefetch", "device")


class DataConfig(Section):
    """Where pairs come from."""

    train: str = Field(
        "synthetic", description="synthetic (of networks with 4D input: `images`), or a folder of shards"
    )
    validation: str = Field("synthetic", description="synthetic (other rooms), or a folder of shards")
    correspondences: int | None = Field(1000, ge=3, description="most per training pair; None: all")
    motions_per_pair: int = Field(
        8, ge=2, description="transforms looked at per pair, by networks that score transforms"
    )
    hidden_viewpoints: float = Field(
        0.1, ge=0, le=1, description="share of those pairs whose sensors' places are kept from the network"
    )
    prefetch: int = Field(4, ge=1, description="batches that each worker prepares ahead")
    synthetic: SyntheticConfig = SyntheticConfig()
    images: ImagePairsConfig = Field(
        ImagePairsConfig(), description="generated matches of two images, for networks with 4D input"
    )
    draw: DrawSettings = Field(
        DrawSettings(), description="which pairs of fragments with features are drawn, and how"
    )
    augmentation: AugmentationConfig = AugmentationConfig()


class OptimizerConfig(Section):
    """Adam and its schedule."""

    learning_rate: float = Field(1e-4, gt=0, description="the largest of the schedule")
    schedule: Literal["exponential", "cosine", "one_cycle", "constant"] = "exponential"
    warmup: float = Field(0.0, ge=0, lt=1, description="share of the schedule with a rising rate")
    decay_start: float = Field(0.16, ge=0, le=1, description="share after which exponential decay sets in")
    final_ratio: float = Field(0.186, gt=0, le=1, description="last learning rate over the largest")
    weight_decay: float = Field(0.0, ge=0, description="decoupled (AdamW)")
    max_gradient_norm: float | None = Field(None, gt=0, description="None: no clipping, as published")
    ema_decay: float = Field(
        0.0, ge=0, lt=1, description="averaged weights are validated and shipped; 0: none"
    )


class ValidationConfig(Section):
    """When and on how many pairs a run is judged."""

    every: int = Field(500, ge=1, description="steps")
    num_pairs: int = Field(64, ge=1)
    best_metric: Literal["recall", "f1", "verdict"] = Field(
        "recall", description="what `best` is chosen by; verdict: for networks that score transforms"
    )


class LoggingConfig(Section):
    """What a run writes."""

    every: int = Field(10, ge=1, description="steps per row of the CSV and per TensorBoard point")
    tensorboard: bool = True


class TrainConfig(Section):
    """One training run."""

    seed: int = Field(0, ge=0)
    steps: int = Field(500_000, ge=1)
    batch_size: int = Field(32, ge=1, description="pairs per process and micro-batch")
    accumulation: int = Field(1, ge=1, description="micro-batches per step")
    device: str = Field("auto", description="auto, cpu, cuda, cuda:1")
    precision: Literal["float32", "bf16"] = "float32"
    checkpoint_activations: bool = Field(
        False, description="recompute layers in the backward pass: less memory"
    )
    workers: int = Field(0, ge=0, description="processes that prepare batches")
    checkpoint_every: int = Field(250, ge=1, description="steps")
    init_from: str | None = Field(None, description="weights to start from (safetensors)")
    max_skipped_in_row: int = Field(50, ge=1, description="non-finite steps in a row that end the run")
    network: NetworkConfig = NetworkConfig()
    data: DataConfig = DataConfig()
    loss: LossConfig = LossConfig()
    optimizer: OptimizerConfig = OptimizerConfig()
    validation: ValidationConfig = ValidationConfig()
    logging: LoggingConfig = LoggingConfig()

    @model_validator(mode="after")
    def _check(self) -> TrainConfig:
        given = self.data.augmentation
        if self.network.judges_motions and (given.rotate or given.swap or given.jitter):
            raise ValueError(
                "a network that scores transforms is trained with data.augmentation.rotate=false, swap=0 and "
                "jitter=0: its channels do not change with rotation, and the others would not fit the transforms"
            )
        if self.checkpoint_activations and self.network.kind != "geomoe":
            raise ValueError(
                f"checkpoint_activations is for GeoMoE, not for '{self.network.kind}'; leave it out"
            )
        if self.validation.best_metric == "verdict" and not self.network.judges_motions:
            raise ValueError("validation.best_metric=verdict is for networks that score transforms")
        return self


class TrainingRules(Section):
    """How runs are measured and what they store; these are no settings of one."""

    validation_seed: int = Field(1_000_003, description="of generated pairs to validate on, unlike any run's")
    max_rotation_deg: float = Field(15.0, gt=0, description="degrees; a transform that errs less is right")
    max_translation_voxels: float = Field(6.0, gt=0, description="voxels; likewise")
    learnt_f1: float = Field(0.99, gt=0, lt=1, description="from that F1 on a batch is learnt by heart")
    num_transforms: int = Field(24, ge=1, description="stored for a pair at most")
    pairs_per_shard: int = Field(100, ge=1, description="that are proposed for at a time")


RULES = TrainingRules()


def load_train_config(path: str | None = None, assignments: list[str] | None = None) -> TrainConfig:
    """The run of a YAML file (None: defaults) with ``key=value`` changes.

    A file that says ``base: OTHER.yaml``, beside it, gives only what differs from that one.

    Raises:
        ConfigError: unreadable file, unknown key (names the nearest), value out of range.
    """
    tree = _read_with_base(Path(path)) if path is not None else {}
    return build_config(TrainConfig, set_keys(tree, assignments or []), str(path or "training configuration"))


def _read_with_base(path: Path) -> dict[str, Any]:
    tree = read_yaml(path)
    base = tree.pop("base", None)
    return tree if base is None else _merged(_read_with_base(path.parent / str(base)), tree)


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """``changes`` laid over ``base``, section by section."""
    result = dict(base)
    for key, value in changes.items():
        both = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = _merged(result[key], value) if both else value
    return result
