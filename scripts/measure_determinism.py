"""How much an answer hangs on the processor: the same pairs under other instruction sets, and moved a little.

    python scripts/measure_determinism.py [--every 8] [--seeds 2] [--out runs/determinism.jsonl]

Every n-th pair of 3DMatch and 3DLoMatch (GEOMOE3D_DATA) is registered by this processor's own instructions, by those
that the libraries can be told to keep to (scripts/narrow.sh says how), and with every point moved at random by 1e-6
of the extent. Prints for each: how many statuses are the same, how many transforms of pairs that are ok in both
lie within a tenth of a voxel, the largest difference of a confidence, and every pair whose status differs. What is
in OUT is not done again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.clouds.io import load_points
from geomoe3d.data.threedmatch import BENCHMARKS, find_data_root, load_benchmark
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.registration import Registrar
from geomoe3d.types import FloatArray

NARROW = ("avx2", "narrowest")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--every", type=int, default=8)
    parser.add_argument("--seeds", type=int, default=2, help="perturbations of the input")
    parser.add_argument("--out", type=Path, default=Path("runs/determinism.jsonl"))
    parser.add_argument("--child", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        answers(given.child, given.every, given.out)
        return
    given.out.parent.mkdir(parents=True, exist_ok=True)
    ways = ["own", *NARROW, *(f"moved {seed}" for seed in range(given.seeds))]
    for way in ways:
        command = [
            sys.executable,
            __file__,
            "--child",
            way,
            "--every",
            str(given.every),
            "--out",
            str(given.out),
        ]
        kept = [str(Path(__file__).with_name("narrow.sh")), way] if way in NARROW else []
        subprocess.run([*kept, *command], check=True)
    rows = [json.loads(line) for line in given.out.read_text().splitlines()]
    rows = [row for row in rows if row["every"] == given.every]
    own = {row["pair"]: row for row in rows if row["way"] == "own"}
    for way in ways[1:]:
        report(way, own, {row["pair"]: row for row in rows if row["way"] == way})


def answers(way: str, every: int, out: Path) -> None:
    """One line per pair, appended."""
    known = set()
    if out.exists():
        lines = map(json.loads, out.read_text().splitlines())
        known = {row["pair"] for row in lines if (row["way"], row["every"]) == (way, every)}
    registrar, root = Registrar(), find_data_root()
    rng = np.random.default_rng(int(way.split()[1])) if way.startswith("moved") else None
    with out.open("a") as file:
        for benchmark in BENCHMARKS:
            for pair in list(load_benchmark(root, benchmark))[::every]:
                name = f"{benchmark}/{pair.scene}/{pair.source_index}-{pair.target_index}"
                if name in known:
                    continue
                clouds = [load_points(path).file_points for path in (pair.source, pair.target)]
                if rng is not None:
                    clouds = [p + rng.normal(0, 1e-6 * np.ptp(p, axis=0).max(), p.shape) for p in clouds]
                result = registrar.register(*clouds)
                row: dict[str, Any] = {
                    "way": way, "every": every, "pair": name, "status": result.status,
                    "confidence": result.confidence, "voxel_size": result.voxel_size,
                    "T": result.T_target_source.tolist(), "centre": clouds[0].mean(0).tolist(),
                }  # fmt: skip
                file.write(json.dumps(row) + "\n")
                file.flush()


def moved(row: dict[str, Any]) -> FloatArray:
    """Where a transform puts the centre of the source."""
    (place,) = transform_points(np.array(row["T"]), np.array([row["centre"]]))
    return np.asarray(place)


def report(way: str, own: dict[str, dict[str, Any]], other: dict[str, dict[str, Any]]) -> None:
    """One paragraph about a way of computing."""
    both = [(own[name], other[name]) for name in own if name in other]
    same = [a["status"] == b["status"] for a, b in both]
    ok = [(a, b) for a, b in both if a["status"] == b["status"] == "ok"]
    apart = [float(np.linalg.norm(moved(a) - moved(b))) / a["voxel_size"] for a, b in ok]
    largest = max(abs(a["confidence"] - b["confidence"]) for a, b in both)
    print(
        f"{way}: {sum(same)} of {len(both)} statuses the same, {sum(x < 0.1 for x in apart)} of {len(ok)} ok "
        f"transforms within a tenth of a voxel, confidence differs by up to {largest:.3f}"
    )
    for (a, b), equal in zip(both, same, strict=True):
        if not equal:
            print(f"  {a['pair']}: {a['status']} {a['confidence']:.3f}, {b['status']} {b['confidence']:.3f}")


if __name__ == "__main__":
    main()
