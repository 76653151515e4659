"""Peak memory and time of registering two clouds of five million points each, through the command line.

    python scripts/measure_memory.py [--points 5000000]

The clouds are the sample pair, its points repeated with 5 mm of noise, written as binary PLY into a
temporary folder; the peak is that of the registering process alone (Linux, macOS).
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from geomoe3d.clouds.io import save_points
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.types import FloatArray


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--points", type=int, default=5_000_000, help="points per cloud")
    count = parser.parse_args().points
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / name for name in ("source.ply", "target.ply")]
        clouds = make_sample_pair()[:2]
        for seed, (path, cloud) in enumerate(zip(paths, clouds, strict=True)):
            save_points(path, densified(cloud.file_points, count, seed))
        begin = time.perf_counter()
        command = [sys.executable, "-m", "geomoe3d", "register", *map(str, paths)]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        seconds = time.perf_counter() - begin
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    peak_gib = peak / (2**30 if sys.platform == "darwin" else 2**20)
    print(run.stdout + run.stderr)
    print("| points per cloud | exit code | peak memory | wall time |")
    print("|---|---|---|---|")
    print(f"| {count:,} | {run.returncode} | {peak_gib:.2f} GiB | {seconds:.1f} s |")


def densified(points: FloatArray, count: int, seed: int) -> FloatArray:
    """Points (count, 3): the given ones repeated with 5 mm of noise."""
    rng = np.random.default_rng(seed)
    rows = rng.integers(0, len(points), count)
    return points[rows] + rng.normal(0, 0.005, (count, 3))


if __name__ == "__main__":
    main()
