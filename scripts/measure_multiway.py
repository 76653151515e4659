"""Whole rooms from their fragments alone, scored against the dev half's published poses.

    python scripts/measure_multiway.py OUT [--scene NAME ...] [--scans N] [--workers N] [--set key=value ...]
    python scripts/measure_multiway.py OUT --truth [--scene NAME ...]    how exact the published poses are

Ground truth is used for scoring only. A fragment is placed rightly when its pose in the largest group is
within 15 deg and 30 cm of the published one, after the group as a whole has been laid on it (rigid fit of the
fragments' frames, the worst tenth left out). A kept edge is wrong beyond the same limits; beyond 30 deg or
1 m it is also counted as gross, the others are inaccurate. OUT keeps the models: run again, pairs are reused,
and "pair seconds" is the sum of what they took when they were registered.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.viewpoint import find_viewpoints
from geomoe3d.config import RegistrationConfig, load_config
from geomoe3d.data.threedmatch import find_benchmark_root, read_gt_log, true_motion
from geomoe3d.evaluation.peak_memory import PeakMemory
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
from geomoe3d.multiway.model import SceneGroup, SceneModel
from geomoe3d.multiway.overlaps import Overlaps
from geomoe3d.multiway.run import MOST_ROUNDS, register_scans
from geomoe3d.multiway.scans import choose_common_voxel_size, find_scans
from geomoe3d.registration import Registrar
from geomoe3d.runtime.journal import read_journal
from geomoe3d.runtime.timing import StageClock
from geomoe3d.types import FloatArray

_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])


def true_poses(scene: str) -> list[dict[int, FloatArray]]:
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
    return parts


def score_group(group: SceneGroup, truth: dict[int, FloatArray]) -> dict[str, Any]:
    """Errors of a group's fragments that the truth knows, after the group was laid on the truth."""
    poses = {number(name): T for name, T in group.poses.items() if number(name) in truth}
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


def truth_drift(files: list[Path], scene: str, config: RegistrationConfig) -> FloatArray:
    """By how much each published pose moves (m) when the scans are laid on each other's surfaces from there.

    What the surfaces do not hold stays, so this says how exact the published poses are, not how exact ours.
    """
    truth = max(true_poses(scene), key=len)
    scans = [scan for scan in find_scans(files) if number(scan.name) in truth]
    size = config.voxel_size or choose_common_voxel_size(scans, config.preparation)[0]
    registrar, surfaces, poses, origins = Registrar(config), {}, {}, {}
    for scan in scans:
        cloud = load_points(scan.path)
        view = find_viewpoints(cloud, cloud, config.preparation.viewpoint)[0]
        key = number(scan.name)
        surfaces[key] = Surface.of(registrar.pipeline.prepare(cloud, size, view, StageClock()))
        origins[key] = cloud.origin
        poses[key] = shift_frames(truth[key], -cloud.origin, np.zeros(3))
    overlaps = Overlaps({key: surface.points for key, surface in surfaces.items()})
    for _ in range(3):
        poses = align_scans(poses, surfaces, overlaps, size)
    group = {str(key): shift_frames(T, origins[key], np.zeros(3)) for key, T in poses.items()}
    ours = np.concatenate([transform_points(T, _CORNERS) for T in group.values()])
    theirs = np.concatenate([transform_points(truth[int(name)], _CORNERS) for name in group])
    T = align(ours, theirs)
    return np.array([translation_error(T @ pose, truth[int(name)]) for name, pose in group.items()])


def score(model: SceneModel, scene: str) -> dict[str, Any]:
    """All that is reported of one room."""
    parts = true_poses(scene)
    truth = max(parts, key=len)
    largest = score_group(model.groups[0], truth) if model.groups else {"placed": 0, "errors": []}
    others = [score_group(group, truth)["placed"] for group in model.groups[1:]]
    kept = [edge for edge in model.edges if edge.kept]
    wrong, gross = 0, 0
    for edge in kept:
        i, j = number(edge.target), number(edge.source)
        part = next((part for part in parts if i in part and j in part), None)
        T = np.full((4, 4), np.nan) if part is None else inverse(part[i]) @ part[j]
        turn, shift = rotation_error_deg(edge.T_target_source, T), translation_error(edge.T_target_source, T)
        wrong += not (turn < 15 and shift < 0.30)
        gross += not (turn < 30 and shift < 1.0)
    errors = np.array(largest["errors"] or [np.nan])
    return {
        "scans": len(model.scans),
        "placed": largest["placed"],
        "in_other_groups": sum(others),
        "groups": [len(group.poses) for group in model.groups],
        "rmse": float(np.sqrt(np.mean(errors**2))),
        "median": float(np.median(errors)),
        "q95": float(np.quantile(errors, 0.95)),
        "kept": len(kept),
        "wrong": wrong,
        "gross": gross,
        "pairs": model.num_pairs,
        "unplaced": model.unplaced,
    }


def number(name: str) -> int:
    """cloud_bin_7 -> 7."""
    return int(name.rsplit("_", 1)[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out")
    parser.add_argument("--scene", action="append", default=[], help="part of a scene's name; repeatable")
    parser.add_argument("--scans", type=int, help="only the first so many fragments")
    parser.add_argument("--pairs", default="auto", choices=("auto", "all", "similar"))
    parser.add_argument("--rounds", type=int, default=MOST_ROUNDS, help="of further pairs")
    parser.add_argument("--workers", type=int, help="local processes; default: this one")
    parser.add_argument("--truth", action="store_true", help="how far the surfaces move the published poses")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="configuration")
    given = parser.parse_args()
    root = find_benchmark_root() / "fragments"
    scenes = sorted(
        p.name for p in root.iterdir() if not given.scene or any(s in p.name for s in given.scene)
    )
    if given.truth:
        for scene in scenes:
            files = sorted((root / scene).glob("*.ply"), key=lambda path: number(path.stem))
            moved = truth_drift(files, scene, load_config(None, given.set))
            print(
                f"{scene[:24]}: RMSE {100 * np.sqrt(np.mean(moved**2)):.1f} cm, median "
                f"{100 * np.median(moved):.1f}, 95 % {100 * np.quantile(moved, 0.95):.1f}, largest "
                f"{100 * moved.max():.1f}",
                flush=True,
            )
        return
    print(
        "| scene | scans | placed | other groups | RMSE, median, 95 % (cm) | edges kept | wrong (gross) |",
        end="",
    )
    print(" pairs | pair seconds | this call | peak memory |\n|---|---|---|---|---|---|---|---|---|---|---|")
    for scene in scenes:
        files = sorted((root / scene).glob("*.ply"), key=lambda path: number(path.stem))[: given.scans]
        folder = Path(given.out) / (scene if given.scans is None else f"{scene}.{given.scans}")
        begin = time.perf_counter()
        with PeakMemory() as memory:
            model = register_scans(
                files,
                folder,
                config=load_config(None, given.set),
                pairs=given.pairs,
                rounds=given.rounds,
                workers=given.workers,
            )
        seconds = time.perf_counter() - begin
        found = score(model, scene)
        spent = sum(r["seconds"].get("total", 0.0) for r in read_journal(folder / "pairs" / "journal.jsonl"))
        (folder / "score.json").write_text(json.dumps({**found, "seconds": model.seconds}, indent=1))
        errors = " / ".join(f"{100 * found[key]:.1f}" for key in ("rmse", "median", "q95"))
        print(
            f"| {scene[:24]} | {found['scans']} | "
            f"{found['placed']} ({found['placed'] / found['scans']:.1%}) | "
            f"{found['in_other_groups']} in {found['groups'][1:]} | {errors} | {found['kept']} | "
            f"{found['wrong']} ({found['gross']}) | {found['pairs']} | {spent:.0f} s | {seconds:.0f} s | "
            f"{(memory.peak or 0) / 2**20:.0f} MiB |",
            flush=True,
        )


if __name__ == "__main__":
    main()
