"""Which function reads or writes which suffix. A reader or writer joins with one decorator.

A reader is called with a path and gives a `RawCloud`, or anything else in memory that `load_points` takes. A
writer is called with a binary file open for writing and a `RawCloud`, and returns the names of what of it the
format cannot hold. Both must leave files of other tools as they are and raise `FormatError` for bad ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

Reader = Callable[[Path], Any]
Writer = Callable[..., Iterable[str]]  # of a BinaryIO and a RawCloud
R = TypeVar("R", bound=Reader)
W = TypeVar("W", bound=Writer)

READERS: dict[str, Reader] = {}
CLOUD_WRITERS: dict[str, Writer] = {}
MESH_WRITERS: dict[str, Writer] = {}


def reader(*suffixes: str) -> Callable[[R], R]:
    """Make a function or a class the reader of files with these suffixes, lower case with dot."""

    def register(function: R) -> R:
        READERS.update(dict.fromkeys(suffixes, function))
        return function

    return register


def writer(*suffixes: str, mesh: bool = False) -> Callable[[W], W]:
    """Make a function the writer of files with these suffixes, lower case with dot.

    Args:
        suffixes: as given for output files.
        mesh: it writes triangles and is not asked for clouds without.
    """

    def register(function: W) -> W:
        (MESH_WRITERS if mesh else CLOUD_WRITERS).update(dict.fromkeys(suffixes, function))
        return function

    return register
