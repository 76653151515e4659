"""Keypoints and matches of two photographs by OpenCV: SIFT, RootSIFT, ORB; nearest neighbour, mutual, ratio."""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from geomoe3d.errors import FormatError, InputError, MissingFileError
from geomoe3d.images.cameras import opencv
from geomoe3d.images.config import KEYPOINTS
from geomoe3d.runtime.optional import optional_module
from geomoe3d.types import BoolArray, Float32Array, FloatArray

Detector = Literal["rootsift", "sift", "orb"]


@dataclass(frozen=True)
class Keypoints:
    """Of one image."""

    pixels: FloatArray  # (N, 2) in the image as stored
    descriptors: Float32Array  # (N, C) of unit length
    size: tuple[int, int]  # width and height of the image


@dataclass(frozen=True)
class Matches:
    """Of two images."""

    pixels: FloatArray  # (N, 4) rows [u0, v0, u1, v1]
    ratio: FloatArray  # (N,) distance of the descriptors over that to the second nearest, at most 1
    mutual: BoolArray  # (N,) each the other's nearest

    def __len__(self) -> int:
        return len(self.pixels)

    def distinct(self, ratio: float = KEYPOINTS.ratio) -> BoolArray:
        """(N,) mutual ones that pass the ratio test."""
        return self.mutual & (self.ratio < ratio)


def read_grey(path: str | Path) -> NDArray[np.uint8]:
    """A photograph (height, width) in grey, as stored: a tag that says it is to be turned is not followed.

    Raises:
        MissingFileError: there is none.
        InputError: OpenCV cannot read it; as FormatError: it is damaged or cut short.
        DependencyError: OpenCV or, for a JPEG, simplejpeg is not installed.
    """
    cv2 = opencv()
    if Path(path).is_dir():
        raise InputError(f"'{path}' is a folder; give one image of it")
    if not Path(path).is_file():
        raise MissingFileError(f"there is no image '{path}'; check the path")
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    image: NDArray[np.uint8] | None = cv2.imread(str(path), flags)
    if image is None:
        raise InputError(
            f"'{path}' cannot be read as an image: it is damaged, or of a kind that OpenCV "
            "does not know; give a whole PNG or JPEG"
        )
    _check_whole(Path(path))
    return image


def _check_whole(path: Path) -> None:
    """Refuse a damaged image: OpenCV fills what it cannot decode with grey and says so on the terminal alone."""
    from PIL import Image, UnidentifiedImageError

    content = path.read_bytes()
    try:
        if content.startswith(b"\xff\xd8\xff"):
            # Pillow sees a JPEG cut short, but no damage inside.
            jpeg = optional_module("simplejpeg", "JPEG images need simplejpeg", "'geomoe3d[images]'")
            kind = jpeg.decode_jpeg_header(content, strict=True)[2]
            jpeg.decode_jpeg(content, "CMYK" if kind in ("CMYK", "YCCK") else "GRAY", strict=True)
            return
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # photographs may be large
            with Image.open(io.BytesIO(content)) as image:
                image.load()
    except (UnidentifiedImageError, Image.DecompressionBombError):
        return  # a kind, or a size, that OpenCV alone reads
    except (OSError, SyntaxError, ValueError) as error:
        raise FormatError(
            f"'{path}' is damaged: {error}; copy it anew from the camera, or, if it looks whole, save it again"
        ) from None


def detect(
    image: str | Path | NDArray[np.uint8],
    detector: Detector = "rootsift",
    most: int = KEYPOINTS.number,
    longer_side: int = KEYPOINTS.longer_side,
) -> Keypoints:
    """The strongest ``most`` keypoints of an image, reduced to ``longer_side`` pixels first where it is larger.

    Args:
        image: path, or (height, width) uint8.
        detector: ``rootsift`` is SIFT under the Hellinger distance (Arandjelović and Zisserman 2012).
        most, longer_side: see above.

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
    orb = detector == "orb"
    made = cv2.ORB_create(most) if orb else cv2.SIFT_create(most, contrastThreshold=KEYPOINTS.contrast)
    found, raw = made.detectAndCompute(grey, None)
    if raw is None:
        return Keypoints(np.zeros((0, 2)), np.zeros((0, 1), np.float32), (width, height))
    # A reduced pixel stands for a square of them, whose middle is not its corner.
    pixels = (np.array([one.pt for one in found], dtype=np.float64) + 0.5) / scale - 0.5
    values = np.unpackbits(raw, axis=1) * 2.0 - 1.0 if orb else raw.astype(np.float64)
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
    alike[rows, nearest] = -1.0  # as far apart as descriptors of unit length can be
    best, other = (
        np.sqrt(np.maximum(2.0 - 2.0 * x.astype(np.float64), 0.0)) for x in (best, alike.max(axis=1))
    )
    return Matches(np.hstack([first.pixels, second.pixels[nearest]]), best / np.maximum(other, 1e-12), mutual)


def halves_of(matches: FloatArray) -> list[FloatArray]:
    """First and second points (N, 2) of matches (N, 4), as OpenCV takes them."""
    return [np.ascontiguousarray(matches[:, :2]), np.ascontiguousarray(matches[:, 2:])]


def random_halves(rows: NDArray[Any]) -> list[NDArray[Any]]:
    """Rows in two halves, drawn at random, the same ones each time."""
    order = np.random.default_rng(0).permutation(rows)
    return [order[::2], order[1::2]]


def checked(pixels: object, weights: object, threshold: Any, seed: Any = 0) -> tuple[FloatArray, FloatArray]:
    """Matches (N, 4) and their weights (N,), 0 for rows that are not finite and 1 where none are given.
    Raises InputError: shapes do not fit, values that are no real numbers or no pixels, a threshold that is
    not positive, or a seed that OpenCV cannot take."""
    points = _numbers("matches", pixels)
    shape = points.shape
    w = np.ones(shape[:1]) if weights is None else np.nan_to_num(_numbers("weights", weights))
    if len(shape) != 2 or shape[1] != 4 or w.shape != shape[:1]:
        raise InputError(f"matches must be (N, 4) and weights (N,), found {shape} and {w.shape}")
    usable = np.isfinite(points).all(axis=1)
    most = float(np.abs(points[usable]).max(initial=0.0))
    if most > 1e7:  # farther out no image reaches, and squares of much more no longer fit a number
        raise InputError(f"matches must be in pixels, found {most:g}; at most 1e+07 is allowed")
    if threshold is not None and not (isinstance(threshold, Real) and 0 < float(threshold) < np.inf):
        raise InputError(f"the inlier threshold must be a positive number of pixels, found {threshold}")
    largest = 2**31 - 1  # OpenCV holds its seed in 32 bits
    if not (isinstance(seed, Integral) and 0 <= int(seed) <= largest):
        raise InputError(f"the seed must be a whole number from 0 to {largest}, found {seed}")
    return points, np.where(usable, w, 0.0)


def _numbers(name: str, values: object) -> FloatArray:
    try:
        array = np.asarray(values)
    except ValueError:  # rows of different lengths
        array = np.asarray(None)
    if array.dtype.kind in "fiub":
        return array.astype(np.float64)
    found = f"{type(values).__name__} ({array.dtype})"
    raise InputError(f"{name} must be an array of real numbers, found {found}")
