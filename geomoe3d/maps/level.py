"""A map on one grid: points with normals, and what is compared with a scan at each of them.

Scans of other sizes want other grids, so a map may hold several levels. FPFH of three reaches (`features.multiscale`)
finds two to three times as many true matches in a whole room as FPFH does; its 99 numbers are brought to 32 by the
map's own principal directions. 200 bytes and some 60 microseconds per point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from geomoe3d.clouds.prepare import drop_isolated, estimate_normals, voxel_means
from geomoe3d.config import PreparationConfig
from geomoe3d.errors import EmptyCloudError
from geomoe3d.features.base import Descriptor, with_features
from geomoe3d.features.fpfh import FpfhDescriptor
from geomoe3d.features.multiscale import MultiscaleDescriptor
from geomoe3d.features.pyramid import one_per_voxel
from geomoe3d.maps.facing import both_sides, facing_alike
from geomoe3d.maps.voxels import VoxelSums
from geomoe3d.types import BoolArray, Float32Array, FloatArray, IntArray, PreparedCloud

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

SPACING = 2  # voxels between the points that are compared: an inlier may be two voxels off
_DIRECTIONS = 32
_SAMPLE = 20_000  # features from which the principal directions are found
_KNOWN = 0.1  # length of a mean direction to the sensors below which they saw a surface from everywhere
_LEAST = 3


@dataclass(frozen=True, eq=False)
class Sides:
    """K surfaces of a map as they are compared: ``points``, ``normals`` (K, 3) and ``features`` (K, 32)."""

    points: FloatArray
    normals: FloatArray
    features: Float32Array


@dataclass(frozen=True, eq=False)
class Level:
    """See the module; local coordinates of the map.

    Attributes:
        voxel_size: edge of the grid, cloud units.
        points, normals: (n, 3); the normals face the sensors where these are known, else the way their neighbours do.
        features: (n, 32) float32 of about length 1 along the directions.
        twins: (m,) rows of the points whose side is not known.
        twin_features: (m, 32) of these, seen from the other side.
        coarse: (c,) one row per two voxels: what is compared first.
        directions: (99, 32) principal directions of the features, orthonormal.
    """

    voxel_size: float
    points: FloatArray
    normals: FloatArray
    features: Float32Array
    twins: IntArray
    twin_features: Float32Array
    coarse: IntArray
    directions: Float32Array

    @classmethod
    def of(cls, voxels: VoxelSums, voxel_size: float, config: PreparationConfig, *, seed: int = 0) -> Level:
        """Describe a map on one grid.

        Args:
            voxels: on a grid as fine or finer.
            voxel_size: wanted edge.
            config: neighbourhoods of the normals, in voxels.
            seed: decides from which features the directions are found.

        Raises:
            EmptyCloudError: fewer than 3 points with neighbours remain.
        """
        radius = config.normal_radius * voxel_size
        means = voxels.points
        points = means if voxel_size <= voxels.edge else voxel_means(means, voxel_size)
        points = drop_isolated(points, radius)
        if len(points) < _LEAST:
            raise EmptyCloudError(
                f"{len(points)} points of the map remain on a {voxel_size:.4g} grid, at least {_LEAST} are needed; "
                "give a denser map or a voxel size that fits it"
            )
        normals = estimate_normals(points, radius, config.normal_neighbors)
        normals, known = _turned(points, normals, voxels)
        bare = PreparedCloud(points, normals, None, voxel_size, None, voxels.origin)
        features = with_features(bare, MultiscaleDescriptor()).features
        assert features is not None
        twins = np.flatnonzero(~known)
        directions = _principal(features, seed)
        turned = both_sides(features[twins])
        found = np.ascontiguousarray(features @ directions), twins, np.ascontiguousarray(turned @ directions)
        return cls(voxel_size, points, normals, *found, one_per_voxel(bare, SPACING), directions)

    @cached_property
    def tree(self) -> cKDTree:
        """Of the points."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points)

    def sides(self, rows: IntArray) -> Sides:
        """Some of the points (rows rising) as they are compared: those whose side is not known twice, for each side."""
        place = np.searchsorted(self.twins, rows)
        place[place == len(self.twins)] = 0
        twice = place[self.twins[place] == rows] if len(self.twins) else place[:0]
        of = self.twins[twice]
        return Sides(
            np.concatenate([self.points[rows], self.points[of]]),
            np.concatenate([self.normals[rows], -self.normals[of]]),
            np.concatenate([self.features[rows], self.twin_features[twice]]),
        )

    @cached_property
    def first(self) -> Sides:
        """What is compared first."""
        return self.sides(self.coarse)


def described_twice(scan: PreparedCloud, describe: Descriptor) -> tuple[PreparedCloud, Float32Array]:
    """A scan with the features of a descriptor, and its (n, 99) of three reaches; plain FPFH is part of these."""
    wide = with_features(scan, MultiscaleDescriptor()).features
    assert wide is not None
    if describe != FpfhDescriptor():
        return with_features(scan, describe), wide
    fine = wide[:, :33]
    length = np.linalg.norm(fine, axis=1, keepdims=True)
    return replace(scan, features=np.ascontiguousarray(fine / np.maximum(length, np.float32(1e-6)))), wide


def _turned(points: FloatArray, normals: FloatArray, voxels: VoxelSums) -> tuple[FloatArray, BoolArray]:
    """Normals turned to the sensors where these are known, and where that is."""
    from scipy.spatial import cKDTree

    if not voxels.towards.any():
        return facing_alike(points, normals), np.zeros(len(points), dtype=np.bool_)
    _, nearest = cKDTree(voxels.points).query(points)
    towards = voxels.towards[nearest] / voxels.counts[nearest, None]
    height = np.einsum("ij,ij->i", normals, towards)
    known: BoolArray = np.abs(height) > _KNOWN
    turned = normals * np.where(height < 0, -1.0, 1.0)[:, None]
    return turned, known


def _principal(features: Float32Array, seed: int) -> Float32Array:
    """(D, 32) directions in which a sample of features is longest, about zero so that products stay products."""
    rows = np.sort(np.random.default_rng(seed).permutation(len(features))[:_SAMPLE])
    sample = features[rows].astype(np.float64)
    _, vectors = np.linalg.eigh(sample.T @ sample)
    return np.ascontiguousarray(vectors[:, ::-1][:, :_DIRECTIONS].astype(np.float32))
