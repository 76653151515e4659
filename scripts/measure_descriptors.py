"""Which descriptor and which matcher find more, and what the network makes of it: the table of compatibility.

    python scripts/measure_descriptors.py OUT [--every 8] [--descriptor NAME[=WEIGHTS]]... [--keypoints 1000]...

Pairs of the dev half of 3DMatch and 3DLoMatch (GEOMOE3D_DATA), a 5 cm grid, sensors as published, so many random
points of each cloud. For every descriptor and matcher: matches per pair, share of right ones (within 10 cm in truth),
pairs of which more than 5 % are right (feature-matching recall) and fewer than 1 %; then recall of consensus on these
matches alone, and with the network that judges transforms (`register_correspondences`), within 15 deg and 30 cm. Time:
features of both clouds and matching, medians on one thread, in one run. Lines go to OUT/rows.jsonl as pairs are
finished; called again, the command goes on. The table goes to OUT/descriptors.md.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.clouds.loading import load_points
from geomoe3d.clouds.prepare import prepare
from geomoe3d.config import DescriptorConfig, MatchingConfig, PreparationConfig, load_config
from geomoe3d.correspondence_registration import CorrespondenceRegistrar
from geomoe3d.data.threedmatch import BENCHMARKS
from geomoe3d.evaluation.benchmarks import load_pairs
from geomoe3d.evaluation.intervals import wilson
from geomoe3d.evaluation.metrics import is_right, motion_errors
from geomoe3d.evaluation.records import INLIER_THRESHOLD, VOXEL_SIZE
from geomoe3d.features.base import descriptor, with_features
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.geometry.se3 import residuals
from geomoe3d.matching.base import matcher
from geomoe3d.types import PreparedCloud

MATCHERS = ("one_way", "mutual", "ratio", "dual_softmax")
DESCRIPTORS = ("fpfh", "multiscale", "learned")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--every", type=int, default=8)
    parser.add_argument("--descriptor", action="append", help="a name, or learned=FILE")
    parser.add_argument("--matcher", action="append", choices=MATCHERS)
    parser.add_argument("--keypoints", type=int, action="append")
    parser.add_argument("--matches-alone", action="store_true", help="no recall")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    path = given.out / "rows.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {(r["benchmark"], r["pair"], r["descriptor"], r["matcher"], r["keypoints"]) for r in rows}
    registrars = {
        name: CorrespondenceRegistrar(load_config(None, [f"scoring.scorers=[{scorers}]"]))
        for name, scorers in (("consensus", "surfaces"), ("network", "surfaces, network"))
    }
    with path.open("a") as out:
        for benchmark in BENCHMARKS:
            for pair in load_pairs(benchmark)[:: given.every]:
                clouds = [
                    prepare(cloud, VOXEL_SIZE, PreparationConfig(), viewpoint=-cloud.origin)
                    for cloud in (load_points(pair.source), load_points(pair.target))
                ]
                for name in given.descriptor or DESCRIPTORS:
                    described: tuple[list[PreparedCloud], float] | None = None
                    for method in given.matcher or MATCHERS:
                        for count in given.keypoints or [1000]:
                            if (benchmark, pair.id, name, method, count) in done:
                                continue
                            described = described or describe(clouds, name)
                            found = measure(
                                *described,
                                method,
                                count,
                                pair.T_target_source,
                                registrars,
                                given.matches_alone,
                            )
                            key = {"benchmark": benchmark, "pair": pair.id, "descriptor": name}
                            row = key | {"matcher": method, "keypoints": count} | found
                            rows.append(row)
                            out.write(json.dumps(row) + "\n")
                            out.flush()
    text = table(rows)
    (given.out / "descriptors.md").write_text(text)
    print(text)


def describe(clouds: list[PreparedCloud], name: str) -> tuple[list[PreparedCloud], float]:
    """Both clouds with features, and the seconds it took."""
    kind, _, weights = name.partition("=")
    options = {"weights": weights} if weights else {}
    part = descriptor.make(DescriptorConfig(name=kind, options=options))
    begin = time.perf_counter()
    described = [with_features(cloud, part) for cloud in clouds]
    return described, time.perf_counter() - begin


def measure(
    clouds: list[PreparedCloud],
    seconds: float,
    method: str,
    count: int,
    truth: Any,
    registrars: dict[str, CorrespondenceRegistrar],
    matches_alone: bool,
) -> dict[str, Any]:
    """One row of one pair."""
    some = []
    for side, cloud in enumerate(clouds):
        assert cloud.features is not None
        keep = drawn_rows(cloud.points, cloud.voxel_size, count, side)
        some.append(
            replace(
                cloud, points=cloud.points[keep], normals=cloud.normals[keep], features=cloud.features[keep]
            )
        )
    part = matcher.make(MatchingConfig(name=method))
    begin = time.perf_counter()
    found = part(*some, limit=count)
    matching = time.perf_counter() - begin
    points = found.points + np.hstack([cloud.origin for cloud in clouds])
    near = residuals(truth, points[:, :3], points[:, 3:]) < INLIER_THRESHOLD
    row: dict[str, Any] = {
        "matches": len(near),
        "right": float(near.mean()) if len(near) else 0.0,
        "describe_ms": 1000 * seconds,
        "match_ms": 1000 * matching,
    }
    if not matches_alone:
        for name, register in registrars.items():
            result = register(points, voxel_size=VOXEL_SIZE)
            T = result.T_target_source if result.found else None
            row[name] = bool(is_right(*motion_errors(T, truth)))
    return row


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown, one table for each benchmark and number of keypoints."""
    parts = []
    for benchmark in BENCHMARKS:
        for count in sorted({r["keypoints"] for r in rows}):
            chosen = [r for r in rows if r["benchmark"] == benchmark and r["keypoints"] == count]
            pairs = len({r["pair"] for r in chosen})
            parts.append(f"### {benchmark}, {count} points of each cloud: {pairs} pairs\n")
            parts.append(
                "| descriptor | matcher | matches | right | more than 5 % right | less than 1 % | "
                "recall by consensus | with the network | features, matching |\n|---|---|---|---|---|---|---|---|---|"
            )
            for name in dict.fromkeys(r["descriptor"] for r in chosen):
                for method in MATCHERS:
                    some = [r for r in chosen if r["descriptor"] == name and r["matcher"] == method]
                    if some:
                        parts.append(_line(name, method, some))
            parts.append("")
    return "\n".join(parts)


def _line(name: str, method: str, some: list[dict[str, Any]]) -> str:
    right = np.array([r["right"] for r in some])
    recalls = []
    for by in ("consensus", "network"):
        if by in some[0]:
            hits = sum(r[by] for r in some)
            low, high = wilson(hits / len(some), len(some))
            recalls.append(f"{100 * hits / len(some):.1f} [{low:.1f}, {high:.1f}] %")
        else:
            recalls.append("-")
    times = [np.median([r[key] for r in some]) for key in ("describe_ms", "match_ms")]
    cells = [
        name,
        method,
        f"{np.mean([r['matches'] for r in some]):.0f}",
        f"{100 * right.mean():.1f} %",
        f"{100 * (right > 0.05).mean():.1f} %",
        f"{100 * (right < 0.01).mean():.1f} %",
        *recalls,
        f"{times[0]:.0f}, {times[1]:.0f} ms",
    ]
    return "| " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
