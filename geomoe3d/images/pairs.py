"""Pairs of views, matched and labelled by their cameras: what is checked, measured and trained on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geomoe3d.errors import InputError
from geomoe3d.geometry.essential import essential_of, label_threshold, pose_errors_deg, symmetric_distance
from geomoe3d.geometry.se3 import rotation_angle_deg, rotation_error_deg
from geomoe3d.images.cameras import ImageScene, View, rays_of, relative_pose
from geomoe3d.images.config import KEYPOINTS, MEASURE
from geomoe3d.images.features import Keypoints, Matches, detect, match
from geomoe3d.images.pose import find_pose, residuals_of
from geomoe3d.runtime.words import counted
from geomoe3d.types import BoolArray, FloatArray

ViewPair = tuple[View, View]


@dataclass(frozen=True)
class MatchedPair:
    """Two views with their matches and the truth."""

    views: ViewPair
    matches: Matches  # every keypoint of the first with the nearest of the second, pixels
    rays: FloatArray  # (N, 4) the same, normalised by the intrinsics
    T: FloatArray  # (4, 4) true pose, X1 = R X0 + t
    true: BoolArray  # (N,) which matches fit it, see `label_threshold`
    longer_side: int  # of the first image as stored, pixels
    plain = "eight-point"  # what fits weighted matches without rejecting any

    @property
    def name(self) -> str:
        """Stems of the images."""
        return "-".join(view.path.stem for view in self.views)

    @property
    def turned(self) -> float:
        """Angle of rotation between the cameras, degrees."""
        return rotation_angle_deg(self.T[:3, :3])

    def answer(self, estimator: Any, weights: FloatArray) -> tuple[float, str]:
        """The larger of the angles by which rotation and translation err, degrees (infinite without a pose), and
        the status; see `find_pose`."""
        cameras = (self.views[0].camera, self.views[1].camera)
        found = find_pose(self.matches.pixels, cameras, weights=weights, estimator=estimator)
        if found.T is None:
            return math.inf, found.status
        errors = pose_errors_deg(torch.from_numpy(found.T), torch.from_numpy(self.T))
        return float(max(errors)), found.status


class ViewMatcher:
    """Matches pairs of views; keypoints of an image are found once."""

    def __init__(self) -> None:
        self._seen: dict[Path, Keypoints] = {}

    def __call__(self, views: ViewPair) -> MatchedPair:
        """Raises as `geomoe3d.images.features.read_grey`."""
        for path in {view.path for view in views} - self._seen.keys():
            self._seen[path] = detect(path)
        first, second = (self._seen[view.path] for view in views)
        found = match(first, second)
        cameras = [view.camera for view in views]
        rays, T = rays_of(found.pixels, cameras), relative_pose(*views)
        side = max(*first.size, *second.size) / max(camera.focal for camera in cameras)
        far = symmetric_distance(essential_of(torch.from_numpy(T)), torch.from_numpy(rays))
        return MatchedPair(views, found, rays, T, (far < label_threshold(side)).numpy(), max(first.size))


def choose_pairs(scene: ImageScene, angles: tuple[float, float], count: int, seed: int = 0) -> list[ViewPair]:
    """At most ``count`` pairs of views whose rotation lies in [least, most) degrees, drawn at random, in order."""
    pairs = [
        pair
        for pair in combinations(scene.views, 2)
        if angles[0] <= rotation_error_deg(*(view.T_camera_world for view in pair)) < angles[1]
        and np.linalg.norm(relative_pose(*pair)[:3, 3]) > 0
    ]
    return [pairs[k] for k in sorted(np.random.default_rng(seed).permutation(len(pairs))[:count])]


def pose_pairs(scene: ImageScene, count: int) -> list[ViewPair]:
    """``count`` pairs of a scene (fewer where there are none): the first of those that came with it, else half
    turned by 3 to 20 degrees and half by 20 to 60."""
    if scene.pairs is not None:
        return [(scene.views[i], scene.views[j]) for i, j in scene.pairs[:count]]
    halves = [choose_pairs(scene, angles, count // 2) for angles in ((3.0, 20.0), (20.0, 60.0))]
    return halves[0] + halves[1]


@dataclass(frozen=True)
class TruthCheck:
    """Whether the cameras of a scene are true: how far its matches lie from the epipolar lines they give."""

    scene: str
    layout: str
    notes: tuple[str, ...]
    num_views: int
    num_pairs: int  # looked at, turned by 3 to 20 degrees, or by less where there are none
    num_matches: int  # mutual ones that pass the ratio test
    share: float  # of them within 2 pixels of their epipolar lines
    median: float  # distance from these, pixels
    usable: bool  # share at least 0.6 and median at most 1 pixel


def check_truth(scene: ImageScene, pairs: int = 40) -> TruthCheck:
    """Measure the cameras of a scene on pairs drawn at random. Raises InputError: no two views are turned by
    at most 20 degrees against each other, or they have no matches."""
    chosen = choose_pairs(scene, (3.0, 20.0), pairs) or choose_pairs(scene, (0.0, 3.0), pairs)
    found = [np.zeros(0)]
    for pair in map(ViewMatcher(), chosen):
        reduced = pair.views[0].camera.focal * KEYPOINTS.longer_side / pair.longer_side
        found.append(residuals_of(pair.T, pair.rays[pair.matches.distinct()]) * reduced)
    far = np.concatenate(found)
    if len(far) == 0:
        raise InputError(
            f"'{scene.name}': no match in {counted(len(chosen), 'pair')} turned by at most 20 degrees; "
            "nothing says whether its cameras are true"
        )
    share, median = float((far < 2.0).mean()), float(np.median(far))
    usable = share >= MEASURE.least_share and median <= MEASURE.most_median
    of_scene = (scene.name, scene.layout, scene.notes, len(scene.views))
    return TruthCheck(*of_scene, len(chosen), len(far), share, median, usable)
