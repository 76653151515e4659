"""Keypoints and matches of two photographs by OpenCV: SIFT, RootSIFT, ORB; nearest neighbour, mutual, ratio."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from geomoe3d.errors import InputError, MissingFileError
from geomoe3d.images.cameras import opencv
from geomoe3d.types import BoolArray, Float32Array, FloatArray

Detector = Literal["rootsift", "sift", "orb"]
NUM_KEYPOINTS = 2000
LONGER_SIDE = 800
RATIO, LOOSE_RATIO = 0.8, 0.95
"""Ratio test by itself, and behind a network that rejects wrong matches."""
_CONTRAST = 1e-5
"""So low that images without much contrast give as many keypoints as are asked for."""


@dataclass(frozen=True)
class Keypoints:
    """Of one image.

    Attributes:
        pixels: (N, 2) in the image as stored.
        descriptors: (N, C) float32 of unit length.
        size: width and height of the image.
    """

    pixels: FloatArray
    descriptors: Float32Array
    size: tuple[int, int]


@dataclass(frozen=True)
class Matches:
    """Of two images.

    Attributes:
        pixels: (N, 4) rows [u0, v0, u1, v1].
        ratio: (N,) distance of the descriptors over that to the second nearest, below 1.
        mutual: (N,) bool, each the other's nearest.
    """

    pixels: FloatArray
    ratio: FloatArray
    mutual: BoolArray

    def __len__(self) -> int:
        return len(self.pixels)

    def distinct(self, ratio: float = RATIO) -> BoolArray:
        """(N,) mutual ones that pass the ratio test."""
        return self.mutual & (self.ratio < ratio)


def read_grey(path: str | Path) -> NDArray[np.uint8]:
    """A photograph (height, width) in grey, as stored: a tag that says it is to be turned is not followed.

    Raises:
        MissingFileError: there is none.
        InputError: OpenCV cannot read it.
    """
    cv2 = opencv()
    if not Path(path).is_file():
        raise MissingFileError(f"no image '{path}'")
    image: NDArray[np.uint8] | None = cv2.imread(
        str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    )
    if image is None:
        raise InputError(f"'{path}' cannot be read as an image; convert it to PNG or JPEG")
    return image


def detect(
    image: str | Path | NDArray[np.uint8],
    detector: Detector = "rootsift",
    most: int = NUM_KEYPOINTS,
    longer_side: int = LONGER_SIDE,
) -> Keypoints:
    """Keypoints of an image, reduced to ``longer_side`` pixels first where it is larger.

    Args:
        image: path, or (height, width) uint8.
        detector: ``rootsift`` is SIFT under the Hellinger distance (Arandjelović and Zisserman 2012).
        most: the strongest so many.
        longer_side: pixels.

    Raises:
        MissingFileError, InputError: see `read_grey`; or an unknown detector.
    """
    cv2 = opencv()
    grey = image if isinstance(image, np.ndarray) else read_grey(image)
    height, width = grey.shape[:2]
    scale = min(1.0, longer_side / max(width, height))
    if scale < 1:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    if detector not in ("rootsift", "sift", "orb"):
        raise InputError(f"there is no detector '{detector}'; there are rootsift, sift and orb")
    made = cv2.ORB_create(most) if detector == "orb" else cv2.SIFT_create(most, contrastThreshold=_CONTRAST)
    found, raw = made.detectAndCompute(grey, None)
    if raw is None:
        return Keypoints(np.zeros((0, 2)), np.zeros((0, 1), np.float32), (width, height))
    # A reduced pixel stands for a square of them, whose middle is not its corner.
    pixels = (np.array([one.pt for one in found], dtype=np.float64) + 0.5) / scale - 0.5
    values = np.unpackbits(raw, axis=1) * 2.0 - 1.0 if detector == "orb" else raw.astype(np.float64)
    if detector == "rootsift":
        values = np.sqrt(values / np.maximum(values.sum(axis=1, keepdims=True), 1e-12))
    values = values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12)
    # SIFT gives a point once per orientation and may pass its limit by some.
    return Keypoints(pixels[:most], values[:most].astype(np.float32), (width, height))


def match(first: Keypoints, second: Keypoints) -> Matches:
    """Every keypoint of the first image with the nearest of the second, in descriptor space."""
    if len(first.pixels) == 0 or len(second.pixels) == 0:
        return Matches(np.zeros((0, 4)), np.zeros(0), np.zeros(0, dtype=bool))
    alike = first.descriptors @ second.descriptors.T
    rows = np.arange(len(alike))
    nearest = alike.argmax(axis=1)
    mutual = alike.argmax(axis=0)[nearest] == rows
    best = alike[rows, nearest].copy()
    alike[rows, nearest] = -np.inf
    other = alike.max(axis=1) if alike.shape[1] > 1 else np.full(len(alike), -1.0)
    distances = [np.sqrt(np.maximum(2.0 - 2.0 * value.astype(np.float64), 0.0)) for value in (best, other)]
    ratio = distances[0] / np.maximum(distances[1], 1e-12)
    return Matches(np.hstack([first.pixels, second.pixels[nearest]]), ratio, mutual)


def checked(
    pixels: FloatArray, weights: FloatArray | None, threshold: float | None
) -> tuple[FloatArray, FloatArray]:
    """Matches (N, 4) and their weights (N,), 0 for rows that are not finite and 1 where none are given.

    Raises:
        InputError: shapes do not fit, or a threshold that is not positive.
    """
    points = np.asarray(pixels, dtype=np.float64)
    w = np.ones(len(points)) if weights is None else np.nan_to_num(np.asarray(weights, dtype=np.float64))
    if points.ndim != 2 or points.shape[1] != 4 or w.shape != (len(points),):
        raise InputError(f"matches must be (N, 4) and weights (N,), found {points.shape} and {w.shape}")
    if threshold is not None and not (np.isfinite(threshold) and threshold > 0):
        raise InputError(f"the inlier threshold must be positive, found {threshold} pixels")
    return points, np.where(np.isfinite(points).all(axis=1), w, 0.0)
