"""From pairs to batches, in an order that depends on seed and step alone.

Sample k of a run is the same pair with the same augmentation whether the run was interrupted or not, and
however many processes share it: with W processes and A micro-batches, block m W + r of a step goes to
process r as its micro-batch m, so two processes do what one does with twice the accumulation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from geomoe3d.data.shards import is_shard
from geomoe3d.errors import InputError
from geomoe3d.filters.architecture import NetworkConfig
from geomoe3d.filters.inputs import BatchInput, PairInput, collate, pair_input
from geomoe3d.training.augment import augment
from geomoe3d.training.config import DataConfig, TrainConfig
from geomoe3d.training.fragment_pairs import FragmentPairs
from geomoe3d.training.losses import network_motion
from geomoe3d.training.pairs import PairDataset, ShardFolder, TrainingPair
from geomoe3d.training.synthetic import SyntheticPairs

_VALIDATION_SEED = 1_000_003


@dataclass(frozen=True)
class Sample:
    """One pair, ready for the network: input, labels (N,) and true motion (4, 4) in network units."""

    input: PairInput
    labels: Tensor
    truth: Tensor


@dataclass(frozen=True)
class Batch:
    """Samples padded to the longest: labels (B, N) bool, False at padding; truth (B, 4, 4) float32."""

    input: BatchInput
    labels: Tensor
    truth: Tensor

    def to(self, device: torch.device) -> Batch:
        """The same batch on another device."""
        labels, truth = (x.to(device, non_blocking=True) for x in (self.labels, self.truth))
        return Batch(self.input.to(device), labels, truth)


def open_pairs(where: str, data: DataConfig, seed: int) -> PairDataset:
    """The dataset that a configuration names: ``synthetic`` or a folder of shards, of either kind.

    Shards of described fragments (``geomoe3d data features``) give fresh correspondences without end, shards
    of correspondences (`write_shard`) those that they hold.
    """
    if where == "synthetic":
        return SyntheticPairs(data.synthetic, seed)
    if Path(where).is_dir() and any(is_shard(path) for path in Path(where).iterdir()):
        return FragmentPairs(where, seed=seed, verify=True)
    return ShardFolder(where)


def open_training(config: TrainConfig) -> PairDataset:
    """Training pairs of a run."""
    return open_pairs(config.data.train, config.data, config.seed)


def open_validation(config: TrainConfig) -> PairDataset:
    """Validation pairs; generated ones come from other rooms, the same for every training seed."""
    return open_pairs(config.data.validation, config.data, _VALIDATION_SEED)


def make_sample(pair: TrainingPair, network: NetworkConfig) -> Sample:
    """A pair as network input with its truth in network units.

    Raises:
        InputError: the pair cannot be used (see `pair_input`).
    """
    points = torch.from_numpy(pair.correspondences).double()
    inputs = pair_input(
        points,
        pair.voxel_size,
        network,
        feature_distance=pair.feature_distance,
        ratio=pair.ratio,
        mutual=pair.mutual,
    )
    truth = network_motion(
        points, torch.from_numpy(pair.T_target_source), pair.voxel_size, network.unit_voxels
    )
    return Sample(inputs, torch.from_numpy(np.ascontiguousarray(pair.labels)), truth.float())


def make_batch(samples: list[Sample]) -> Batch:
    """Stack samples."""
    longest = max(len(s.labels) for s in samples)
    labels = torch.stack([torch.nn.functional.pad(s.labels, (0, longest - len(s.labels))) for s in samples])
    return Batch(collate([s.input for s in samples]), labels, torch.stack([s.truth for s in samples]))


class TrainingSamples(Dataset[Sample]):
    """Sample number -> augmented pair, without end: epoch after epoch, each in its own order."""

    def __init__(self, pairs: PairDataset, config: TrainConfig) -> None:
        self.pairs = pairs
        self.config = config
        self._order: tuple[int, Any] = (-1, None)

    def __getitem__(self, number: int) -> Sample:
        data = self.config.data
        pair = self.pairs[self._index(number)]
        rng = np.random.default_rng([self.config.seed, 77, number])
        changed = augment(pair, data.augmentation, data.correspondences, rng)
        try:
            return make_sample(changed, self.config.network)
        except InputError as error:
            raise type(error)(f"training pair {self._index(number)}: {error}") from None

    def _index(self, number: int) -> int:
        size = len(self.pairs)
        if size > 1 << 32:  # generated without end: no order to shuffle
            return number % size
        epoch, place = divmod(number, size)
        if self._order[0] != epoch:
            self._order = (epoch, np.random.default_rng([self.config.seed, 13, epoch]).permutation(size))
        return int(self._order[1][place])


class StepSampler(Sampler[list[int]]):
    """Sample numbers of each micro-batch of this process, from a given step on."""

    def __init__(self, config: TrainConfig, first_step: int, rank: int = 0, world: int = 1) -> None:
        self.config = config
        self.first_step = first_step
        self.rank = rank
        self.world = world

    def __iter__(self) -> Iterator[list[int]]:
        size, accumulation = self.config.batch_size, self.config.accumulation
        for step in range(self.first_step, self.config.steps):
            for micro in range(accumulation):
                block = (step * accumulation + micro) * self.world + self.rank
                yield list(range(block * size, (block + 1) * size))

    def __len__(self) -> int:
        return (self.config.steps - self.first_step) * self.config.accumulation


def training_loader(
    config: TrainConfig, pairs: PairDataset, first_step: int, rank: int = 0, world: int = 1
) -> DataLoader[Batch]:
    """Batches from ``first_step`` on."""
    return DataLoader(
        TrainingSamples(pairs, config),  # type: ignore[arg-type]
        batch_sampler=StepSampler(config, first_step, rank, world),
        num_workers=config.workers,
        collate_fn=make_batch,
        prefetch_factor=config.data.prefetch if config.workers else None,
        worker_init_fn=partial(_worker_init),
    )


def validation_samples(config: TrainConfig) -> list[Sample]:
    """The first pairs of the validation set, not augmented but cut to the training length, seeded."""
    pairs = open_validation(config)
    samples = []
    for index in range(min(config.validation.num_pairs, len(pairs))):
        pair = pairs[index]
        rows = config.data.correspondences
        if rows is not None and len(pair) > rows:
            pair = pair.take(np.random.default_rng([5, index]).permutation(len(pair))[:rows])
        samples.append(make_sample(pair, config.network))
    return samples


def _worker_init(_: int) -> None:
    torch.set_num_threads(1)
