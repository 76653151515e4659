"""Holds the deviations that an answer gives of itself against its true error.

    python scripts/measure_accuracy.py [FOLDER...] [--pairs 220] [--sample 30] [--every 8] [--set key=value ...]

FOLDER: posed fragments (generated rooms: bent as those of a depth camera are). Without one, every n-th pair of both
benchmarks, whose published poses err themselves by centimetres. --sample: rigid pairs of the sample room, seeds 0 to
n - 1, whose truth is exact. Prints, of right answers, the share of true errors below one and two deviations with
Wilson's intervals: at the centre of the overlap, at the farthest point, of the rotation.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from fit_confidence import draw

from geomoe3d.clouds.io import load_points
from geomoe3d.config import load_config
from geomoe3d.data.collection import load_fragment
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.data.threedmatch import BENCHMARKS, load_benchmark
from geomoe3d.evaluation.intervals import wilson
from geomoe3d.evaluation.metrics import is_right, motion_errors
from geomoe3d.geometry.se3 import inverse, rotation_angle_deg, transform_points
from geomoe3d.registration import Registrar
from geomoe3d.result import RegistrationResult
from geomoe3d.types import FloatArray

Row = tuple[float, float, float]


def generated(folders: list[str], count: int) -> Iterator[tuple[Any, Any, FloatArray]]:
    for _, source, target, T, _ in draw(folders, count, 0):
        yield load_fragment(Path(source)), load_fragment(Path(target)), np.array(T)


def recorded(every: int) -> Iterator[tuple[Any, Any, FloatArray]]:
    for benchmark in BENCHMARKS:
        for pair in load_benchmark(None, benchmark)[::every]:
            yield load_points(pair.source), load_points(pair.target), pair.T_target_source


def errors_over_deviations(
    result: RegistrationResult, source: FloatArray, target: FloatArray, truth: FloatArray
) -> Row | None:
    """True error over one deviation, or None where the answer is wrong or says nothing."""
    found, T = result.accuracy, result.T_target_source
    if found is None or not is_right(*motion_errors(T, truth)):
        return None
    moved, right, center = result.apply(source), truth @ inverse(T), result.information_center[None]
    places = np.vstack([moved, target])
    farthest = places[[np.argmax(np.sum((places - center) ** 2, axis=1))]]
    at_center, at_farthest = (
        float(np.linalg.norm(transform_points(right, p) - p)) for p in (center, farthest)
    )
    turned = rotation_angle_deg(right[:3, :3])
    return (
        at_center / found.sigma_center,
        at_farthest / found.sigma_farthest,
        turned / found.sigma_rotation_deg,
    )


def report(name: str, rows: list[Row], count: int) -> None:
    print(f"{name}: {count} pairs, {len(rows)} right")
    for which, ratios in zip(("centre", "farthest", "rotation"), np.array(rows).T, strict=True):
        shares = []
        for deviations in (1, 2):
            inside = int((ratios < deviations).sum())
            share = inside / len(ratios)
            low, high = wilson(share, len(ratios))
            shares.append(f"{share:.0%} [{low:.0f}, {high:.0f}] within {deviations}")
        print(f"  {which:10}{', '.join(shares)}; median ratio {np.median(ratios):.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", nargs="*")
    parser.add_argument("--pairs", type=int, default=220)
    parser.add_argument("--sample", type=int, default=0)
    parser.add_argument("--every", type=int, default=8)
    parser.add_argument("--set", dest="assignments", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    registrar = Registrar(load_config(None, given.assignments))
    lots = {
        "sample rooms, rigid": (make_sample_pair(seed) for seed in range(given.sample)),
        "generated": generated(given.folders, given.pairs) if given.folders else iter(()),
        "benchmarks": iter(()) if given.folders or given.sample else recorded(given.every),
    }
    for name, pairs in lots.items():
        rows, count = [], 0
        for source, target, truth in pairs:
            clouds = source.file_points, target.file_points
            row = errors_over_deviations(registrar.register(source, target), *clouds, truth)
            rows += [] if row is None else [row]
            count += 1
        if rows:
            report(name, rows, count)


if __name__ == "__main__":
    main()
