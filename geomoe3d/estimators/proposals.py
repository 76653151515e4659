"""What an estimator proposes for a pair: from all correspondences and, if wanted, from the mutual ones alone.

Place: propose. Where all matches of large clouds are taken, one-way ones drown the mutual ones, and a round of
the latter often holds the right transform; of a thousand matches, mutual first, it adds little.
"""

from __future__ import annotations

import numpy as np

from geomoe3d.clouds.pair import Pair
from geomoe3d.config import EstimatorConfig
from geomoe3d.estimators.base import Estimator, check_correspondences
from geomoe3d.estimators.keypoint_alignment import KeypointAligner
from geomoe3d.estimators.surroundings import Surroundings
from geomoe3d.types import BoolArray, FloatArray, Hypothesis


def propose(
    estimate: Estimator, pair: Pair, weights: FloatArray, config: EstimatorConfig
) -> list[Hypothesis]:
    """Hypotheses of both rounds, those of the first round first, each round best first as it was proposed.

    Args:
        estimate: what proposes.
        pair: N correspondences; without the attribute ``mutual`` there is one round. Where they bring no
            normals there are no clouds to refine on later: the keypoints draw closer what is proposed.
        weights: (N,) what a filter says of them.
        config: weight of one-way matches, whether there is a second round, how many are drawn closer.

    Raises:
        InputError: as `Estimator`.
    """
    matched, threshold = pair.matched, pair.inlier_threshold
    check_correspondences(matched.points, weights, threshold)
    if matched.mutual is not None:
        weights = weights * np.where(matched.mutual, 1.0, config.one_way_weight)
    around = None
    if estimate.uses_surroundings and len(matched):
        surfaces = pair.keypoint_surfaces if matched.normals is None else None
        around = Surroundings.of(matched, threshold, surfaces)

    def of(rows: BoolArray) -> list[Hypothesis]:
        extra = {} if around is None else {"surroundings": around.take(rows)}
        points = matched.points[rows]
        return estimate(points, weights[rows], inlier_threshold=threshold, seed=pair.seed, **extra)

    found = of(np.ones(len(matched), dtype=np.bool_))
    if config.mutual_round and matched.mutual is not None and not matched.mutual.all():
        found += of(matched.mutual)
    if around is not None and matched.normals is None and config.num_aligned:
        few, others = found[: config.num_aligned], found[config.num_aligned :]
        aligner = KeypointAligner(matched.points, threshold, pair.keypoint_surfaces)
        found = aligner.hypotheses(few) + others
    return found
