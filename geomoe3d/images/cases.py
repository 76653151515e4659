"""What methods are measured on: poses of scenes and of published lists, homographies of three kinds.

A pair of photographs goes through keypoints and matches once; every method gets these.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geomoe3d.errors import FormatError, InputError
from geomoe3d.geometry.essential import pose_errors_deg
from geomoe3d.geometry.se3 import rotation_angle_deg
from geomoe3d.images.cameras import Camera, View, opencv, rays_of
from geomoe3d.images.config import KEYPOINTS
from geomoe3d.images.features import Matches, detect, match, read_grey
from geomoe3d.images.homography import corner_error, find_homography, map_points
from geomoe3d.images.pairs import MatchedPair, ViewMatcher, ViewPair, pose_pairs
from geomoe3d.images.pose import find_pose
from geomoe3d.images.scenes import images_in, layout_of, read_scene
from geomoe3d.types import BoolArray, FloatArray

POSE_ESTIMATORS = {"RANSAC": "ransac", "MAGSAC++": "magsac", "eight-point": "eight_point"}
HOMOGRAPHY_ESTIMATORS = {"RANSAC": "ransac", "MAGSAC++": "magsac", "DLT": "dlt"}
"""Names in tables; the last one of either takes the weights themselves and rejects nothing."""


@dataclass(frozen=True)
class Case:
    """A pair with known answer.

    Attributes:
        name: of the pair.
        matches: that every method gets.
        rays: (N, 4) the same as a network sees them.
        true: (N,) bool, which of them fit the truth.
        estimators: name in tables and keyword.
        answer: weights (N,) and keyword of an estimator to error (infinite without an answer) and status.
        turned: rotation between the cameras, degrees; NaN for homographies.
    """

    name: str
    matches: Matches
    rays: FloatArray
    true: BoolArray
    estimators: dict[str, str]
    answer: Callable[[FloatArray, Any], tuple[float, str]]
    turned: float = math.nan


def pose_cases(pairs: Iterable[ViewPair], seed: int = 0) -> Iterator[Case]:
    """Relative poses; the error is the larger of the angles of rotation and translation, degrees."""
    for pair in map(ViewMatcher(), pairs):
        name = "-".join(view.path.stem for view in pair.views)
        answer = partial(_pose_error, pair, seed)
        turned = rotation_angle_deg(pair.T[:3, :3])
        yield Case(name, pair.matches, pair.rays, pair.true, POSE_ESTIMATORS, answer, turned)


def _pose_error(pair: MatchedPair, seed: int, weights: FloatArray, estimator: Any) -> tuple[float, str]:
    cameras = (pair.views[0].camera, pair.views[1].camera)
    result = find_pose(pair.matches.pixels, cameras, weights=weights, estimator=estimator, seed=seed)
    if result.T is None:
        return math.inf, result.status
    errors = pose_errors_deg(torch.from_numpy(result.T), torch.from_numpy(pair.T))
    return float(max(errors)), result.status


def homography_case(name: str, found: Matches, H: FloatArray, size: tuple[int, int]) -> Case:
    """Of a true homography and the size of the first image; the error is the mean of its corners', pixels."""
    rays = rays_of(found.pixels, [Camera.guess(*size)] * 2)
    true = np.linalg.norm(map_points(H, found.pixels[:, :2]) - found.pixels[:, 2:], axis=1) < 3.0  # pixels

    def answer(weights: FloatArray, estimator: Any) -> tuple[float, str]:
        result = find_homography(found.pixels, weights=weights, estimator=estimator)
        return corner_error(result.H, H, size), result.status

    return Case(name, found, rays, true, HOMOGRAPHY_ESTIMATORS, answer)


def read_pair_list(file: Path, root: Path | None = None) -> list[ViewPair]:
    """Pairs of a list as published for YFCC100M and ScanNet: a line has two names, two turns of the images
    (unused), two 3 x 3 intrinsics and a 4 x 4 pose of the second camera, row by row. Images lie in ``root``,
    else beside the list. Raises FormatError: a line has another number of words, or one that is no number."""
    pairs = []
    for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1):
        words = line.split()
        if words and len(words) != 38:
            raise FormatError(f"'{file}' line {number} has {len(words)} words; a pair has 38")
        if words:
            try:
                values = np.array(words[4:], dtype=np.float64)
            except ValueError as error:
                raise FormatError(f"'{file}' line {number}: {error}") from None
            cameras = [Camera.of(K) for K in values[:18].reshape(2, 3, 3)]
            poses = (np.eye(4), values[18:].reshape(4, 4))
            one, other = (View((root or file.parent) / words[k], cameras[k], poses[k]) for k in (0, 1))
            pairs.append((one, other))
    return pairs


def warped_cases(folder: Path, count: int, seed: int = 0) -> Iterator[Case]:
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
        square = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float32)
        first = detect(image)
        for k in range(2):
            rng = np.random.default_rng([seed, number, k])
            turned = np.radians(rng.uniform(-45, 45))
            R = np.array([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]])
            middle = np.array([width, height]) / 2
            moved = (square - middle) @ R.T * rng.uniform(0.6, 1.2) + middle
            moved = moved + rng.uniform(-0.2, 0.2, (4, 2)) * [width, height]
            H = cv2.getPerspectiveTransform(square, moved.astype(np.float32))
            other = cv2.warpPerspective(image, H, (width, height)) * rng.uniform(0.6, 1.0)
            other = np.clip(other + rng.normal(0, 4, other.shape), 0, 255).astype(np.uint8)
            name = f"{paths[number].stem}/{k}"
            yield homography_case(name, match(first, detect(other)), H, (width, height))


def hpatches_cases(folder: Path) -> Iterator[Case]:
    """A sequence as HPatches publishes it: 1.ppm to 6.ppm with H_1_2 to H_1_6."""
    first = detect(folder / "1.ppm", most=4000)
    for k in range(2, 7):
        found = match(first, detect(folder / f"{k}.ppm", most=4000))
        yield homography_case(f"1-{k}", found, np.loadtxt(folder / f"H_1_{k}"), first.size)


def model_cases(folder: Path) -> Iterator[Case]:
    """Pairs of danini/magsac: NAME_pts.txt (u0 v0 1 u1 v1 1) and NAME_model.txt, which maps B into A.

    Ratio and mutuality of the matches are not known: all count as distinct.
    """
    for file in sorted(folder.glob("*_model.txt")):
        name = file.name.removesuffix("_model.txt")
        rows = np.loadtxt(folder / f"{name}_pts.txt")[:, [0, 1, 3, 4]]
        image = next(path for path in images_in(folder) if path.stem == f"{name}A")
        height, width = read_grey(image).shape
        matches = Matches(rows, np.zeros(len(rows)), np.ones(len(rows), dtype=bool))
        H = np.asarray(np.linalg.inv(np.loadtxt(file)), dtype=np.float64)
        yield homography_case(name, matches, H, (width, height))


def cases_of(path: Path, count: int, homographies: bool, root: Path | None = None) -> Iterator[Case]:
    """What lies at a path: a scene or a list of pairs, or one of the three kinds of homographies."""
    if not homographies:
        return pose_cases(
            read_pair_list(path, root) if path.is_file() else pose_pairs(read_scene(path), count)
        )
    if (path / "H_1_2").is_file():
        return hpatches_cases(path)
    return model_cases(path) if any(path.glob("*_model.txt")) else warped_cases(path, count)
