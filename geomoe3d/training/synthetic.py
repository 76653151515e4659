"""Correspondence pairs made up on the fly, so that training runs with no data on disk at all.

A box-shaped room with furniture boxes is sampled. True matches come from an overlap region; as keypoints
of two scans rarely coincide, they lie off along the surface, and some by a little too much to count as
true. Wrong ones come from what misleads real descriptors: any other surface point, another point of the
same or a parallel surface, and whole groups that agree on another motion (repeated structure). No images, no
descriptors: a few milliseconds per pair, and the share of true matches is set, not met by chance.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation

from geomoe3d.config import Section
from geomoe3d.training.pairs import TrainingPair
from geomoe3d.types import BoolArray, FloatArray, IntArray


class SyntheticConfig(Section):
    """Difficulty of the generated pairs; lengths in voxels unless said otherwise."""

    num_pairs: int = Field(1 << 40, ge=1, description="distinct pairs; the default never repeats one")
    correspondences: tuple[int, int] = Field((1000, 1000), description="least and most per pair")
    inlier_ratio: tuple[float, float] = Field((0.005, 0.6), description="range, drawn log-uniformly")
    noise: tuple[float, float] = Field((0.1, 0.4), description="standard deviation of a matched point")
    spread: tuple[float, float] = Field(
        (0.5, 1.5),
        description="how far along its surface a true match lies off, since sampled points rarely coincide",
    )
    near_misses: tuple[float, float] = Field(
        (0.0, 1.5), description="matches off by a little too much to be true, per true match"
    )
    inlier_threshold: float = Field(2.0, gt=0, description="residual below which a match is labelled true")
    structured_fraction: float = Field(
        0.3, ge=0, le=1, description="largest share of the wrong matches that agree on other transforms"
    )
    surface_fraction: float = Field(
        0.5, ge=0, le=1, description="largest share of wrong matches that stay on the same or a like surface"
    )
    voxel_size: tuple[float, float] = Field((0.02, 0.3), description="metres, drawn log-uniformly")

    @model_validator(mode="after")
    def _check(self) -> SyntheticConfig:
        least_of = {"correspondences": 3, "spread": 1e-3, "voxel_size": 1e-9}
        for name in ("correspondences", "inlier_ratio", "noise", "spread", "near_misses", "voxel_size"):
            least = least_of.get(name, 0)
            low, high = getattr(self, name)
            if not least <= low <= high:
                raise ValueError(f"{name} must be a range [low, high] with {least} <= low <= high")
        if self.inlier_ratio[1] > 1 or self.inlier_ratio[0] <= 0:
            raise ValueError("inlier_ratio must lie within (0, 1]")
        return self


class SyntheticPairs:
    """Generated pairs; pair ``index`` depends on ``seed`` and ``index`` alone."""

    def __init__(self, config: SyntheticConfig, seed: int = 0) -> None:
        self.config = config
        self.seed = seed

    def __len__(self) -> int:
        return self.config.num_pairs

    def __getitem__(self, index: int) -> TrainingPair:
        if not 0 <= index < len(self):
            raise IndexError(f"pair {index} of {len(self)}")
        return generate_pair(np.random.default_rng([self.seed, index]), self.config)

    def identity(self) -> str:
        """Seed and settings."""
        return f"synthetic:3:{self.seed}:{self.config.model_dump_json()}"

    def voxel_sizes(self) -> tuple[float, float]:
        """The range that they are drawn from."""
        return self.config.voxel_size


def generate_pair(rng: np.random.Generator, config: SyntheticConfig) -> TrainingPair:
    """One pair with about the drawn share of true matches (chance hits are labelled true as well)."""
    num = int(rng.integers(config.correspondences[0], config.correspondences[1] + 1))
    num_true = int(np.clip(round(num * _log_uniform(rng, config.inlier_ratio)), 1, num))
    num_near = min(int(num_true * rng.uniform(*config.near_misses)), (num - num_true) // 2)
    num_like = num_true + num_near
    base = 0.05  # metres: the voxel size of the room before it is scaled
    room = _Room(rng)
    T = _random_motion(rng, 3.0)
    points, face = room.sample(rng, num, num_like)
    target = points.copy()
    spread = rng.uniform(*config.spread)
    off = np.concatenate([
        _rayleigh(rng, spread, 0.9 * config.inlier_threshold, num_true),
        1.1 * config.inlier_threshold + rng.exponential(3 * spread, num_near),
    ])  # fmt: skip
    target[:num_like] += room.along(rng, face[:num_like], off * base)
    wrong = np.arange(num_like, num)
    target[wrong] = _wrong_targets(rng, room, config, points[wrong], face[wrong])
    sigma = rng.uniform(*config.noise) * base
    target = target + rng.normal(0, sigma, target.shape)
    target = target @ T[:3, :3].T + T[:3, 3]
    residual = np.linalg.norm(points @ T[:3, :3].T + T[:3, 3] - target, axis=1)
    labels: BoolArray = residual < config.inlier_threshold * base
    order = rng.permutation(num)
    voxel_size = _log_uniform(rng, config.voxel_size)
    scale = voxel_size / base
    T[:3, 3] *= scale
    rows = (np.concatenate([points, target], axis=1)[order] * scale).astype(np.float32)
    return TrainingPair(rows, labels[order], T, voxel_size)


class _Room:
    """Rectangles (corner, two edges) of a room's shell and of boxes in it, in metres."""

    def __init__(self, rng: np.random.Generator) -> None:
        size = rng.uniform([2.5, 2.5, 2.2], [6.0, 6.0, 3.0])
        boxes = [_Box(np.zeros(3), size, 0.0)]
        for _ in range(int(rng.integers(4, 16))):
            extent = rng.uniform([0.2, 0.2, 0.2], [1.6, 1.0, 1.8])
            place = rng.uniform(0, 1, 3) * np.maximum(size - extent, 0.1) * [1, 1, float(rng.random() < 0.3)]
            boxes.append(_Box(place, extent, float(rng.choice([0.0, 0.0, rng.uniform(0, np.pi)]))))
        faces = np.array([face for box in boxes for face in box.faces()])
        self.size = size
        self.corner, self.u, self.v = faces[:, 0], faces[:, 1], faces[:, 2]
        normal = np.cross(self.u, self.v)
        self.area = np.linalg.norm(normal, axis=1)
        self.normal = normal / self.area[:, None]
        # A camera sees little of the floor and walls at a time and much of the furniture.
        weight = self.area * np.where(np.arange(len(self.area)) < 6, 0.5, 1.5)
        self.share = weight / weight.sum()

    def on_faces(self, rng: np.random.Generator, face: IntArray) -> FloatArray:
        a, b = rng.random((2, len(face), 1))
        points: FloatArray = self.corner[face] + a * self.u[face] + b * self.v[face]
        return points

    def along(self, rng: np.random.Generator, face: IntArray, length: FloatArray) -> FloatArray:
        """Steps of given lengths in random directions within the faces."""
        angle = rng.uniform(0, 2 * np.pi, (len(face), 1))
        u, v = (x[face] / np.linalg.norm(x[face], axis=1, keepdims=True) for x in (self.u, self.v))
        steps: FloatArray = length[:, None] * (np.cos(angle) * u + np.sin(angle) * v)
        return steps

    def sample(self, rng: np.random.Generator, num: int, num_region: int) -> tuple[FloatArray, IntArray]:
        """Surface points and their faces, evenly over the room; the first ``num_region`` share a region.

        The region stands for the overlap of two scans. It holds other points too, as dense as elsewhere:
        where points lie says which of them may be true, never which of them are.
        """
        face = rng.choice(len(self.share), size=num, p=self.share)
        points = self.on_faces(rng, face)
        center = points[rng.integers(num)]
        inside = int(np.clip(num_region / rng.uniform(0.1, 0.8), num_region, num))
        near = np.argsort(np.linalg.norm(points - center, axis=1))[:inside]
        chosen = rng.permutation(near)[:num_region]
        order = np.concatenate([chosen, np.setdiff1d(np.arange(num), chosen)])
        return points[order], face[order]


class _Box:
    """Six rectangles of a box turned about the vertical."""

    def __init__(self, place: FloatArray, extent: FloatArray, angle: float) -> None:
        self.place, self.extent, self.angle = place, extent, angle

    def faces(self) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
        c, s = np.cos(self.angle), np.sin(self.angle)
        axes = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]) * self.extent[:, None]
        pairs = [(0, 1, 2), (1, 2, 0), (2, 0, 1)]
        return [(self.place + far * axes[k], axes[i], axes[j]) for i, j, k in pairs for far in (0.0, 1.0)]


def _wrong_targets(
    rng: np.random.Generator, room: _Room, config: SyntheticConfig, points: FloatArray, face: IntArray
) -> FloatArray:
    """Where wrong matches point to, in the source frame: anywhere, along like surfaces, or in groups."""
    target = room.on_faces(rng, rng.choice(len(room.share), size=len(points), p=room.share))
    slipped = rng.random(len(points)) < rng.uniform(0, config.surface_fraction)
    if slipped.any():
        like = np.abs(room.normal @ room.normal.T) > 0.99
        chance = like * room.share
        cumulative = np.cumsum(chance / chance.sum(1, keepdims=True), axis=1)[face[slipped]]
        chosen = (rng.random((len(cumulative), 1)) > cumulative).sum(1).clip(max=len(room.share) - 1)
        target[slipped] = room.on_faces(rng, chosen)
    left = int(len(points) * rng.uniform(0, config.structured_fraction))
    order = rng.permutation(len(points))
    while left > 3:
        size = int(rng.integers(3, max(4, min(left, len(points) // 4) + 1)))
        center = points[rng.integers(len(points))]
        # A group is a connected piece of surface that also occurs elsewhere.
        candidates = order[:left] if left <= len(order) else order
        near = np.argsort(np.linalg.norm(points[candidates] - center, axis=1))[:size]
        group = candidates[near]
        T = _repeat_motion(rng, room, center)
        target[group] = points[group] @ T[:3, :3].T + T[:3, 3]
        order = np.setdiff1d(order, group, assume_unique=True)
        left -= size
    return target


def _repeat_motion(rng: np.random.Generator, room: _Room, center: FloatArray) -> FloatArray:
    """A motion by which a piece of a room looks like another: shifts, and turns about the vertical."""
    if rng.random() < 0.2:
        return _random_motion(rng, 2.0)
    angle = rng.choice([0.0, np.pi / 2, np.pi, -np.pi / 2, rng.uniform(0, 2 * np.pi)])
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", angle).as_matrix()
    goal = center + rng.uniform(-0.5, 0.5, 3) * room.size * [1, 1, 0.2]
    T[:3, 3] = goal - T[:3, :3] @ center
    return T


def _random_motion(rng: np.random.Generator, spread: float) -> FloatArray:
    q = rng.normal(size=4)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(q).as_matrix()
    T[:3, 3] = rng.normal(0, spread, 3)
    return T


def _rayleigh(rng: np.random.Generator, scale: float, limit: float, num: int) -> FloatArray:
    """Lengths of plane Gaussian steps, below a limit."""
    most = -np.expm1(-0.5 * (limit / scale) ** 2)
    lengths: FloatArray = scale * np.sqrt(-2 * np.log1p(-rng.random(num) * most))
    return lengths


def _log_uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(np.log(bounds[0]), np.log(bounds[1]))))
