"""Shards to validate a training run by: pairs of the dev half with their motions, never to be trained on.

    python scripts/validation_set.py OUT [--every 6] [--benchmark NAME] [--no-motions]

Takes every n-th pair of 3DMatch and of 3DLoMatch with the fixed 1,000 correspondences, and what consensus
proposes for it (not needed by networks that judge no motions). Needs the benchmark data (GEOMOE3D_DATA).
Give the folder as data.validation.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from geomoe3d.data.threedmatch import BENCHMARKS, iterate_fixed_correspondences
from geomoe3d.evaluation.records import INLIER_THRESHOLD, VOXEL_SIZE
from geomoe3d.geometry.se3 import residuals
from geomoe3d.training.motions import with_motions
from geomoe3d.training.pairs import TrainingPair, write_shard


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--every", type=int, default=6, help="take every n-th pair")
    parser.add_argument("--benchmark", action="append", choices=BENCHMARKS, help="default: both")
    parser.add_argument("--no-motions", action="store_true", help="leave out what consensus proposes")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    for benchmark in given.benchmark or BENCHMARKS:
        pairs = []
        for pair in list(iterate_fixed_correspondences(None, benchmark))[:: given.every]:
            T = pair.T_target_source
            labels = residuals(T, pair.points[:, :3], pair.points[:, 3:]) < INLIER_THRESHOLD
            rows = pair.points.astype(np.float32)
            plain = TrainingPair(rows, labels, T, VOXEL_SIZE)
            pairs.append(plain if given.no_motions else with_motions(plain))
        write_shard(given.out / benchmark, pairs)
        print(f"{benchmark}: {len(pairs)} pairs", flush=True)


if __name__ == "__main__":
    main()
