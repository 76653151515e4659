"""What an estimator proposes for a pair: from all correspondences and, if wanted, from the mutual ones alone.

Place: solve. Where all matches of large clouds are taken, one-way ones drown the mutual ones, and a round of
the latter often holds the right motion; of a thousand matches, mutual first, it adds little.
"""

from __future__ import annotations

import numpy as np

from geomoe3d.clouds.keypoints import KeypointSurfaces
from geomoe3d.config import EstimatorConfig
from geomoe3d.estimators.base import Estimator, check_correspondences
from geomoe3d.estimators.keypoint_alignment import KeypointAligner
from geomoe3d.estimators.surroundings import Surroundings
from geomoe3d.types import BoolArray, Correspondences, FilterOutput, FloatArray, Hypothesis


def propose(
    estimate: Estimator,
    matched: Correspondences,
    weights: FloatArray,
    config: EstimatorConfig,
    *,
    inlier_threshold: float,
    seed: int,
    surfaces: KeypointSurfaces | None = None,
) -> list[Hypothesis]:
    """Hypotheses of both rounds, those of the first round first, each round best first as it was proposed.

    Args:
        estimate: what proposes.
        matched: N correspondences; without the attribute ``mutual`` there is one round. Where they bring no
            normals there are no clouds to refine on later: the keypoints draw closer what consensus proposes.
        weights: (N,) what a filter says of them.
        config: weight of one-way matches, whether there is a second round, how many motions are drawn closer.
        inlier_threshold: cloud units.
        seed: decides every random choice.
        surfaces: of all the keypoints, in inlier thresholds, where somebody has them already.

    Raises:
        InputError: as `Estimator`.
    """
    check_correspondences(matched.points, weights, inlier_threshold)
    if matched.mutual is not None:
        weights = weights * np.where(matched.mutual, 1.0, config.one_way_weight)
    asking = getattr(estimate, "with_surroundings", None) if len(matched) else None
    around = None
    if asking is not None:
        if surfaces is None and matched.normals is None:
            places = matched.viewpoints or (None, None)
            surfaces = KeypointSurfaces.of(matched.points, places, inlier_threshold)
        around = Surroundings.of(matched, inlier_threshold, surfaces)

    def of(rows: BoolArray) -> list[Hypothesis]:
        one = estimate if asking is None or around is None else asking(around.take(rows))
        found: list[Hypothesis] = one(
            matched.points[rows], weights[rows], inlier_threshold=inlier_threshold, seed=seed
        )
        return found

    found = of(np.ones(len(matched), dtype=np.bool_))
    if config.mutual_round and matched.mutual is not None and not matched.mutual.all():
        found += of(matched.mutual)
    if around is not None and matched.normals is None and config.num_aligned:
        few, others = found[: config.num_aligned], found[config.num_aligned :]
        found = KeypointAligner(matched.points, inlier_threshold, surfaces).hypotheses(few) + others
    return found


def solve(
    estimate: Estimator,
    matched: Correspondences,
    weighed: FilterOutput,
    config: EstimatorConfig,
    *,
    inlier_threshold: float,
    seed: int,
) -> list[Hypothesis]:
    """Hypotheses for weighed correspondences: what a filter has judged already, or what `propose` gives.

    Only consensus is not sought twice: it is what such a filter asked itself. See `propose` for the rest.
    """
    if weighed.hypotheses and config.name == "consensus":
        return list(weighed.hypotheses)
    return propose(estimate, matched, weighed.weights, config, inlier_threshold=inlier_threshold, seed=seed)
