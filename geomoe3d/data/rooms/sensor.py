"""A structured-light depth camera in a scene of triangles.

What makes real depth different from true depth, each from how such a camera works: the projector's shadow
beside near objects, dropout on grazing and far surfaces, block matching that smears edges, noise of the
disparity that is alike in neighbouring pixels, its rounding to eighths of a pixel (2.6 cm at 3 m), a slow
bias over the image that belongs to the device, and a limited range. About 15 ms per frame of 320 x 240 on
one core, half of it casting the rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from geomoe3d.config import Section
from geomoe3d.types import BoolArray, Float32Array, FloatArray, IntArray


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: size in pixels, focal length and centre in pixels."""

    width: int
    height: int
    focal: float

    @property
    def intrinsics(self) -> FloatArray:
        """(3, 3) matrix; the centre lies in the middle of the image."""
        cx, cy = (self.width - 1) / 2, (self.height - 1) / 2
        return np.array([[self.focal, 0, cx], [0, self.focal, cy], [0, 0, 1.0]])

    def rays(self) -> FloatArray:
        """(H*W, 3) directions with z = 1, so that the distance along a ray is depth."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        K = self.intrinsics
        x, y = (u - K[0, 2]) / self.focal, (v - K[1, 2]) / self.focal
        return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)


KINECT = Camera(320, 240, 292.5)
"""A Kinect's 57 by 45 degrees at half its resolution."""


@dataclass(frozen=True)
class Hits:
    """What the rays of one image met.

    Attributes:
        depth: (H, W) metres along the optical axis, inf where nothing was met.
        slope: (H, W) cosine between ray and surface normal in [0, 1], 0 where nothing was met.
        triangle: (H*W,) index of the triangle.
        normal: (H*W, 3) float32 of the surface in the world, of either sign.
    """

    depth: FloatArray
    slope: FloatArray
    triangle: IntArray
    normal: Float32Array


class SensorSettings(Section):
    """The strengths of what the sensor does; see the module's text.

    Attributes:
        near: least depth, metres.
        far: largest depth, metres.
        baseline: between projector and camera, metres.
        disparity_step: rounding of the disparity, pixels of a 640-pixel image.
        disparity_noise: its standard deviation before rounding, pixels of a 640-pixel image.
        edge_shift: standard deviation of the pixel shift by block matching, pixels.
        min_slope: cosine below which a surface is never seen.
        full_slope: cosine above which it always is.
        hole_share: share of patches that fail for other reasons (dark, shiny).
        bias: largest relative depth error of the device at 3 m, smooth over the image.
    """

    near: float = 0.5
    far: float = 4.5
    baseline: float = 0.075
    disparity_step: float = 0.125
    disparity_noise: float = 0.14
    edge_shift: float = 0.8
    min_slope: float = 0.08
    full_slope: float = 0.25
    hole_share: float = 0.03
    bias: float = 0.008


def cast(scene: Any, camera: Camera, T_world_camera: FloatArray) -> Hits:
    """True depth of an image of a ray casting scene (`Solids.scene`), on one thread."""
    import open3d as o3d

    rays = camera.rays() @ T_world_camera[:3, :3].T
    origin = np.broadcast_to(T_world_camera[:3, 3], rays.shape)
    bundle = np.column_stack([origin, rays]).astype(np.float32)
    hits = scene.cast_rays(o3d.core.Tensor.from_numpy(bundle), nthreads=1)
    normals = hits["primitive_normals"].numpy().astype(np.float64)
    directions = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    shape = (camera.height, camera.width)
    depth = hits["t_hit"].numpy().astype(np.float64).reshape(shape)
    slope = np.abs(np.einsum("ij,ij->i", directions, normals)).reshape(shape)
    slope = np.where(np.isfinite(depth), slope, 0.0)
    return Hits(depth, slope, hits["primitive_ids"].numpy(), hits["primitive_normals"].numpy())


class DepthSensor:
    """One device: its slow bias is drawn once, its noise anew for every frame."""

    def __init__(self, camera: Camera, settings: SensorSettings, rng: np.random.Generator) -> None:
        self.camera = camera
        self.settings = settings
        self._rng = rng
        y, x = np.mgrid[-1 : 1 : camera.height * 1j, -1 : 1 : camera.width * 1j]
        c = rng.normal(0, 0.5, 6)
        smooth = c[0] + c[1] * x + c[2] * y + c[3] * x * y + c[4] * (x**2 - 0.33) + c[5] * (y**2 - 0.33)
        # Kinect's systematic error grows with the square of depth: a shift of the disparity.
        self._bias_at_3m = settings.bias * np.clip(smooth, -1.5, 1.5)

    def measure(self, hits: Hits) -> Float32Array:
        """Depth (H, W) float32 in metres as the device reports it, 0 where it reports none."""
        s, rng = self.settings, self._rng
        shape = hits.depth.shape
        rows, columns = np.indices(shape)
        shift = s.edge_shift * _smooth(rng.standard_normal((2, *shape)))
        rows = np.clip(np.rint(rows + shift[0]), 0, shape[0] - 1).astype(np.intp)
        columns = np.clip(np.rint(columns + shift[1]), 0, shape[1] - 1).astype(np.intp)
        depth, slope = hits.depth[rows, columns], hits.slope[rows, columns]
        seen = np.isfinite(depth) & (depth > s.near) & (depth < s.far)
        seen &= ~self._shadow(hits.depth)
        chance = np.clip((slope - s.min_slope) / (s.full_slope - s.min_slope), 0, 1)
        seen &= _patches(rng, shape) < chance
        seen &= _patches(rng, shape, 6) >= s.hole_share
        focal = 640.0 / self.camera.width * self.camera.focal
        safe = np.where(seen, depth, 1.0)
        disparity = s.baseline * focal / safe
        disparity = disparity * (1 + self._bias_at_3m * safe / 3.0)
        disparity = disparity + s.disparity_noise * _smooth(rng.standard_normal(shape))
        disparity = np.maximum(np.rint(disparity / s.disparity_step) * s.disparity_step, s.disparity_step)
        measured = s.baseline * focal / disparity
        seen &= (measured > s.near) & (measured < s.far)
        return np.where(seen, measured, 0.0).astype(np.float32)

    def _shadow(self, depth: FloatArray) -> BoolArray:
        """Pixels that the projector, ``baseline`` to the side, does not reach."""
        height, width = depth.shape
        disparity = self.settings.baseline * self.camera.focal / depth
        column = np.arange(width)[None, :] - disparity
        reached = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
        beyond = np.concatenate([reached[:, 1:], np.full((height, 1), np.inf)], axis=1)
        return np.asarray(column > beyond + 0.5)


def _smooth(values: FloatArray) -> FloatArray:
    """Noise averaged over 3 x 3 pixels, brought back to unit variance."""
    padded = np.pad(values, [(0, 0)] * (values.ndim - 2) + [(1, 1), (1, 1)], mode="wrap")
    rows = padded[..., :-2, :] + padded[..., 1:-1, :] + padded[..., 2:, :]
    total: FloatArray = (rows[..., :-2] + rows[..., 1:-1] + rows[..., 2:]) / 3.0
    return total


def _patches(rng: np.random.Generator, shape: tuple[int, ...], size: int = 3) -> FloatArray:
    """Uniform numbers that are alike within patches of ``size`` pixels."""
    rows, columns = -(-shape[0] // size), -(-shape[1] // size)
    coarse = rng.random((rows, columns))
    return np.repeat(np.repeat(coarse, size, axis=0), size, axis=1)[: shape[0], : shape[1]]
