"""Spectral matching: weights from the leading eigenvector of the compatibility of all pairs.

A classical filter that needs no training (Leordeanu and Hebert, ICCV 2005): correspondences that preserve
length with many others that do so too get a large entry. Cost O(N^2) time; memory is bounded by taking a
seeded sample of at most ``max_anchors`` correspondences as the columns of the matrix.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomoe3d.filters.base import OutlierFilter, outlier_filter
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.types import Correspondences, FilterOutput, Float32Array


@outlier_filter("spectral")
@dataclass(frozen=True)
class SpectralFilter(OutlierFilter):
    """Leading eigenvector of C_ij = max(0, 1 - (| |p_i-p_j| - |q_i-q_j| | / d)^2), largest entry 1.

    Attributes:
        distance_voxels: d, in voxels.
        iterations: power iterations.
        max_anchors: columns used at most; beyond it the others are weighed by their agreement with them.
    """

    distance_voxels: float = 2.0
    iterations: int = 10
    max_anchors: int = 3000

    def __call__(self, correspondences: Correspondences, *, voxel_size: float, seed: int = 0) -> FilterOutput:
        """See `OutlierFilter`. Without any compatible pair all weights are zero."""
        count = len(correspondences)
        if count == 0:
            return FilterOutput(np.zeros(0))
        anchors = drawn_rows(correspondences.points, voxel_size, self.max_anchors, seed)
        rows = correspondences.points - correspondences.points.mean(0)
        unit = (rows / (self.distance_voxels * voxel_size)).astype(np.float32)
        C = _soft_compatibility(unit[anchors], unit[anchors])
        C[np.arange(len(anchors)), np.arange(len(anchors))] = 0
        vector = np.ones(len(anchors), dtype=np.float32)
        for _ in range(self.iterations):
            vector = C @ vector
            norm = float(np.linalg.norm(vector))
            if norm == 0:
                return FilterOutput(np.zeros(count))
            vector /= norm
        weights = np.empty(count, dtype=np.float32)
        for start in range(0, count, self.max_anchors):
            rows_here = np.arange(start, min(start + self.max_anchors, count))
            block = _soft_compatibility(unit[rows_here], unit[anchors])
            block[rows_here[:, None] == anchors[None, :]] = 0
            weights[rows_here] = block @ vector
        largest = float(weights.max())
        return FilterOutput(weights.astype(np.float64) / largest if largest > 0 else np.zeros(count))


def _soft_compatibility(a: Float32Array, b: Float32Array) -> Float32Array:
    """(n, m) compatibility of correspondences (n, 6) and (m, 6) in units of d."""
    from scipy.spatial.distance import cdist

    difference = cdist(a[:, :3], b[:, :3])
    difference -= cdist(a[:, 3:], b[:, 3:])
    difference *= difference
    return np.maximum(1 - difference, 0).astype(np.float32)
