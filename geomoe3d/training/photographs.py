"""Matches of real photographs to train and validate on, scene by scene, so that whole scenes can be left out."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import numpy as np

from geomoe3d.errors import InputError
from geomoe3d.geometry.se3 import make_transform
from geomoe3d.images.config import KEYPOINTS
from geomoe3d.images.pairs import MatchedPair, ViewMatcher, check_truth, pose_pairs
from geomoe3d.images.scenes import read_scene
from geomoe3d.runtime.files import new_folder
from geomoe3d.training.pairs import TrainingPair, write_shard


def write_training_set(
    folders: Sequence[str | Path],
    out: str | Path,
    *,
    count: int,
    left_out: Collection[str] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, int]:
    """One shard of matches per scene in OUT/train, or in OUT/validation where a scene is left out.

    Args:
        folders: scenes, see `read_scene`.
        out: new folder, written completely or not at all.
        count: pairs at most, of each scene, see `pose_pairs`.
        left_out: names of scenes that are not trained on.
        progress: called with scenes done and in all.

    Returns:
        Number of pairs by scene.

    Raises:
        OutputError: ``out`` exists.
        InputError: two scenes of one name, no scene to train on, one left out that is not given, or one without
            pairs or whose cameras are not those of its photographs (`check_truth`).
    """
    scenes = {scene.name: scene for scene in map(read_scene, folders)}
    if len(scenes) < len(folders):
        raise InputError(f"two scenes have one name; there are {', '.join(sorted(scenes))}; rename a folder")
    if (wrong := set(left_out) - set(scenes)) or set(left_out) == set(scenes):
        what = f"no scene '{min(wrong)}' can be left out" if wrong else "no scene remains to train on"
        raise InputError(f"{what}; given are {', '.join(scenes)}")
    made: dict[str, int] = {}
    with new_folder(Path(out), "training set") as folder:
        for name, scene in scenes.items():
            progress(len(made), len(scenes))
            if not (found := check_truth(scene)).usable:
                raise InputError(
                    f"the cameras of '{name}' are not those of its photographs: {found.share:.0%} of its matches lie "
                    "within 2 pixels of their epipolar lines; see 'geomoe3d data check'"
                )
            pairs = map(ViewMatcher(), pose_pairs(scene, count))
            rows = [_training_pair(pair) for pair in pairs if len(pair.matches) >= KEYPOINTS.least_to_train]
            if not rows:
                raise InputError(
                    f"'{name}' has no pair of photographs turned by 3 to 60 degrees with matches"
                )
            place = folder / ("validation" if name in left_out else "train")
            place.mkdir(exist_ok=True)
            write_shard(place / name, rows)
            made[name] = len(rows)
    return made


def _training_pair(pair: MatchedPair) -> TrainingPair:
    T = make_transform(pair.T[:3, :3], pair.T[:3, 3] / np.linalg.norm(pair.T[:3, 3]))
    return TrainingPair(pair.rays.astype(np.float32), pair.true, T, 1.0)
