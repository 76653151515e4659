"""Motions that an estimator proposes: a second round from mutual matches."""

from __future__ import annotations

from typing import Any

import numpy as np
from corner_scenes import VOXEL, scene

from geomoe3d.clouds.pair import Pair
from geomoe3d.config import EstimatorConfig
from geomoe3d.estimators.consensus import ConsensusEstimator
from geomoe3d.estimators.proposals import propose
from geomoe3d.types import Correspondences


def test_proposals_take_a_second_round_from_mutual_matches() -> None:
    rows, _ = scene(4)
    mutual = np.arange(len(rows)) % 2 == 0
    config = EstimatorConfig(mutual_round=True)

    def run(estimator: EstimatorConfig, mutual: Any) -> int:
        found = propose(
            ConsensusEstimator(num_hypotheses=3),
            Pair(Correspondences(rows, mutual=mutual), VOXEL, 2 * VOXEL),
            np.ones(len(rows)),
            estimator,
        )
        return len(found)

    assert (
        run(config, mutual)
        > run(config, None)
        == run(config.model_copy(update={"mutual_round": False}), mutual)
    )
