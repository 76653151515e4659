"""Training of the surface network: hypotheses of posed pairs, what both clouds show under each, which of them is right.

`examples_of` makes them as the second look meets them, `train` learns from files of them. Which hypotheses are right
is measured at the centroid of the source: below 0.28 m and 12 degrees; those below 0.6 m and 20 degrees that are not
right count as neither. Lengths of the limits are for rooms.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from geomoe3d.clouds.viewpoint import known_viewpoints
from geomoe3d.clouds.voxel_size import own_voxel_sizes, round_size
from geomoe3d.data.collection import PosedPair, load_fragment, open_collection
from geomoe3d.decision.distinct import distinct
from geomoe3d.features.base import with_features
from geomoe3d.geometry.se3 import inverse, motions_apart, shift_frames, transform_points
from geomoe3d.pipeline import Pipeline
from geomoe3d.runtime.files import write_atomically
from geomoe3d.runtime.timing import StageClock
from geomoe3d.scoring.surface_channels import NUM_CHANNELS, NUM_POINTS, RAW, SurfaceChannels, channels_of
from geomoe3d.scoring.surfaces import SURFACES
from geomoe3d.types import Float32Array, FloatArray, Hypothesis, PointCloud


@dataclass(frozen=True)
class Examples:
    """Hypotheses of one pair.

    Attributes:
        channels: (K, 2, N, C) raw channels, see `scoring.surface_channels`.
        shift, turn: (K,) distance from the truth at the source's centroid, cloud units, and in degrees.
    """

    channels: Float32Array
    shift: FloatArray
    turn: FloatArray


def draw_pairs(folder: str | Path, count: int, seed: int = 0) -> list[PosedPair]:
    """At most ``count`` pairs of a collection, those of little overlap far more often than others."""
    pairs = list(open_collection(folder).pairs)
    overlap = np.array([0.5 if pair.overlap is None else pair.overlap for pair in pairs])
    weight = np.where(overlap < 0.3, 1.0, np.where(overlap < 0.6, 0.35, 0.1))
    rng = np.random.default_rng(seed)
    rows = rng.choice(len(pairs), min(count, len(pairs)), replace=False, p=weight / weight.sum())
    return [pairs[k] for k in rows]


def cut(pair: PosedPair, seed: int, tries: int = 30) -> tuple[PointCloud, PointCloud] | None:
    """Both clouds of a pair cut by planes until 8 to 40 % of the source lie on the target; None where that fails.

    A recorded place gives few pairs of little overlap; cut ones are as hard.
    """
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(seed)
    clouds = load_fragment(pair.source), load_fragment(pair.target)
    for _ in range(tries):
        parts = []
        for cloud in clouds:
            height = cloud.points @ _direction(rng)
            kept = cloud.points[height > np.quantile(height, rng.uniform(0.15, 0.6))]
            parts.append(replace(cloud, points=kept, normals=None, colors=None))
        moved = transform_points(pair.T_target_source, parts[0].file_points[::20])
        gap, _ = cKDTree(parts[1].file_points).query(moved, distance_upper_bound=0.08)
        if 0.08 < np.isfinite(gap).mean() < 0.4:
            return parts[0], parts[1]
    return None


def examples_of(
    pipeline: Pipeline, clouds: tuple[PointCloud, PointCloud], T_file: FloatArray
) -> Examples | None:
    """What the second look would see of a pair: the best hypotheses of both descriptors and the truth, all refined.

    None where nothing is proposed.
    """
    clock, T = StageClock(), shift_frames(T_file, -clouds[0].origin, -clouds[1].origin)
    places = known_viewpoints(*clouds, "auto")
    size = round_size(max(own_voxel_sizes(*clouds, pipeline.config.preparation.voxel_points)))
    first, second = pipeline.prepare_both(clouds, size, places or (None, None), clock)
    if len(first) < len(second):  # as the line orders them
        first, second, T = second, first, inverse(T)
        places = None if places is None else (places[1], places[0])
    learned = pipeline.second_descriptor
    if learned is None:
        raise ValueError("the surface network is trained on the features of a second descriptor")
    usual = pipeline.match((first, second), places, clock)
    described = [with_features(cloud, learned, pipeline.descriptor) for cloud in (first, second)]
    own = pipeline.match((described[0], described[1]), places, clock, draw=1)
    joint = pipeline.together((usual, own), places)
    found = [h for pair in (own, usual) for h in pipeline.propose(pair, clock)[1]]
    if not found:
        return None
    said = pipeline.scorers[SURFACES].about(joint)(np.array([h.T_target_source for h in found]))
    ranked = [h for _, h in sorted(zip(said, found, strict=True), key=lambda one: -one[0].factor)]
    best = distinct(ranked, joint.clouds[0], 3 * joint.inlier_threshold, 14)
    refine = pipeline.refiner.about(joint)
    motions = []
    for hypothesis in (*best, Hypothesis(T)):
        refined, _ = refine(hypothesis)
        motions.append(hypothesis.T_target_source if refined is None else refined)
    apart = [motions_apart(T, motion, joint.clouds[0].points.mean(0)) for motion in motions]
    shift, turn = np.array(apart).T
    return Examples(SurfaceChannels(joint)(np.array(motions)), shift, turn)


def write_examples(file: Path, examples: Sequence[Examples]) -> None:
    """Write the examples of some pairs as one .npz, in half precision."""
    start = np.cumsum([0, *(len(one.shift) for one in examples)])
    content: dict[str, Any] = {
        "channels": np.concatenate([one.channels for one in examples]).astype(np.float16),
        "shift": np.concatenate([one.shift for one in examples]),
        "turn": np.concatenate([one.turn for one in examples]),
        "start": start,
    }
    write_atomically(file, lambda path: np.savez(path, **content), force=True)


def read_examples(files: Sequence[Path]) -> Iterator[Examples]:
    """The examples of files, pair by pair."""
    for file in files:
        with np.load(file) as held:
            channels, shift, turn, start = (held[key] for key in ("channels", "shift", "turn", "start"))
        for a, b in itertools.pairwise(start):
            yield Examples(channels[a:b], shift[a:b], turn[a:b])


class SurfaceNetwork(nn.Module):
    """The network of `scoring.surface_network` in torch, with the same names of tensors.

    Args:
        mean, std: (C,) of the channels.
        width: channels of a point.
    """

    def __init__(self, mean: Tensor, std: Tensor, width: int = 48) -> None:
        super().__init__()
        self.mean: Tensor
        self.std: Tensor
        self.register_buffer("mean", mean)
        self.register_buffer("std", std)
        w = width
        self.point = nn.Sequential(nn.Linear(NUM_CHANNELS, w), nn.ReLU(), nn.Linear(w, w), nn.ReLU())
        self.head = nn.Sequential(
            nn.Linear(3 * w + NUM_CHANNELS, 64), nn.ReLU(), nn.Dropout(0.15), nn.Linear(64, 32), nn.ReLU(),
            nn.Linear(32, 1),
        )  # fmt: skip

    def forward(self, channels: Tensor) -> Tensor:
        """(K,) logits of channels (K, 2, N, C)."""
        near = channels[..., 1:2]
        x = (channels - self.mean) / self.std
        held = self.point(x)
        weighed = (held * near).sum(2) / (near.sum(2) + 0.02 * x.shape[2])
        pooled = torch.cat([held.mean(2), weighed, held.amax(2), x.mean(2)], dim=-1)
        verdict: Tensor = self.head(pooled.mean(1))[..., 0]
        return verdict


def augmented(channels: Float32Array, rng: np.random.Generator) -> Float32Array:
    """Raw channels of one pair as another sensor might have given them: lengths and similarities off by a factor and a
    step, in one of eight no place of a sensor known, in half the clouds exchanged."""
    held = channels.astype(np.float32)
    column = {name: k for k, name in enumerate(RAW)}
    held[..., [column[k] for k in ("distance", "off_plane", "margin")]] *= np.exp(rng.normal(0, 0.15))
    held[..., [column[k] for k in ("similarity", "fpfh", "best")]] += rng.normal(0, 0.05)
    if rng.random() < 0.125:
        held[..., [column[k] for k in ("seen", "margin", "range")]] = 0
        held[..., column["normal"]] = np.abs(held[..., column["normal"]])
    return held[:, ::-1] if rng.random() < 0.5 else held


def train(
    examples: Sequence[Examples], weight: FloatArray, epochs: int, seed: int = 0, pairs: int = 4
) -> Iterator[tuple[int, int, float, SurfaceNetwork]]:
    """Train; yields (step, steps, mean loss, network) every 200 steps and at the end.

    Args:
        examples: of each pair.
        weight: (n,) how often each pair is drawn beside others.
        epochs: passes over a pair of weight one.
        seed: of all draws.
        pairs: in a step.

    The loss is the binary cross entropy of each hypothesis and half the negative log of what a softmax over the pair
    gives to those that are right.
    """
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    seen = channels_of(np.concatenate([one.channels[::9, :, ::4] for one in examples]).astype(np.float32))
    flat = torch.from_numpy(seen.reshape(-1, NUM_CHANNELS))
    network = SurfaceNetwork(flat.mean(0), flat.std(0) + 1e-3)
    steps = max(1, round(epochs * float(weight.sum()) / pairs))
    optimizer = torch.optim.AdamW(network.parameters(), 1e-3, weight_decay=2e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, steps + 2)
    total, count = 0.0, 0
    for step in range(1, steps + 1):
        rows = rng.choice(len(examples), min(pairs, len(examples)), replace=False, p=weight / weight.sum())
        some = np.sort(rng.permutation(NUM_POINTS)[: rng.integers(NUM_POINTS // 3, 2 * NUM_POINTS // 3 + 1)])
        loss = torch.zeros(())
        for k in rows:
            one = examples[k]
            loss = loss + _loss(network, augmented(one.channels[:, :, some], rng), one) / len(rows)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
        total, count = total + loss.item(), count + 1
        if step % 200 == 0 or step == steps:
            yield step, steps, total / count, network
            total, count = 0.0, 0


def save(network: SurfaceNetwork, file: Path) -> None:
    """Write the weights, in half precision but for the scale of the channels."""
    from safetensors.torch import save_file

    tensors = {
        name: (value if name in ("mean", "std") else value.half()).contiguous()
        for name, value in network.state_dict().items()
    }
    write_atomically(file, lambda path: save_file(tensors, path), force=True)


def _loss(network: SurfaceNetwork, raw: Float32Array, one: Examples) -> Tensor:
    right = (one.shift < 0.28) & (one.turn < 12.0)  # metres, degrees
    wrong = (one.shift > 0.6) | (one.turn > 20.0)
    used = right | wrong
    if not used.any():
        return torch.zeros(())
    logits = network(torch.from_numpy(np.ascontiguousarray(channels_of(raw[used]))))
    target = torch.from_numpy(right[used])
    loss = nn.functional.binary_cross_entropy_with_logits(
        logits, target.float(), pos_weight=torch.tensor(2.0)
    )
    if target.any():
        loss = loss - 0.5 * torch.log_softmax(logits, 0)[target].logsumexp(0)
    return loss


def _direction(rng: np.random.Generator) -> FloatArray:
    found = rng.standard_normal(3)
    unit: FloatArray = found / np.linalg.norm(found)
    return unit
