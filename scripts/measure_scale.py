"""How well an unknown scale is found, and what a wrong unit is called.

    python scripts/measure_scale.py [--every 8] [--benchmark 3DMatch] [--unrelated 40] [--set key=value ...]
    python scripts/measure_scale.py --factors 0.8,1.05,3.28 [--every 21]

The first: the source of every n-th pair of the dev half times a factor between 0.2 and 5, uniform in its logarithm,
is registered with scale: estimate. Right: rotation and translation as in the benchmark, and the scale within 10 %.
--unrelated: fragments of two different scenes; an `ok` there is wrong. The second: with the scale fixed, as by
default, the source times each factor: how many are called ok. Shares with Wilson's 95 % intervals.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from measure_registration import unrelated_pairs

from geomoe3d.clouds.io import load_points
from geomoe3d.config import load_config
from geomoe3d.data.threedmatch import BENCHMARKS, BenchmarkPair, load_benchmark
from geomoe3d.evaluation.intervals import wilson
from geomoe3d.evaluation.metrics import is_right, motion_errors
from geomoe3d.registration import Registrar

_SPREAD = 5.0
_RIGHT_SCALE = 0.1


def share(count: int, total: int) -> str:
    low, high = wilson(count / max(total, 1), total)
    return f"{count} of {total} ({100 * count / max(total, 1):.1f} % [{low:.1f}, {high:.1f}])"


def estimated(pairs: list[BenchmarkPair], registrar: Registrar) -> None:
    """Recall, precision of ok, and the error of the scale."""
    rng = np.random.default_rng(0)
    right, ok, wrong, errors, seconds = 0, 0, 0, [], []
    for pair in pairs:
        factor = float(np.exp(rng.uniform(-np.log(_SPREAD), np.log(_SPREAD))))
        source, target = (load_points(path).file_points for path in (pair.source, pair.target))
        begin = time.process_time()
        result = registrar.register(factor * source, target)
        seconds.append(time.process_time() - begin)
        rigid = result.T_target_source.copy()
        rigid[:3, :3] /= result.scale
        error = abs(np.log(result.scale * factor))
        good = is_right(*motion_errors(rigid, pair.T_target_source)) and error < _RIGHT_SCALE
        right, ok, wrong = right + good, ok + result.ok, wrong + (result.ok and not good)
        errors += [error] if good else []
        print(
            f"{pair.scene} {pair.source_index} {pair.target_index} x {factor:.3f}: {result.status} "
            f"{'right' if good else 'wrong'} {100 * error:.2f} %",
            flush=True,
        )
    low, middle, high = 100 * np.quantile(errors, [0.25, 0.5, 0.75])
    print(f"right {share(right, len(pairs))}, ok {share(ok, len(pairs))}, ok and wrong {share(wrong, ok)}")
    print(f"error of the scale, right answers: quartiles {low:.2f}, {middle:.2f}, {high:.2f} %")
    print(f"processor time: median {np.median(seconds):.2f} s, mean {np.mean(seconds):.2f} s a pair")


def of_other_scenes(pairs: list[tuple[Path, Path]], registrar: Registrar) -> None:
    """What must not be ok."""
    rng = np.random.default_rng(1)
    accepted = 0
    for one, other in pairs:
        factor = float(np.exp(rng.uniform(-np.log(_SPREAD), np.log(_SPREAD))))
        result = registrar.register(factor * load_points(one).file_points, load_points(other))
        accepted += result.ok
        print(f"{one.name} {other.name}: {result.status} {result.confidence:.2f}", flush=True)
    print(f"unrelated pairs called ok: {share(accepted, len(pairs))}")


def fixed(pairs: list[BenchmarkPair], factors: list[float], registrar: Registrar) -> None:
    """How many of another size are called ok where the scale is not estimated."""
    for factor in factors:
        ok = 0
        for pair in pairs:
            source, target = (load_points(path).file_points for path in (pair.source, pair.target))
            ok += registrar.register(factor * source, target).ok
        print(f"source times {factor:g}: ok {share(ok, len(pairs))}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--every", type=int, default=8)
    parser.add_argument("--benchmark", choices=BENCHMARKS, default="3DMatch")
    parser.add_argument("--unrelated", type=int, default=0)
    parser.add_argument("--factors", default="", help="numbers with commas: the scale stays fixed")
    parser.add_argument("--set", dest="assignments", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    pairs = load_benchmark(None, given.benchmark)[:: given.every]
    if given.factors:
        factors = [float(factor) for factor in given.factors.split(",")]
        fixed(pairs, factors, Registrar(load_config(None, given.assignments)))
        return
    registrar = Registrar(load_config(None, ["scale=estimate", *given.assignments]))
    estimated(pairs, registrar)
    if given.unrelated:
        of_other_scenes(unrelated_pairs(given.unrelated), registrar)


if __name__ == "__main__":
    main()
