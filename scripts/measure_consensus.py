"""Registration recall and time of consensus and RANSAC on the fixed 1k correspondences of the dev half.

    python scripts/measure_consensus.py [--every 1] [--no-peer] [--lengths-alone] [--set set_sizes=[10] ...]

--set changes a field of `ConsensusEstimator` (YAML); --lengths-alone keeps from it what the surfaces around
the keypoints say (`geomoe3d.estimators.surroundings`), whose making counts as its time. Success: rotation
error < 15 deg and translation error < 30 cm, strict. Both methods see every pair one after the other, so that
the ratio of their times holds on a busy machine. Needs the benchmark data (GEOMOE3D_DATA).
"""

from __future__ import annotations

import argparse
import statistics
import time

import numpy as np

from geomoe3d.config import set_keys
from geomoe3d.data.threedmatch import BENCHMARKS, iterate_fixed_correspondences
from geomoe3d.estimators.base import Estimator
from geomoe3d.estimators.consensus import ConsensusEstimator
from geomoe3d.estimators.ransac import RansacEstimator
from geomoe3d.estimators.surroundings import Surroundings
from geomoe3d.evaluation.metrics import is_right, motion_errors
from geomoe3d.evaluation.records import INLIER_THRESHOLD
from geomoe3d.types import Correspondences

AT_ZERO = (np.zeros(3), np.zeros(3))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--every", type=int, default=1, help="take every n-th pair")
    parser.add_argument("--no-peer", action="store_true", help="leave RANSAC out")
    parser.add_argument("--lengths-alone", action="store_true", help="without normals and free space")
    parser.add_argument("--set", dest="fields", action="append", default=[], metavar="FIELD=VALUE")
    given = parser.parse_args()
    every, changes = given.every, set_keys({}, given.fields)
    if "set_sizes" in changes:
        changes["set_sizes"] = tuple(changes["set_sizes"])
    methods: dict[str, Estimator] = {"consensus": ConsensusEstimator(**{"num_hypotheses": 20, **changes})}
    if not given.no_peer:
        methods["Open3D RANSAC 50k"] = RansacEstimator(iterations=50_000, confidence=0.999)
    print("| benchmark | method | pairs | recall | any hypothesis right | median time |")
    print("|---|---|---|---|---|---|")
    for benchmark in BENCHMARKS:
        seconds: dict[str, list[float]] = {name: [] for name in methods}
        best: dict[str, int] = dict.fromkeys(methods, 0)
        anywhere: dict[str, int] = dict.fromkeys(methods, 0)
        pairs = list(iterate_fixed_correspondences(None, benchmark))[::every]
        for pair in pairs:
            for name, estimate in methods.items():
                begin = time.perf_counter()
                if isinstance(estimate, ConsensusEstimator) and not given.lengths_alone:
                    rows = Correspondences(pair.points, viewpoints=AT_ZERO)
                    near = Surroundings.of(rows, INLIER_THRESHOLD)
                    found = estimate(pair.points, inlier_threshold=INLIER_THRESHOLD, surroundings=near)
                else:
                    found = estimate(pair.points, inlier_threshold=INLIER_THRESHOLD)
                seconds[name].append(time.perf_counter() - begin)
                right = [is_right(*motion_errors(h.T_target_source, pair.T_target_source)) for h in found]
                best[name] += bool(right and right[0])
                anywhere[name] += any(right)
        for name in methods:
            shares = f"{100 * best[name] / len(pairs):.2f} % | {100 * anywhere[name] / len(pairs):.2f} %"
            median = 1000 * statistics.median(seconds[name])
            print(f"| {benchmark} | {name} | {len(pairs)} | {shares} | {median:.1f} ms |", flush=True)
        if not given.no_peer:
            ratio = statistics.median(seconds["consensus"]) / statistics.median(seconds["Open3D RANSAC 50k"])
            print(f"\nconsensus takes {ratio:.2f} x the median time of RANSAC\n", flush=True)


if __name__ == "__main__":
    main()
