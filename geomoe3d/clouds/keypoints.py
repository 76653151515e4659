"""Keypoints of one scan taken as a coarse surface: planes, and what its sensor saw.

Correspondences bring points, often nothing else. Those of one scan still trace its surfaces, at the spacing
of the keypoints, and that is enough to ask in which plane a point lies and what must be empty. Place: used
by estimation and by the network that scores transforms; about 3 ms for 1,000 points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomoe3d.clouds.range_image import RangeImage
from geomoe3d.config import expert
from geomoe3d.runtime.threads import each
from geomoe3d.types import FloatArray, IntArray


@dataclass(frozen=True)
class Surface:
    """Keypoints of one scan as a coarse surface, lengths in inlier thresholds.

    Attributes:
        points: (n, 3) distinct points.
        normals: (n, 3) unit normals turned to the sensor, if it is known.
        planarity: (n,) in [0, 1]; 1 where the nearest points lie in a plane (or on a line).
        tree: k-d tree of the points.
        view: what the sensor saw, or None.
        viewpoint: (3,) or None.
    """

    points: FloatArray
    normals: FloatArray
    planarity: FloatArray
    tree: object
    view: RangeImage | None
    viewpoint: FloatArray | None

    @classmethod
    def of(cls, points: FloatArray, viewpoint: FloatArray | None) -> Surface:
        """Normals by a plane through the nearest points."""
        import small_gicp
        from scipy.spatial import cKDTree

        k = min(expert().keypoints.normal_neighbors, len(points))
        # Twice as fast at finding several; the other one is at finding what lies within a reach.
        near, _ = small_gicp.KdTree(small_gicp.PointCloud(points)).batch_knn_search(points, k)
        tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
        patch = points[near.reshape(len(points), k)]
        patch = patch - patch.mean(1, keepdims=True)
        values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", patch, patch))
        normals = vectors[:, :, 0]
        planarity = 1 - np.sqrt(np.maximum(values[:, 0], 0) / np.maximum(values[:, 1], 1e-9))
        view = None
        if viewpoint is not None:
            away = np.einsum("ij,ij->i", normals, viewpoint - points) < 0
            normals = np.where(away[:, None], -normals, normals)
            view = RangeImage.of(points, viewpoint, expert().keypoints.pixel_deg)
        return cls(points, normals, planarity, tree, view, viewpoint)


@dataclass(frozen=True)
class KeypointSurfaces:
    """Both scans of a pair as `Surface`, and where in them the points of each correspondence are.

    Attributes:
        sides: source and target.
        rows: (N,) of each: the keypoint that a correspondence has there.
    """

    sides: tuple[Surface, Surface]
    rows: tuple[IntArray, IntArray]

    @classmethod
    def of(
        cls,
        correspondences: FloatArray,
        viewpoints: tuple[FloatArray | None, FloatArray | None],
        unit: float,
    ) -> KeypointSurfaces:
        """Both sides at once, where there are threads.

        Args:
            correspondences: (N, 6) finite rows [source xyz, target xyz].
            viewpoints: (3,) places of the two sensors, or None for either.
            unit: length that becomes one: the inlier threshold.
        """

        def side(number: int) -> tuple[Surface, IntArray]:
            points = correspondences[:, 3 * number : 3 * number + 3] / unit
            distinct, row = np.unique(points, axis=0, return_inverse=True)
            viewpoint = viewpoints[number]
            return Surface.of(distinct, None if viewpoint is None else viewpoint / unit), row.ravel()

        (source, source_row), (target, target_row) = each(side, (0, 1))
        return cls((source, target), (source_row, target_row))
