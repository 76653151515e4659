"""From a loaded cloud to voxel points with oriented normals.

Place: prepare, between load and describe. One representative per occupied voxel (the mean of its points,
which also averages sensor noise) bounds everything after it: O(N log N) time for N points in, and memory
of a few arrays of N numbers, so millions of points in are fine.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from geomoe3d.clouds.viewpoint import guess_viewpoint
from geomoe3d.clouds.voxel_grid import drop_duplicates, drop_isolated, voxel_means
from geomoe3d.config import PreparationConfig, expert
from geomoe3d.errors import EmptyCloudError, InputError
from geomoe3d.geometry.columns import extents
from geomoe3d.runtime.open3d_core import open3d_core
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray, PointCloud, PreparedCloud

_MIN_POINTS = 3


def prepare(
    cloud: PointCloud,
    voxel_size: float,
    config: PreparationConfig,
    *,
    viewpoint: FloatArray | None = None,
    seed: int = 0,
) -> PreparedCloud:
    """Thin a cloud to its voxel grid and give every point a normal turned to the sensor.

    Args:
        cloud: finite points in local coordinates.
        voxel_size: edge of the grid, cloud units.
        config: neighbourhoods in voxels.
        viewpoint: (3,) local position of the sensor; None guesses it. Where no guess is plausible, or none
            is wanted (``config.viewpoint`` centroid), normals turn to the cloud's centroid.
        seed: decides the guess.

    Returns:
        A cloud without features; see `PreparedCloud` for what was dropped and counted.

    Raises:
        InputError: a voxel so small that the grid's indices overflow.
        EmptyCloudError: fewer than 3 voxel points remain.
    """
    points, num_duplicates = drop_duplicates(cloud.points)
    shift = config.grid_shift * voxel_size
    voxels = voxel_means(points + shift, voxel_size) - shift if shift else voxel_means(points, voxel_size)
    num_voxels = len(voxels)
    radius = config.normal_radius * voxel_size
    voxels = drop_isolated(voxels, radius)
    if len(voxels) < _MIN_POINTS:
        raise EmptyCloudError(
            f"'{cloud.name}': {len(voxels)} of {counted(len(cloud), 'point')} remain on a {voxel_size:.4g} grid "
            f"({num_duplicates} duplicates, {num_voxels - len(voxels)} isolated), at least {_MIN_POINTS} are "
            f"needed; give a denser scan or a voxel size that fits it"
        )
    normals = estimate_normals(voxels, radius, config.normal_neighbors)
    if viewpoint is None and config.viewpoint != "centroid":
        viewpoint = guess_viewpoint(voxels, normals, voxel_size, seed=seed)
    towards = voxels.mean(0) if viewpoint is None else viewpoint
    return PreparedCloud(
        points=voxels,
        normals=orient_normals(voxels, normals, towards),
        features=None,
        voxel_size=voxel_size,
        viewpoint=viewpoint,
        origin=cloud.origin,
        name=cloud.name,
        num_input=len(cloud) + cloud.num_non_finite,
        num_non_finite=cloud.num_non_finite,
        num_duplicates=num_duplicates,
        num_isolated=num_voxels - len(voxels),
    )


def check_cloud(cloud: PointCloud) -> None:
    """Refuse a cloud that cannot fix a rigid transform whatever the other one is. Raises EmptyCloudError: fewer
    than 3 points, or all points equal; InputError: an extent under `expert.loading.least_extent`."""
    if len(cloud) < _MIN_POINTS:
        held = f"'{cloud.name}' holds {counted(len(cloud), 'point')}"
        raise EmptyCloudError(f"{held}; a rigid transform needs at least {_MIN_POINTS}")
    extent = float(extents(cloud.points).max())
    if not extent:
        raise EmptyCloudError(
            f"'{cloud.name}': all {len(cloud)} points are equal to {cloud.file_points[0].tolist()}; "
            "they fix no rotation"
        )
    limit = expert().loading.least_extent
    if extent < limit:
        raise InputError(
            f"'{cloud.name}' is {extent:.3g} long at most, under the limit of {limit:g}; use a smaller unit"
        )


def estimate_normals(points: FloatArray, radius: float, neighbors: int) -> FloatArray:
    """Unit normals (n, 3) of local planes, sign arbitrary, by Open3D."""
    o3d = open3d_core()

    # The tensor API takes three fifths of the legacy one's time, and gives the same to the last few bits.
    cloud: Any = o3d.t.geometry.PointCloud(o3d.core.Tensor.from_numpy(np.ascontiguousarray(points)))
    cloud.estimate_normals(min(neighbors, len(points)), radius)
    return np.array(cloud.point.normals.numpy(), dtype=np.float64)


def orient_normals(points: FloatArray, normals: FloatArray, towards: FloatArray) -> FloatArray:
    """Normals flipped where they point away from ``towards`` (3,)."""
    away = np.einsum("ij,ij->i", normals, towards - points) < 0
    return np.where(away[:, None], -normals, normals)
