"""Pinhole cameras with radial and tangential distortion, and the views of a scene; pixel centres at whole numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.errors import InputError
from geomoe3d.geometry.se3 import inverse
from geomoe3d.runtime.optional import optional_module
from geomoe3d.types import FloatArray


def opencv() -> Any:
    """OpenCV. Raises DependencyError: it is not installed."""
    return optional_module("cv2", "images need OpenCV", "'geomoe3d[images]'")


def robust_estimator(name: str, seed: int, plain: str) -> tuple[Any, int]:
    """OpenCV, its random numbers seeded, and its constant for an estimator. Raises InputError: it is none."""
    cv2 = opencv()
    if name not in ("ransac", "magsac"):
        raise InputError(f"there is no estimator '{name}'; there are magsac, ransac and {plain}")
    cv2.setRNGSeed(seed)
    return cv2, cv2.RANSAC if name == "ransac" else cv2.USAC_MAGSAC


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one image.

    Attributes:
        fx, fy, cx, cy: pixels.
        distortion: k1, k2, p1, p2 (OpenCV's model), all 0 for an ideal camera.
        size: width and height in pixels, or None where not known.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not (np.isfinite(values).all() and self.fx > 0 and self.fy > 0):
            given = ", ".join(
                f"{name}={value}" for name, value in zip(("fx", "fy", "cx", "cy"), values, strict=False)
            )
            raise InputError(f"intrinsics {given}: focal lengths must be positive, and all of them finite")

    @classmethod
    def guess(cls, width: int, height: int) -> Camera:
        """Of an unknown camera: the middle of the image, and a focal length of its longer side."""
        focal = max(width, height)
        return cls(focal, focal, (width - 1) / 2, (height - 1) / 2, size=(width, height))

    @classmethod
    def of(cls, K: FloatArray) -> Camera:
        """Of an intrinsic matrix (3, 3), or the first columns of a projection (3, 4)."""
        return cls(K[0, 0], K[1, 1], K[0, 2], K[1, 2])

    @property
    def focal(self) -> float:
        """Pixels that one focal length is worth, mean of both axes."""
        return (self.fx + self.fy) / 2

    def side(self, pixels: FloatArray) -> float:
        """Longer side of the image in focal lengths; without a known size the extent of pixels (N, 2)."""
        if self.size is not None:
            return max(self.size) / self.focal
        return max(float(np.ptp(pixels, axis=0).max()), 1.0) / self.focal if len(pixels) else 1.0

    def normalise(self, pixels: FloatArray) -> FloatArray:
        """Pixels (N, 2) to rays (N, 2), x = (u - c) / f with the distortion undone."""
        points = np.ascontiguousarray(pixels, dtype=np.float64)
        if any(self.distortion) and len(points):
            K = np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])
            undone: FloatArray = opencv().undistortPoints(points, K, np.array(self.distortion))
            return undone.reshape(-1, 2)
        return (points - [self.cx, self.cy]) / [self.fx, self.fy]


@dataclass(frozen=True)
class View:
    """One photograph of a scene."""

    path: Path
    camera: Camera
    T_camera_world: FloatArray  # (4, 4), X_camera = R X_world + t; x right, y down, z forward


@dataclass(frozen=True)
class ImageScene:
    """Photographs with known cameras."""

    name: str  # of its folder
    layout: str  # which reader understood it
    views: tuple[View, ...]  # in the order of the file
    notes: tuple[str, ...] = ()  # what was left out, and why
    pairs: tuple[tuple[int, int], ...] | None = None  # as published; None: to be chosen by rotation


def relative_pose(first: View, second: View) -> FloatArray:
    """(4, 4) that maps the first camera's frame into the second's; t in the unit of the scene."""
    T: FloatArray = second.T_camera_world @ inverse(first.T_camera_world)
    return T


def rays_of(pixels: FloatArray, cameras: Sequence[Camera]) -> FloatArray:
    """Matches (N, 4) in pixels of two cameras as rays (N, 4), see `Camera.normalise`."""
    return np.hstack([camera.normalise(pixels[:, 2 * k : 2 * k + 2]) for k, camera in enumerate(cameras)])
