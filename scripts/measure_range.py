"""How far the answers hold: other numbers of correspondences, grids, inlier ratios, sensors and sizes.

    python scripts/measure_range.py [counts] [ratios] [voxels] [scans] [objects] [fine] [--every 16]
        [--weights FILE] [--models FOLDER] [--bodies FOLDER] [--fine FOLDER] [--out runs/range.jsonl]

Every case is asked with and without the network, the same pairs in the same order. One line per pair goes
to OUT.

- counts: 250 to 5,000 keypoints drawn in each fragment of the dev half at 5 cm, all where it has fewer,
  nearest neighbours source to target; recall of consensus alone and of the network on its motions.
- ratios: the fixed 1,000 correspondences, by their share of inliers; for 70 and 90 % outliers are left out,
  where 20 inliers or more are there, which leaves few correspondences.
- voxels: `register` on the fragments of the dev half with a fixed voxel size.
- scans: `register` on laser scans taken in two scene meshes and in generated flats, spinning and on a tripod,
  1 to 8 m apart.
- objects: `register` on depth views of single bodies, 25 to 75 degrees apart, made 1, 0.1 and 100 large.
  The bodies are those of Debian's libcgal-demo: `apt-get download libcgal-demo`, `dpkg-deb -x *.deb .`, and
  unpack its data.tar.gz into --bodies (default runs/bodies).
- fine: `register` on generated fragments with 2 and 5 cm voxels; make them with `geomoe3d data synthesize
  runs/fine-rooms grid=0.01 --scenes 10 --seed 777 --models FOLDER`.

Right: within 15 degrees and 30 cm; for objects within 15 degrees and a tenth of the diagonal. Scans and
objects are simulated (no recorded ones are at hand), by the scanners and the camera of `geomoe3d data
synthesize`; scene meshes and furniture models also served to make training sets, the bodies did not. `size`
is the median number of correspondences or of points of the smaller cloud, `ok` is what `register` says with
the network.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.pair import Pair
from geomoe3d.config import load_config
from geomoe3d.correspondence_registration import CorrespondenceRegistrar
from geomoe3d.data.collection import load_fragment, open_collection
from geomoe3d.data.describe import describe_fragment
from geomoe3d.data.draw import draw_pair
from geomoe3d.data.fusion import measure_overlap, thin
from geomoe3d.data.rooms.bodies import any_attitude
from geomoe3d.data.rooms.models import open_library
from geomoe3d.data.rooms.scanner import SPINNING, TRIPOD, LaserScanner, stand_scanner
from geomoe3d.data.rooms.scenes import generate_scene, load_mesh_scene
from geomoe3d.data.rooms.sensor import Camera, cast
from geomoe3d.data.rooms.solids import Solids
from geomoe3d.data.rooms.walk import camera_pose
from geomoe3d.data.threedmatch import (
    BENCHMARKS,
    find_data_root,
    iterate_fixed_correspondences,
    load_benchmark,
)
from geomoe3d.evaluation.metrics import motion_errors
from geomoe3d.evaluation.records import INLIER_THRESHOLD, VOXEL_SIZE
from geomoe3d.geometry.se3 import inverse, residuals
from geomoe3d.registration import Registrar
from geomoe3d.runtime.timing import StageClock
from geomoe3d.types import Correspondences, FloatArray

AT_ZERO = (np.zeros(3), np.zeros(3))
COUNTS = (250, 500, 1000, 2500, 5000)
VOXELS = (0.03, 0.05, 0.10, 0.20, 0.30)
RATIOS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 0.8, 1.0)
MIXED = (0.7, 0.9)
SIZES = (1.0, 0.1, 100.0)
BODIES = (
    "armadillo", "bear", "boeing", "bones", "bull", "bunny00", "camel", "cow", "dino",
    "diplodocus", "elephant", "elk", "fandisk_large", "femur", "hand", "head", "homer", "joint", "lion",
    "lion-head", "man", "mannequin-devil", "mech-holes-shark", "nefertiti", "pig", "triceratops",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One pair under one condition.

    Attributes:
        condition: what its row of the table is called.
        name: of the pair.
        given: two clouds, or correspondences (N, 6).
        truth: (4, 4) p_target = R p_source + t.
        tolerance: of the translation, in the clouds' unit.
        settings: of `register`.
    """

    condition: str
    name: str
    given: tuple[Any, ...]
    truth: FloatArray
    tolerance: float = 0.30
    settings: tuple[str, ...] = ()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; default all")
    parser.add_argument("--every", type=int, default=16, help="take every n-th pair of a benchmark")
    parser.add_argument("--pairs", type=int, default=40, help="simulated pairs per kind")
    parser.add_argument("--weights", help="of the network; default what ships")
    parser.add_argument("--models", default="/usr/share/sweethome3d/furniture", help="furniture models")
    parser.add_argument("--bodies", default="runs/bodies", help="folder of the bodies' meshes")
    parser.add_argument("--fine", default="runs/fine-rooms", help="generated fragments, kept at 1 cm")
    parser.add_argument("--out", type=Path, default=Path("runs/range.jsonl"))
    given = parser.parse_args()
    unknown = set(given.parts) - set(PARTS)
    if unknown:
        parser.error(f"unknown part {', '.join(sorted(unknown))}; known: {', '.join(PARTS)}")
    given.out.parent.mkdir(parents=True, exist_ok=True)
    weights = [] if given.weights is None else [f"scoring.weights={given.weights}"]
    ways = {"without": ["scoring.scorers=[surfaces]"], "network": weights}
    print(
        "| case | pairs | size | right: without / network | only without / only network | ok | right of ok "
        "| median ms: without / network |"
    )
    print("|---|---|---|---|---|---|---|---|")
    with given.out.open("a", encoding="utf-8") as stream:
        for part in given.parts or PARTS:
            rows: dict[str, list[dict[str, Any]]] = {}
            for case in PARTS[part](given):
                row = {"part": part, "condition": case.condition, "pair": case.name, "size": size_of(case)}
                row |= {"weights": given.weights, "every": given.every, "pairs": given.pairs}
                order = list(ways) if len(rows.get(case.condition, [])) % 2 else list(ways)[::-1]
                row |= {way: ask(case, tuple(ways[way])) for way in order}
                stream.write(json.dumps(row, allow_nan=False) + "\n")
                rows.setdefault(case.condition, []).append(row)
            for condition in sorted(rows):
                print(table_row(part, condition, rows[condition]), flush=True)


def size_of(case: Case) -> int:
    """Number of correspondences, or points of the smaller cloud."""
    return min(map(len, case.given))


def table_row(part: str, condition: str, rows: list[dict[str, Any]]) -> str:
    """One condition as a line of the table."""
    right = {way: np.array([row[way]["right"] for row in rows]) for way in ("without", "network")}
    shares = " / ".join(f"{100 * found.mean():.1f}" for found in right.values())
    only = f"{(right['without'] & ~right['network']).sum()} / {(right['network'] & ~right['without']).sum()}"
    ok = np.array([row["network"].get("status") == "ok" for row in rows])
    said = f"{100 * ok.mean():.0f} % | {100 * right['network'][ok].mean():.0f} %" if ok.any() else "| "
    times = " / ".join(
        f"{1000 * statistics.median(row[way]['seconds'] for row in rows):.0f}" for way in right
    )
    size = f"{statistics.median(row['size'] for row in rows):.0f}"
    return f"| {part} {condition} | {len(rows)} | {size} | {shares} | {only} | {said} | {times} |"


def ask(case: Case, settings: tuple[str, ...]) -> dict[str, Any]:
    """What came out for a case."""
    T: FloatArray | None
    of_clouds = len(case.given) == 2
    if of_clouds:  # weights are read before the clock starts
        register = registrar((*settings, *case.settings)).register
    else:
        without_clouds(settings)
    begin = time.perf_counter()
    if of_clouds:
        result = register(*case.given)
        T, said = result.T_target_source, {"status": result.status, "confidence": result.confidence}
        said["voxel_size"] = result.voxel_size
    else:
        T, said = from_correspondences(case.given[0], settings), {}
    seconds = time.perf_counter() - begin
    turn, way = motion_errors(T, case.truth)
    return {
        "right": bool(turn < 15 and way < case.tolerance),
        "turn": turn if np.isfinite(turn) else None,
        "way": way if np.isfinite(way) else None,
        "seconds": seconds,
        **said,
    }


@lru_cache(maxsize=16)
def registrar(settings: tuple[str, ...]) -> Registrar:
    """Kept warm."""
    return Registrar(load_config(None, list(settings)))


@lru_cache(maxsize=4)
def without_clouds(settings: tuple[str, ...]) -> CorrespondenceRegistrar:
    """Kept warm."""
    return CorrespondenceRegistrar(load_config(None, list(settings)))


def from_correspondences(matched: Correspondences, settings: tuple[str, ...]) -> FloatArray | None:
    """Outlier rejection, proposing and what the network says."""
    pair = Pair(matched, VOXEL_SIZE, INLIER_THRESHOLD)
    found, _ = without_clouds(settings).hypotheses(pair, StageClock())
    return found[0].T_target_source if found else None


def counts(given: argparse.Namespace) -> Iterator[Case]:
    """Keypoints drawn in fragments with features of the dev half."""

    @lru_cache(maxsize=64)
    def described(path: Path) -> tuple[Any, Any]:
        return describe_fragment(load_fragment(path), VOXEL_SIZE)

    for benchmark in BENCHMARKS:
        for number, pair in enumerate(load_benchmark(None, benchmark)[:: given.every]):
            for count in COUNTS:
                drawn = draw_pair(
                    described(pair.source), described(pair.target), pair.T_target_source, VOXEL_SIZE, count,
                    INLIER_THRESHOLD / VOXEL_SIZE, np.random.default_rng([number, count]),
                )  # fmt: skip
                rows = Correspondences(drawn.correspondences.points, viewpoints=AT_ZERO)
                name = f"{pair.scene} {pair.source_index} {pair.target_index}"
                yield Case(f"{count:5d}, {benchmark}", name, (rows,), pair.T_target_source)


def ratios(given: argparse.Namespace) -> Iterator[Case]:
    """The fixed correspondences by their share of inliers."""
    for benchmark in BENCHMARKS:
        for number, pair in enumerate(list(iterate_fixed_correspondences(None, benchmark))[:: given.every]):
            T = pair.T_target_source
            good = residuals(T, pair.points[:, :3], pair.points[:, 3:]) < INLIER_THRESHOLD
            name = f"{pair.scene} {pair.source_index} {pair.target_index}"
            for share in (float(good.mean()), *(MIXED if good.sum() >= 20 else ())):
                rows = thinned(pair.points, good, share, number)
                low = max(edge for edge in RATIOS[:-1] if edge <= share)
                high = RATIOS[RATIOS.index(low) + 1]
                matched = Correspondences(rows, viewpoints=AT_ZERO)
                yield Case(f"{100 * low:4.1f} to {100 * high:.1f} %", name, (matched,), T)


def thinned(points: FloatArray, good: Any, share: float, seed: int) -> FloatArray:
    """All inliers, and as many of the outliers as make them this share."""
    outliers = np.flatnonzero(~good)
    kept = min(len(outliers), round(good.sum() * (1 - share) / share)) if share > 0 else len(outliers)
    chosen = np.random.default_rng(seed).permutation(outliers)[:kept]
    kept_rows: FloatArray = points[np.sort(np.concatenate([np.flatnonzero(good), chosen]))]
    return kept_rows


def voxels(given: argparse.Namespace) -> Iterator[Case]:
    """Fragments of the dev half on other grids."""
    for benchmark in BENCHMARKS:
        for pair in load_benchmark(None, benchmark)[:: given.every]:
            clouds = load_points(pair.source).file_points, load_points(pair.target).file_points
            name = f"{pair.scene} {pair.source_index} {pair.target_index}"
            for size in VOXELS:
                settings = (f"voxel_size={size}",)
                yield Case(
                    f"{100 * size:2.0f} cm, {benchmark}", name, clouds, pair.T_target_source, 0.3, settings
                )


def scans(given: argparse.Namespace) -> Iterator[Case]:
    """Laser scans in a scene mesh or a generated flat, some metres apart."""
    library = open_library([given.models])
    meshes = [
        load_mesh_scene(find_data_root() / "scenes" / f"{name}.ply") for name in ("small_house", "bookstore")
    ]
    for kind, settings in (("spinning", SPINNING), ("tripod", TRIPOD)):
        scanner = LaserScanner(settings)
        for number in range(given.pairs):
            rng = np.random.default_rng([number, settings.rings])
            place = meshes[number % 4] if number % 4 < 2 else generate_scene(rng, library)
            for _ in range(100):
                poses = stand_scanner(rng, place, 2)
                if len(poses) < 2:
                    continue
                clouds = [scanner.scan(place.rays, pose, rng) for pose in poses]
                truth = inverse(poses[1]) @ poses[0]
                # On a coarse grid, so that what is near, densely scanned, does not decide it.
                coarse = [thin(cloud, 0.1) for cloud in clouds]
                if measure_overlap(coarse[0], coarse[1], truth, 0.15) > 0.3:
                    break
            else:
                print(f"no two places in {place.name}", flush=True)
                continue
            for size in (None, 0.1, 0.3):
                fixed = () if size is None else (f"voxel_size={size}",)
                label = "auto" if size is None else f"{100 * size:.0f} cm"
                yield Case(f"{kind}, {label}", f"{place.name} {number}", tuple(clouds), truth, 0.3, fixed)


def objects(given: argparse.Namespace) -> Iterator[Case]:
    """Depth views of one body from two sides."""
    files = {path.stem: path for path in sorted(Path(given.bodies).rglob("*.off"))}
    missing = [name for name in BODIES if name not in files]
    if missing:
        raise SystemExit(
            f"'{given.bodies}' lacks {missing[0]}.off; the head of this script says how to get it"
        )
    camera = Camera(320, 240, 292.5)
    for number, name in enumerate(2 * BODIES):
        rng = np.random.default_rng([number, 7])
        scene, diagonal = standing(files[name], rng)
        for _ in range(100):
            first, pitch = rng.uniform(0, 360), rng.normal(0, 25)
            turn = float(rng.choice([-1, 1]) * rng.uniform(25, 75))
            views, poses = [], []
            for yaw in (first, first + turn):
                pose = camera_pose(np.zeros(3), yaw, pitch, rng.normal(0, 5))
                pose[:3, 3] = -1.5 * diagonal * pose[:3, 2]
                depth = cast(scene, camera, pose).depth.ravel()
                seen = np.isfinite(depth)
                noisy = depth[seen] + 0.002 * diagonal * rng.standard_normal(int(seen.sum()))
                views.append(camera.rays()[seen] * noisy[:, None])
                poses.append(pose)
            truth = inverse(poses[1]) @ poses[0]
            if measure_overlap(views[0], views[1], truth, 0.02 * diagonal) > 0.4:
                break
        else:
            print(f"no two views of {name} overlap", flush=True)
            continue
        for size in SIZES:
            scaled = truth.copy()
            scaled[:3, 3] *= size / diagonal
            clouds = tuple(size / diagonal * view for view in views)
            yield Case(f"of size {size:5.1f}", f"{name} {number}", clouds, scaled, 0.1 * size)


def standing(file: Path, rng: np.random.Generator) -> tuple[Any, float]:
    """A body in any attitude about the origin, for rays, and its diagonal."""
    import trimesh

    mesh: Any = trimesh.load(file, force="mesh", process=False)
    vertices = (mesh.vertices - mesh.bounds.mean(0)) @ any_attitude(rng).T
    solids = Solids()
    solids.triangles(np.asarray(vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64))
    return solids.scene(), float(np.linalg.norm(mesh.extents))


def fine(given: argparse.Namespace) -> Iterator[Case]:
    """Generated fragments, kept at 1 cm, on a grid of 2 cm beside one of 5 cm."""
    pairs = open_collection(given.fine).pairs
    chosen = np.random.default_rng(0).permutation(len(pairs))[: given.pairs]
    for pair in (pairs[k] for k in chosen):
        clouds = load_fragment(pair.source), load_fragment(pair.target)
        for size in (0.02, 0.05):
            settings = (f"voxel_size={size}", "preparation.max_points=100000")
            yield Case(
                f"{100 * size:.0f} cm",
                f"{pair.source} {pair.target}",
                clouds,
                pair.T_target_source,
                0.3,
                settings,
            )


PARTS: dict[str, Callable[[argparse.Namespace], Iterator[Case]]] = {
    "counts": counts,
    "ratios": ratios,
    "voxels": voxels,
    "scans": scans,
    "objects": objects,
    "fine": fine,
}

if __name__ == "__main__":
    main()
