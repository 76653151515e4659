"""``geomoe3d data fragments``: recorded frames to fragments with exact ground truth between them.

Every run of 50 frames becomes one cloud in the frame of its first camera, as 3DMatch made its fragments;
the motion between two fragments is that between their first cameras. Writes what `collection` reads as a
posed folder. About 5 s per fragment of 50 frames on one core.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from geomoe3d.data.fusion import FusionSettings, fuse, measure_overlap, thin
from geomoe3d.data.rgbd import Frame, Recording, image_size, read_depth
from geomoe3d.data.threedmatch import PairTable, write_gt_log, write_gt_overlap
from geomoe3d.errors import GeoMoE3DError, InputError, OutputError
from geomoe3d.geometry.se3 import inverse
from geomoe3d.runtime.files import make_folder
from geomoe3d.runtime.words import counted
from geomoe3d.types import Float32Array, FloatArray

OVERLAP_GRID = 0.025


@dataclass
class FragmentsReport:
    """What was made.

    Attributes:
        folder: where it lies.
        num_points: points of each fragment.
        num_pairs: pairs in gt.log.
        skipped: one sentence per frame or fragment that was left out.
    """

    folder: Path
    num_points: list[int] = field(default_factory=list)
    num_pairs: int = 0
    skipped: list[str] = field(default_factory=list)


def make_fragments(
    recording: Recording,
    folder: str | Path,
    *,
    frames_per_fragment: int = 50,
    settings: FusionSettings | None = None,
    min_overlap: float = 0.1,
    grid: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> FragmentsReport:
    """Fuse a recording into ``folder/cloud_bin_N.ply`` with gt.log and gt_overlap.log.

    Args:
        recording: frames with poses.
        folder: is made; must not exist, or be empty.
        frames_per_fragment: frames fused into one; a last run of fewer than half is left out.
        settings: None fuses as 3DMatch did.
        min_overlap: pairs below it are not listed in gt.log; gt_overlap.log has all pairs that overlap.
        grid: keep one point per cell of this edge (metres); None keeps every fused point.
        progress: called with (fragments done, all).

    Raises:
        InputError: fewer than 2 frames per fragment, a length that is not positive, or no fragment came of
            the frames.
        OutputError: the folder holds files, or cannot be written.
    """
    from geomoe3d.clouds.io import save_points

    if frames_per_fragment < 2:
        raise InputError(f"a fragment needs at least 2 frames, found {frames_per_fragment}")
    used = settings or FusionSettings()
    lengths = {"voxel size": used.voxel_size, "truncation": used.truncation, "greatest depth": used.max_depth}
    for name, length in (lengths if grid is None else {**lengths, "grid": grid}).items():
        if not 0 < length < float("inf"):
            raise InputError(f"the {name} must be positive and finite, found {length}")
    folder = Path(folder)
    make_folder(folder)
    if any(folder.iterdir()):
        raise OutputError(f"'{folder}' holds files already; give a new folder")
    report = FragmentsReport(folder, skipped=list(recording.skipped))
    runs = split_runs(recording.frames, frames_per_fragment)
    size = image_size(recording)
    clouds: list[FloatArray] = []
    poses: list[FloatArray] = []
    for number, run in enumerate(runs):
        points, pose = fuse_run(recording, run, size, used, report.skipped)
        if grid is not None:
            points = thin(points, grid)
        if len(points) < 100 or pose is None:
            report.skipped.append(
                f"fragment of {run[0].path.name} to {run[-1].path.name}: {counted(len(points), 'point')}"
            )
        else:
            save_points(folder / f"cloud_bin_{len(clouds)}.ply", points.astype(np.float32))
            report.num_points.append(len(points))
            clouds.append(thin(points, OVERLAP_GRID))
            poses.append(pose)
        if progress is not None:
            progress(number + 1, len(runs))
    if not clouds:
        raise InputError(
            f"'{recording.folder}': no fragment came of {counted(len(recording.frames), 'frame')}"
        )
    entries, overlaps = relate(clouds, poses, min_overlap)
    write_gt_log(folder / "gt.log", entries, len(clouds))
    write_gt_overlap(folder / "gt_overlap.log", overlaps)
    report.num_pairs = len(entries)
    return report


def split_runs(frames: list[Frame], length: int) -> list[list[Frame]]:
    """Consecutive runs of ``length`` frames; a rest of at least half a run is kept, a shorter one is not."""
    runs = [frames[k : k + length] for k in range(0, len(frames), length)]
    if len(runs) > 1 and len(runs[-1]) < length / 2:
        runs.pop()
    return runs


def fuse_run(
    recording: Recording,
    run: list[Frame],
    size: tuple[int, int],
    settings: FusionSettings,
    skipped: list[str],
) -> tuple[FloatArray, FloatArray | None]:
    """One fragment (N, 3) in the frame of its first usable camera, and T_world_fragment (4, 4).

    Frames that cannot be used are named in ``skipped``; (0, 3) and None where none can.
    """
    pose: list[FloatArray] = []

    def usable() -> Iterator[tuple[Float32Array, FloatArray]]:
        for frame in run:
            try:
                depth = read_depth(recording, frame)
            except GeoMoE3DError as error:
                skipped.append(f"{frame.path.name}: {error}")
                continue
            if depth.shape != size:
                found, others = (f"{width} x {height}" for height, width in (depth.shape, size))
                skipped.append(f"{frame.path.name}: {found} pixels, the others have {others}")
                continue
            share = float(np.mean(depth > 0))
            if share < 0.01:  # of the pixels of a depth image
                skipped.append(f"{frame.path.name}: depth in {share:.1%} of the pixels only")
                continue
            if not pose:
                pose.append(frame.T_world_camera)
            yield depth, inverse(pose[0]) @ frame.T_world_camera

    try:
        points = fuse(usable(), recording.intrinsics, settings)
    except InputError:
        return np.zeros((0, 3)), None
    return points, pose[0] if pose else None


def relate(
    clouds: list[FloatArray], poses: list[FloatArray], min_overlap: float, grid: float = OVERLAP_GRID
) -> tuple[PairTable, dict[tuple[int, int], float]]:
    """Entries of gt.log, and the overlap of every pair i < j that has any.

    Args:
        clouds: (n, 3) thinned to ``grid`` or finer, each in its own frame.
        poses: T_world_fragment (4, 4) of each.
        min_overlap: least overlap of an entry.
        grid: points within one and a half of it are the same place; 2.5 cm is the benchmark's.
    """
    entries: PairTable = []
    overlaps: dict[tuple[int, int], float] = {}
    for i in range(len(clouds)):
        for j in range(i + 1, len(clouds)):
            T_i_j = inverse(poses[i]) @ poses[j]
            share = measure_overlap(clouds[i], clouds[j], inverse(T_i_j), 1.5 * grid)
            if share > 0:
                overlaps[i, j] = share
            if share >= min_overlap:
                entries.append((i, j, T_i_j))
    return entries, overlaps
