"""Fields of a cloud that point somewhere, such as velocities: a motion turns them as it turns normals.

They are told by their names alone: vx, vy, vz; velocity_x, ...; Normals_0, ... Three components of a word that
means a direction are turned. What depends on the axes and is not known to be a direction, or is not complete,
stays as it is and is named.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomoe3d.types import FloatArray

_DIRECTIONS = frozenset(
    [
        *(
            "v",
            "vel",
            "velocity",
            "velocities",
            "a",
            "acc",
            "accel",
            "acceleration",
            "u",
            "flow",
            "sceneflow",
        ),
        *(
            "n",
            "normal",
            "normals",
            "norm",
            "dir",
            "direction",
            "directions",
            "ray",
            "beam",
            "axis",
            "tangent",
        ),
        *("bitangent", "binormal", "gradient", "grad", "curvature", "d", "displacement", "offset", "force"),
    ]
)
_TURNS = frozenset(("rot", "rotation", "quat", "quaternion", "orientation"))
_ANGLES = frozenset(("azimuth", "yaw", "pitch", "roll", "heading", "bearing", "zenith"))

Fields = Mapping[str, NDArray[Any]]


def turned(fields: Fields, R: FloatArray) -> tuple[dict[str, NDArray[Any]], tuple[str, ...]]:
    """The fields of a cloud after a rotation.

    Args:
        fields: values (N,) by name.
        R: (3, 3) the rotation.

    Returns:
        The fields, directions turned, in the same order; and names of those that depend on the axes and stayed.
    """
    found = dict(fields)
    stayed: list[str] = []
    for stem, members in _families(fields).items():
        complete = len(members) == 3
        if complete and _words(stem) & _DIRECTIONS:
            columns = [fields[name] for name in members]
            small = all(column.dtype in (np.float16, np.float32) for column in columns)
            rotated = np.stack(columns, axis=1).astype(np.float64) @ R.T
            for name, column in zip(members, rotated.T, strict=True):
                found[name] = column.astype(np.float32) if small else np.ascontiguousarray(column)
        else:
            stayed += members
    stayed += [name for name in fields if _words(name) & _ANGLES or re.fullmatch(r"f_rest_\d+", name.lower())]
    return found, tuple(dict.fromkeys(stayed))


def _families(fields: Fields) -> dict[str, list[str]]:
    """Names that differ in one letter x, y or z, or in a number behind a word, by what they share."""
    letters: dict[str, dict[str, str]] = {}
    numbers: dict[str, dict[str, str]] = {}
    for name in fields:
        plain = name.lower()
        for match in re.finditer(r"(?<![a-z])([a-z]?)([xyz])(?![a-z])|[xyz]$", plain):
            place = match.end() - 1
            letters.setdefault(f"{plain[:place]}?{plain[place + 1 :]}", {})[plain[place]] = name
        if numbered := re.fullmatch(r"(.+)[_:.]([0-9])", plain):
            numbers.setdefault(f"{numbered[1]}?", {})[numbered[2]] = name
    found = {stem: [m[axis] for axis in "xyz" if axis in m] for stem, m in letters.items() if len(m) > 1}
    for stem, members in numbers.items():
        words = _words(stem)
        if (words & _DIRECTIONS and set(members) == set("012")) or words & _TURNS:
            found[stem] = [members[key] for key in sorted(members)]
    return found


def _words(name: str) -> set[str]:
    return set(re.findall(r"[a-z]+", name.lower()))
