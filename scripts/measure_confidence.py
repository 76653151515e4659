"""How far the confidence can be believed over several benchmarks together, from predictions that lie ready.

    python scripts/measure_confidence.py OUT [--run geomoe3d]

OUT: folder of `scripts/benchmark.py` or `geomoe3d evaluate run` with the track ``clouds``. Pools the pairs of
3DMatch and 3DLoMatch that are predicted there and prints AUROC of success, calibration error and what is
called ok; unrelated pairs apart.
"""

from __future__ import annotations

import argparse

import numpy as np

from geomoe3d.evaluation.benchmarks import UNRELATED
from geomoe3d.evaluation.calibration import auroc_of, calibration_error_of
from geomoe3d.evaluation.score import score_runs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out")
    parser.add_argument("--run", default="geomoe3d")
    given = parser.parse_args()
    runs = [r.score for r in score_runs(given.out) if r.score.info.label == given.run]
    runs = [run for run in runs if run.info.track == "clouds"]
    pairs = [p for run in runs if run.info.benchmark != UNRELATED for p in run.pairs]
    confidence = np.array([p.confidence or 0.0 for p in pairs])
    right = np.array([p.right for p in pairs])
    everything = np.ones((1, len(pairs)))
    ok = np.array([p.status == "ok" for p in pairs])
    print(f"{len(pairs)} pairs, {100 * right.mean():.1f} % right")
    print(f"AUROC of success {auroc_of(confidence, right)(everything)[0]:.4f}")
    print(f"calibration error {calibration_error_of(confidence, right)(everything)[0]:.4f}")
    print(f"called ok {100 * ok.mean():.1f} %, of these right {100 * right[ok].mean():.1f} %")
    for run in runs:
        if run.info.benchmark == UNRELATED:
            accepted = sum(p.status == "ok" for p in run.pairs)
            print(f"unrelated: {accepted} of {len(run.pairs)} called ok")


if __name__ == "__main__":
    main()
