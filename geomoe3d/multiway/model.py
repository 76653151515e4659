"""What many scans come to: who stands where, who does not, and which edges hold it together."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from geomoe3d.batch.folder import foreign, has_mark, short_transform_name
from geomoe3d.clouds.io import READABLE_SUFFIXES, load_points
from geomoe3d.clouds.transform_files import save_transform
from geomoe3d.decision.answer import library_versions
from geomoe3d.decision.scale import DIFFERS
from geomoe3d.errors import GeoMoE3DError, InputError
from geomoe3d.geometry.se3 import inverse, shift_frames
from geomoe3d.multiway.edges import Edge
from geomoe3d.multiway.formats import g2o_text, kitti_text, tum_text
from geomoe3d.multiway.merged import merge_clouds, write_e57, write_merged
from geomoe3d.multiway.scans import Scan
from geomoe3d.multiway.tables import (
    EDGES_FILE,
    EDGES_HEADER,
    SCANS_FILE,
    SCANS_HEADER,
    edges_text,
    scans_text,
)
from geomoe3d.runtime.files import remove, write_text
from geomoe3d.runtime.plain import parse_json
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray

MATRICES_FOLDER = "matrices"
"""One 4 x 4 matrix per placed scan, as CloudCompare and others read it."""
_POSE_MARK = "geomoe3d multiway pose: p_reference = R p_scan + t"
POSES_FILE, PAGE_FILE = "poses.json", "page.html"
PAGE_MARK = '<meta name="generator" content="geomoe3d multiway">'
_FORMAT, _KIND = "geomoe3d scene 2", "geomoe3d scene "
_GROUP_FILE = re.compile(r"group\d+\.(tum\.txt|kitti\.txt|(gtsam\.)?g2o|ply|e57)")
_OFTEN_NO_CLOUDS = {".txt", ".csv", ".asc", ".bin", ".npy", ".npz"}


@dataclass(frozen=True)
class EdgeReport:
    """One registered pair and what became of it.

    Attributes:
        source, target: names of the scans.
        fate: ``kept``: it holds the model together; ``near``: it says about what the poses say; ``rejected``:
            it contradicts them or is not sure enough; ``between groups``: it would join two groups.
        reason: why it is not kept; of one that is kept, what its registration says of another scale.
        confidence: of the registration.
        belief: probability that it is right, in the company of the other pairs.
        shift: root mean square distance by which it moves the source elsewhere than the final poses do, cloud
            units, and ``turn_deg`` its angle; None where its scans stand in no common group.
        closes_loop: whether the model hangs together without it, too.
        of_maps: whether local maps about the two scans were registered, not the scans alone.
        given: whether it was not registered, but is of the initial poses.
        T_target_source: (4, 4) file coordinates.
    """

    source: str
    target: str
    fate: str
    reason: str
    confidence: float
    belief: float
    shift: float | None
    turn_deg: float | None
    closes_loop: bool
    of_maps: bool
    T_target_source: FloatArray
    given: bool = False

    @property
    def kept(self) -> bool:
        """Whether it holds the model together."""
        return self.fate == "kept"


@dataclass(frozen=True)
class LoopReport:
    """A loop of measured transforms, see `geomoe3d.multiway.loops`; ``scans`` by name."""

    scans: tuple[str, ...]
    shift: float
    turn_deg: float
    closes: bool


@dataclass(frozen=True)
class SceneGroup:
    """Scans that hang together.

    Attributes:
        reference: name of the first scan; its file coordinates are those of the group.
        poses: T_reference_scan (4, 4) by name, file coordinates: p_reference = R p_scan + t.
        local_poses: the same between local coordinates, by number of the scan.
        edges: those near the poses.
        loops: of its sure edges, the worst first.
        contradictions: pairs of its scans that are `ok` by themselves and would have them elsewhere, by more than any
            bend explains, where sensors saw through nothing; the surest first.
    """

    reference: str
    poses: dict[str, FloatArray]
    local_poses: dict[int, FloatArray]
    edges: tuple[Edge, ...]
    loops: tuple[LoopReport, ...] = ()
    contradictions: tuple[EdgeReport, ...] = ()

    @property
    def bent(self) -> str:
        """A sentence where loops do not close, else empty."""
        open_loops = [loop for loop in self.loops if not loop.closes]
        if not open_loops:
            return ""
        worst = open_loops[0]
        return (
            f"loops that do not close: {len(open_loops)} of {len(self.loops)}. The worst, by '{worst.scans[0]}' and "
            f"'{worst.scans[-1]}' ({counted(len(worst.scans), 'scan')}), ends {worst.shift:.3g} and "
            f"{worst.turn_deg:.1f} deg off; the group may be bent there"
        )

    @property
    def repeated(self) -> str:
        """A sentence where structure seems to repeat, so that parts may stand a period off; else empty."""
        if not self.contradictions:
            return ""
        first = self.contradictions[0]
        return (
            f"repeated structure: {counted(len(self.contradictions), 'pair')} that registration is sure of would have "
            f"scans elsewhere, the surest '{first.source}' and '{first.target}' by {first.shift:.3g} and "
            f"{first.turn_deg:.0f} deg; a part of the group may be off by one period, as among equal shelves or doors"
        )


@dataclass(frozen=True)
class SceneModel:
    """The result of `register_scans`.

    Attributes:
        folder: where it was written.
        voxel_size: of the common grid.
        scans: all that were given, in order.
        groups: scans that hang together, two or more each, the largest first; never forced into one.
        unplaced: name -> why the scan is in no group.
        edges: all pairs that gave a transform.
        num_pairs: pairs registered so far.
        seconds: wall time of this call by stage.
        faults: name of a scan that is placed -> what is wrong with it as a whole: mirrored, or of another unit.
        copies: name of a scan -> name of an earlier one whose file is the same, byte for byte.
    """

    folder: Path
    voxel_size: float
    scans: tuple[Scan, ...]
    groups: tuple[SceneGroup, ...]
    unplaced: dict[str, str]
    edges: tuple[EdgeReport, ...]
    num_pairs: int
    seconds: dict[str, float]
    faults: dict[str, str] = field(default_factory=dict)
    copies: dict[str, str] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """True where all scans stand in one group in which no structure seems to repeat, and none is `doubted`."""
        whole = len(self.groups) == 1 and not self.unplaced
        return whole and not self.groups[0].repeated and not self.doubted

    @cached_property
    def doubted(self) -> dict[str, str]:
        """Name of a scan that is placed -> why it may be wrong: a fault of its own, or most of the pairs that hold
        it, two at least, say that its scale differs."""
        found = {}
        for scan in self.scans:
            mine = [e for e in self.edges if e.kept and scan.name in (e.source, e.target)]
            say = [e.reason for e in mine if e.reason.startswith(DIFFERS)]
            if len(say) > max(1, len(mine) / 2):
                found[scan.name] = f"{len(say)} of the {len(mine)} pairs that hold it say so: {say[0]}"
        return {**found, **self.faults}

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
                    "bent": group.bent,
                    "repeated": group.repeated,
                    "loops": [
                        {
                            "scans": list(loop.scans),
                            "shift": loop.shift,
                            "turn_deg": loop.turn_deg,
                            "closes": loop.closes,
                        }
                        for loop in group.loops
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
                    "fate": edge.fate,
                    "reason": edge.reason,
                    "confidence": edge.confidence,
                    "belief": edge.belief,
                    "shift": edge.shift,
                    "turn_deg": edge.turn_deg,
                    "closes_loop": edge.closes_loop,
                    "of_maps": edge.of_maps,
                    "T_target_source": edge.T_target_source.tolist(),
                }
                for edge in self.edges
            ],
            "doubted": self.doubted,
            "copies": self.copies,
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
    for path in _foreign_extras(folder):
        raise InputError(foreign(path, "a model"))
    path = folder / PAGE_FILE
    if page and path.exists() and not has_mark(path, PAGE_MARK):
        raise InputError(f"{foreign(path, 'a model')}, or leave the page out")
    for path in sorted(folder.iterdir()):
        if path not in (*groups, folder / SCANS_FILE, folder / EDGES_FILE) and _is_cloud(path):
            raise _among_scans(folder, path)


def is_model(folder: Path) -> bool:
    """Whether the poses in a folder are those of a model of this package."""
    try:
        stored = parse_json((folder / POSES_FILE).read_text(encoding="utf-8"))
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
        tables = [folder / SCANS_FILE, folder / EDGES_FILE]
        remove([*_group_files(folder), *_own_poses(folder), *tables, folder / POSES_FILE])
        place = folder / MATRICES_FOLDER
        if place.is_dir() and not any(place.iterdir()):
            place.rmdir()


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


def _own_poses(folder: Path) -> list[Path]:
    """The matrices of an earlier model, by their first lines."""
    place = folder / MATRICES_FOLDER
    return (
        [path for path in sorted(place.glob("*.txt")) if has_mark(path, _POSE_MARK)] if place.is_dir() else []
    )


def _foreign_extras(folder: Path) -> list[Path]:
    """Files of the user's under names that the tables and matrices of a model take."""
    found = [folder / name for name in (SCANS_FILE, EDGES_FILE)]
    headers = (SCANS_HEADER, EDGES_HEADER)
    tables = [p for p, h in zip(found, headers, strict=True) if p.exists() and not has_mark(p, h)]
    place, own = folder / MATRICES_FOLDER, set(_own_poses(folder))
    if place.exists() and not place.is_dir():
        return [*tables, place]
    return [*tables, *(path for path in sorted(place.glob("*.txt")) if path not in own)]


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


def write_model(model: SceneModel, merged_voxel_size: float | None, *, e57: bool = False) -> None:
    """poses.json, tables, and per group its poses, its graph and its merged cloud; older ones are replaced.

    Args:
        model: what to write, into its folder.
        merged_voxel_size: of the merged clouds, cloud units; None takes that of the registration.
        e57: all scans of a group with their poses in one file, too.
    """
    number = {scan.name: k for k, scan in enumerate(model.scans)}
    paths = {scan.name: scan.path for scan in model.scans}
    write_text(model.folder / POSES_FILE, model.to_json(), force=True)
    write_text(model.folder / SCANS_FILE, scans_text(model), force=True)
    write_text(model.folder / EDGES_FILE, edges_text(model), force=True)
    remove([*_group_files(model.folder), *_own_poses(model.folder)])
    poses_folder = model.folder / MATRICES_FOLDER
    poses_folder.mkdir(exist_ok=True)
    for count, group in enumerate(model.groups, start=1):
        names, poses = list(group.poses), list(group.poses.values())
        prefix = model.folder / f"group{count}"
        write_text(
            prefix.with_suffix(".tum.txt"), tum_text(names, [number[n] for n in names], poses), force=True
        )
        write_text(prefix.with_suffix(".kitti.txt"), kitti_text(poses), force=True)
        graph = group.local_poses, group.edges
        write_text(prefix.with_suffix(".g2o"), g2o_text(*graph), force=True)
        write_text(prefix.with_suffix(".gtsam.g2o"), g2o_text(*graph, half_turns=False), force=True)
        merged = merge_clouds(
            [paths[n] for n in names],
            [number[n] for n in names],
            poses,
            merged_voxel_size or model.voxel_size,
        )
        write_merged(prefix.with_suffix(".ply"), merged)
        if e57:
            write_e57(prefix.with_suffix(".e57"), [(n, paths[n], group.poses[n]) for n in names])
        for name, T in group.poses.items():
            comments = [_POSE_MARK, f"scan '{name}' in group {count}, the frame of '{group.reference}'"]
            save_transform(poses_folder / short_transform_name(name), T, comments, force=True)
