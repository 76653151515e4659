"""What a sensor saw along each direction: the nearest surface, and so the space that must be free.

Place: used by estimation and verification. A spherical image around the sensor, by default of 2.5 degrees per
pixel; O(N) to build and to ask. Fused scans were seen from several places near the sensor, so the nearest
surface in a 3 x 3 neighbourhood counts, and a margin is left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomoe3d.config import expert
from geomoe3d.types import FloatArray, IntArray


@dataclass(frozen=True)
class RangeImage:
    """Nearest range per direction around one sensor.

    Attributes:
        viewpoint: (3,) sensor position.
        axes: (3, 3) rows forward, left, up; up is a direction in which the cloud has no points if it can.
        nearest: (rows, columns) smallest range in the 3 x 3 pixels around, -inf where the pixel itself holds no point.
    """

    viewpoint: FloatArray
    axes: FloatArray
    nearest: FloatArray

    @classmethod
    def of(cls, points: FloatArray, viewpoint: FloatArray, pixel_deg: float | None = None) -> RangeImage:
        """The range image of points (N, 3) seen from ``viewpoint`` (3,), same frame; None: as surfaces are asked."""
        columns = round(360 / (pixel_deg or expert().surfaces.pixel_deg))
        shape = (columns // 2, columns)
        axes = _viewing_axes(points - viewpoint)
        pixel, distance = _pixels(points, viewpoint, axes, shape)
        nearest = np.full(shape, np.inf)
        np.minimum.at(nearest.reshape(-1), pixel, distance)
        around = np.minimum(nearest, np.minimum(np.roll(nearest, 1, 1), np.roll(nearest, -1, 1)))
        padded = np.pad(around, ((1, 1), (0, 0)), constant_values=np.inf)
        around = np.minimum(around, np.minimum(padded[:-2], padded[2:]))
        return cls(viewpoint, axes, np.where(np.isfinite(nearest), around, -np.inf))

    def margins(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """For points (..., 3) that are claimed to exist: how far they lie behind what the sensor saw in their direction
        (negative: in space which it saw through; inf where it saw nothing), and their distances from the sensor."""
        pixel, distance = _pixels(points.reshape(-1, 3), self.viewpoint, self.axes, self.nearest.shape)
        shape = points.shape[:-1]
        return (distance - self.nearest.take(pixel)).reshape(shape), distance.reshape(shape)


def _viewing_axes(rays: FloatArray) -> FloatArray:
    """Forward is the mean direction: the poles, where pixels crowd, then lie at the side of the view."""
    lengths = np.linalg.norm(rays, axis=1, keepdims=True)
    forward = (rays / np.maximum(lengths, 1e-12)).mean(0)
    norm = np.linalg.norm(forward)
    forward = forward / norm if norm > 1e-6 else np.array([1.0, 0.0, 0.0])
    helper = np.eye(3)[np.argmin(np.abs(forward))]
    left = np.cross(helper, forward)
    left /= np.linalg.norm(left)
    return np.array([forward, left, np.cross(forward, left)])


def _pixels(
    points: FloatArray, viewpoint: FloatArray, axes: FloatArray, shape: tuple[int, ...]
) -> tuple[IntArray, FloatArray]:
    """In which pixel, counted row by row, points (N, 3) lie, and how far away."""
    # One coordinate at a time: on columns of rows of three numpy's functions take two to three times as long.
    x, y, z = axes @ (points - viewpoint).T
    distance = np.sqrt(x * x + y * y + z * z)
    azimuth = np.arctan2(y, x) * (0.5 / np.pi) + 0.5
    polar = np.arccos(np.clip(z / np.maximum(distance, 1e-12), -1, 1)) / np.pi
    row = np.minimum((polar * shape[0]).astype(np.int64), shape[0] - 1)
    column = np.minimum((azimuth * shape[1]).astype(np.int64), shape[1] - 1)
    return row * shape[1] + column, distance
