"""Whether the cameras of a scene are true: how far its matches lie from the epipolar lines they give."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomoe3d.errors import InputError
from geomoe3d.images.cameras import ImageScene
from geomoe3d.images.config import KEYPOINTS, TRUTH
from geomoe3d.images.pairs import ViewMatcher, choose_pairs
from geomoe3d.images.pose import residuals_of
from geomoe3d.runtime.words import counted


@dataclass(frozen=True)
class TruthCheck:
    """What was found.

    Attributes:
        scene, layout, notes, num_views: of the scene.
        num_pairs: pairs looked at, turned by 3 to 20 degrees, or by less where there are none.
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
    at most 20 degrees against each other, or they have no matches."""
    near = [choose_pairs(scene, angles, pairs, seed) for angles in ((3.0, 20.0), (0.0, 3.0))]
    chosen = near[0] or near[1]
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
    usable = share >= TRUTH.least_share and median <= TRUTH.most_median
    return TruthCheck(
        scene.name, scene.layout, scene.notes, len(scene.views), len(chosen), len(far), share, median, usable
    )
