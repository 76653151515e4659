"""What the surface of a cloud says of points that are claimed to exist in its frame, for all who ask.

Which of them have a point of the surface within reach, how high they lie over its plane there, and whether their
normals meet its normals; what the sensor says of them, is `range_image`. Scorers, the channels of networks and what
is fitted to shared surfaces go by these, each with its own lengths.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from geomoe3d.types import FloatArray, IntArray


@dataclass(frozen=True)
class Met:
    """Those of n points that have a point of a surface within reach, m of them.

    Attributes:
        rows: (m,) of the points.
        nearest: (m,) of the surface's points, the nearest to each.
        distance: (m,) between them.
    """

    rows: IntArray
    nearest: IntArray
    distance: FloatArray

    @classmethod
    def of(cls, points: FloatArray, tree: Any, reach: float) -> Met:
        """Ask the k-d tree of a surface about points (..., 3), counted in their order."""
        distance, nearest = map(np.asarray, tree.query(points.reshape(-1, 3), distance_upper_bound=reach))
        rows = np.flatnonzero(np.isfinite(distance))
        return cls(rows, nearest[rows], distance[rows])

    def cosines(self, normals: FloatArray, there: FloatArray, signed: bool) -> FloatArray:
        """(m,) of the normals (..., 3) of the points and those of the surface; magnitudes where signs are a guess."""
        found: FloatArray = np.einsum("ij,ij->i", normals.reshape(-1, 3)[self.rows], there[self.nearest])
        return found if signed else np.abs(found)

    def heights(self, points: FloatArray, there: FloatArray, normals: FloatArray) -> FloatArray:
        """(m,) of the points (..., 3) over the planes through the surface's points with the surface's normals."""
        apart = points.reshape(-1, 3)[self.rows] - there[self.nearest]
        found: FloatArray = np.einsum("ij,ij->i", apart, normals[self.nearest])
        return found


def kernel(square: FloatArray, lowest: float = -10.0) -> FloatArray:
    """exp(-square / 2) of the square of a length in its own unit; not below exp(lowest), since numbers next to zero
    slow networks down."""
    found: FloatArray = np.exp(np.maximum(-0.5 * square, lowest))
    return found
