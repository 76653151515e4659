"""An append-only file of JSON lines that survives being killed: what has been done, one line each.

Long work (predictions, batches) writes every finished piece here and goes on from it after a kill or a power
cut. A line counts once it ends in a newline; the torn rest of an interrupted write is cut off when the
journal is opened for writing. A lock keeps a second writer out.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import IO, Any

from geomoe3d.errors import FormatError, OutputError, cannot_read
from geomoe3d.runtime.files import refusals
from geomoe3d.runtime.plain import parse_json


def read_journal(path: str | os.PathLike[str]) -> Iterator[dict[str, Any]]:
    """The complete records of a journal, in order of writing; a torn last line is left out.

    A file that does not exist gives nothing.

    Raises:
        InputError: the file cannot be read.
        FormatError: a line that ends in a newline is no JSON object; names the line.
    """
    path = Path(path)
    try:
        stream = path.open("rb")
    except FileNotFoundError:
        return
    except OSError as error:
        raise cannot_read(error, f"cannot read '{path}': {error.strerror}") from None
    with stream:
        for number, line in enumerate(stream, start=1):
            if not line.endswith(b"\n"):
                return
            try:
                record = parse_json(line)
            except ValueError:
                record = None
            if not isinstance(record, dict):
                raise FormatError(
                    f"'{path}' line {number} is no JSON object; the file was damaged: remove that line and "
                    "what it stood for is done again"
                )
            yield record


class Journal:
    """A journal open for appending; use it as a context manager.

    Args:
        path: of the file; made if missing, its folder must exist.

    Raises:
        OutputError: the file cannot be written, or another process is writing it.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        with self._writing():
            self._stream: IO[bytes] = self.path.open("a+b")
            _lock(self._stream, self.path)
            _cut_torn_line(self._stream)
        self._synced = time.monotonic()

    def append(self, record: dict[str, Any]) -> None:
        """Add one record. It survives a kill from now on, and a power cut within a second. Raises
        OutputError: the disk refuses; ValueError: the record holds a NaN or infinite number, which JSON does
        not have."""
        line = json.dumps(record, allow_nan=False, separators=(",", ":")).encode() + b"\n"
        with self._writing():
            self._stream.write(line)
            self._stream.flush()
            if time.monotonic() - self._synced > 1.0:  # s
                self._sync()

    def close(self) -> None:
        """Bring everything to the disk and let go of the file."""
        if not self._stream.closed:
            try:
                with self._writing():
                    self._sync()
            finally:
                self._stream.close()

    def _writing(self) -> AbstractContextManager[None]:
        return refusals(f"cannot write '{self.path}'")

    def _sync(self) -> None:
        os.fsync(self._stream.fileno())
        self._synced = time.monotonic()

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def _lock(stream: IO[bytes], path: Path) -> None:
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        return
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        stream.close()
        raise OutputError(f"'{path}' is being written by another process; wait for it or stop it") from None


def _cut_torn_line(stream: IO[bytes]) -> None:
    """Cut what follows the last newline."""
    end = stream.seek(0, os.SEEK_END)
    position, block = end, 65536
    while position > 0:
        start = max(0, position - block)
        stream.seek(start)
        newline = stream.read(position - start).rfind(b"\n")
        if newline >= 0:
            position = start + newline + 1
            break
        position = start
    if position < end:
        stream.truncate(position)
    stream.seek(0, os.SEEK_END)
