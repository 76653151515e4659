"""How well the verdicts of networks tell right motions from wrong ones, on real correspondences.

    python scripts/measure_verdicts.py WEIGHTS... [--every 4]

WEIGHTS: names or .safetensors files of networks that score transforms; all are shown the same 20 motions that
consensus proposes for the fixed 1,000 correspondences of 3DMatch and 3DLoMatch (GEOMOE3D_DATA). Prints per
network and benchmark: how often the motion that it likes best of the first 8 and of 20 is right, the AUROC of
the best of the first 8 verdicts over pairs, the mean binary cross-entropy of all 20, and the F1 of the labels
under the motion liked best, mean over pairs.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from geomoe3d.data.threedmatch import BENCHMARKS, iterate_fixed_correspondences
from geomoe3d.estimators.consensus import ConsensusEstimator
from geomoe3d.estimators.surroundings import Surroundings
from geomoe3d.evaluation.calibration import auroc_of
from geomoe3d.evaluation.metrics import is_right, motion_errors, precision_recall_f1
from geomoe3d.evaluation.records import INLIER_THRESHOLD, VOXEL_SIZE
from geomoe3d.geometry.se3 import residuals
from geomoe3d.networks.motion_judge import MotionJudge
from geomoe3d.types import BoolArray, Correspondences, FloatArray

FIRST, MOST = 8, 20
AT_ZERO = (np.zeros(3), np.zeros(3))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("weights", nargs="+")
    parser.add_argument("--every", type=int, default=4, help="take every n-th pair")
    given = parser.parse_args()
    judges = {name: MotionJudge.from_pretrained(name) for name in given.weights}
    estimate = ConsensusEstimator(num_hypotheses=MOST)
    everything: dict[str, list[tuple[BoolArray, FloatArray]]] = {name: [] for name in judges}
    for benchmark in BENCHMARKS:
        seen: dict[str, list[tuple[BoolArray, FloatArray]]] = {name: [] for name in judges}
        f1: dict[str, list[float]] = {name: [] for name in judges}
        for pair in list(iterate_fixed_correspondences(None, benchmark))[:: given.every]:
            given_rows = Correspondences(pair.points, viewpoints=AT_ZERO)
            near = Surroundings.of(given_rows, INLIER_THRESHOLD)
            found = estimate(pair.points, inlier_threshold=INLIER_THRESHOLD, surroundings=near)
            if not found:
                continue
            motions = np.array([h.T_target_source for h in found])
            truth = pair.T_target_source
            right = np.array([is_right(*motion_errors(T, truth)) for T in motions])
            labels = residuals(truth, pair.points[:, :3], pair.points[:, 3:]) < INLIER_THRESHOLD
            for name, judge in judges.items():
                judged = judge.about(given_rows, voxel_size=VOXEL_SIZE)(motions)
                verdicts = np.array([j.verdict for j in judged])
                seen[name].append((right, verdicts))
                logits = judged[int(verdicts.argmax())].output.logits
                assert logits is not None
                f1[name].append(precision_recall_f1(logits > 0, labels)[2])
        for name in judges:
            everything[name] += seen[name]
            print(f"{benchmark}, {name}: {summary(seen[name])}, F1 {np.mean(f1[name]):.3f}")
    for name in judges:
        print(f"both, {name}: {summary(everything[name])}")


def summary(seen: list[tuple[BoolArray, FloatArray]]) -> str:
    """One line about pairs of (which motions are right, their verdicts)."""
    best = {k: np.array([right[:k][v[:k].argmax()] for right, v in seen]) for k in (FIRST, MOST)}
    surest = np.array([v[:FIRST].max() for _, v in seen])
    everything: NDArray[np.float64] = np.ones((1, len(seen)))
    auroc = auroc_of(surest, best[FIRST])(everything)[0]
    entropy = np.mean([np.logaddexp(0, np.where(right, -v, v)).mean() for right, v in seen])
    liked = ", ".join(f"{100 * found.mean():.1f} % (of {k})" for k, found in best.items())
    return f"{len(seen)} pairs, liked best and right {liked}, AUROC {auroc:.4f}, cross-entropy {entropy:.3f}"


if __name__ == "__main__":
    main()
