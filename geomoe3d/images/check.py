"""Whether the cameras of a scene are true: how far its matches lie from the epipolar lines they give."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geomoe3d.errors import InputError
from geomoe3d.images.cameras import ImageScene, relative_pose
from geomoe3d.images.config import KEYPOINTS, TRUTH
from geomoe3d.images.features import Keypoints, detect, match
from geomoe3d.images.pose import residuals_of
from geomoe3d.images.scenes import choose_pairs
from geomoe3d.runtime.words import counted


@dataclass(frozen=True)
class TruthCheck:
    """What was found.

    Attributes:
        scene, layout, notes, num_views: of the scene.
        num_pairs: pairs looked at, turned by 3 to 20 degrees.
        num_matches: mutual ones that pass the ratio test.
        share: of them within 2 pixels of their epipolar lines.
        median: pixels.
        usable: share at least 0.6 and median at most 1 pixel.
    """

    scene: str
    layout: str
    notes: tuple[str, ...]
    num_views: int
    num_pairs: int
    num_matches: int
    share: float
    median: float
    usable: bool


def check_truth(scene: ImageScene, pairs: int = 40, seed: int = 0) -> TruthCheck:
    """Measure the cameras of a scene on pairs drawn at random. Raises InputError: no two views are turned by
    3 to 20 degrees against each other, or they have no matches."""
    chosen = choose_pairs(scene, (3.0, 20.0), pairs, seed)
    seen: dict[Path, Keypoints] = {}
    found = []
    for i, j in chosen:
        views = scene.views[i], scene.views[j]
        for view in views:
            if view.path not in seen:
                seen[view.path] = detect(view.path)
        matches = match(*(seen[view.path] for view in views))
        pixels = matches.pixels[matches.distinct()]
        rays = np.hstack([v.camera.normalise(pixels[:, 2 * k : 2 * k + 2]) for k, v in enumerate(views)])
        scale = KEYPOINTS.longer_side / max(seen[views[0].path].size)
        found.append(residuals_of(relative_pose(*views), rays) * views[0].camera.focal * scale)
    far = np.concatenate(found) if found else np.zeros(0)
    if len(far) == 0:
        raise InputError(
            f"'{scene.name}': no match in {counted(len(chosen), 'pair')} turned by 3 to 20 degrees; "
            "nothing says whether its cameras are true"
        )
    share, median = float((far < 2.0).mean()), float(np.median(far))
    usable = share >= TRUTH.least_share and median <= TRUTH.most_median
    return TruthCheck(
        scene.name, scene.layout, scene.notes, len(scene.views), len(chosen), len(far), share, median, usable
    )
