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

from geomoe3d.answer import library_versions
from geomoe3d.clouds.io import load_points, save_points
from geomoe3d.clouds.prepare import voxel_means
from geomoe3d.errors import InputError
from geomoe3d.files import write_atomically
from geomoe3d.geometry.se3 import inverse, shift_frames, transform_points
from geomoe3d.multiway.edges import Edge
from geomoe3d.multiway.formats import g2o_text, kitti_text, tum_text
from geomoe3d.multiway.scans import Scan
from geomoe3d.types import FloatArray

POSES_FILE = "poses.json"
_GROUP_FILE = re.compile(r"group\d+\.(tum\.txt|kitti\.txt|g2o|ply)")


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
            "format": "geomoe3d scene 1",
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


def check_folder(folder: Path, inputs: Iterable[str | os.PathLike[str]]) -> None:
    """Refuse a folder in which the model would overwrite, or next time be taken for, something of the user's.

    Raises:
        InputError: it is a file, one of the inputs, or holds files under the model's names but no model.
    """
    if folder.is_file():
        raise InputError(f"'{folder}' is a file; the folder in which the model is written is named last")
    if any(Path(given).is_dir() and folder.resolve() == Path(given).resolve() for given in inputs):
        raise InputError(
            f"'{folder}' is a folder of scans too: the merged cloud would be taken for a scan; give another"
        )
    strange = [] if (folder / POSES_FILE).exists() else _group_files(folder)
    if strange:
        raise InputError(
            f"'{strange[0]}' is not of a model of geomoe3d and would be overwritten; give another folder"
        )


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
    write_text(model.folder / POSES_FILE, model.to_json())
    for old in _group_files(model.folder):
        old.unlink()
    for count, group in enumerate(model.groups, start=1):
        names, poses = list(group.poses), list(group.poses.values())
        prefix = model.folder / f"group{count}"
        write_text(prefix.with_suffix(".tum.txt"), tum_text(names, [number[n] for n in names], poses))
        write_text(prefix.with_suffix(".kitti.txt"), kitti_text(poses))
        write_text(prefix.with_suffix(".g2o"), g2o_text(group.local_poses, group.edges))
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


def write_text(path: Path, text: str) -> None:
    """A text file, complete or not at all; an older one is replaced."""
    write_atomically(path, lambda temporary: _put(temporary, text), force=True)


def _put(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", newline="\n")
