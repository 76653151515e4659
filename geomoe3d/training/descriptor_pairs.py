"""What the learned descriptor is trained on: points of two fragments, and how far each lies from each in
truth.

From the shards of ``geomoe3d data features``: their points are those that registration sees, normals are
fitted anew and turned to the sensor at each fragment's origin. A fragment's pyramid is built when it is first
drawn and kept in memory in half precision, 0.5 MB. About 20 ms per pair on one core after that, 0.3 s before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from geomoe3d.clouds.prepare import estimate_normals, orient_normals
from geomoe3d.config import PreparationConfig
from geomoe3d.data.shards import DescribedScene, open_shard, shard_folders
from geomoe3d.errors import InputError
from geomoe3d.features.pyramid import Level, pyramid
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.types import Float32Array, IntArray, PreparedCloud

_SAME = 0.9  # voxels: a point of the other fragment so near is the same place
_LEAST_COSINE = 0.5  # of the two normals there
_LEAST_SHARED = 40
_BANDS = ((0.35, 2.0), (0.7, 1.0), (np.inf, 0.4))
"""Overlap up to, and how often such a pair is drawn: low overlap in the majority."""
# FPFH of normals turned over: the first and the third of its three histograms run backwards.
_TURNED_OVER = np.concatenate([np.arange(11)[::-1], np.arange(11, 22), np.arange(22, 33)[::-1]])


@dataclass(frozen=True)
class ContrastPair:
    """Points of two fragments of which the first ``num_shared`` of each are the same places, in order.

    Attributes:
        levels: pyramids of both. queries: rows of their finest levels: the shared ones, then random ones.
        num_shared: how many. apart: (num_shared, q) of each: true distances in voxels from its shared points
        to all points asked of the
            other.
    """

    levels: tuple[tuple[Level, ...], tuple[Level, ...]]
    queries: tuple[IntArray, IntArray]
    num_shared: int
    apart: tuple[Float32Array, Float32Array]


class ContrastPairs:
    """Pairs drawn from all shards of some folders, without end; pair ``number`` depends on the seed alone.

    Args:
        folders: of shards.
        seed: another seed draws others.
        leave_out: so many scenes, the first by name, are not drawn from; negative: only they are.
        num_shared, num_random: points asked of each fragment, at most.
        flipped: share of the pairs whose normals are all turned over, as where a guess of the sensors failed.

    Raises:
        InputError: no shards, or no scene is left.
        FormatError: a shard is damaged or of another version.
    """

    def __init__(
        self,
        folders: list[str],
        seed: int = 0,
        *,
        leave_out: int = 0,
        num_shared: int = 300,
        num_random: int = 500,
        flipped: float = 0.1,
    ) -> None:
        paths = [path for folder in folders for path in shard_folders(Path(folder))]
        paths = paths[:-leave_out] if leave_out < 0 else paths[leave_out:]
        if not paths:
            raise InputError(f"no scene is left of {folders} when {abs(leave_out)} are left out")
        self._scenes = [open_shard(path) for path in paths]
        self._seed, self._flipped = seed, flipped
        self._num_shared, self._num_random = num_shared, num_random
        self._pyramids: dict[tuple[int, int], tuple[Level, ...]] = {}

    def __getitem__(self, number: int) -> ContrastPair:
        rng = np.random.default_rng((self._seed, number))
        while True:
            found = self._draw(rng)
            if found is not None:
                return found

    def _draw(self, rng: np.random.Generator) -> ContrastPair | None:
        """A pair, or None where too little of the one drawn is shared."""
        k = int(rng.integers(len(self._scenes)))
        scene = self._scenes[k]
        often = np.select([scene.overlap < most for most, _ in _BANDS], [share for _, share in _BANDS])
        row = int(rng.choice(len(often), p=often / often.sum()))
        i, j = (int(index) for index in scene.pair[row])
        T = scene.T_target_source[row]
        source, target = self._levels(k, i), self._levels(k, j)
        places = [scene.fragment(index)[0].astype(np.float64) / scene.voxel_size for index in (i, j)]
        moved = transform_points(T, places[0] * scene.voxel_size) / scene.voxel_size
        distance, near = map(np.asarray, cKDTree(places[1]).query(moved, distance_upper_bound=_SAME))
        same = np.flatnonzero(np.isfinite(distance))
        cosine = np.einsum("ij,ij->i", source[0].normals[same] @ T[:3, :3].T, target[0].normals[near[same]])
        same = rng.permutation(same[cosine > _LEAST_COSINE])[: self._num_shared]
        if len(same) < _LEAST_SHARED:
            return None
        queries = tuple(
            np.concatenate([shared, rng.permutation(len(points))[: self._num_random]])
            for shared, points in ((same, moved), (near[same], places[1]))
        )
        if rng.random() < self._flipped:
            source, target = _turned_over(source), _turned_over(target)
        m = len(same)
        asked, others = moved[queries[0]], places[1][queries[1]]
        apart = cdist(asked[:m], others), cdist(others[:m], asked)
        return ContrastPair(
            (source, target),
            (queries[0], queries[1]),
            m,
            (apart[0].astype(np.float32), apart[1].astype(np.float32)),
        )

    def _levels(self, scene: int, fragment: int) -> tuple[Level, ...]:
        key = scene, fragment
        if key not in self._pyramids:
            self._pyramids[key] = tuple(
                replace(level, features=level.features.astype(np.float16))
                for level in pyramid(as_prepared(self._scenes[scene], fragment))
            )
        return tuple(
            replace(level, features=level.features.astype(np.float32)) for level in self._pyramids[key]
        )


def as_prepared(scene: DescribedScene, fragment: int) -> PreparedCloud:
    """A fragment as registration prepares it, its sensor at the origin."""
    config = PreparationConfig()
    points = scene.fragment(fragment)[0].astype(np.float64)
    normals = estimate_normals(points, config.normal_radius * scene.voxel_size, config.normal_neighbors)
    origin = np.zeros(3)
    turned = orient_normals(points, normals, origin)
    return PreparedCloud(points, turned, None, scene.voxel_size, viewpoint=origin, origin=origin)


def _turned_over(levels: tuple[Level, ...]) -> tuple[Level, ...]:
    return tuple(
        replace(level, normals=-level.normals, features=level.features[:, _TURNED_OVER]) for level in levels
    )
