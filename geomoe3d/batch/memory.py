"""How much memory a worker takes, said before the work begins, and how many workers that allows."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from geomoe3d.batch.table import PairRow
from geomoe3d.errors import InputError
from geomoe3d.runtime.machine import Machine
from geomoe3d.runtime.provenance import usable_cores
from geomoe3d.runtime.words import counted

_BASE_BYTES = 750 * 2**20  # libraries, torch among them, a block of the similarity matrix, described clouds
LONG_READ = 2**30
"""Bytes of files from which on it is said that they are read before the first pair."""
_COMPRESSED = {".laz", ".npz", ".e57", ".glb"}


def worker_bytes(rows: Iterable[PairRow]) -> int:
    """An estimate of the memory that the largest pair takes; missing files count nothing."""
    largest = 0.0
    sizes: dict[str, float] = {}
    for row in rows:
        for path in (row.source, row.target):
            if path not in sizes:
                sizes[path] = _loaded_bytes(path)
        largest = max(largest, sizes[row.source] + sizes[row.target])
    return int(_BASE_BYTES + largest)


def worker_bytes_of_any(paths: Iterable[str]) -> int:
    """The same for whichever two of some files: the two largest."""
    return int(_BASE_BYTES + sum(sorted(map(_loaded_bytes, paths))[-2:]))


def choose_workers(wanted: int | None, each: int) -> tuple[int, int | None]:
    """How many local processes to start, and the limit in bytes that each is held to.

    Args:
        wanted: None takes as many as there are cores and memory for.
        each: what `worker_bytes` gave.

    Returns:
        The number, and an equal share of the free memory; None where the system does not tell it.

    Raises:
        InputError: less than 1 worker, or more than fit into memory.
    """
    if wanted is not None and wanted < 1:
        raise InputError(f"there must be at least 1 worker, found {wanted}")
    memory = Machine().memory()
    if memory is None:
        return wanted or usable_cores(), None
    # A tenth is kept free.
    free = int((1 - 0.1) * memory[0])
    fitting = max(1, free // each)
    if wanted is not None and wanted > fitting:
        raise InputError(
            f"{counted(wanted, 'worker')} would take about {gibibytes(wanted * each)}, but only {gibibytes(free)} are "
            f"free; use at most --workers {fitting}"
        )
    workers = wanted or min(usable_cores(), fitting)
    return workers, max(each, free // workers)


def gibibytes(count: float) -> str:
    """A number of bytes for the eye."""
    return f"{count / 2**30:.1f} GiB"


def _loaded_bytes(path: str) -> float:
    try:
        size = os.stat(path).st_size  # noqa: PTH116
    except OSError:
        return 0.0
    # Binary PLY of single floats has 12 bytes a point in the file, some 60 while it is thinned.
    return size * (40 if Path(path).suffix.lower() in _COMPRESSED else 5)
