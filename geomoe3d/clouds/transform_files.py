"""A rigid motion as a file: text with a comment on which way it maps, a NumPy array, or the result as JSON.

Stands beside `files`, below everything that registers. Numbers keep every bit: 17 significant digits in
text, float64 in NPY, shortest exact form in JSON.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from geomoe3d.errors import FormatError, InputError
from geomoe3d.result import RegistrationResult
from geomoe3d.runtime.files import write_atomically, write_text
from geomoe3d.types import FloatArray

TRANSFORM_SUFFIXES = (".txt", ".json", ".npy")


def transform_text(T: FloatArray, comments: list[str]) -> str:
    """Four rows of 17 significant digits under ``#`` comments; `numpy.loadtxt` reads it back bit for bit."""
    head = "".join(f"# {' '.join(line.split())}\n" for line in comments)
    return head + "".join(" ".join(f"{value:.17g}" for value in row) + "\n" for row in T)


def save_transform(
    path: str | os.PathLike[str], T: FloatArray, comments: list[str], *, force: bool = False
) -> None:
    """Write a motion (4, 4) as .txt (with the comments) or .npy.

    Raises:
        InputError: the matrix is not (4, 4) or not finite.
        FormatError: the suffix is neither of the two.
        OutputError: as `geomoe3d.runtime.files.write_atomically`.
    """
    path = Path(path)
    T = np.asarray(T, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(f"'{path}' not written: expected a finite (4, 4) matrix, found {T.tolist()}")
    suffix = check_suffix(path, (".txt", ".npy"))
    if suffix == ".txt":
        write_text(path, transform_text(T, comments), force=force)
        return

    def write(temporary: Path) -> None:
        with temporary.open("wb") as stream:
            np.save(stream, T)

    write_atomically(path, write, force=force)


def save_result(
    path: str | os.PathLike[str], result: RegistrationResult, comments: list[str], *, force: bool = False
) -> bool:
    """Write a result as its suffix says: .json the whole result, .txt or .npy its transform.

    Returns:
        False where nothing was written because the result holds no transform and the suffix asks for one.

    Raises:
        FormatError: an unknown suffix.
        OutputError: as `geomoe3d.runtime.files.write_atomically`.
    """
    path = Path(path)
    if check_suffix(path, TRANSFORM_SUFFIXES) == ".json":
        write_text(path, result.to_json() + "\n", force=force)
        return True
    if not has_transform(result):
        return False
    save_transform(path, result.T_target_source, comments, force=force)
    return True


def has_transform(result: RegistrationResult) -> bool:
    """Whether a result holds a motion at all, right or not."""
    return bool(np.isfinite(result.T_target_source).all())


def check_suffix(path: str | os.PathLike[str], suffixes: tuple[str, ...]) -> str:
    """The lower-case suffix of a path.

    Raises:
        FormatError: it is none of ``suffixes``.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in suffixes:
        found = f"suffix '{suffix}'" if suffix else "no suffix"
        raise FormatError(f"cannot write '{path}': {found}; use one of {', '.join(suffixes)}")
    return suffix


def load_transform(path: str | os.PathLike[str]) -> FloatArray:
    """The motion (4, 4) of a file that `save_transform` or `save_result` wrote, or of four rows of text.

    Raises:
        InputError: the file cannot be read, or holds a result without a transform.
        FormatError: an unknown suffix, or not 4 x 4 numbers.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in TRANSFORM_SUFFIXES:
        raise FormatError(
            f"'{path}' has no suffix of a transform; use one of {', '.join(TRANSFORM_SUFFIXES)}"
        )
    try:
        if suffix == ".json":
            T = RegistrationResult.from_json(path.read_text(encoding="utf-8")).T_target_source
        elif suffix == ".npy":
            T = np.asarray(np.load(path, allow_pickle=False), dtype=np.float64)
        else:
            T = np.loadtxt(path, dtype=np.float64, ndmin=2)
    except OSError as error:
        raise InputError(f"cannot read '{path}': {error.strerror or error}") from None
    except (ValueError, EOFError) as error:
        raise FormatError(f"'{path}' holds no transform: {error}") from None
    if T.shape != (4, 4):
        raise FormatError(f"'{path}' holds numbers of shape {T.shape}, expected (4, 4)")
    if not np.isfinite(T).all():
        raise InputError(f"'{path}' holds no transform, its numbers are not finite")
    return T
