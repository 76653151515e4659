"""Pairs of views, matched and labelled by their cameras: what is checked, measured and trained on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from geomoe3d.geometry.essential import essential_of, label_threshold, symmetric_distance
from geomoe3d.geometry.se3 import rotation_error_deg
from geomoe3d.images.cameras import ImageScene, View, rays_of, relative_pose
from geomoe3d.images.features import Keypoints, Matches, detect, match
from geomoe3d.types import BoolArray, FloatArray

ViewPair = tuple[View, View]


@dataclass(frozen=True)
class MatchedPair:
    """Two views with their matches and the truth.

    Attributes:
        views: the two.
        matches: every keypoint of the first with the nearest of the second, pixels.
        rays: (N, 4) the same, normalised by the intrinsics.
        T: (4, 4) true pose, X1 = R X0 + t.
        true: (N,) bool, which matches fit it, see `label_threshold`.
        longer_side: of the first image as stored, pixels.
    """

    views: ViewPair
    matches: Matches
    rays: FloatArray
    T: FloatArray
    true: BoolArray
    longer_side: int


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
    views = scene.views
    pairs = [
        (one, other)
        for i, one in enumerate(views)
        for other in views[i + 1 :]
        if angles[0] <= rotation_error_deg(one.T_camera_world, other.T_camera_world) < angles[1]
        and np.linalg.norm(relative_pose(one, other)[:3, 3]) > 0
    ]
    chosen = np.random.default_rng(seed).permutation(len(pairs))[:count]
    return [pairs[k] for k in sorted(chosen)]


def pose_pairs(scene: ImageScene, count: int) -> list[ViewPair]:
    """``count`` pairs of a scene (fewer where there are none): the first of those that came with it, else half
    turned by 3 to 20 degrees and half by 20 to 60."""
    if scene.pairs is not None:
        return [(scene.views[i], scene.views[j]) for i, j in scene.pairs[:count]]
    halves = [choose_pairs(scene, angles, count // 2) for angles in ((3.0, 20.0), (20.0, 60.0))]
    return halves[0] + halves[1]
