"""Scans in maps: one room, three rooms side by side, scans of another building, generated buildings; peers beside.

    python scripts/measure_maps.py OUT [--cases room three stranger building alike large] [--methods geomoe3d
        kiss-matcher open3d-feature-ransac] [--every 1]

The rooms are three dev scenes of 3DMatch, each merged by its published poses; 60 fragments are asked for, 20 of each.
They are left out in five turns: a map holds none of the twelve fragments asked for in its turn. Side by side the rooms
stand 12 m apart (34 m, 3 million points). Strangers are the fragments of a fourth scene, sought in the three rooms.
The building holds 40 generated rooms in a raster, no two alike, or (`alike`) ten of them the same room; each is
scanned from three places by a laser on a tripod. Every second room, or each of those that are alike, is asked for by a
depth camera that turns by 60 degrees. `large` is the building without two alike, each point eight times with noise of
5 mm: some 50 million points as OUT/large.laz, indexed by a process of its own, whose memory is measured. Peers register
the same clouds on the grid of geomoe3d. Right: within 15 degrees and 30 cm. One line per query goes to
OUT/queries.jsonl; what is there is not done again; `--every N` asks for every Nth query. The map's time is that of
`Map.from_cloud`, once per turn; a query's is that of `Map.locate`, by the clock and of the processor. Ten places are
asked for where rooms are alike, else three, as by default.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.clouds.io import load_points
from geomoe3d.data.rooms.scanner import TRIPOD, LaserScanner, stand_scanner
from geomoe3d.data.rooms.scenes import Scene, generate_scene
from geomoe3d.data.rooms.sensor import KINECT, cast
from geomoe3d.data.rooms.walk import camera_pose
from geomoe3d.data.threedmatch import BENCHMARKS, find_benchmark_root, load_benchmark
from geomoe3d.evaluation.intervals import wilson
from geomoe3d.evaluation.metrics import is_right, motion_errors
from geomoe3d.evaluation.peers import PEERS
from geomoe3d.evaluation.records import MethodInput
from geomoe3d.geometry.se3 import inverse, transform_points
from geomoe3d.maps.map import Map
from geomoe3d.runtime.journal import Journal, read_journal
from geomoe3d.types import FloatArray

OURS = "geomoe3d"
METHODS = (OURS, "kiss-matcher", "open3d-feature-ransac")
CASES = ("room", "three", "stranger", "building", "alike", "large")
ROOMS, ALIKE, SPACE = 40, 10, 9.0
_TRIPOD = TRIPOD.model_copy(update={"rings": 150, "azimuth_step_deg": 1.0})
_TIMES, _NOISE = 8, 0.005
APART, PER_SCENE, TURNS = 12.0, 20, 5
GRID = 0.055  # of the peers; geomoe3d describes these maps on it


@dataclass(frozen=True)
class Query:
    """One scan sought in one map; ``truth`` T_map_scan, or None where it lies nowhere in it."""

    case: str
    scene: str
    number: int
    turn: int
    truth: FloatArray | None

    @property
    def key(self) -> str:
        """What the query is called in the journal."""
        return f"{self.case}/{self.scene}/{self.number}"


class Scenes:
    """The fragments of the dev scenes, and where they lie."""

    def __init__(self) -> None:
        self._folder = find_benchmark_root() / "fragments"
        self.names = sorted(path.name for path in self._folder.iterdir())
        self._poses = {name: _poses(name) for name in self.names}

    def points(self, scene: str, number: int) -> FloatArray:
        """(N, 3) of a fragment, its sensor at the origin."""
        return load_points(self._folder / scene / f"cloud_bin_{number}.ply").file_points

    def numbers(self, scene: str) -> list[int]:
        """Of its fragments whose place is known."""
        return sorted(self._poses[scene])

    def pose(self, scene: str, number: int) -> FloatArray:
        """(4, 4) T_map_fragment, the scenes side by side."""
        T: FloatArray = self._poses[scene][number].copy()
        T[0, 3] += APART * self.names.index(scene)
        return T

    def asked(self, scene: str) -> list[int]:
        """The fragments that are asked for, evenly over the scene."""
        numbers = self.numbers(scene)
        return [numbers[k] for k in np.linspace(0, len(numbers) - 1, PER_SCENE).round().astype(int)]

    def merged(self, scenes: list[str], turn: int) -> FloatArray:
        """(N, 3) of some scenes without what is asked for in a turn."""
        parts = []
        for scene in scenes:
            out = self.asked(scene)[turn::TURNS]
            parts += [
                transform_points(self.pose(scene, number), self.points(scene, number))
                for number in self.numbers(scene)
                if number not in out
            ]
        return np.concatenate(parts)


def _poses(scene: str) -> dict[int, FloatArray]:
    """T_world_fragment (4, 4) along as few published motions as possible."""
    motions: dict[int, list[tuple[int, FloatArray]]] = {}
    for benchmark in BENCHMARKS:
        for pair in load_benchmark(None, benchmark):
            if pair.scene == scene:
                i, j, T = pair.source_index, pair.target_index, pair.T_target_source
                motions.setdefault(i, []).append((j, inverse(T)))
                motions.setdefault(j, []).append((i, T))
    first = max(motions, key=lambda number: len(motions[number]))
    found, queue = {first: np.eye(4)}, deque([first])
    while queue:
        known = queue.popleft()
        for other, T_known_other in motions[known]:
            if other not in found:
                found[other] = found[known] @ T_known_other
                queue.append(other)
    return found


class Building:
    """Generated rooms in a raster; the first ten are one room where they are to be alike."""

    def __init__(self, alike: bool) -> None:
        self._seeds = [0 if alike and k < ALIKE else k for k in range(ROOMS)]
        self.asked = list(range(ALIKE)) if alike else list(range(0, ROOMS, 2))
        self._scenes = {seed: _one_room(seed) for seed in sorted(set(self._seeds))}

    def _place(self, room: int) -> FloatArray:
        return np.array([SPACE * (room % 8), SPACE * (room // 8), 0.0])

    def scans(self) -> Iterator[FloatArray]:
        """(N, 3) of each scan of each room."""
        for room, seed in enumerate(self._seeds):
            rng, scene = np.random.default_rng((1, room)), self._scenes[seed]
            for pose in stand_scanner(np.random.default_rng((2, seed)), scene, 3):
                yield transform_points(pose, LaserScanner(_TRIPOD).scan(scene.rays, pose, rng)) + self._place(
                    room
                )

    def cloud(self) -> FloatArray:
        """(N, 3) of all rooms, each scanned anew."""
        return np.concatenate(list(self.scans()))

    def write(self, path: Path) -> int:
        """All rooms as a LAZ file, each point eight times with noise of its own; how many points that are."""
        import laspy

        rng = np.random.default_rng(4)
        header = laspy.LasHeader(point_format=0, version="1.2")
        header.scales, count = np.full(3, 0.001), 0
        with laspy.open(path, mode="w", header=header) as file:
            for scan in self.scans():
                points = np.repeat(scan, _TIMES, axis=0) + rng.normal(0, _NOISE, (_TIMES * len(scan), 3))
                record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
                record.x, record.y, record.z = points.T
                file.write_points(record)
                count += len(points)
        return count

    def view(self, room: int) -> tuple[FloatArray, FloatArray]:
        """(N, 3) of a depth camera in one room, in its frame, and its pose T_map_camera."""
        rng, scene = np.random.default_rng((3, room)), self._scenes[self._seeds[room]]
        stand = stand_scanner(rng, scene, 1)[0]
        yaw = rng.uniform(0, 360)
        poses, parts = [], []
        for turn in (-30.0, 0.0, 30.0):
            poses.append(camera_pose(stand[:3, 3], yaw + turn, -15.0, 0.0))
            hits = cast(scene.rays, KINECT, poses[-1])
            depth = hits.depth.ravel()
            seen = np.isfinite(depth) & (depth > 0.4) & (depth < 6.0) & (hits.slope.ravel() > 0.1)
            noisy = depth[seen] + 0.0015 * depth[seen] ** 2 * rng.standard_normal(int(seen.sum()))
            points = KINECT.rays()[seen] * noisy[:, None]
            parts.append(transform_points(inverse(poses[0]) @ poses[-1], points))
        pose = poses[0].copy()
        pose[:3, 3] += self._place(room)
        return np.concatenate(parts), pose


def _one_room(seed: int) -> Scene:
    """The first generated scene from a seed on that is a single room."""
    for attempt in range(100):
        scene = generate_scene(np.random.default_rng((seed, attempt)))
        if len(scene.areas) == 1:
            return scene
    raise RuntimeError(f"no single room among a hundred of seed {seed}")


def maps(scenes: Scenes, cases: list[str]) -> Iterator[tuple[str, int, list[str], list[Query]]]:
    """Case, turn, the rooms of the map, and the scans sought in it."""
    rooms = scenes.names[:3]
    for turn in range(TURNS):
        asked = {scene: scenes.asked(scene)[turn::TURNS] for scene in rooms}
        if "room" in cases:
            for scene in rooms:
                queries = [Query("room", scene, n, turn, scenes.pose(scene, n)) for n in asked[scene]]
                yield "room", turn, [scene], queries
        if "three" in cases:
            queries = [Query("three", s, n, turn, scenes.pose(s, n)) for s in rooms for n in asked[s]]
            yield "three", turn, rooms, queries
        if "stranger" in cases:
            other = scenes.names[3]
            queries = [Query("stranger", other, n, turn, None) for n in scenes.numbers(other)[turn::TURNS]]
            yield "stranger", turn, rooms, queries
    for case in ("building", "alike", "large"):
        if case in cases:
            yield case, 0, [], [Query(case, "rooms", n, 0, None) for n in Building(case == "alike").asked]


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


def ask(method: str, query: Query, scan: FloatArray, world: FloatArray, made: Map | None) -> dict[str, Any]:
    """What a method says of one query, as a line of the journal."""
    begin, worked = time.perf_counter(), time.process_time()
    line: dict[str, Any] = {}
    if made is not None:
        found = made.locate(scan, k=ALIKE) if query.case == "alike" else made.locate(scan)
        T: FloatArray | None = found.T_map_scan
        evidence = found.result.evidence
        line = {"status": found.status, "confidence": found.result.confidence}
        line |= {name: evidence.get(name) for name in ("scale_ratio", "scale_sigma")}
        places = [place.T_map_scan for place in found.places]
    else:
        given = MethodInput(query.key, source=scan, target=world, voxel_size=GRID, inlier_threshold=2 * GRID)
        T = PEERS[method](given).T_target_source
        places = []
    line["seconds"] = time.perf_counter() - begin
    line["processor_seconds"] = time.process_time() - worked
    if query.truth is not None:
        line["right"] = is_right(*motion_errors(T, query.truth))
        line["among"] = any(is_right(*motion_errors(place, query.truth)) for place in places)
    return line


def report(lines: list[dict[str, Any]]) -> None:
    """The table: counts with Wilson's intervals and the median time."""
    for case, method in sorted({(line["case"], line["method"]) for line in lines}):
        of = [line for line in lines if (line["case"], line["method"]) == (case, method)]
        count, words = len(of), []
        sure = [line for line in of if line.get("status") == "ok"]
        wrong = sum(not line.get("right", False) for line in sure)
        for name, number in (
            ("right", sum(line.get("right", False) for line in of) if case != "stranger" else None),
            ("among ten", sum(line.get("among", False) for line in of) if case == "alike" else None),
            ("ok", len(sure) if method == OURS else None),
            ("wrong ok", wrong if method == OURS else None),
        ):
            if number is not None:
                low, high = wilson(number / count, count)
                words.append(f"{name} {number} ({100 * number / count:.1f} %, {low:.1f} to {high:.1f})")
        seconds = statistics.median(line["seconds"] for line in of)
        worked = statistics.median(line.get("processor_seconds", float("nan")) for line in of)
        print(
            f"{case:9} {method:22} of {count}: {', '.join(words)}; median {seconds:.2f} s "
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
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / "queries.jsonl"
    done = {(line["key"], line["method"]) for line in read_journal(path)}
    scenes = Scenes()
    with Journal(path) as journal:
        for case, turn, rooms, queries in maps(scenes, options.cases):
            chosen = queries[:: options.every]
            open_ones = [(q, m) for q in chosen for m in options.methods if (q.key, m) not in done]
            if not open_ones:
                continue
            building = None if rooms else Building(case == "alike")
            made, indexed, world = None, 0.0, np.zeros((0, 3))
            if case == "large" and building is not None:
                open_ones = [(q, method) for q, method in open_ones if method == OURS]
                made, indexed = indexed_apart(building, options.out)
            else:
                world = scenes.merged(rooms, turn) if building is None else building.cloud()
            if made is None and any(method == OURS for _, method in open_ones):
                begin = time.perf_counter()
                made = Map.from_cloud(world)
                indexed = time.perf_counter() - begin
            for query, method in open_ones:
                if building is None:
                    scan = scenes.points(query.scene, query.number)
                else:
                    scan, truth = building.view(query.number)
                    query = replace(query, truth=truth)
                line = ask(method, query, scan, world, made if method == OURS else None)
                head = {"key": query.key, "case": case, "method": method}
                if method == OURS:
                    head["index_seconds"] = indexed
                journal.append({**head, **line})
                print(f"{query.key} {method}: {line}", flush=True)
    report(list(read_journal(path)))


if __name__ == "__main__":
    main()
