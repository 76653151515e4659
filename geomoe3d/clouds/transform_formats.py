"""A rigid transform as the text that other programs read, and whatever they write as a transform again.

Every text holds p_target = R p_source + t with 17 significant digits. ROS calls target the parent frame and
source the child. What a text means is told from its content, so that any of them can be a first guess.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from geomoe3d.config.reading import parse_yaml
from geomoe3d.errors import FormatError, plain_reason
from geomoe3d.runtime.plain import parse_json
from geomoe3d.runtime.words import counted, shape_in_words
from geomoe3d.types import FloatArray

_SEVEN = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")


def _digits(values: Sequence[float] | FloatArray) -> str:
    return " ".join(f"{value:.17g}" for value in values)


def _seven(T: FloatArray) -> FloatArray:
    """Translation and unit quaternion (x, y, z, w), w >= 0."""
    from scipy.spatial.transform import Rotation

    seven: FloatArray = np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)])
    return seven


def _remarks(comments: Sequence[str]) -> str:
    return "".join(f"# {' '.join(line.split())}\n" for line in comments)


def matrix_text(T: FloatArray, comments: Sequence[str] = (), frames: tuple[str, str] = ("", "")) -> str:
    """Four rows and ``#`` comments behind them; `numpy.loadtxt` reads it back bit for bit.

    CloudCompare takes the first 16 words of a file for the matrix, so comments in front of the rows, or words
    that are no numbers, give it zeros, and it lays every point on the origin without a complaint.
    """
    return "".join(_digits(row) + "\n" for row in T) + _remarks(comments)


def _quaternion(T: FloatArray, comments: Sequence[str], frames: tuple[str, str]) -> str:
    return f"{_digits(_seven(T))}\n# {' '.join(_SEVEN)}\n{_remarks(comments)}"


def _tum(T: FloatArray, comments: Sequence[str], frames: tuple[str, str]) -> str:
    return f"0 {_digits(_seven(T))}\n# timestamp {' '.join(_SEVEN)}\n{_remarks(comments)}"


def _kitti(T: FloatArray, comments: Sequence[str], frames: tuple[str, str]) -> str:
    return _digits(T[:3].ravel()) + "\n"


def _pdal(T: FloatArray, comments: Sequence[str], frames: tuple[str, str]) -> str:
    stage = {"type": "filters.transformation", "matrix": _digits(T.ravel())}
    return json.dumps({"pipeline": [stage]}, indent=2) + "\n"


def _ros(T: FloatArray, comments: Sequence[str], frames: tuple[str, str]) -> str:
    values = " ".join(
        f"--{n[-1] if n[0] == 't' else n} {v:.17g}" for n, v in zip(_SEVEN, _seven(T), strict=True)
    )
    frame, child = frames
    line = f"ros2 run tf2_ros static_transform_publisher {values} --frame-id {frame} --child-frame-id {child}"
    return f"{line}\n{_remarks(comments)}"


def _tf(T: FloatArray, comments: Sequence[str], frames: tuple[str, str]) -> str:
    values = dict(zip(_SEVEN, (f"{value:.17g}" for value in _seven(T)), strict=True))
    lines = [f"header:\n  frame_id: {frames[0]}", f"child_frame_id: {frames[1]}", "transform:"]
    for name, letter, axes in (("translation", "t", "xyz"), ("rotation", "q", "xyzw")):
        lines += [f"  {name}:", *(f"    {axis}: {_yaml_float(values[letter + axis])}" for axis in axes)]
    return "\n".join(lines) + f"\n{_remarks(comments)}"


def _yaml_float(text: str) -> str:
    """YAML takes 1e-05 for a word."""
    mantissa, e, exponent = text.partition("e")
    return f"{mantissa}{'' if '.' in mantissa else '.0'}{e}{exponent}"


WITHOUT_SCALE = ("quaternion", "tum", "kitti", "ros", "tf")
"""Formats of a rotation and a translation, which cannot hold a similarity."""

TEXTS: dict[str, Callable[[FloatArray, Sequence[str], tuple[str, str]], str]] = {
    "matrix": matrix_text,
    "cloudcompare": matrix_text,
    "quaternion": _quaternion,
    "tum": _tum,
    "kitti": _kitti,
    "pdal": _pdal,
    "ros": _ros,
    "tf": _tf,
}


def parse_transform(text: str) -> FloatArray:
    """The transform (4, 4) of a text: any of `TEXTS`, a result as JSON, or a bare matrix. Raises FormatError:
    nothing that is understood, or more than one transform; InputError: a result without a transform."""
    if text.lstrip()[:1] in ("{", "["):
        try:
            return _of_document(parse_json(text))
        except json.JSONDecodeError:
            if text.lstrip()[0] == "{":
                raise
            text = text.replace("\n", " ")  # an array that numpy printed, perhaps over several lines
    if "static_transform_publisher" in re.sub(r"#.*", "", text):
        return _of_publisher(text)
    if re.search(r"^\s*(- )?(translation|position)\s*:", text, re.M):
        import yaml

        try:
            return _of_document(parse_yaml(text))
        except yaml.YAMLError as error:
            raise FormatError(f"no YAML: {' '.join(str(error).split())}") from None
    remarks = " ".join(re.findall(r"(?:#|//)(.*)", text))
    rows = [re.sub(r"[\[\](),;]", " ", re.sub(r"(#|//).*", "", line)).split() for line in text.splitlines()]
    try:
        numbers = [[float(word) for word in row] for row in rows if row]
    except ValueError as error:
        raise FormatError(plain_reason(error)) from None
    return _of_rows(numbers, remarks)


def _of_rows(rows: list[list[float]], remarks: str) -> FloatArray:
    shape = (len(rows), len(rows[0]) if rows and len({len(row) for row in rows}) == 1 else 0)
    if shape in ((4, 4), (3, 4), (1, 16), (1, 12)):
        return of_matrix(np.array(rows))
    if shape in ((1, 8), (1, 7)):
        order = [word for word in re.findall(r"[a-z]+", remarks) if word in _SEVEN]
        names = order[:7] if sorted(order[:7]) == sorted(_SEVEN) else _SEVEN
        found = dict(zip(names, rows[0][-7:], strict=True))
        return of_seven([found[name] for name in _SEVEN])
    if shape[0] > 1 and shape[1] in (7, 8, 12):
        raise FormatError(
            f"{counted(shape[0], 'row')} of {counted(shape[1], 'number')}; give a file of one transform"
        )
    what = (
        shape_in_words(shape)
        if shape[1]
        else f"{counted(len(rows), 'row')} of {counted(sum(map(len, rows)), 'number')}"
    )
    raise FormatError(
        f"{what}; expected 4 rows (or 3) of 4 numbers, or translation and quaternion (7 numbers)"
    )


def of_matrix(values: FloatArray) -> FloatArray:
    """(4, 4) from (4, 4), (3, 4), or these row after row. Raises FormatError: another number of values."""
    if values.size not in (12, 16) or (values.ndim == 2 and values.shape[1] != 4 and values.shape[0] != 1):
        raise FormatError(f"{shape_in_words(values.shape)}, expected 4 rows of 4")
    T = np.eye(4)
    T[: values.size // 4] = values.reshape(-1, 4)
    return T


def of_seven(values: Sequence[float]) -> FloatArray:
    """(4, 4) from a translation and a quaternion x y z w. Raises FormatError: its length is not 1."""
    from scipy.spatial.transform import Rotation

    length = float(np.linalg.norm(values[3:]))
    if not abs(length - 1.0) < 1e-3:
        raise FormatError(
            f"the quaternion has the length {length:.6g}, expected 1; the order is {' '.join(_SEVEN)}"
        )
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
    T[:3, 3] = values[:3]
    return T


def _of_publisher(text: str) -> FloatArray:
    """ROS 2 with names (--x), or ROS 1 with bare numbers: x y z and a quaternion or yaw, pitch, roll."""
    from scipy.spatial.transform import Rotation

    words = re.sub(r"#.*", "", text).replace("\\\n", " ").split("static_transform_publisher", 1)[1].split()
    named = {word[2:]: words[k + 1] for k, word in enumerate(words[:-1]) if word.startswith("--")}
    try:
        if named:
            values = {name: float(named.get(name, name == "qw")) for name in ("x", "y", "z", *_SEVEN[3:])}
            angles = [float(named.get(name, 0)) for name in ("yaw", "pitch", "roll")]
            uses_angles = bool({"yaw", "pitch", "roll"} & named.keys())
            place, turn = [values[axis] for axis in "xyz"], [values[q] for q in _SEVEN[3:]]
        else:
            numbers = []
            for word in words:
                if not re.fullmatch(r"[-+]?[\d.]+(e[-+]?\d+)?", word, re.I):
                    break
                numbers.append(float(word))
            if len(numbers) not in (6, 7):
                raise FormatError(
                    f"{counted(len(numbers), 'number')} behind static_transform_publisher, expected 6 or 7"
                )
            uses_angles, place, angles, turn = len(numbers) == 6, numbers[:3], numbers[3:6], numbers[3:]
    except ValueError as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(str(error)) from None
    if uses_angles:
        turn = Rotation.from_euler("ZYX", angles).as_quat().tolist()
    return of_seven([*place, *turn])


def _of_document(data: Any) -> FloatArray:
    """What JSON or YAML holds: a result, a PDAL pipeline, a transform or pose of ROS, or a matrix."""
    if isinstance(data, dict) and "T_target_source" in data:
        return np.array(
            data["T_target_source"], dtype=np.float64
        )  # of a failed result None, which becomes NaN
    found: list[FloatArray] = list(_motions(data))
    if len(found) != 1:
        raise FormatError(f"{len(found)} transforms in it, expected one")
    return found[0]


def _motions(data: Any, depth: int = 0) -> Any:
    if depth > 20:
        raise FormatError("nested too deep")
    if isinstance(data, dict):
        if data.get("type") == "filters.transformation":
            yield of_matrix(np.array(str(data.get("matrix", "")).split(), dtype=np.float64))
            return
        place = data.get("translation", data.get("position"))
        turn = data.get("rotation", data.get("orientation"))
        if isinstance(place, dict) and isinstance(turn, dict):
            yield of_seven([*(float(place[a]) for a in "xyz"), *(float(turn[a]) for a in "xyzw")])
            return
        for value in data.values():
            yield from _motions(value, depth + 1)
    elif isinstance(data, list):
        if data and not any(isinstance(value, (dict, str)) for value in data):
            yield of_matrix(np.array(data, dtype=np.float64))
            return
        for value in data:
            yield from _motions(value, depth + 1)
