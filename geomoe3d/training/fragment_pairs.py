"""Training pairs from fragments with features on disk: fresh correspondences in every epoch.

Place: a pair dataset beside `ShardFolder` and `SyntheticPairs`; the drawing itself is in
`geomoe3d.data.draw`. About 5 ms per pair of 1,000 keypoints on one core.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geomoe3d.data.draw import DrawnPair, DrawSettings, FragmentPool
from geomoe3d.training.pairs import TrainingPair


class FragmentPairs:
    """Pairs of all shards that ``geomoe3d data features`` made in a folder, without end.

    Args:
        folder: of shards.
        settings: which pairs are drawn and how; None takes the defaults.
        seed: another seed draws other pairs and keypoints.
        verify: True compares the hashes of all shards first.

    Raises:
        InputError: no shards, or none of their pairs lies in a band of the settings.
        FormatError: a shard is damaged or of another version.
    """

    def __init__(
        self, folder: str | Path, settings: DrawSettings | None = None, seed: int = 0, *, verify: bool = False
    ) -> None:
        self.pool = FragmentPool(folder, settings, seed, verify=verify)

    def __len__(self) -> int:
        return len(self.pool)

    def __getitem__(self, index: int) -> TrainingPair:
        return as_training_pair(self.pool[index])

    def identity(self) -> str:
        """Changes with the shards, the settings and the seed."""
        return self.pool.identity()

    def voxel_sizes(self) -> tuple[float, float]:
        """Least and largest of all scenes, metres."""
        return self.pool.voxel_sizes


def as_training_pair(pair: DrawnPair) -> TrainingPair:
    """A drawn pair as training takes it; coordinates in single precision."""
    found = pair.correspondences
    return TrainingPair(
        found.points.astype(np.float32),
        pair.labels,
        pair.T_target_source,
        pair.voxel_size,
        found.feature_distance,
        found.ratio,
        found.mutual,
    )
