"""Poses of all scans from elsewhere, as of odometry, read from a file: TUM, KITTI or JSON.

They are first guesses and edges of a stated uncertainty between scans taken one after the other, never more:
the clouds decide.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geomoe3d.config import expert
from geomoe3d.errors import GeoMoE3DError, InputError
from geomoe3d.geometry.se3 import check_motion, inverse, shift_frames
from geomoe3d.multiway.edges import Edge, Shape
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray


@dataclass(frozen=True)
class InitialPoses:
    """Given poses, one per scan.

    Attributes:
        poses: T_world_scan (4, 4) in file coordinates, in the order of the scans.
        shift: standard deviation of the motion between two scans taken one after the other, cloud units.
        turn_deg: that of its angle.
    """

    poses: tuple[FloatArray, ...]
    shift: float
    turn_deg: float

    def edges(self, scans: Sequence[int], shapes: Sequence[Shape]) -> list[Edge]:
        """Edges between scans taken one after the other, as the poses have them.

        Args:
            scans: numbers of those that can be registered, rising.
            shapes: of all scans.
        """
        known = expert().many_pairs
        sigma = [np.radians(self.turn_deg)] * 3 + [self.shift] * 3
        information = np.diag(1 / np.square(sigma))
        information *= known.odometry_points / float(np.trace(information[3:, 3:]))
        found = []
        for i, j in pairwise(scans):
            T = inverse(self.poses[i]) @ self.poses[j]
            local = shift_frames(T, -shapes[j].origin, -shapes[i].origin)
            found.append(Edge(j, i, local, known.odometry_confidence, information, self.shift, given=True))
        return found


def read_poses(path: str | os.PathLike[str], names: Sequence[str]) -> tuple[FloatArray, ...]:
    """T_world_scan (4, 4) of every scan: p_world = R p_scan + t.

    Text has one line per scan in their order: eight numbers (TUM: time, translation, quaternion x y z w) or
    twelve (KITTI: the upper three rows). JSON holds a list of matrices in their order, matrices by name of
    the scan, or the poses.json of a model with one group.

    Raises:
        InputError: no such file, none of these, another number of poses than scans, or no rigid transform.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "it is no text in UTF-8"
        raise InputError(f"cannot read the initial poses '{path}': {why}") from None
    try:
        found = _of_json(json.loads(text), names) if text.lstrip()[:1] in "[{" else _of_text(text)
        if len(found) != len(names):
            raise InputError(
                f"{counted(len(found), 'pose')} for {counted(len(names), 'scan')}; give one per scan, in their order"
            )
        return tuple(check_motion(T) for T in found)
    except KeyError as error:
        raise InputError(f"initial poses '{path}': the key {error} is missing") from None
    except (GeoMoE3DError, ValueError, TypeError) as error:
        raise InputError(f"initial poses '{path}': {error}") from None


def _of_text(text: str) -> list[FloatArray]:
    rows = [
        [float(word) for word in line.split()]
        for line in text.splitlines()
        if line.strip() and line.strip()[0] != "#"
    ]
    lengths = {len(row) for row in rows}
    if lengths == {12}:
        return [np.vstack([np.reshape(row, (3, 4)), [0, 0, 0, 1]]) for row in rows]
    if lengths == {8}:
        found = []
        for row in rows:
            T = np.eye(4)
            T[:3, 3], T[:3, :3] = row[1:4], Rotation.from_quat(row[4:]).as_matrix()
            found.append(T)
        return found
    held = " and ".join(map(str, sorted(lengths))) or "no"
    raise InputError(f"its lines hold {held} numbers; all lines of TUM hold 8, all of KITTI 12")


def _of_json(data: Any, names: Sequence[str]) -> list[FloatArray]:
    if isinstance(data, dict) and isinstance(data.get("groups"), list):
        data = {
            scan["name"]: scan["T_reference_scan"] for group in data["groups"][:1] for scan in group["scans"]
        }
    if isinstance(data, dict):
        missing = [name for name in names if name not in data]
        if missing:
            raise InputError(f"no pose for '{missing[0]}'")
        data = [data[name] for name in names]
    return [np.array(matrix, dtype=np.float64).reshape(4, 4) for matrix in data]
