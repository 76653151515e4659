"""A cloud on three grids, each with FPFH of its own reach, and how points of one lie to those of another.

The fine grid is the cloud's; of the coarser ones, twice and four times as wide, each holds one point of the
cloud per voxel. FPFH with radius 5 of each grid's voxels so sees 5, 10 and 20 voxels far at the price of
little more than the first. `multiscale` joins the three; `learned` makes more of them. All of it turns with
the cloud.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from geomoe3d.clouds.voxel_grid import voxel_keys
from geomoe3d.features.fpfh import FpfhDescriptor
from geomoe3d.runtime.threads import usable_threads
from geomoe3d.types import Float32Array, IntArray, PreparedCloud

if TYPE_CHECKING:
    import small_gicp

FACTORS = (1, 2, 4)
"""Edges of the grids, in voxels of the cloud."""
NUM_RELATIONS = 8
"""Numbers by which `relations` says how one point lies to another."""


@dataclass(frozen=True, eq=False)
class Level:
    """Some of a cloud's points, lengths in voxels of the cloud.

    Attributes:
        rows: (m,) which of the cloud's points.
        points: (m, 3) float32, relative to the cloud's centroid.
        normals: (m, 3) float32 unit normals.
        features: (m, 33) float32 FPFH of length 1, of the points of this level alone.
        edge: of its grid.
    """

    rows: IntArray
    points: Float32Array
    normals: Float32Array
    features: Float32Array
    edge: int

    def __len__(self) -> int:
        return len(self.rows)

    @cached_property
    def tree(self) -> small_gicp.KdTree:
        """Of the points; half the time of scipy's."""
        import small_gicp

        return small_gicp.KdTree(small_gicp.PointCloud(self.points.astype(np.float64)), num_threads=1)

    def take(self, rows: IntArray | slice) -> Level:
        """Only these points of it."""
        kept = self.rows[rows], self.points[rows], self.normals[rows], self.features[rows]
        return Level(*kept, self.edge)


def pyramid(cloud: PreparedCloud, fpfh: Float32Array | None = None) -> tuple[Level, ...]:
    """The levels of a cloud of n >= 1 points, finest first; see `FACTORS`.

    ``fpfh``: (n, 33) features of `FpfhDescriptor()` where somebody has them, which is most of the work.
    """
    places = ((cloud.points - cloud.center) / cloud.voxel_size).astype(np.float32)
    normals = cloud.normals.astype(np.float32)
    levels = []
    for edge in FACTORS:
        rows = one_per_voxel(cloud, edge)
        if edge == 1 and fpfh is not None:
            features = fpfh
        else:
            some = replace(cloud, points=cloud.points[rows], normals=cloud.normals[rows], features=None)
            features = FpfhDescriptor(radius=5.0 * edge)(some)
        levels.append(Level(rows, places[rows], normals[rows], features, edge))
    return tuple(levels)


def one_per_voxel(cloud: PreparedCloud, edge: int) -> IntArray:
    """The cloud's first point in every voxel of a grid so many times as wide; all points at 1."""
    if edge == 1:
        return np.arange(len(cloud))
    _, first = np.unique(voxel_keys(cloud.points, edge * cloud.voxel_size), return_index=True)
    return np.sort(first)


def nearest(at: Level, of: Level, count: int) -> tuple[Float32Array, IntArray]:
    """Distances and rows (m, k) of the nearest points of a level, nearest first; k: ``count`` or all."""
    k = min(count, len(of))
    rows, squared = of.tree.batch_knn_search(at.points.astype(np.float64), k, num_threads=usable_threads())
    return np.sqrt(squared, dtype=np.float32, casting="same_kind"), rows.astype(np.int64)


def relations(at: Level, of: Level, rows: IntArray) -> Float32Array:
    """How points of ``of`` lie to points of ``at``, (k, m, 8), the same however the cloud is turned.

    Distance, height of either point over the other's plane, cosine between the normals, their triple product
    with the connection, the sines of both heights, and the distance squared; lengths in 4 edges of ``of``'s
    grid.

    Args:
        at: m points.
        of: level of the others.
        rows: (k, m) of ``of``, nearest first.
    """
    # One coordinate at a time: numpy is then ten times as quick as along a last axis of three.
    way = [of.points[:, axis].take(rows) - at.points[:, axis] for axis in range(3)]
    for coordinate in way:
        coordinate /= np.float32(4 * of.edge)
    there = [of.normals[:, axis].take(rows) for axis in range(3)]
    here = [at.normals[:, axis] for axis in range(3)]
    squared, over_here, over_there = _dot(way, way), _dot(way, here), _dot(way, there)
    distance = np.sqrt(squared) + np.float32(1e-6)
    (x, y, z), (a, b, c) = way, there
    triple = _dot(here, [y * c - z * b, z * a - x * c, x * b - y * a])
    slopes = over_here / distance, over_there / distance
    found: Float32Array = np.stack(
        [distance, over_here, over_there, _dot(there, here), triple, *slopes, squared], axis=-1
    )
    return found


def _dot(a: list[Float32Array], b: list[Float32Array]) -> Float32Array:
    product: Float32Array = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product
