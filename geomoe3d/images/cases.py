"""What methods are measured on: poses of scenes and of published lists, homographies of three kinds.

A pair of photographs goes through keypoints and matches once; every method gets these.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.errors import FormatError, InputError, plain_reason
from geomoe3d.images.cameras import Camera, View, opencv, rays_of
from geomoe3d.images.config import KEYPOINTS
from geomoe3d.images.features import Matches, detect, match, read_grey
from geomoe3d.images.homography import corner_error, find_homography, map_points
from geomoe3d.images.pairs import MatchedPair, ViewMatcher, ViewPair, pose_pairs
from geomoe3d.images.scenes import images_in, layout_of, read_scene
from geomoe3d.types import BoolArray, FloatArray


@dataclass(frozen=True)
class HomographyPair:
    """Two images of a plane with their matches and the truth; offers what `MatchedPair` does."""

    name: str
    matches: Matches  # in pixels
    H: FloatArray  # (3, 3) true homography, pixel1 ~ H pixel0
    size: tuple[int, int]  # width and height of the first image
    plain = "DLT"
    turned = math.nan

    @property
    def rays(self) -> FloatArray:
        """(N, 4) as a network sees the matches, of guessed cameras."""
        return rays_of(self.matches.pixels, [Camera.guess(*self.size)] * 2)

    @property
    def true(self) -> BoolArray:
        """(N,) which matches end within 3 pixels of where the truth sends them."""
        first, second = self.matches.pixels[:, :2], self.matches.pixels[:, 2:]
        within: BoolArray = np.linalg.norm(map_points(self.H, first) - second, axis=1) < 3.0
        return within

    def answer(self, estimator: Any, weights: FloatArray) -> tuple[float, str]:
        """Mean error of the first image's corners, pixels (infinite without H), and the status; see
        `find_homography`."""
        found = find_homography(self.matches.pixels, weights=weights, estimator=estimator)
        return corner_error(found.H, self.H, self.size), found.status


Case = MatchedPair | HomographyPair


def read_pair_list(file: Path, root: Path | None = None) -> list[ViewPair]:
    """Pairs of a list as published for YFCC100M and ScanNet: a line has two names, two turns of the images
    (unused), two 3 x 3 intrinsics and a 4 x 4 pose of the second camera, row by row. Images lie in ``root``,
    else beside the list. Raises FormatError: it is no such list."""
    try:
        rows = np.loadtxt(file, dtype=str, ndmin=2)
        numbers = rows[:, 4:].astype(np.float64)
    except ValueError as error:
        raise FormatError(f"'{file}' is no list of pairs: {plain_reason(error)}") from None
    if rows.shape[1] != 38:
        raise FormatError(f"'{file}' has {rows.shape[1]} words a line; a pair has 38")
    pairs = []
    for names, values in zip(rows, numbers, strict=True):
        cameras = [Camera.of(K) for K in values[:18].reshape(2, 3, 3)]
        poses = (np.eye(4), values[18:].reshape(4, 4))
        one, other = (View((root or file.parent) / names[k], cameras[k], poses[k]) for k in (0, 1))
        pairs.append((one, other))
    return pairs


def warped_cases(folder: Path, count: int, seed: int = 0) -> Iterator[HomographyPair]:
    """At most ``count`` exact warps, two of an image, darkened and with noise, of images spread evenly over those
    of a folder or of a scene; all reduced to 800 pixels."""
    cv2 = opencv()
    scene = layout_of(folder) is not None
    paths = [view.path for view in read_scene(folder).views] if scene else images_in(folder)
    if not paths:
        raise InputError(f"'{folder}' holds no images")
    chosen = np.unique(np.linspace(0, len(paths) - 1, max(1, count // 2)).astype(int))
    for number in chosen:
        image = read_grey(paths[number])
        scale = KEYPOINTS.longer_side / max(image.shape)
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        height, width = image.shape
        middle = (width / 2, height / 2)
        square = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float32)
        first = detect(image)
        for k in range(2):
            rng = np.random.default_rng([seed, number, k])
            turn = cv2.getRotationMatrix2D(middle, -rng.uniform(-45, 45), rng.uniform(0.6, 1.2))
            moved = cv2.transform(square[None], turn)[0] + rng.uniform(-0.2, 0.2, (4, 2)) * image.shape[::-1]
            H = cv2.getPerspectiveTransform(square, moved.astype(np.float32))
            other = cv2.warpPerspective(image, H, (width, height)) * rng.uniform(0.6, 1.0)
            other = np.clip(other + rng.normal(0, 4, other.shape), 0, 255).astype(np.uint8)
            name = f"{paths[number].stem}/{k}"
            yield HomographyPair(name, match(first, detect(other)), H, (width, height))


def hpatches_cases(folder: Path) -> Iterator[HomographyPair]:
    """A sequence as HPatches publishes it: 1.ppm to 6.ppm with H_1_2 to H_1_6."""
    first = detect(folder / "1.ppm", most=4000)
    for k in range(2, 7):
        found = match(first, detect(folder / f"{k}.ppm", most=4000))
        yield HomographyPair(f"1-{k}", found, _homography(folder / f"H_1_{k}"), first.size)


def model_cases(folder: Path) -> Iterator[HomographyPair]:
    """Pairs of danini/magsac: NAME_pts.txt (u0 v0 1 u1 v1 1) and NAME_model.txt, which maps B into A.

    Ratio and mutuality of the matches are not known: all count as distinct.
    """
    images = {path.stem: path for path in images_in(folder)}
    for file in sorted(folder.glob("*_model.txt")):
        name = file.name.removesuffix("_model.txt")
        rows = _numbers(folder / f"{name}_pts.txt", 6)[:, [0, 1, 3, 4]]
        height, width = read_grey(images.get(f"{name}A", folder / f"{name}A.png")).shape
        matches = Matches(rows, np.zeros(len(rows)), np.ones(len(rows), dtype=bool))
        yield HomographyPair(name, matches, np.linalg.inv(_homography(file)).astype(float), (width, height))


def _homography(file: Path) -> FloatArray:
    """The three rows of three numbers of a file. Raises FormatError: it holds others, or no homography."""
    H = _numbers(file, 3)
    norm = float(np.linalg.norm(H))
    if H.shape != (3, 3) or not (np.isfinite(norm) and abs(np.linalg.det(H / max(norm, 1e-300))) > 1e-15):
        raise FormatError(
            f"'{file}' holds no homography: three rows of three numbers whose determinant is not 0"
        )
    return H


def _numbers(file: Path, columns: int) -> FloatArray:
    try:
        rows: FloatArray = np.loadtxt(file, ndmin=2)
    except (OSError, ValueError) as error:
        raise FormatError(f"'{file}' cannot be read: {plain_reason(error)}") from None
    if rows.shape[1] < columns:
        raise FormatError(f"'{file}' has {rows.shape[1]} numbers a line; at least {columns} are needed")
    return rows


def cases_of(path: Path, count: int, homographies: bool, root: Path | None = None) -> Iterator[Case]:
    """What lies at a path: a scene or a list of pairs, or one of the three kinds of homographies."""
    if not homographies:
        listed = read_pair_list(path, root) if path.is_file() else pose_pairs(read_scene(path), count)
        return map(ViewMatcher(), listed)
    if (path / "H_1_2").is_file():
        return hpatches_cases(path)
    return model_cases(path) if any(path.glob("*_model.txt")) else warped_cases(path, count)
