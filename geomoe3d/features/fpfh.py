"""FPFH features of prepared clouds, by Open3D.

Place: describe. About 0.06 s for 5,000 points of an indoor scan on one core; linear in the points.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from geomoe3d.config import PreparationConfig
from geomoe3d.types import Float32Array, PreparedCloud


def describe(cloud: PreparedCloud, config: PreparationConfig) -> PreparedCloud:
    """The cloud with L2-normalised FPFH features (n, 33) float32.

    A point without neighbours in the feature radius has an all-zero histogram and keeps a zero feature,
    which is equally far from every unit feature.

    Source: Rusu et al., ICRA 2009; radius 5 voxels, at most 100 neighbours, unit length as in PointDSC's
    protocol.
    """
    import open3d as o3d

    # The tensor API gives the legacy one's features in two thirds of its time. It works in single precision,
    # hence centred and in voxels.
    places = (cloud.points - cloud.points.mean(0)) / cloud.voxel_size
    tensor = o3d.core.Tensor.from_numpy
    geometry: Any = o3d.t.geometry.PointCloud(tensor(places.astype(np.float32)))
    geometry.point.normals = tensor(cloud.normals.astype(np.float32))
    raw = o3d.t.pipelines.registration.compute_fpfh_feature(
        geometry, config.feature_neighbors, config.feature_radius
    )
    features: Float32Array = raw.numpy()
    features = np.where(np.isfinite(features), features, np.float32(0))
    features /= np.linalg.norm(features, axis=1, keepdims=True) + np.float32(1e-6)
    return replace(cloud, features=np.ascontiguousarray(features))


def flip_normals(cloud: PreparedCloud, config: PreparationConfig) -> PreparedCloud:
    """The cloud as if its sensor had stood on the other side of every surface: described anew, no sensor."""
    return describe(replace(cloud, normals=-cloud.normals, viewpoint=None), config)


def flip_pair(
    described: tuple[PreparedCloud, PreparedCloud], config: PreparationConfig
) -> tuple[PreparedCloud, PreparedCloud]:
    """Both clouds with the normals of the first turned over, and without sensors."""
    return flip_normals(described[0], config), replace(described[1], viewpoint=None)
