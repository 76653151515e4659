"""What many scans come to: who stands where, who does not, and which edges hold it together."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.batch.folder import foreign, has_mark, remove
from geomoe3d.clouds.io import READABLE_SUFFIXES, load_points, save_points
from geomoe3d.clouds.prepare import voxel_means
from geomoe3d.decision.answer import library_versions
from geomoe3d.errors import GeoMoE3DError, InputError
from geomoe3d.geometry.se3 import inverse, shift_frames, transform_points
from geomoe3d.multiway.edges import Edge
from geomoe3d.multiway.formats import g2o_text, kitti_text, tum_text
from geomoe3d.multiway.scans import Scan
from geomoe3d.runtime.files import write_text
from geomoe3d.types import FloatArray

POSES_FILE, PAGE_FILE = "poses.json", "page.html"
PAGE_MARK = '<meta name="generator" content="geomoe3d multiway">'
_FORMAT, _KIND = "geomoe3d scene 1", "geomoe3d scene "
_GROUP_FILE = re.compile(r"group\d+\.(tum\.txt|kitti\.txt|g2o|ply)")
_OFTEN_NO_CLOUDS = {".txt", ".csv", ".asc", ".bin", ".npy", ".npz"}


@dataclass(frozen=True)
class EdgeReport:
    """One registered pair and what became of it.

    Attributes:
        source, target: names of the scans.
        kept: whether it holds the model together.
        reason: why not.
        confidence: of the registration.
        T_target_source: (4, 4) file coordinates.
    """

    source: str
    target: str
    kept: bool
    reason: str
    confidence: float
    T_target_source: FloatArray


@dataclass(frozen=True)
class SceneGroup:
    """Scans that hang together.

    Attributes:
        reference: name of the first scan; its file coordinates are those of the group.
        poses: T_reference_scan (4, 4) by name, file coordinates: p_reference = R p_scan + t.
        local_poses: the same between local coordinates, by number of the scan.
        edges: the kept ones.
    """

    reference: str
    poses: dict[str, FloatArray]
    local_poses: dict[int, FloatArray]
    edges: tuple[Edge, ...]


@dataclass(frozen=True)
class SceneModel:
    """The result of `register_scans`.

    Attributes:
        folder: where it was written.
        voxel_size: of the common grid.
        scans: all that were given, in order.
        groups: scans that hang together, two or more each, the largest first; never forced into one.
        unplaced: name -> why the scan is in no group.
        edges: all pairs that gave a motion.
        num_pairs: pairs registered so far.
        seconds: wall time of this call by stage.
    """

    folder: Path
    voxel_size: float
    scans: tuple[Scan, ...]
    groups: tuple[SceneGroup, ...]
    unplaced: dict[str, str]
    edges: tuple[EdgeReport, ...]
    num_pairs: int
    seconds: dict[str, float]

    @property
    def ok(self) -> bool:
        """True where all scans stand in one group."""
        return len(self.groups) == 1 and not self.unplaced

    def to_json(self) -> str:
        """Everything but the points, in JSON; matrices by rows, every digit."""
        paths = {scan.name: scan.path for scan in self.scans}
        data: dict[str, Any] = {
            "format": _FORMAT,
            "versions": library_versions(),
            "voxel_size": self.voxel_size,
            "groups": [
                {
                    "reference": group.reference,
                    "scans": [
                        {"name": name, "path": paths[name], "T_reference_scan": T.tolist()}
                        for name, T in group.poses.items()
                    ],
                }
                for group in self.groups
            ],
            "unplaced": [
                {"name": name, "path": paths[name], "reason": reason}
                for name, reason in self.unplaced.items()
            ],
            "edges": [
                {
                    "source": edge.source,
                    "target": edge.target,
                    "kept": edge.kept,
                    "reason": edge.reason,
                    "confidence": edge.confidence,
                    "T_target_source": edge.T_target_source.tolist(),
                }
                for edge in self.edges
            ],
            "num_pairs": self.num_pairs,
        }
        return json.dumps(data, indent=1, allow_nan=False) + "\n"


def check_folder(folder: Path, inputs: Iterable[str | os.PathLike[str]], *, page: bool) -> None:
    """Refuse a folder in which the model would overwrite, or next time be taken for, something of the user's.

    Args:
        folder: in which the model is to be written.
        inputs: files and folders of scans.
        page: whether a page is written too.

    Raises:
        InputError: it is a file, a folder of scans, or holds files of the user's under the model's names.
    """
    if folder.is_file():
        raise InputError(f"'{folder}' is a file; the folder in which the model is written is named last")
    if not folder.is_dir():
        return
    here = folder.resolve()
    for given in map(Path, inputs):
        if here in ([given.resolve()] if given.is_dir() else given.resolve().parents[:1]):
            raise _among_scans(folder, given)
    groups = _group_files(folder)
    if not is_model(folder):
        for path in (folder / POSES_FILE, *groups):
            if path.exists():
                raise InputError(foreign(path, "a model"))
    path = folder / PAGE_FILE
    if page and path.exists() and not has_mark(path, PAGE_MARK):
        raise InputError(f"{foreign(path, 'a model')}, or leave the page out")
    for path in sorted(folder.iterdir()):
        if path not in groups and _is_cloud(path):
            raise _among_scans(folder, path)


def is_model(folder: Path) -> bool:
    """Whether the poses in a folder are those of a model of this package."""
    try:
        stored = json.loads((folder / POSES_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(stored, dict) and str(stored.get("format")).startswith(_KIND)


def remove_model(folder: Path) -> None:
    """Delete what an earlier call wrote of a model, apart from its pairs; nothing else is touched.

    Raises:
        OutputError: a file cannot be removed.
    """
    if has_mark(folder / PAGE_FILE, PAGE_MARK):
        remove([folder / PAGE_FILE])
    if is_model(folder):  # its poses go last: they say whose the others are
        remove([*_group_files(folder), folder / POSES_FILE])


def _among_scans(folder: Path, scan: Path) -> InputError:
    return InputError(
        f"'{folder}' is a folder of scans too ('{scan}'): the merged cloud would be taken for a scan; give "
        "another"
    )


def _is_cloud(path: Path) -> bool:
    """By the suffix; text and arrays, which are often something else, only if they can be read as a cloud."""
    suffix = path.suffix.lower()
    if suffix not in READABLE_SUFFIXES or not path.is_file():
        return False
    if suffix not in _OFTEN_NO_CLOUDS:
        return True
    try:
        load_points(path)
    except GeoMoE3DError:
        return False
    return True


def _group_files(folder: Path) -> list[Path]:
    """What `write_model` writes per group."""
    return sorted(path for path in folder.glob("group*") if _GROUP_FILE.fullmatch(path.name))


def file_poses(
    local: dict[int, FloatArray], scans: Sequence[Scan], origins: dict[int, FloatArray]
) -> tuple[str, dict[str, FloatArray]]:
    """Name of the reference and T_reference_scan by name, in file coordinates."""
    first = min(local)
    to_first = inverse(local[first])
    poses = {
        scans[k].name: shift_frames(to_first @ local[k], origins[k], origins[first]) for k in sorted(local)
    }
    return scans[first].name, poses


def write_model(model: SceneModel, merged_voxel_size: float | None) -> None:
    """poses.json, and per group its poses as text, its graph and its merged cloud; older ones are replaced.

    Args:
        model: what to write, into its folder.
        merged_voxel_size: of the merged clouds, cloud units; None takes that of the registration.
    """
    number = {scan.name: k for k, scan in enumerate(model.scans)}
    paths = {scan.name: scan.path for scan in model.scans}
    write_text(model.folder / POSES_FILE, model.to_json(), force=True)
    remove(_group_files(model.folder))
    for count, group in enumerate(model.groups, start=1):
        names, poses = list(group.poses), list(group.poses.values())
        prefix = model.folder / f"group{count}"
        write_text(
            prefix.with_suffix(".tum.txt"), tum_text(names, [number[n] for n in names], poses), force=True
        )
        write_text(prefix.with_suffix(".kitti.txt"), kitti_text(poses), force=True)
        write_text(prefix.with_suffix(".g2o"), g2o_text(group.local_poses, group.edges), force=True)
        merged = merge_clouds([paths[n] for n in names], poses, merged_voxel_size or model.voxel_size)
        save_points(prefix.with_suffix(".ply"), merged, force=True)


def merge_clouds(paths: Sequence[str], poses: Sequence[FloatArray], voxel_size: float) -> FloatArray:
    """(N, 3) mean points per voxel of all scans in the reference's file coordinates, one scan at a time.

    Works about the first scan's origin in float64, so that map coordinates lose nothing.
    """
    origin = load_points(paths[0]).origin
    parts = []
    for path, T in zip(paths, poses, strict=True):
        cloud = load_points(path)
        local = shift_frames(T, -cloud.origin, -origin)
        parts.append(voxel_means(transform_points(local, cloud.points), voxel_size))
    merged: FloatArray = voxel_means(np.concatenate(parts), voxel_size) + origin
    return merged
