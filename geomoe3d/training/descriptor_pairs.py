"""What the learned descriptor is trained on: points of two fragments, and how far each lies from each in truth.

From the shards of ``geomoe3d data features``: their points and FPFH are those that registration sees; normals are
fitted anew and turned to the sensor at each fragment's origin. A fragment's grids are made when it is first drawn and
kept on the device, 1.5 MB each.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from geomoe3d.clouds.prepare import estimate_normals, orient_normals
from geomoe3d.config import PreparationConfig
from geomoe3d.data.shards import DescribedScene, open_shard, shard_folders
from geomoe3d.errors import InputError
from geomoe3d.features.pyramid import pyramid
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.training.descriptor_views import Fragment, View, batch_view
from geomoe3d.types import FloatArray, IntArray, PreparedCloud

_BANDS = ((0.35, 2.0), (0.7, 1.0), (np.inf, 0.4))
"""Overlap up to, and how often such a pair is drawn: low overlap in the majority."""


@dataclass(frozen=True)
class ContrastBatch:
    """P pairs, each with q points asked of either fragment, of which the first m are the same places, in order.

    Attributes:
        view: the 2 P fragments, source and target of each pair in turn, at their queries.
        apart: (2 P, m, q) true distances in voxels from the shared points of each fragment to all points asked of
            the other one of its pair.
    """

    view: View
    apart: Tensor


class ContrastPairs:
    """Pairs drawn from all shards of some folders, without end; batch ``number`` depends on the seed alone.

    Args:
        folders: of shards.
        seed: another seed draws others.
        device: where fragments are kept.
        leave_out: so many scenes, the first by name, are not drawn from; negative: only they are.
        num_shared, num_random: points asked of each fragment; where fewer are shared some are asked twice.
        flipped: share of the pairs whose normals are all turned over, as where a guess of the sensors failed.

    Raises:
        InputError: no shards, or no scene is left.
        FormatError: a shard is damaged or of another version.
    """

    def __init__(
        self,
        folders: list[str],
        seed: int = 0,
        device: torch.device | str = "cpu",
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
        self._scenes = [scene for path in paths if len((scene := open_shard(path)).pair)]
        self._seed, self._device, self._flipped = seed, device, flipped
        self._num_shared, self._num_random = num_shared, num_random
        self._fragments: dict[tuple[int, int], Fragment | None] = {}
        self._same: dict[tuple[int, int], tuple[IntArray, IntArray]] = {}

    def batch(self, number: int, size: int) -> ContrastBatch:
        """``size`` pairs."""
        rng = np.random.default_rng((self._seed, number))
        fragments: list[Fragment] = []
        queries: list[Tensor] = []
        places: list[Tensor] = []
        while len(fragments) < 2 * size:
            drawn = self._draw(rng)
            if drawn is not None:
                fragments += drawn[0]
                queries += drawn[1]
                places += drawn[2]
        other = torch.stack(places).view(size, 2, -1, 3).flip(1).flatten(0, 1)
        shared = torch.stack(places)[:, : self._num_shared]
        apart = torch.cdist(shared, other, compute_mode="donot_use_mm_for_euclid_dist")
        return ContrastBatch(batch_view(fragments, queries), apart)

    def _draw(
        self, rng: np.random.Generator
    ) -> tuple[tuple[Fragment, ...], tuple[Tensor, ...], tuple[Tensor, ...]] | None:
        """Fragments, queries, and where these lie in the target; None where too little is shared."""
        k = int(rng.integers(len(self._scenes)))
        scene = self._scenes[k]
        often = np.select([scene.overlap < most for most, _ in _BANDS], [share for _, share in _BANDS])
        row = int(rng.choice(len(often), p=often / often.sum()))
        i, j = (int(index) for index in scene.pair[row])
        source, target = self._fragment(k, i), self._fragment(k, j)
        if source is None or target is None:
            return None
        T = scene.T_target_source[row]
        moved = transform_points(T, scene.fragment(i)[0].astype(np.float64)) / scene.voxel_size
        there = scene.fragment(j)[0].astype(np.float64) / scene.voxel_size
        if (k, row) not in self._same:
            normals = (
                source.grids[0].normals.cpu().numpy() @ T[:3, :3].T,
                target.grids[0].normals.cpu().numpy(),
            )
            self._same[k, row] = _same_places(moved, there, *normals)
        same, near = self._same[k, row]
        if len(same) < 40:
            return None
        first = np.resize(rng.permutation(len(same)), self._num_shared)
        queries = [
            np.concatenate([shared[first], rng.integers(len(points), size=self._num_random)])
            for shared, points in ((same, moved), (near, there))
        ]
        places = moved[queries[0]], there[queries[1]]
        if rng.random() < self._flipped:
            source, target = source.turned_over(), target.turned_over()
        return (
            (source, target),
            tuple(torch.from_numpy(rows).to(self._device) for rows in queries),
            tuple(torch.from_numpy(x).float().to(self._device) for x in places),
        )

    def _fragment(self, scene: int, index: int) -> Fragment | None:
        key = scene, index
        if key not in self._fragments:
            whole = self._scenes[scene]
            levels = pyramid(as_prepared(whole, index), whole.fragment(index)[1].astype(np.float32))
            self._fragments[key] = Fragment.of(levels, self._device)
        return self._fragments[key]


def as_prepared(scene: DescribedScene, fragment: int) -> PreparedCloud:
    """A fragment as registration prepares it, its sensor at the origin."""
    config = PreparationConfig()
    points = scene.fragment(fragment)[0].astype(np.float64)
    normals = estimate_normals(points, config.normal_radius * scene.voxel_size, config.normal_neighbors)
    origin = np.zeros(3)
    turned = orient_normals(points, normals, origin)
    return PreparedCloud(points, turned, None, scene.voxel_size, viewpoint=origin, origin=origin)


def _same_places(
    moved: FloatArray, there: FloatArray, normals: FloatArray, normals_there: FloatArray
) -> tuple[IntArray, IntArray]:
    """Rows of points of either fragment that are one place: near each other, and facing the same way."""
    # A point of the other fragment within 0.9 voxels is the same place,
    distance, near = map(np.asarray, cKDTree(there).query(moved, distance_upper_bound=0.9))
    same = np.flatnonzero(np.isfinite(distance))
    cosine = np.einsum("ij,ij->i", normals[same], normals_there[near[same]])
    # if its normal turns the same way.
    same = same[cosine > 0.5]
    return same, near[same]
