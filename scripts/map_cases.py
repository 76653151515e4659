"""What `measure_maps.py` seeks in what: recorded rooms, generated buildings, meshes, the pairs of data/world."""

from __future__ import annotations

import json
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np

from geomoe3d.clouds.io import load_points
from geomoe3d.data.rooms.scanner import TRIPOD, LaserScanner, stand_scanner
from geomoe3d.data.rooms.scenes import Scene, generate_scene
from geomoe3d.data.rooms.sensor import KINECT, cast
from geomoe3d.data.rooms.walk import camera_pose
from geomoe3d.data.threedmatch import BENCHMARKS, find_benchmark_root, load_benchmark
from geomoe3d.geometry.se3 import inverse, transform_points
from geomoe3d.types import FloatArray

CASES = ("room", "three", "stranger", "feet", "building", "alike", "large", "world")
ROOMS, ALIKE, SPACE = 40, 10, 9.0
FEET = 1 / 0.3048
_TRIPOD = TRIPOD.model_copy(update={"rings": 150, "azimuth_step_deg": 1.0})
_TIMES, _NOISE = 8, 0.005
APART, PER_SCENE, TURNS = 12.0, 20, 5
_OUTDOORS = (
    "terrestrial",
    "driving",
    "outdoor",
    "airborne",
    "forest",
)  # kinds of data/world that may be maps

Scan = tuple[FloatArray, FloatArray | None]
"""(N, 3) of a scan, and T_map_scan, or None where it lies nowhere in the map."""


@dataclass(frozen=True)
class Query:
    """One scan sought in one map.

    Attributes:
        key: what it is called in the journal.
        load: gives it.
        limits: degrees and length within which an answer is right.
        of_centroid: whether the length is that of the scan's middle, else of its origin.
    """

    key: str
    load: Callable[[], Scan]
    limits: tuple[float, float] = (15.0, 0.3)
    of_centroid: bool = False


@dataclass(frozen=True)
class Task:
    """A map, and what is sought in it; ``building`` where it is one."""

    case: str
    world: Callable[[], FloatArray]
    queries: list[Query]
    building: Building | None = None


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
        """The fragments that are asked for."""
        return self.some(scene, PER_SCENE)

    def some(self, scene: str, count: int) -> list[int]:
        """So many fragments, evenly over the scene."""
        numbers = self.numbers(scene)
        return [numbers[k] for k in np.linspace(0, len(numbers) - 1, count).round().astype(int)]

    def merged(self, scenes: list[str], turn: int | None = None) -> FloatArray:
        """(N, 3) of some scenes without what is asked for in a turn."""
        parts = []
        for scene in scenes:
            out = [] if turn is None else self.asked(scene)[turn::TURNS]
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
    """Generated rooms in a raster, of seeds from one on; the first ten are one room where they are to be alike."""

    def __init__(self, alike: bool = False, *, begin: int = 0, count: int = ROOMS) -> None:
        self._seeds = [begin if alike and k < ALIKE else begin + k for k in range(count)]
        self.asked = (
            [(k % ALIKE, k // ALIKE) for k in range(2 * ALIKE)] if alike else [(k, 0) for k in range(count)]
        )
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

    def view(self, room: int, again: int = 0) -> Scan:
        """A depth camera in one room; ``again``: which of its views there."""
        rng = np.random.default_rng((3, room, again) if again else (3, room))
        scene = self._scenes[self._seeds[room]]
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


def tasks(cases: list[str], begin: int = 0) -> Iterator[Task]:
    """The maps of some cases; ``begin``: seed of the first room of generated buildings, for other ones."""
    if set(cases) & {"room", "three", "feet"}:
        yield from _of_rooms(Scenes(), cases)
    if "stranger" in cases:
        yield from _of_strangers(Scenes())
    for case in ("building", "alike", "large"):
        if case in cases:
            made = Building(case == "alike", begin=begin)
            other = f" {begin}" if begin else ""
            queries = [
                Query(f"{case}{other}/rooms/{room + ALIKE * again}", partial(made.view, room, again))
                for room, again in (made.asked if case != "large" else made.asked[::2])
            ]
            yield Task(case, made.cloud, queries, made)
    if "world" in cases:
        yield from _of_world(find_benchmark_root().parent / "world")


def _of_rooms(scenes: Scenes, cases: list[str]) -> Iterator[Task]:
    rooms = scenes.names[:3]

    query = partial(_fragment, scenes)
    for turn in range(TURNS):
        asked = {scene: scenes.asked(scene)[turn::TURNS] for scene in rooms}
        world = cache(partial(scenes.merged, rooms, turn))
        every = [(scene, number) for scene in rooms for number in asked[scene]]
        if "room" in cases:
            for scene in rooms:
                alone = [query("room", scene, number) for number in asked[scene]]
                yield Task("room", partial(scenes.merged, [scene], turn), alone)
        if "three" in cases:
            yield Task("three", world, [query("three", *of) for of in every])
        if "feet" in cases:
            both = [
                query(f"feet{name}", *of, there=False, times=times)
                for of in every
                for name, times in (("", FEET), (" back", 1 / FEET))
            ]
            yield Task("feet", world, both)


def _of_strangers(scenes: Scenes) -> Iterator[Task]:
    """Scans of scenes that are not in the map: in one room, in three, in 40 generated ones, in scanned meshes."""

    def fragments(case: str, of: list[str], count: int) -> list[Query]:
        return [
            _fragment(scenes, case, scene, number, there=False)
            for scene in of
            for number in scenes.some(scene, count)
        ]

    for scene in scenes.names:
        others = [name for name in scenes.names if name != scene]
        one, three = f"stranger one {scene}", f"stranger three without {scene}"
        yield Task("stranger, one room", partial(scenes.merged, [scene]), fragments(one, others, 5))
        yield Task("stranger, three", partial(scenes.merged, others), fragments(three, [scene], 10))
    elsewhere = Building(begin=1000, count=12)

    def view(room: int) -> Scan:
        return elsewhere.view(room)[0], None

    views = [Query(f"stranger building/{room}", partial(view, room)) for room, _ in elsewhere.asked]
    recorded = fragments("stranger building", scenes.names, 3)
    yield Task("stranger, building", Building().cloud, [*views, *recorded])
    for mesh in sorted((find_benchmark_root().parent / "scenes").glob("*.ply")):
        cloud = load_points(mesh, mesh_points=200_000).file_points
        yield Task(
            "stranger, mesh", partial(np.asarray, cloud), fragments(f"stranger {mesh.stem}", scenes.names, 5)
        )


def _fragment(
    scenes: Scenes, case: str, scene: str, number: int, *, there: bool = True, times: float = 1.0
) -> Query:
    def load() -> Scan:
        return times * scenes.points(scene, number), scenes.pose(scene, number) if there else None

    return Query(f"{case}/{scene}/{number}", load)


def _of_world(folder: Path) -> Iterator[Task]:
    """Of scans that share a target, each sought in the target and the others; of two, one in the other."""
    stars = defaultdict(list)
    for pair in json.loads((folder / "pairs.json").read_text()):
        if pair["kind"].startswith(_OUTDOORS):
            stars[pair["name"].rsplit("_", 2)[0], pair["name"].rsplit("_", 1)[1]].append(pair)
    for star in stars.values():
        for pair in star:
            others = [other for other in star if other is not pair]
            limits = float(pair["max_rot_deg"]), float(pair["max_trans"])
            query = Query(f"world/{pair['name']}", partial(_world_scan, folder, pair), limits, True)
            yield Task("world", partial(_world_map, folder, pair, others), [query])


def _world_scan(folder: Path, pair: dict[str, str]) -> Scan:
    return load_points(folder / pair["source"]).file_points, np.array(pair["T_target_source"])


def _world_map(folder: Path, pair: dict[str, str], others: list[dict[str, str]]) -> FloatArray:
    parts = [load_points(folder / pair["target"]).file_points]
    for other in others:
        scan, T = _world_scan(folder, other)
        parts += [] if T is None else [transform_points(T, scan)]
    return np.concatenate(parts)
