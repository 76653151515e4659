"""From posed fragments of any layout to shards of described ones: the step that is done once.

Points, normals and features are those of registration itself (voxels of 5 cm unless told, normals turned
to the sensor, L2-normalised FPFH). About 0.2 s per fragment on one core.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.clouds.prepare import prepare
from geomoe3d.config import PreparationConfig
from geomoe3d.data.collection import PosedPair, load_fragment, open_collection
from geomoe3d.data.fusion import measure_overlap
from geomoe3d.data.shards import DescribedScene, is_shard, open_shard, why_stale, write_shard
from geomoe3d.data.splits import split_of
from geomoe3d.errors import FormatError, GeoMoE3DError, InputError
from geomoe3d.features.base import with_features
from geomoe3d.features.fpfh import FpfhDescriptor
from geomoe3d.runtime.files import make_folder
from geomoe3d.runtime.workers import ProcessPool, SerialPool, WorkerDied, run_surviving
from geomoe3d.types import Float32Array, PointCloud


@dataclass
class DescribeReport:
    """What a run came to.

    Attributes:
        folder: of the shards.
        made: shards made.
        kept: shards that were there and fit.
        num_fragments: in the shards made.
        num_pairs: in the shards made.
        skipped: one sentence per fragment or scene that was left out.
    """

    folder: Path
    made: int = 0
    kept: int = 0
    num_fragments: int = 0
    num_pairs: int = 0
    skipped: list[str] = field(default_factory=list)


def describe_fragment(cloud: PointCloud, voxel_size: float = 0.05) -> tuple[Float32Array, Float32Array]:
    """Voxel points (n, 3) and unit features (n, 33) float32 of a fragment whose sensor is at its origin.
    Raises EmptyCloudError: fewer than 3 voxels."""
    config = PreparationConfig()
    prepared = with_features(prepare(cloud, voxel_size, config, viewpoint=-cloud.origin), FpfhDescriptor())
    assert prepared.features is not None
    return (prepared.points + cloud.origin).astype(np.float32), prepared.features


def describe_collection(
    root: str | Path,
    folder: str | Path,
    *,
    groups: tuple[str, ...] | None = None,
    scenes: tuple[str, ...] | None = None,
    split: str | None = None,
    min_overlap: float = 0.1,
    voxel_size: float = 0.05,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> DescribeReport:
    """Make one shard per scene of a folder of posed fragments; those that are there and fit stay.

    Args:
        root: any layout that `open_collection` knows.
        folder: of the shards; is made.
        groups: lists of pairs to take; None takes all.
        scenes: scenes to take; None takes all.
        split: train, validation or test takes the scenes of that published split alone; None takes all.
        min_overlap: pairs below it are left out; where no overlap is listed it is measured.
        voxel_size: metres.
        workers: processes over scenes; the shards are the same for any number.
        progress: called with (scenes done, scenes in all).

    Raises:
        InputError: the layout is unknown, no pair is left, there is no worker, or the voxel size is not
            positive and finite.
        FormatError: a shard in the folder is damaged or stale; the message says why.
        OutputError: the disk refuses.
    """
    if not (np.isfinite(voxel_size) and voxel_size > 0):
        raise InputError(f"the voxel size must be a positive length, found {voxel_size}")
    collection = open_collection(root)
    folder = Path(folder)
    make_folder(folder)
    by_scene: dict[str, list[PosedPair]] = {}
    for pair in collection.pairs:
        if (groups is None or pair.group in groups) and (scenes is None or pair.scene in scenes):
            by_scene.setdefault(pair.scene, []).append(pair)
    if split is not None:
        by_scene = {scene: pairs for scene, pairs in by_scene.items() if split_of(scene) == split}
    if not by_scene:
        raise InputError(f"'{root}' lists no pairs of the wanted scenes, groups and split")
    report = DescribeReport(folder, skipped=list(collection.problems))
    settings = {
        "voxel_size": voxel_size,
        "min_overlap": min_overlap,
        "preparation": PreparationConfig().model_dump(mode="json"),
        "groups": list(groups) if groups is not None else None,
    }
    if workers < 1:
        raise InputError(f"at least one worker is needed, found {workers}")
    jobs = []
    for scene, pairs in by_scene.items():
        target = folder / scene.replace("/", "_")
        source = _fingerprint(pairs)
        if not is_shard(target):
            jobs.append(_Job(scene, pairs, target, min_overlap, voxel_size, settings, source))
            continue
        reason = why_stale(target, settings, source)
        if reason is not None:
            raise FormatError(
                f"shard '{target}' is stale; remove it, or give another folder. It has {reason}"
            )
        open_shard(target, verify=True)
        report.kept += 1
    done = report.kept
    skipped: dict[str, list[str]] = {}
    for job, made in _run(jobs, workers):
        skipped[job.scene] = made.skipped
        report.made += made.made
        report.num_fragments += made.num_fragments
        report.num_pairs += made.num_pairs
        done += 1
        if progress is not None:
            progress(done, len(by_scene))
    report.skipped += [line for job in jobs for line in skipped[job.scene]]  # in the order of the scenes
    return report


@dataclass(frozen=True)
class _Job:
    """One shard to be made; travels to another process."""

    scene: str
    pairs: list[PosedPair]
    target: Path
    min_overlap: float
    voxel_size: float
    settings: dict[str, Any]
    source: str


@dataclass(frozen=True)
class _Made:
    made: int
    num_fragments: int
    num_pairs: int
    skipped: list[str]


def _run(jobs: list[_Job], workers: int) -> Iterator[tuple[_Job, _Made]]:
    """Every job with what came of it, as they finish."""
    pool = SerialPool() if workers == 1 or len(jobs) < 2 else ProcessPool(min(workers, len(jobs)))
    for job, made in run_surviving(pool, _make_shard, jobs):
        if isinstance(made, WorkerDied):
            made = _Made(0, 0, 0, [f"scene '{job.scene}': {made.reason}"])
        yield job, made


def _make_shard(job: _Job) -> _Made:
    skipped: list[str] = []
    described = _describe_scene(job.scene, job.pairs, job.min_overlap, job.voxel_size, skipped)
    if described is None:
        return _Made(0, 0, 0, skipped)
    write_shard(job.target, described, job.settings, job.source)
    return _Made(1, len(described.start) - 1, len(described.pair), skipped)


def _describe_scene(
    scene: str, pairs: list[PosedPair], min_overlap: float, voxel_size: float, skipped: list[str]
) -> DescribedScene | None:
    paths = sorted({path for pair in pairs for path in (pair.source, pair.target)})
    index: dict[Path, int] = {}
    points: list[Float32Array] = []
    features: list[Any] = []
    for path in paths:
        try:
            found = describe_fragment(load_fragment(path), voxel_size)
        except GeoMoE3DError as error:
            skipped.append(str(error) if str(path) in str(error) else f"'{path}': {error}")
            continue
        index[path] = len(points)
        points.append(found[0])
        features.append(found[1].astype(np.float16))
    rows, motions, overlaps = [], [], []
    for pair in pairs:
        if pair.source not in index or pair.target not in index:
            continue
        i, j = index[pair.source], index[pair.target]
        overlap = pair.overlap
        if overlap is None:
            a, b = points[i].astype(np.float64), points[j].astype(np.float64)
            overlap = measure_overlap(a, b, pair.T_target_source, radius=voxel_size)
        if overlap >= min_overlap:
            rows.append((i, j))
            motions.append(pair.T_target_source)
            overlaps.append(overlap)
    if not rows:
        skipped.append(f"scene '{scene}': no pair overlaps by {min_overlap} or more")
        return None
    return DescribedScene(
        scene,
        np.concatenate(points),
        np.concatenate(features),
        np.cumsum([0, *map(len, points)]).astype(np.int64),
        np.array(rows, dtype=np.int64),
        np.stack(motions),
        np.array(overlaps, dtype=np.float32),
        voxel_size,
    )


def _fingerprint(pairs: list[PosedPair]) -> str:
    """Hash of the fragments' names and sizes and of the true motions."""
    digest = hashlib.sha256()
    paths = sorted({path for pair in pairs for path in (pair.source, pair.target)})
    sizes = [[path.name, path.stat().st_size if path.is_file() else -1] for path in paths]
    digest.update(json.dumps(sizes).encode())
    for pair in pairs:
        digest.update(np.round(pair.T_target_source, 6).tobytes())
    return digest.hexdigest()[:16]
