"""From pairs to batches, in an order that depends on seed and step alone.

Sample k of a run is the same pair with the same augmentation whether the run was interrupted or not, and
however many processes share it: with W processes and A micro-batches, block m W + r of a step goes to
process r as its micro-batch m, so two processes do what one does with twice the accumulation.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from geomoe3d.data.shards import is_shard
from geomoe3d.errors import InputError
from geomoe3d.geometry.se3 import rotation_error_deg
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.inputs import BatchInput, PairInput, collate, pair_input, under_motions
from geomoe3d.networks.motion_inputs import MotionInputs
from geomoe3d.networks.neighbors import neighbors_in_batch
from geomoe3d.runtime.threads import THREADS_VARIABLE
from geomoe3d.training.augment import augment
from geomoe3d.training.config import RULES, DataConfig, TrainConfig
from geomoe3d.training.fragment_pairs import FragmentPairs
from geomoe3d.training.image_pairs import ImagePairsConfig, generate_matches
from geomoe3d.training.losses import network_motion
from geomoe3d.training.pairs import PairDataset, ShardFolder, TrainingPair
from geomoe3d.training.synthetic import SyntheticPairs
from geomoe3d.types import BoolArray, FloatArray


@dataclass(frozen=True)
class Sample:
    """One pair, ready for the network.

    Attributes:
        inputs: what the network sees: one input, or one for each of M motions that it is to judge.
        labels: (N,) bool.
        truth: (4, 4) true motion in network units.
        right: (M,) bool, which motions are right; None for networks that judge none.
    """

    inputs: tuple[PairInput, ...]
    labels: Tensor
    truth: Tensor
    right: Tensor | None = None


@dataclass(frozen=True)
class Batch:
    """Inputs of all samples, padded to the longest.

    Attributes:
        input: B inputs, those of one sample one after the other.
        labels: (B, N) bool, False at padding.
        truth: (B, 4, 4) float32.
        right: (B,) bool, whether each input's motion is right, or None.
        pair: (B,) int64, the sample that each input belongs to.
    """

    input: BatchInput
    labels: Tensor
    truth: Tensor
    right: Tensor | None
    pair: Tensor

    def to(self, device: torch.device) -> Batch:
        """The same batch on another device."""
        labels, truth, pair = (x.to(device, non_blocking=True) for x in (self.labels, self.truth, self.pair))
        right = None if self.right is None else self.right.to(device, non_blocking=True)
        return Batch(self.input.to(device), labels, truth, right, pair)


def open_pairs(where: str, data: DataConfig, seed: int) -> PairDataset:
    """The dataset that a configuration names: ``synthetic`` or a folder of shards, of either kind.

    Shards of fragments with features (``geomoe3d data features``) give fresh correspondences without end, shards
    of correspondences (`write_shard`) those that they hold.
    """
    if where == "synthetic":
        return SyntheticPairs(data.synthetic, seed)
    if Path(where).is_dir() and any(is_shard(path) for path in Path(where).iterdir()):
        return FragmentPairs(where, data.draw, seed, verify=True)
    return ShardFolder(where)


def open_training(config: TrainConfig) -> PairDataset | ImagePairs:
    """Training pairs of a run."""
    if config.network.correspondence_dim == 4 and config.data.train == "synthetic":
        return ImagePairs(config.data.images, config.network, config.seed)
    return open_pairs(config.data.train, config.data, config.seed)


def open_validation(config: TrainConfig) -> PairDataset:
    """Validation pairs; generated ones come from other rooms, the same for every training seed."""
    return open_pairs(config.data.validation, config.data, RULES.validation_seed)


def make_sample(
    pair: TrainingPair,
    network: NetworkConfig,
    data: DataConfig | None = None,
    rng: np.random.Generator | None = None,
) -> Sample:
    """A pair as network input with its truth in network units.

    Args:
        pair: with motions, where the network judges some.
        network: that is to see it.
        data: how many motions are looked at; None takes the defaults.
        rng: draws motions among those proposed, and hides viewpoints; None takes the first ones, hides none.

    Raises:
        InputError: the pair cannot be used (see `pair_input`), or lacks motions.
    """
    data = data or DataConfig()
    points = torch.from_numpy(pair.correspondences).double()
    labels = torch.from_numpy(np.ascontiguousarray(pair.labels))
    if points.shape[1] != network.correspondence_dim:
        raise InputError(
            f"its correspondences have {points.shape[1]} columns, and the network takes {network.correspondence_dim}: "
            "4 are matches of images, 6 those of clouds"
        )
    if network.correspondence_dim == 4:
        if len(points) < network.num_neighbors:
            raise InputError(f"{len(points)} matches; the network needs at least {network.num_neighbors}")
        matches = points.float()
        inputs = PairInput(matches, None, neighbors_in_batch(matches[None], network.num_neighbors)[0])
        return Sample((inputs,), labels, torch.from_numpy(pair.T_target_source).float())
    truth = network_motion(
        points, torch.from_numpy(pair.T_target_source), pair.voxel_size, network.unit_voxels
    ).float()
    if network.judges_motions:
        motions, right = choose_motions(pair, data.motions_per_pair, rng)
        views: tuple[Any, Any] = (None, None)
        if pair.viewpoints is not None and not (rng is not None and rng.random() < data.hidden_viewpoints):
            views = (pair.viewpoints[0], pair.viewpoints[1])
        several = under_motions(MotionInputs(points.numpy(), views, pair.voxel_size, network), motions)
        return Sample(tuple(several), labels, truth, torch.from_numpy(right))
    inputs = pair_input(
        points,
        pair.voxel_size,
        network,
        feature_distance=pair.feature_distance,
        ratio=pair.ratio,
        mutual=pair.mutual,
    )
    if inputs.turned is not None:
        A, B = (turn.float() for turn in inputs.turned)
        truth[:3] = torch.cat([B @ truth[:3, :3] @ A.T, B @ truth[:3, 3:]], dim=1)
    return Sample((inputs,), labels, truth)


def choose_motions(
    pair: TrainingPair, count: int, rng: np.random.Generator | None
) -> tuple[FloatArray, BoolArray]:
    """At most ``count`` of a pair's motions (K, 4, 4), and which are right (K,).

    With ``rng``: a right one where there is any, the first two, and others at random. Right: rotation
    error below 15 degrees and translation error below 6 voxels, 30 cm at 5 cm voxels.

    Raises:
        InputError: the pair has no motions.
    """
    if pair.motions is None or len(pair.motions) == 0:
        raise InputError(
            "consensus proposed no transform to score; leave such pairs out"
            if pair.motions is not None
            else "no transforms to score; make the data with 'geomoe3d data transforms'"
        )
    T = pair.T_target_source
    right = np.array(
        [
            rotation_error_deg(m, T) < RULES.max_rotation_deg
            and np.linalg.norm(m[:3, 3] - T[:3, 3]) < RULES.max_translation_voxels * pair.voxel_size
            for m in pair.motions
        ]
    )
    rows = np.arange(len(right))
    if rng is not None and len(rows) > count:
        good = np.flatnonzero(right)
        first = [*(good[rng.integers(len(good))][None] if len(good) else []), 0, 1]
        rows = np.array(list(dict.fromkeys([*first, *rng.permutation(len(right))])))
    rows = np.sort(rows[:count])
    return pair.motions[rows], right[rows]


def make_batch(samples: list[Sample]) -> Batch:
    """Stack samples."""
    longest = max(len(s.labels) for s in samples)
    counts = [len(s.inputs) for s in samples]
    pair = torch.repeat_interleave(torch.arange(len(samples)), torch.tensor(counts))
    labels = torch.stack([torch.nn.functional.pad(s.labels, (0, longest - len(s.labels))) for s in samples])
    truth = torch.stack([s.truth for s in samples])
    right = [s.right for s in samples if s.right is not None]
    return Batch(
        collate([one for s in samples for one in s.inputs]),
        labels[pair],
        truth[pair],
        torch.cat(right) if right else None,
        pair,
    )


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
            return make_sample(changed, self.config.network, data, rng)
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


class ImagePairs:
    """Generated matches of two images, a whole batch at a time, on the device that trains.

    A batch depends on seed and number, and on the kind of device: GPUs draw other numbers than processors.
    """

    def __init__(self, config: ImagePairsConfig, network: NetworkConfig, seed: int) -> None:
        self.config, self.network, self.seed = config, network, seed

    def batch(self, size: int, number: int, device: torch.device | str = "cpu") -> Batch:
        """Batch ``number`` of ``size`` pairs."""
        seed = int(np.random.SeedSequence([self.seed, number]).generate_state(1, np.uint64)[0] >> 1)
        drawn = generate_matches(self.config, size, seed, device)
        neighbors = neighbors_in_batch(drawn.matches, self.network.num_neighbors)
        inputs = BatchInput(drawn.matches, None, neighbors, None)
        return Batch(inputs, drawn.labels, drawn.truth, None, torch.arange(size, device=device))

    def identity(self) -> str:
        """Seed and settings."""
        return f"images:1:{self.seed}:{self.config.model_dump_json()}"

    def voxel_sizes(self) -> tuple[float, float]:
        """One focal length: image points have no voxels."""
        return 1.0, 1.0


def training_loader(
    config: TrainConfig,
    pairs: PairDataset | ImagePairs,
    first_step: int,
    rank: int = 0,
    world: int = 1,
    device: torch.device | str = "cpu",
) -> Iterable[Batch]:
    """Batches from ``first_step`` on; those of images are drawn on ``device``."""
    if isinstance(pairs, ImagePairs):
        blocks = StepSampler(config, first_step, rank, world)
        return (pairs.batch(len(block), block[0] // len(block), device) for block in blocks)
    return DataLoader(
        TrainingSamples(pairs, config),
        batch_sampler=StepSampler(config, first_step, rank, world),
        num_workers=config.workers,
        collate_fn=make_batch,
        prefetch_factor=config.data.prefetch if config.workers else None,
        worker_init_fn=_worker_init,
    )


def first_batch(config: TrainConfig) -> Batch:
    """The batch of a run's first step, made in this process."""
    alone = config.model_copy(update={"workers": 0})
    return next(iter(training_loader(alone, open_training(alone), 0)))


def validation_samples(config: TrainConfig) -> list[Sample]:
    """The first pairs of the validation set, not augmented but cut to the training length, seeded."""
    if config.network.correspondence_dim == 4 and config.data.validation == "synthetic":
        return _image_samples(config)
    pairs = open_validation(config)
    samples = []
    for index in range(min(config.validation.num_pairs, len(pairs))):
        pair = pairs[index]
        rows = config.data.correspondences
        if rows is not None and len(pair) > rows:
            pair = pair.take(np.random.default_rng([5, index]).permutation(len(pair))[:rows])
        samples.append(make_sample(pair, config.network, config.data))
    return samples


def _image_samples(config: TrainConfig) -> list[Sample]:
    pairs = ImagePairs(config.data.images, config.network, RULES.validation_seed)
    samples = []
    for number in range(config.validation.num_pairs):
        one = pairs.batch(1, number)
        inputs = PairInput(one.input.coordinates[0], None, one.input.neighbors[0])
        samples.append(Sample((inputs,), one.labels[0], one.truth[0]))
    return samples


def _worker_init(_: int) -> None:
    os.environ[THREADS_VARIABLE] = "1"  # this process alone
    torch.set_num_threads(1)
