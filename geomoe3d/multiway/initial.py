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

from geomoe3d.clouds.transform_formats import of_matrix, of_seven
from geomoe3d.config import expert
from geomoe3d.errors import FormatError, InputError, plain_reason
from geomoe3d.geometry.se3 import check_motion, inverse, shift_frames
from geomoe3d.multiway.edges import Edge, Shape
from geomoe3d.runtime.plain import parse_json
from geomoe3d.runtime.words import counted, shape_in_words
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


@np.errstate(over="ignore", invalid="ignore")  # what comes of huge numbers is refused
def read_poses(path: str | os.PathLike[str], names: Sequence[str]) -> tuple[FloatArray, ...]:
    """T_world_scan (4, 4) of every scan: p_world = R p_scan + t.

    Text has one line per scan in their order: eight numbers (TUM: time, translation, quaternion x y z w; no time is
    before that of the line above) or twelve (KITTI: the upper three rows). JSON holds a list of matrices in their
    order, matrices by name of the scan, or the poses.json of a model with one group.

    Raises:
        InputError: no such file, another number of poses than scans, no rigid transform, or one further off than
            `expert.loading.most_coordinate`.
        FormatError: none of these formats.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "it is no text in UTF-8"
        raise InputError(f"cannot read the initial poses '{path}': {why}") from None
    try:
        if not text:
            raise FormatError(f"an empty file (0 bytes); give one pose per scan: {_KINDS}")
        found = _of_json(text, names) if text.lstrip()[:1] in ("[", "{") else _of_text(text)
        if len(found) != len(names):
            raise InputError(
                f"{counted(len(found), 'pose')} for {counted(len(names), 'scan')}; give one per scan, in their order"
            )
        return tuple(_checked(T, name) for T, name in zip(found, names, strict=True))
    except KeyError as error:
        raise FormatError(f"initial poses '{path}': the key {error} is missing") from None
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        kind = InputError if type(error) is InputError else FormatError
        raise kind(f"initial poses '{path}': {plain_reason(error)}") from None


_KINDS = "lines of TUM or KITTI, or JSON"


def _checked(T: FloatArray, name: str) -> FloatArray:
    """A rigid motion that is not too far off."""
    limit, shift = expert().loading.most_coordinate, T[:3, 3]
    if np.isfinite(shift).all() and np.abs(shift).max() > limit:
        raise InputError(
            f"the pose of '{name}' has the translation {shift.tolist()}, beyond the limit of {limit:g}; correct it or "
            "use a larger unit"
        )
    try:
        return check_motion(T)
    except InputError as error:
        raise InputError(f"the pose of '{name}': {error}") from None


def _of_text(text: str) -> list[FloatArray]:
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.strip()[0] == "#":
            continue
        try:
            rows.append([float(word) for word in line.split()])
        except ValueError as error:
            raise FormatError(f"line {number}: {plain_reason(error)}; expected {_KINDS}") from None
    lengths = {len(row) for row in rows}
    if lengths == {12}:
        return [of_matrix(np.array(row)) for row in rows]
    if lengths == {8}:
        for before, after in pairwise(row[0] for row in rows):
            if not after >= before:
                raise InputError(
                    f"the time {after:.17g} stands behind {before:.17g}; lines are taken in the order of the scans, so "
                    "their times must rise: sort lines and scans alike"
                )
        return [of_seven(row[1:]) for row in rows]
    held = " and ".join(map(str, sorted(lengths))) or "no"
    raise FormatError(f"its lines hold {held} numbers; all lines of TUM hold 8, all of KITTI 12")


def _of_json(text: str, names: Sequence[str]) -> list[FloatArray]:
    try:
        data = parse_json(text, parse_int=float)  # however many digits
    except json.JSONDecodeError as error:
        raise FormatError(f"no JSON: line {error.lineno}, column {error.colno}: {error.msg}") from None
    if isinstance(data, dict) and "groups" in data and not all(name in data for name in names):
        data = _of_model(data["groups"])
    if isinstance(data, dict):
        missing = [name for name in names if name not in data]
        if missing:
            raise InputError(f"no pose for '{missing[0]}'")
        data = [data[name] for name in names]
    elif _numbers(data) is not None:
        raise FormatError(
            f"it holds {shape_in_words(np.shape(data))}; expected a list of matrices, one for each of "
            f"{counted(len(names), 'scan')}, also where that is one"
        )
    found = [_numbers(matrix) for matrix in data]
    for number, (values, matrix) in enumerate(zip(found, data, strict=True), start=1):
        if values is None or values.size != 16:
            held = json.dumps(matrix)[:40] if values is None else shape_in_words(values.shape)
            raise FormatError(f"pose {number} is {held}, expected 4 rows of 4 numbers")
    return [values.reshape(4, 4) for values in found if values is not None]


def _numbers(matrix: Any) -> FloatArray | None:
    """Rows of numbers, or None where it is something else."""
    try:
        found = np.array(matrix)
    except ValueError:
        return None
    usable = found.ndim in (1, 2) and found.dtype.kind in "if"
    return found.astype(np.float64) if usable else None


def _of_model(groups: Any) -> dict[str, Any]:
    """Matrices by name of the scan, of the groups in a poses.json."""
    try:
        scans = [scan for group in list(groups)[:1] for scan in group["scans"]]
        return {scan["name"]: scan["T_reference_scan"] for scan in scans}
    except TypeError:
        raise FormatError(
            "its 'groups' are not those of a poses.json: a list, where each has 'scans', and each of these 'name' and "
            "'T_reference_scan'"
        ) from None
