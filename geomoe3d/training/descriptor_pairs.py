"""What the learned descriptor is trained on: points of two fragments, and how far each lies from each in truth.

From the shards of ``geomoe3d data features``: their points are those that registration sees; normals, FPFH and
grids are made anew, of the points as they are and with noise and thinned, when a fragment is first drawn, and kept
on the device, 1.5 MB each.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from geomoe3d.data.shards import open_shard, shard_folders
from geomoe3d.errors import InputError
from geomoe3d.training.descriptor_views import Fragment, View, batch_view
from geomoe3d.training.torch_surface import nearest_points

_SAME = 0.9  # voxels: a point of the other fragment so near is the same place
_LEAST_COSINE = 0.5  # of the two normals there
_LEAST_SHARED = 40
_BANDS = ((0.35, 2.0), (0.7, 1.0), (np.inf, 0.4))
"""Overlap up to, and how often such a pair is drawn: low overlap in the majority."""
_MOST_NOISE = (
    0.08  # voxels, standard deviation: half of a sensor's is gone once a voxel's points are averaged
)
_LEAST_KEPT = 0.5  # of a thinned fragment's points


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
        variants: of every fragment; the first as it is, the others with noise and thinned.

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
        variants: int = 2,
    ) -> None:
        paths = [path for folder in folders for path in shard_folders(Path(folder))]
        paths = paths[:-leave_out] if leave_out < 0 else paths[leave_out:]
        if not paths:
            raise InputError(f"no scene is left of {folders} when {abs(leave_out)} are left out")
        self._scenes = [scene for path in paths if len((scene := open_shard(path)).pair)]
        self._seed, self._device, self._flipped, self._variants = seed, device, flipped, variants
        self._num_shared, self._num_random = num_shared, num_random
        self._fragments: dict[tuple[int, int, int], Fragment | None] = {}
        self._same: dict[tuple[int, int, int, int], tuple[Tensor, Tensor]] = {}

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
        first_kind, second_kind = (int(kind) for kind in rng.integers(self._variants, size=2))
        draw = torch.Generator().manual_seed(int(rng.integers(1 << 62)))
        flip = rng.random() < self._flipped
        i, j = (int(index) for index in scene.pair[row])
        source, target = self._fragment(k, i, first_kind), self._fragment(k, j, second_kind)
        if source is None or target is None:
            return None
        T = torch.tensor(scene.T_target_source[row], dtype=torch.float32, device=self._device)
        fine = source.grids[0], target.grids[0]
        moved = fine[0].points @ T[:3, :3].T + T[:3, 3] / scene.voxel_size
        key = k, row, first_kind, second_kind
        if key not in self._same:
            distance, near = (x[:, 0] for x in nearest_points(moved, fine[1].points, 1))
            alike = (fine[0].normals @ T[:3, :3].T * fine[1].normals[near]).sum(1) > _LEAST_COSINE
            same = torch.nonzero((distance < _SAME) & alike)[:, 0]
            self._same[key] = same, near[same]
        same, near = self._same[key]
        if len(same) < _LEAST_SHARED:
            return None
        first = torch.rand(len(same), generator=draw).argsort()[: self._num_shared]
        first = first[torch.arange(self._num_shared) % len(first)].to(self._device)
        queries = []
        for shared, grid in ((same[first], fine[0]), (near[first], fine[1])):
            more = torch.randint(len(grid.points), (self._num_random,), generator=draw).to(self._device)
            queries.append(torch.cat([shared, more]))
        if flip:
            source, target = source.turned_over(), target.turned_over()
        return (source, target), tuple(queries), (moved[queries[0]], fine[1].points[queries[1]])

    def _fragment(self, scene: int, index: int, variant: int) -> Fragment | None:
        key = scene, index, variant
        if key not in self._fragments:
            self._fragments[key] = self._build(*key)
        return self._fragments[key]

    def _build(self, scene: int, index: int, variant: int) -> Fragment | None:
        rng = np.random.default_rng((self._seed, 5, scene, index, variant))
        whole = self._scenes[scene]
        points = whole.fragment(index)[0].astype(np.float64) / whole.voxel_size
        corner, turn = np.zeros(3), np.eye(3)
        if variant > 0:
            corner, turn = rng.uniform(0, 4, 3), Rotation.random(random_state=rng).as_matrix()
            points = points[rng.random(len(points)) < rng.uniform(_LEAST_KEPT, 1)]
            points = points + rng.normal(0, rng.uniform(0, _MOST_NOISE), points.shape)
        given = (points, np.zeros(3), corner, turn)
        return Fragment.build(*(torch.from_numpy(x).float().to(self._device) for x in given))
