"""A rigid transform as a file, for geomoe3d and for other programs.

Stands beside `files`, below everything that registers. Numbers keep every bit: 17 significant digits in text
(a quaternion rounds the rotation once more), float64 in NPY, shortest exact form in JSON. The texts
themselves are in `transform_formats`.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geomoe3d.clouds.transform_formats import (
    TEXTS,
    WITHOUT_SCALE,
    matrix_text,
    of_matrix,
    parse_transform,
)
from geomoe3d.config import expert
from geomoe3d.errors import FormatError, InputError, cannot_read, plain_reason
from geomoe3d.geometry.se3 import scale_of
from geomoe3d.runtime.files import write_atomically, write_text
from geomoe3d.runtime.words import shape_in_words
from geomoe3d.types import FloatArray

if TYPE_CHECKING:
    from geomoe3d.result import RegistrationResult

TRANSFORM_FORMATS = (*TEXTS, "json", "npy")
_BY_SUFFIX = {
    **{".txt": "matrix", ".mat": "matrix", ".json": "json", ".npy": "npy", ".yaml": "tf", ".yml": "tf"},
    **{".tum": "tum", ".kitti": "kitti"},
}
TRANSFORM_SUFFIXES = tuple(_BY_SUFFIX)

transform_text = matrix_text


def transform_format(target: str | os.PathLike[str]) -> tuple[str, Path]:
    """The format that a path stands for, and the path: ``pdal:T.json``, ``T.kitti.txt`` or ``T.tum``.

    A name in front of a colon decides, else the inner one of two suffixes, else the last.

    Raises:
        FormatError: no format of that name or suffix.
    """
    text = os.fspath(target)
    name, colon, rest = text.partition(":")
    if colon and re.fullmatch(r"[A-Za-z]{2,}", name):
        if name.lower() not in TRANSFORM_FORMATS or not rest:
            raise FormatError(
                f"cannot write '{text}': no format '{name}'; use one of {', '.join(TRANSFORM_FORMATS)} (or "
                f"'./{text}', if that is the file's name)"
            )
        return name.lower(), Path(rest)
    path = Path(text)
    inner = Path(path.stem).suffix[1:].lower()
    if inner in TRANSFORM_FORMATS and path.suffix:
        return inner, path
    suffix = check_suffix(
        path, TRANSFORM_SUFFIXES, "; or name a format, such as pdal:FILE: " + ", ".join(TEXTS)
    )
    return _BY_SUFFIX[suffix], path


def save_transform(
    path: str | os.PathLike[str],
    T: FloatArray,
    comments: Sequence[str],
    *,
    frames: tuple[str, str] = ("target", "source"),
    force: bool = False,
) -> None:
    """Write a transform (4, 4) in any format of `transform_format` but a whole result.

    Args:
        path: the file, with or without the name of a format.
        T: p_target = R p_source + t, R with its scale.
        comments: lines that say which way it maps, where the format has room for them.
        frames: what T maps into, and what it maps, in formats that name frames.
        force: replace an existing file.

    Raises:
        InputError: the matrix is not (4, 4) or not finite.
        FormatError: no such format, "json", which is a whole result's, or one that cannot hold the scale of T.
        OutputError: as `geomoe3d.runtime.files.write_atomically`.
    """
    kind, path = transform_format(path)
    T = np.asarray(T, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(f"'{path}' not written: expected a finite (4, 4) matrix, found {T.tolist()}")
    if kind == "json":
        raise FormatError(f"cannot write '{path}': JSON holds whole results; use .txt or .npy for a matrix")
    check_scale_format(kind, path, scale_of(T))
    if kind in TEXTS:
        write_text(path, TEXTS[kind](T, comments, frames), force=force)
        return

    def write(temporary: Path) -> None:
        with temporary.open("wb") as stream:
            np.save(stream, T)

    write_atomically(path, write, force=force)


def check_scale_format(kind: str, path: Path, scale: float | None) -> None:
    """Refuse a format that holds a rotation and a translation where there is a scale.

    Args:
        kind: of `transform_format`.
        path: named in the message.
        scale: of the similarity, or None where it is still to be estimated.

    Raises:
        FormatError: the format cannot hold it.
    """
    if scale != 1.0 and kind in WITHOUT_SCALE:
        said = "an estimated scale" if scale is None else f"a scale of {scale:.6g}"
        others = [name for name in TRANSFORM_FORMATS if name not in WITHOUT_SCALE]
        raise FormatError(
            f"cannot write '{path}': '{kind}' holds a rotation and a translation, not {said}; use one of "
            f"{', '.join(others)}"
        )


def save_result(
    path: str | os.PathLike[str],
    result: RegistrationResult,
    comments: Sequence[str],
    *,
    frames: tuple[str, str] = ("target", "source"),
    force: bool = False,
) -> bool:
    """Write a result: as JSON the whole, in any other format its transform.

    Returns:
        False where nothing was written because the result holds no transform and the format asks for one.

    Raises:
        FormatError: no such format.
        OutputError: as `geomoe3d.runtime.files.write_atomically`.
    """
    kind, file = transform_format(path)
    if kind == "json":
        write_text(file, result.to_json() + "\n", force=force)
        return True
    if not has_transform(result):
        return False
    save_transform(path, result.T_target_source, comments, frames=frames, force=force)
    return True


def has_transform(result: RegistrationResult) -> bool:
    """Whether a result holds a transform at all, right or not."""
    return bool(np.isfinite(result.T_target_source).all())


def check_suffix(path: str | os.PathLike[str], suffixes: tuple[str, ...], more: str = "") -> str:
    """The lower-case suffix of a path. Raises FormatError: it is none of ``suffixes``."""
    suffix = Path(path).suffix.lower()
    if suffix not in suffixes:
        found = f"suffix '{suffix}'" if suffix else "no suffix"
        raise FormatError(f"cannot write '{path}': {found}; use one of {', '.join(suffixes)}{more}")
    return suffix


def load_transform(path: str | os.PathLike[str]) -> FloatArray:
    """The transform (4, 4) of a file, told from its content whatever its name.

    Anything that `save_result` writes; also a matrix of four or three rows of text, ROS 1's
    static_transform_publisher, geometry_msgs as YAML, and a PDAL pipeline with one filters.transformation.

    Raises:
        InputError: the file cannot be read, or holds a result without a transform.
        FormatError: nothing that is understood as one transform.
    """
    path = Path(path)
    try:
        with path.open("rb") as handle:
            largest = 1 << 24  # bytes; a transform is some hundred
            data = handle.read(largest)
        if data[:6] == b"\x93NUMPY":
            T = _of_npy(data)
        elif b"\0" in data or len(data) == largest:
            raise FormatError("it is no text")
        else:
            T = parse_transform(data.decode("utf-8-sig", errors="replace"))
    except OSError as error:
        raise cannot_read(error, f"cannot read '{path}': {error.strerror or error}") from None
    except (
        ValueError, EOFError, LookupError, TypeError, AttributeError, RecursionError, OverflowError
    ) as error:  # fmt: skip
        raise FormatError(f"'{path}' holds no transform: {plain_reason(error)}") from None
    if T.shape != (4, 4):
        raise FormatError(f"'{path}' holds {shape_in_words(T.shape)}, expected 4 rows of 4")
    if not np.isfinite(T).all():
        raise InputError(f"'{path}' holds no transform, its numbers are not finite")
    limit = expert().loading.most_coordinate
    if np.abs(T[:3, 3]).max() > limit:
        raise InputError(
            f"'{path}': the translation is {T[:3, 3].tolist()}, beyond the limit of {limit:g}; correct it"
        )
    return T


def _of_npy(data: bytes) -> FloatArray:
    """The transform of an NPY file; one whose header describes more than memory holds is refused too."""
    try:
        array = np.load(io.BytesIO(data), allow_pickle=False)
        if array.dtype.kind == "c":
            raise FormatError("complex numbers, expected real ones")
        return of_matrix(np.asarray(array, dtype=np.float64))
    except FormatError:
        raise
    except Exception as error:  # numpy's header parser has many ways to refuse
        raise FormatError(plain_reason(error)) from None
