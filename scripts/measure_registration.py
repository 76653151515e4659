"""End-to-end registration of the dev half's 2.5 cm fragments, beside KISS-Matcher in the same run.

    python scripts/measure_registration.py [--every 4] [--unrelated 200] [--set key=value ...]

Success: rotation error < 15 deg and translation error < 30 cm, strict. Clouds are in memory as arrays when
the clock starts; both methods see every pair one after the other. Unrelated pairs are fragments of two
different scenes: an `ok` there is a false one. Each pair's outcome goes to a JSON lines file for a closer
look. KISS-Matcher (extra `peers`) is left out where it is not installed, or with --no-peer.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.clouds.io import load_points
from geomoe3d.config import load_config
from geomoe3d.data.threedmatch import BENCHMARKS, BenchmarkPair, load_benchmark
from geomoe3d.evaluation.benchmarks import UNRELATED
from geomoe3d.evaluation.config import RULES
from geomoe3d.evaluation.metrics import is_right, motion_errors
from geomoe3d.geometry.se3 import make_transform, rotation_error_deg, translation_error
from geomoe3d.registration import Registrar
from geomoe3d.types import FloatArray

Peer = Callable[[FloatArray, FloatArray], FloatArray]


def kiss_matcher(voxel_size: float = 0.05) -> Peer | None:
    """KISS-Matcher as a function of two arrays, or None where it is not installed."""
    if importlib.util.find_spec("kiss_matcher") is None:
        return None
    import kiss_matcher

    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel_size))

    def run(source: FloatArray, target: FloatArray) -> FloatArray:
        answer = matcher.estimate(source, target)
        return make_transform(np.array(answer.rotation), np.array(answer.translation).ravel())

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--every", type=int, default=4, help="take every n-th pair")
    parser.add_argument(
        "--unrelated", type=int, default=RULES.num_unrelated, help="pairs of different scenes to try"
    )
    parser.add_argument("--no-peer", action="store_true", help="leave KISS-Matcher out")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="configuration")
    parser.add_argument("--out", default="runs/registration.jsonl", help="one line per pair")
    given = parser.parse_args()
    registrar = Registrar(load_config(None, given.set))
    peer = None if given.no_peer else kiss_matcher()
    out = Path(given.out)
    out.parent.mkdir(parents=True, exist_ok=True)
    print("| benchmark | method | pairs | recall | ok, right of ok | median time |")
    print("|---|---|---|---|---|---|")
    with out.open("w", encoding="utf-8") as stream:
        for benchmark in BENCHMARKS:
            pairs = load_benchmark(None, benchmark)[:: given.every]
            rows = [measure(pair, registrar, peer) for pair in pairs]
            stream.writelines(json.dumps({"benchmark": benchmark, **row}) + "\n" for row in rows)
            print_rows(benchmark, rows)
        if given.unrelated:
            rows = [unrelated(pair, registrar) for pair in unrelated_pairs(given.unrelated)]
            stream.writelines(json.dumps({"benchmark": UNRELATED, **row}) + "\n" for row in rows)
            accepted = sum(row["status"] == "ok" for row in rows)
            print(f"\nunrelated pairs called ok: {accepted} of {len(rows)}")


def measure(pair: BenchmarkPair, registrar: Registrar, peer: Peer | None) -> dict[str, Any]:
    """One pair through both methods."""
    clouds = [load_points(path).file_points for path in (pair.source, pair.target)]
    begin = time.perf_counter()
    result = registrar.register(*clouds)
    row: dict[str, Any] = {
        "scene": pair.scene,
        "pair": [pair.source_index, pair.target_index],
        "seconds": time.perf_counter() - begin,
        "right": is_right(*motion_errors(result.T_target_source, pair.T_target_source)),
        "rotation_error_deg": rotation_error_deg(result.T_target_source, pair.T_target_source),
        "translation_error": translation_error(result.T_target_source, pair.T_target_source),
        **facts(result),
    }
    other = result.alternative
    row["alternative_right"] = other is not None and is_right(
        *motion_errors(other.T_target_source, pair.T_target_source)
    )
    if peer is not None:
        begin = time.perf_counter()
        T = peer(*clouds)
        row["peer_seconds"] = time.perf_counter() - begin
        row["peer_right"] = is_right(*motion_errors(T, pair.T_target_source))
    return row


def facts(result: Any) -> dict[str, Any]:
    """What the result says of itself."""
    return {
        "status": result.status,
        "confidence": result.confidence,
        "evidence": result.evidence,
        "lead": None if result.alternative is None else 1 / max(result.alternative.relative_score, 1e-9),
        "voxel_size": result.voxel_size,
        "stages": result.seconds,
        "reasons": result.reasons,
    }


def unrelated_pairs(count: int) -> list[tuple[Path, Path]]:
    """Seeded pairs of fragments from different scenes."""
    fragments: dict[str, list[Path]] = {}
    for pair in load_benchmark(None, "3DMatch"):
        for path in (pair.source, pair.target):
            scene = fragments.setdefault(pair.scene, [])
            if path not in scene:
                scene.append(path)
    rng = np.random.default_rng(0)
    names = sorted(fragments)
    chosen = []
    for _ in range(count):
        one, other = rng.permutation(len(names))[:2]
        sides = [fragments[names[k]][rng.integers(len(fragments[names[k]]))] for k in (one, other)]
        chosen.append((sides[0], sides[1]))
    return chosen


def unrelated(paths: tuple[Path, Path], registrar: Registrar) -> dict[str, Any]:
    """One pair that must not be accepted."""
    return {"pair": [path.name for path in paths], **facts(registrar.register(*paths))}


def print_rows(benchmark: str, rows: list[dict[str, Any]]) -> None:
    ours = sum(row["right"] for row in rows)
    trusted = [row["right"] for row in rows if row["status"] == "ok"]
    median = statistics.median(row["seconds"] for row in rows)
    right = f"{100 * sum(trusted) / max(len(trusted), 1):.1f} %"
    print(
        f"| {benchmark} | geomoe3d | {len(rows)} | {100 * ours / len(rows):.1f} % | "
        f"{100 * len(trusted) / len(rows):.1f} %, {right} | {1000 * median:.0f} ms |",
        flush=True,
    )
    if "peer_right" in rows[0]:
        theirs = sum(row["peer_right"] for row in rows)
        peer_median = statistics.median(row["peer_seconds"] for row in rows)
        print(
            f"| {benchmark} | KISS-Matcher 0.05 | {len(rows)} | {100 * theirs / len(rows):.1f} % | - | "
            f"{1000 * peer_median:.0f} ms |",
            flush=True,
        )
        print(f"\ngeomoe3d takes {median / peer_median:.2f} x the median time of KISS-Matcher\n", flush=True)


if __name__ == "__main__":
    main()
