"""Scans in maps: one room, three rooms side by side, scans of another building, generated buildings; peers beside.

    python scripts/measure_maps.py OUT [--cases room three stranger feet building alike large world] [--methods geomoe3d
        kiss-matcher open3d-feature-ransac] [--every 1] [--begin 0]

The rooms are three dev scenes of 3DMatch, each merged by its published poses; 60 fragments are asked for, 20 of each.
They are left out in five turns: a map holds none of the twelve fragments asked for in its turn. Side by side the rooms
stand 12 m apart (34 m, 3 million points). Strangers are scans of scenes that are not in the map, none of which may be
ok: fragments in each other scene and in the three others, views of other generated rooms and fragments in the building,
fragments in the meshes of data/scenes;
`feet` are the 60 with lengths multiplied by 3.28 and by 0.3048, none of which may be ok. The building holds 40
generated rooms in a raster, no two alike, or (`alike`) ten of them the same room; each is scanned from three places by
a laser on a tripod. Each room, or twice each of those that are alike, is asked for by a depth camera that turns by 60
degrees. `large` is the building without two alike, each point eight times with noise of 5 mm: some 50 million points as
OUT/large.laz, indexed by a process of its own, whose memory is measured. `world` are the pairs of data/world outdoors:
each scan sought in its target merged with the other scans of that target. Peers register the same clouds on the grid of
geomoe3d. Right: within 15 degrees and 30 cm, in `world` within the limits of each pair. One line per query goes to
OUT/queries.jsonl; what is there is not done again; `--every N` asks for every Nth query. The map's time is that of
`Map.from_cloud`, once per turn; a query's is that of `Map.locate`, by the clock and of the processor. Ten places are
asked for where rooms are alike, else three, as by default. Views whose extent is under a thirtieth of the building's
are counted apart as well.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from map_cases import ALIKE, CASES, Building, Query, Scan, tasks

from geomoe3d.clouds.voxel_size import robust_extent
from geomoe3d.evaluation.intervals import wilson
from geomoe3d.evaluation.metrics import motion_errors
from geomoe3d.evaluation.peers import PEERS
from geomoe3d.evaluation.records import MethodInput
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.maps.map import Map
from geomoe3d.runtime.journal import Journal, read_journal
from geomoe3d.types import FloatArray

OURS = "geomoe3d"
METHODS = (OURS, "kiss-matcher", "open3d-feature-ransac")
GRID = 0.055  # of the peers; geomoe3d describes these maps on it
SMALL = 30  # times the extent of a view: the largest map that is asked for


def indexed_apart(building: Building, out: Path) -> tuple[Map, float]:
    """The large building indexed by a process of its own, and its seconds; prints what it took."""
    cloud, path = out / "large.laz", out / "large.map"
    if not cloud.exists():
        part = out / "part.laz"
        building.write(part)
        part.rename(cloud)
    begin = time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "geomoe3d", "index", str(cloud), str(path), "--fresh", "--quiet"], check=True
    )
    seconds = time.perf_counter() - begin
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    made = Map.open(path)
    print(
        f"indexed {made.num_points:,} points in {seconds:.0f} s ({used.ru_utime + used.ru_stime:.0f} s of processor "
        f"time), {used.ru_maxrss / 2**20:.2f} GiB at most, described on a grid of {made.voxel_sizes[0]:.3g}",
        flush=True,
    )
    return made, seconds


def is_right(query: Query, scan: FloatArray, T: FloatArray | None, truth: FloatArray) -> bool:
    """Whether an answer is within the query's limits."""
    rotation, shift = motion_errors(T, truth)
    if query.of_centroid and T is not None:
        middle = scan.mean(0)[None]
        shift = float(np.linalg.norm(transform_points(T, middle) - transform_points(truth, middle)))
    return rotation < query.limits[0] and shift < query.limits[1]


def ask(
    method: str, query: Query, given: Scan, world: FloatArray, made: Map | None, k: int
) -> dict[str, Any]:
    """What a method says of one query, as a line of the journal; ``k``: places asked for."""
    (scan, truth), line = given, dict[str, Any]()
    begin, worked = time.perf_counter(), time.process_time()
    if made is not None:
        found = made.locate(scan, k=k)
        T: FloatArray | None = found.T_map_scan
        evidence = found.result.evidence
        line = {"status": found.status, "confidence": found.result.confidence}
        line["evidence"] = dict(evidence)
        line["voxel_size"], line["inliers"] = found.result.voxel_size, found.result.num_inliers
        line["reasons"] = found.result.reasons
        places = [place.T_map_scan for place in found.places]
    else:
        clouds: dict[str, Any] = {"source": scan, "target": world}
        T = PEERS[method](
            MethodInput(query.key, **clouds, voxel_size=GRID, inlier_threshold=2 * GRID)
        ).T_target_source
        places = []
    line["seconds"] = time.perf_counter() - begin
    line["processor_seconds"] = time.process_time() - worked
    if truth is not None:
        line["right"] = is_right(query, scan, T, truth)
        line["among"] = any(is_right(query, scan, place, truth) for place in places)
    return line


def report(lines: list[dict[str, Any]]) -> None:
    """The table: counts with Wilson's intervals and the median time."""
    lines += [
        {**line, "case": f"{line['case']}, seen well"}
        for line in lines
        if line.get("times", SMALL + 1) <= SMALL
    ]
    for case, method in sorted({(line["case"], line["method"]) for line in lines}):
        of = [line for line in lines if (line["case"], line["method"]) == (case, method)]
        count, words = len(of), []
        sure = [line for line in of if line.get("status") == "ok"]
        wrong = sum(not line.get("right", False) for line in sure)
        for name, number in (
            ("right", sum(line["right"] for line in of) if "right" in of[0] else None),
            (
                "named",
                sum("units differ" in "".join(line["reasons"]) for line in of) if case == "feet" else None,
            ),
            ("among ten", sum(line.get("among", False) for line in of) if case.startswith("alike") else None),
            ("ok", len(sure) if method == OURS else None),
            ("wrong ok", wrong if method == OURS else None),
        ):
            if number is not None:
                low, high = wilson(number / count, count)
                words.append(f"{name} {number} ({100 * number / count:.1f} %, {low:.1f} to {high:.1f})")
        seconds = statistics.median(line["seconds"] for line in of)
        worked = statistics.median(line.get("processor_seconds", float("nan")) for line in of)
        print(
            f"{case:20} {method:22} of {count}: {', '.join(words)}; median {seconds:.2f} s "
            f"({worked:.2f} s of the processor)"
        )
    indexed = [line["index_seconds"] for line in lines if "index_seconds" in line]
    if indexed:
        print(f"maps described: median {statistics.median(indexed):.1f} s, longest {max(indexed):.1f} s")


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument(
        "--begin", type=int, default=0, help="seed of the first room of generated buildings: another building"
    )
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "queries.jsonl"
    done = {(line["key"], line["method"]) for line in read_journal(path)}
    with Journal(path) as journal:
        for task in tasks(options.cases, options.begin):
            chosen = task.queries[:: options.every]
            methods = [OURS] if task.case in ("large", "feet") else options.methods
            open_ones = [(q, m) for q in chosen for m in methods if (q.key, m) not in done]
            if not open_ones:
                continue
            made, indexed, world = None, 0.0, np.zeros((0, 3))
            if task.case == "large" and task.building is not None:
                made, indexed = indexed_apart(task.building, options.out)
            else:
                world = task.world()
            if made is None and any(method == OURS for _, method in open_ones):
                begin = time.perf_counter()
                made = Map.from_cloud(world)
                indexed = time.perf_counter() - begin
            extent = made.extent if made is not None else robust_extent(world)
            for query, method in open_ones:
                scan = query.load()
                head = {"key": query.key, "case": task.case, "method": method}
                if task.building is not None:
                    head["times"] = extent / robust_extent(scan[0])
                if method == OURS:
                    head["index_seconds"] = indexed
                k = ALIKE if task.case == "alike" else 3
                line = ask(method, query, scan, world, made if method == OURS else None, k)
                journal.append({**head, **line})
                print(f"{query.key} {method}: {line}", flush=True)
    report(list(read_journal(path)))


if __name__ == "__main__":
    main()
