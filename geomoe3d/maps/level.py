"""A map on one grid: points with normals, and what is compared with a scan at each of them.

Scans of other sizes want other grids, so a map may hold several levels. The learned descriptor finds two to ten times
as many true matches in a whole building as FPFH of three reaches does. It is computed at one point per two voxels; the
others count where surfaces are laid on each other. 220 bytes and some 50 microseconds per point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from geomoe3d.clouds.prepare import estimate_normals, orient_normals
from geomoe3d.clouds.range_image import RangeImage
from geomoe3d.clouds.voxel_grid import drop_isolated, voxel_means
from geomoe3d.config import PreparationConfig, expert
from geomoe3d.errors import EmptyCloudError
from geomoe3d.features.base import Descriptor, with_features
from geomoe3d.features.fpfh import FpfhDescriptor
from geomoe3d.features.learned import LearnedDescriptor
from geomoe3d.features.pyramid import one_per_voxel, pyramid
from geomoe3d.maps.facing import both_sides, facing_alike
from geomoe3d.maps.voxels import VoxelSums
from geomoe3d.runtime.words import counted
from geomoe3d.types import BoolArray, Float32Array, FloatArray, IntArray, PreparedCloud

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Float16Array = NDArray[np.float16]
SPACING = 2  # voxels between the points that are compared: an inlier may be two voxels off


@dataclass(frozen=True, eq=False)
class Compared:
    """Points by which scan and map are compared: ``points``, ``normals`` (K, 3) and ``features`` (K, 65)."""

    points: FloatArray
    normals: FloatArray
    features: Float32Array

    def take(self, rows: IntArray) -> Compared:
        """Some of them."""
        return Compared(self.points[rows], self.normals[rows], self.features[rows])


@dataclass(frozen=True, eq=False)
class Level:
    """See the module; local coordinates of the map.

    Attributes:
        voxel_size: edge of the grid, cloud units.
        points, normals: (n, 3); the normals face the sensors where these are known, else the way their neighbours do.
        fpfh: (n, 33) float16 of all points, by `FpfhDescriptor`.
        rows: (c,) of the points that are compared.
        features: (c, 65) float32 of these, by `LearnedDescriptor`.
        twins: (m,) which of these have no known side.
        twin_features: (m, 65) of the twins, seen from the other side.
        sensors: (S, 3) of the map, as far as they are known.
    """

    voxel_size: float
    points: FloatArray
    normals: FloatArray
    fpfh: Float16Array
    rows: IntArray
    features: Float32Array
    twins: IntArray
    twin_features: Float32Array
    sensors: FloatArray

    @classmethod
    def of(cls, voxels: VoxelSums, voxel_size: float, config: PreparationConfig, name: str = "map") -> Level:
        """Describe a map on one grid.

        Args:
            voxels: on a grid as fine or finer.
            voxel_size: wanted edge.
            config: neighbourhoods of the normals, in voxels.
            name: of the map, for messages.

        Raises:
            EmptyCloudError: fewer than 3 points with neighbours remain.
        """
        radius = config.normal_radius * voxel_size
        means = voxels.points
        points = means if voxel_size <= voxels.edge else voxel_means(means, voxel_size)
        points = drop_isolated(points, radius)
        if len(points) < (least := expert().maps.least_points):
            raise EmptyCloudError(
                f"'{name}' fills only {counted(len(means), 'voxel')}, and {len(points)} of these have neighbours "
                f"on a {voxel_size:.4g} grid, at least {least} must: too few points for a map; give a denser cloud "
                "or a voxel size that fits it"
            )
        normals = estimate_normals(points, radius, config.normal_neighbors)
        normals, known = _turned(points, normals, voxels)
        bare = PreparedCloud(points, normals, None, voxel_size, None, voxels.origin)
        describe, grids, rows = LearnedDescriptor(), pyramid(bare), one_per_voxel(bare, SPACING)
        twins = np.flatnonzero(~known[rows])
        turned = tuple(
            replace(grid, normals=-grid.normals, features=both_sides(grid.features)) for grid in grids
        )
        features = describe.at(grids, rows)
        seen_behind = describe.at(turned, rows[twins]) if len(twins) else features[:0]
        fpfh = grids[0].features.astype(np.float16)
        return cls(voxel_size, points, normals, fpfh, rows, features, twins, seen_behind, voxels.sensors)

    @cached_property
    def tree(self) -> cKDTree:
        """Of the points."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points)

    def met(self, points: FloatArray, normals: FloatArray) -> tuple[BoolArray, BoolArray]:
        """Which of points (..., 3) with normals have a point of the map within two voxels, and which of these its plane
        too, whichever way it faces."""
        distance, nearest = self.tree.query(points, distance_upper_bound=2 * self.voxel_size)
        hit = np.isfinite(distance)
        cosines = np.einsum("...i,...i->...", normals, self.normals[np.where(hit, nearest, 0)])
        return hit, hit & (np.abs(cosines) > expert().surfaces.least_cosine)

    def range_image(self, number: int) -> RangeImage:
        """What one of the sensors saw; made once."""
        if number not in self._range_images:
            self._range_images[number] = RangeImage.of(self.points, self.sensors[number])
        return self._range_images[number]

    @cached_property
    def _range_images(self) -> dict[int, RangeImage]:
        return {}

    def seen_from(
        self, eye: FloatArray, rows: IntArray, part: PreparedCloud, describe: Descriptor, anew: bool
    ) -> PreparedCloud:
        """Some of the points as a scan from a place: normals turned to it, with the features of a descriptor.

        Args:
            eye: (3,) the place.
            rows: (k,) of the points.
            part: what else the cloud holds; its arrays are replaced.
            describe: the descriptor.
            anew: describe just these points. Else what FPFH says of the whole map is taken, seen from the other side
                where normals turn over.
        """
        points, own = self.points[rows], self.normals[rows]
        normals = orient_normals(points, own, eye)
        cloud = replace(part, points=points, normals=normals)
        if anew or describe != FpfhDescriptor():
            return with_features(cloud, describe)
        features = self.fpfh[rows].astype(np.float32)
        behind = np.einsum("ij,ij->i", normals, own) < 0
        features[behind] = both_sides(features[behind])
        return replace(cloud, features=features)

    @cached_property
    def compared(self) -> Compared:
        """What is compared with a scan: points whose side is not known twice, once for each side."""
        also = self.rows[self.twins]
        return Compared(
            np.concatenate([self.points[self.rows], self.points[also]]),
            np.concatenate([self.normals[self.rows], -self.normals[also]]),
            np.concatenate([self.features, self.twin_features]),
        )


def compared_rows(scan: PreparedCloud) -> IntArray:
    """(k,) which points of a scan are compared with a map. Raises EmptyCloudError: fewer than 3."""
    rows = one_per_voxel(scan, SPACING)
    if len(rows) < (least := expert().maps.least_points):
        raise EmptyCloudError(
            f"'{scan.name}': {len(rows)} of {counted(scan.num_input, 'point')} remain to be compared with the map on "
            f"a {SPACING * scan.voxel_size:.4g} grid, at least {least} are needed; give a denser scan or a voxel size "
            "that fits it"
        )
    return rows


def described(scan: PreparedCloud, describe: Descriptor, rows: IntArray) -> tuple[PreparedCloud, Compared]:
    """A scan with the features of a descriptor, and what is compared of it with a map, by `compared_rows`."""
    found = with_features(scan, describe)
    fpfh = found.features if describe == FpfhDescriptor() else None
    features = LearnedDescriptor().at(pyramid(scan, fpfh), rows)
    return found, Compared(scan.points[rows], scan.normals[rows], features)


def _turned(points: FloatArray, normals: FloatArray, voxels: VoxelSums) -> tuple[FloatArray, BoolArray]:
    """Normals turned to the sensors where these are known, and where that is."""
    from scipy.spatial import cKDTree

    if not voxels.towards.any():
        return facing_alike(points, normals), np.zeros(len(points), dtype=np.bool_)
    _, nearest = cKDTree(voxels.points).query(points)
    towards = voxels.towards[nearest] / voxels.counts[nearest, None]
    height = np.einsum("ij,ij->i", normals, towards)
    known: BoolArray = np.abs(height) > expert().maps.known
    turned = normals * np.where(height < 0, -1.0, 1.0)[:, None]
    return turned, known
