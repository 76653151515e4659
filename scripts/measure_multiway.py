"""Whole rooms from their fragments alone, scored against the dev half's published poses.

    python scripts/measure_multiway.py OUT [--scene NAME ...] [--scans N] [--workers N] [--sequence]
        [--beside CHECKOUT] [--option=--...]      the command, and that of another checkout in the same run
    python scripts/measure_multiway.py OUT --rooms FOLDER [--every N] ...    generated rooms instead
    python scripts/measure_multiway.py OUT --world ...                       facade 0-3 and captures 1-5
    python scripts/measure_multiway.py OUT --building N ...                  N laser scans of a generated building
    python scripts/measure_multiway.py OUT --truth [--scene NAME ...]    how exact the published poses are

Ground truth is used for scoring only. A fragment is placed rightly when its pose in the largest group is
within 15 deg and 30 cm of the published one, after the group as a whole has been laid on it (rigid fit of the
fragments' frames, the worst tenth left out). A kept edge is wrong beyond the same limits; beyond 30 deg or
1 m it is also counted as gross; of one whose
scan has no published pose nothing is known. A pair of the benchmarks is recalled when the poses of one group give its
motion within 15 deg and 30 cm, or (RMSE) within 0.2 m of the benchmark's error where the pair is not
consecutive; it is bent when its scans stand in one group and the motion is not within 15 deg and 30 cm. Each
model is made by `geomoe3d multiway` in a process of its own; seconds are wall time of the whole command,
processor seconds those of all its processes.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.viewpoint import find_viewpoints
from geomoe3d.config import RegistrationConfig, load_config
from geomoe3d.data.fusion import thin
from geomoe3d.data.rooms.arrange import furnish
from geomoe3d.data.rooms.scanner import TRIPOD, LaserScanner, stand_scanner
from geomoe3d.data.rooms.scenes import Scene
from geomoe3d.data.rooms.shell import build_shell, plan_flat
from geomoe3d.data.rooms.solids import Solids
from geomoe3d.data.threedmatch import (
    find_benchmark_root,
    find_data_root,
    read_gt_info,
    read_gt_log,
    true_motion,
)
from geomoe3d.evaluation.metrics import benchmark_rmse
from geomoe3d.geometry.rigid_fit import fit_rigid
from geomoe3d.geometry.se3 import (
    inverse,
    make_transform,
    rotation_error_deg,
    shift_frames,
    transform_points,
    translation_error,
)
from geomoe3d.multiway.alignment import Surface, align_scans
from geomoe3d.multiway.overlaps import Overlaps
from geomoe3d.multiway.scans import choose_common_voxel_size, find_scans
from geomoe3d.registration import Registrar, register
from geomoe3d.runtime.timing import StageClock
from geomoe3d.types import FloatArray

Poses = dict[str, FloatArray]
"""T_group_scan (4, 4) by the scan's name."""
_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])


class Room(NamedTuple):
    """Scans with their true poses, one dictionary per part that the truth connects; ``scene`` of 3DMatch."""

    name: str
    files: list[Path]
    parts: list[Poses]
    scene: str = ""


def dev_rooms(wanted: list[str], count: int | None) -> list[Room]:
    """The scenes of the dev half, by parts of their names."""
    root = find_benchmark_root() / "fragments"
    rooms = []
    for scene in sorted(p.name for p in root.iterdir() if not wanted or any(s in p.name for s in wanted)):
        files = sorted((root / scene).glob("*.ply"), key=lambda path: number(path.stem))[:count]
        rooms.append(Room(scene if count is None else f"{scene}.{count}", files, true_poses(scene), scene))
    return rooms


def generated_rooms(folder: Path, every: int) -> list[Room]:
    """Rooms of `geomoe3d data synthesize`, every so many."""
    rooms = []
    for place in sorted(folder.glob("scene-*"))[::every]:
        files = sorted(place.glob("cloud_bin_*.ply"), key=lambda path: number(path.stem))
        poses = np.loadtxt(place / "poses.txt").reshape(-1, 4, 4)
        rooms.append(Room(place.name, files, [{path.stem: poses[number(path.stem)] for path in files}]))
    return rooms


def building(folder: Path, count: int) -> Room:
    """Laser scans of a generated building of furnished rooms with doorways, four to a room.

    Each stands within 8 m of one before, in the same room or another; written into the folder, unless they are there.
    """
    rng, per_room = np.random.default_rng(count), 4
    plan, solids = plan_flat(rng, max(count // per_room, 1)), Solids()
    for room in plan:
        build_shell(rng, solids, room)
        furnish(rng, solids, room, None, 20.0)
    scene = Scene("primitives", "building", solids, [room.rect for room in plan])
    scanner, truth, files = (
        LaserScanner(TRIPOD.model_copy(update={"rings": 150, "azimuth_step_deg": 1.0})),
        {},
        [],
    )
    folder.mkdir(parents=True, exist_ok=True)
    for k, pose in enumerate(stand_scanner(rng, scene, count)):
        files.append(folder / f"scan_{k}.npy")
        truth[files[-1].stem] = pose
        if not files[-1].exists():
            np.save(files[-1], thin(scanner.scan(scene.rays, pose, np.random.default_rng((count, k))), 0.025))
    return Room(folder.name, files, [truth])


def world_rooms() -> list[Room]:
    """Consecutive scans among the real pairs of other sensors.

    Every pair was thinned and moved by itself, so that one scan has another frame in each of its pairs; the
    frames are tied by registering the scan with itself.
    """
    folder = find_data_root() / "world"
    pairs = json.loads((folder / "pairs.json").read_text())
    motions = {pair["name"]: np.array(pair["T_target_source"]) for pair in pairs}
    rooms = []
    for name, steps in (("facade", ("1_0", "2_1", "3_2")), ("pcl_capture", ("2_1", "3_2", "4_3", "5_4"))):
        truth = {f"{name}_{steps[0]}_t": np.eye(4)}
        for step in steps:
            known, T = list(truth.items())[-1]
            again = f"{name}_{step}_t"
            if again != known:
                tied = register(folder / f"{again}.ply", folder / f"{known}.ply")
                T = T @ tied.T_target_source
            truth[f"{name}_{step}_s"] = T @ motions[f"{name}_{step}"]
        rooms.append(Room(name, [folder / f"{scan}.ply" for scan in truth], [truth]))
    return rooms


def true_poses(scene: str) -> list[Poses]:
    """Absolute poses of the fragments that the published pairs connect, one dictionary per connected part."""
    motions: dict[int, list[tuple[int, FloatArray]]] = {}
    for benchmark in ("3DMatch", "3DLoMatch"):
        log = find_benchmark_root() / "benchmarks" / benchmark / scene / "gt.log"
        for i, j, entry in read_gt_log(log):
            T = true_motion(entry)  # of i into j
            motions.setdefault(i, []).append((j, inverse(T)))
            motions.setdefault(j, []).append((i, T))
    parts: list[dict[int, FloatArray]] = []
    for first in sorted(motions):
        if any(first in part for part in parts):
            continue
        part, waiting = {first: np.eye(4)}, [first]
        while waiting:
            scan = waiting.pop(0)
            for other, T in motions[scan]:
                if other not in part:
                    part[other] = part[scan] @ T
                    waiting.append(other)
        parts.append(part)
    return [{f"cloud_bin_{scan}": T for scan, T in part.items()} for part in parts]


def score_group(group: Poses, truth: Poses) -> dict[str, Any]:
    """Errors of a group's fragments that the truth knows, after the group was laid on the truth."""
    poses = {scan: T for scan, T in group.items() if scan in truth}
    if len(poses) < 2:
        return {"placed": 0, "errors": []}
    ours = np.concatenate([transform_points(T, _CORNERS) for T in poses.values()])
    theirs = np.concatenate([transform_points(truth[k], _CORNERS) for k in poses])
    T = align(ours, theirs)
    errors = [
        (rotation_error_deg(T @ pose, truth[k]), translation_error(T @ pose, truth[k]))
        for k, pose in poses.items()
    ]
    return {"placed": sum(r < 15 and t < 0.30 for r, t in errors), "errors": [t for _, t in errors]}


def align(ours: FloatArray, theirs: FloatArray) -> FloatArray:
    """The rigid motion that lays most of our points on theirs: a least squares fit, trimmed four times."""
    keep = np.ones(len(ours), dtype=np.bool_)
    T = np.eye(4)
    for _ in range(5):
        R, t = fit_rigid(ours[keep], theirs[keep], np.ones(int(keep.sum())))
        T = make_transform(R, t)
        away = np.linalg.norm(transform_points(T, ours) - theirs, axis=1)
        keep = away <= np.quantile(away, 0.9)
    return T


def truth_drift(room: Room, config: RegistrationConfig) -> FloatArray:
    """By how much each published pose moves (m) when the scans are laid on each other's surfaces from there.

    What the surfaces do not hold stays, so this says how exact the published poses are, not how exact ours.
    """
    truth = max(room.parts, key=len)
    scans = [scan for scan in find_scans(room.files) if scan.name in truth]
    size = config.voxel_size or choose_common_voxel_size(scans, config.preparation)[0]
    registrar, surfaces, poses, origins = Registrar(config), {}, {}, {}
    for scan in scans:
        cloud = load_points(scan.path)
        view = find_viewpoints(cloud, cloud, config.preparation.viewpoint)[0]
        key = number(scan.name)
        surfaces[key] = Surface.of(registrar.pipeline.prepare(cloud, size, view, StageClock()))
        origins[key] = cloud.origin
        poses[key] = shift_frames(truth[scan.name], -cloud.origin, np.zeros(3))
    overlaps = Overlaps({key: surface.points for key, surface in surfaces.items()}, size)
    for _ in range(3):
        poses = align_scans(poses, surfaces, overlaps, size)
    group = {f"cloud_bin_{key}": shift_frames(T, origins[key], np.zeros(3)) for key, T in poses.items()}
    ours = np.concatenate([transform_points(T, _CORNERS) for T in group.values()])
    theirs = np.concatenate([transform_points(truth[name], _CORNERS) for name in group])
    T = align(ours, theirs)
    return np.array([translation_error(T @ pose, truth[name]) for name, pose in group.items()])


def score(folder: Path, room: Room) -> dict[str, Any]:
    """All that is reported of one room, from the poses.json of its model."""
    model = json.loads((folder / "poses.json").read_text())
    groups: list[Poses] = [
        {scan["name"]: np.array(scan["T_reference_scan"]) for scan in group["scans"]}
        for group in model["groups"]
    ]
    truth = max(room.parts, key=len)
    largest = score_group(groups[0], truth) if groups else {"placed": 0, "errors": []}
    others = [score_group(group, truth)["placed"] for group in groups[1:]]
    kept = [edge for edge in model["edges"] if edge["kept"]]
    wrong, gross, unknown = 0, 0, 0
    for edge in kept:
        i, j, found = edge["target"], edge["source"], np.array(edge["T_target_source"])
        part = next((part for part in room.parts if i in part and j in part), None)
        if part is None:
            unknown += 1
            continue
        T = inverse(part[i]) @ part[j]
        turn, shift = rotation_error_deg(found, T), translation_error(found, T)
        wrong += not (turn < 15 and shift < 0.30)
        gross += not (turn < 30 and shift < 1.0)
    errors = np.array(largest["errors"] or [np.nan])
    return {
        "scans": sum(map(len, groups)) + len(model["unplaced"]),
        "placed": largest["placed"],
        "in_other_groups": sum(others),
        "groups": [len(group) for group in groups],
        "rmse": float(np.sqrt(np.mean(errors**2))),
        "kept": len(kept),
        "wrong": wrong,
        "gross": gross,
        "unknown": unknown,
        "pairs": model["num_pairs"],
        "benchmarks": {
            name: recall(groups, name, room.scene) for name in ("3DMatch", "3DLoMatch") if room.scene
        },
    }


def recall(groups: list[Poses], benchmark: str, scene: str) -> dict[str, int]:
    """Of the pairs of a benchmark: how many there are, recalled, recalled by RMSE of how many, and bent."""
    folder = find_benchmark_root() / "benchmarks" / benchmark / scene
    information = {(i, j): matrix for i, j, matrix in read_gt_info(folder / "gt.info")}
    count = {"pairs": 0, "right": 0, "bent": 0, "not_consecutive": 0, "rmse": 0}
    for i, j, entry in read_gt_log(folder / "gt.log"):
        truth = true_motion(entry)  # of i into j
        one, other = f"cloud_bin_{i}", f"cloud_bin_{j}"
        group = next((g for g in groups if one in g and other in g), None)
        found = None if group is None else inverse(group[other]) @ group[one]
        near = found is not None and (
            rotation_error_deg(found, truth) < 15 and translation_error(found, truth) < 0.30
        )
        count["pairs"] += 1
        count["right"] += near
        count["bent"] += group is not None and not near
        if abs(i - j) > 1 and (i, j) in information:
            rmse = benchmark_rmse(found, truth, information[i, j])
            count["not_consecutive"] += 1
            count["rmse"] += rmse is not None and rmse < 0.2
    return count


def run(checkout: Path, files: list[Path], folder: Path, options: list[str]) -> dict[str, float]:
    """The command in a process of its own: wall and processor seconds, and the largest process in MiB."""
    words = [sys.executable, "-m", "geomoe3d", "multiway", *map(str, files), str(folder), "--quiet", *options]
    begin = time.perf_counter()
    own = {"PYTHONPATH": str(checkout), "GEOMOE3D_CACHE": str(folder / "cache")}
    child = subprocess.Popen(words, cwd=checkout, env={**os.environ, **own})
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode not in (0, 3):
        raise SystemExit(f"{' '.join(words[:4])} ... ended with {child.returncode}")
    seconds, processor = time.perf_counter() - begin, used.ru_utime + used.ru_stime
    return {"seconds": seconds, "processor": processor, "mebibytes": used.ru_maxrss / 1024}


def number(name: str) -> int:
    """cloud_bin_7 -> 7."""
    return int(name.rsplit("_", 1)[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out")
    parser.add_argument("--scene", action="append", default=[], help="part of a scene's name; repeatable")
    parser.add_argument("--scans", type=int, help="only the first so many fragments")
    parser.add_argument("--rooms", metavar="FOLDER", help="generated rooms instead of the dev half")
    parser.add_argument("--every", type=int, default=1, help="of the generated rooms")
    parser.add_argument("--world", action="store_true", help="scans of other sensors instead")
    parser.add_argument("--workers", type=int, default=2, help="local processes")
    parser.add_argument("--sequence", action="store_true", help="the fragments are given as a sequence")
    parser.add_argument("--beside", metavar="CHECKOUT", help="another checkout, measured in the same run")
    parser.add_argument("--option", action="append", default=[], help="for this checkout alone; repeatable")
    parser.add_argument("--score-only", action="store_true", help="of models that are there")
    parser.add_argument("--building", type=int, help="so many laser scans of a generated building")
    parser.add_argument("--truth", action="store_true", help="how far the surfaces move the published poses")
    given = parser.parse_args()
    if given.building:
        rooms = [building(Path(given.out) / f"building-{given.building}", given.building)]
    elif given.rooms:
        rooms = generated_rooms(Path(given.rooms), given.every)
    else:
        rooms = world_rooms() if given.world else dev_rooms(given.scene, given.scans)
    if given.truth:
        for room in rooms:
            moved = truth_drift(room, load_config(None, []))
            print(
                f"{room.name[:24]}: RMSE {100 * np.sqrt(np.mean(moved**2)):.1f} cm, median "
                f"{100 * np.median(moved):.1f}, 95 % {100 * np.quantile(moved, 0.95):.1f}, largest "
                f"{100 * moved.max():.1f}",
                flush=True,
            )
        return
    here = Path(__file__).resolve().parents[1]
    options = [*given.option, *(["--sequence"] if given.sequence else [])]
    builds = [("this", here, options)]
    if given.beside:
        builds.append(("beside", Path(given.beside).resolve(), []))
    print(
        "| scene, build | scans | placed | other groups | RMSE (cm) | edges kept | wrong (gross) | "
        "bent pairs | 3DMatch, 3DLoMatch: recall; RMSE recall | pairs | seconds; processor | MiB |\n"
        + "|---" * 12
        + "|"
    )
    for room in rooms:
        for name, checkout, more in builds:
            folder = Path(given.out).resolve() / name / room.name
            used = {"seconds": np.nan, "processor": np.nan, "mebibytes": np.nan}
            if not given.score_only:
                words = ["--workers", str(given.workers), "--no-page", *more]
                used = run(checkout, room.files, folder, words)
            found = {**score(folder, room), **used}
            (folder / "score.json").write_text(json.dumps(found, indent=1))
            print(row(f"{room.name[:24]}, {name}", found), flush=True)


def row(name: str, found: dict[str, Any]) -> str:
    """One row of the table."""
    two = found["benchmarks"].values()
    right = ", ".join(f"{b['right'] / max(b['pairs'], 1):.1%}" for b in two)
    rmse = ", ".join(f"{b['rmse'] / max(b['not_consecutive'], 1):.1%}" for b in two)
    return (
        f"| {name} | {found['scans']} | {found['placed']} ({found['placed'] / found['scans']:.1%}) | "
        f"{found['in_other_groups']} in {found['groups'][1:]} | {100 * found['rmse']:.1f} | "
        f"{found['kept']} | {found['wrong']} ({found['gross']}) | {sum(b['bent'] for b in two)} of "
        f"{sum(b['pairs'] for b in two)} | {right}; {rmse} | {found['pairs']} | {found['seconds']:.0f}; "
        f"{found['processor']:.0f} | {found['mebibytes']:.0f} |"
    )


if __name__ == "__main__":
    main()
