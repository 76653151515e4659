"""The content of the files of a batch, by hashes; a file is read once, and again when its stamp has changed.

A stamp is size, times of the last change of content and of the file itself, and its place on the disk. Hashes are kept
in the folder of the batch, so that one that is gone on with reads only what is new.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any

from geomoe3d.errors import GeoMoE3DError
from geomoe3d.runtime.files import file_hash, write_text
from geomoe3d.runtime.plain import parse_json

CONTENTS_MARK = '"geomoe3d batch files 1"'

Stamp = tuple[int, ...]


class Contents:
    """Hashes of files, kept in a file of their own.

    Args:
        file: where they are kept, read when the first is asked for; None: nowhere.
    """

    def __init__(self, file: Path | None = None) -> None:
        self._file = file
        self._kept: dict[str, Any] | None = None
        self._changed = False

    def of(self, path: str) -> str | None:
        """A hash of a file's bytes, and of the files that hold the buffers of a glTF; None of one that cannot be
        read."""
        own = self._of_one(path)
        beside = _buffers(Path(path)) if own and path.lower().endswith((".gltf", ".glb")) else []
        if not beside:
            return own
        return hashlib.sha256(json.dumps([own, *map(self._of_one, beside)]).encode()).hexdigest()

    def unread(self, paths: Iterable[str]) -> tuple[int, int]:
        """How many of some files are to be read anew, and their bytes."""
        known = self._known()
        stamps = {path: stamp for path in paths if (stamp := _stamp(path))}
        sizes = [stamp[0] for path, stamp in stamps.items() if known.get(path, [])[1:] != list(stamp)]
        return len(sizes), sum(sizes)

    def save(self) -> None:
        """Write what is new. Raises OutputError: it cannot be written."""
        if self._file is not None and self._changed:
            text = json.dumps(self._known(), separators=(",", ":"))
            write_text(self._file, f'{{"format":{CONTENTS_MARK},"files":{text}}}\n', force=True)
            self._changed = False

    def _of_one(self, path: str) -> str | None:
        stamp = _stamp(path)
        if stamp is None:
            return None
        known = self._known().get(path)
        if known is not None and known[1:] == list(stamp):
            return str(known[0])
        try:
            found = _hash_of(path, stamp)
        except GeoMoE3DError:
            return None
        self._known()[path] = [found, *stamp]
        self._changed = True
        return found

    def _known(self) -> dict[str, Any]:
        """[hash, *stamp] by path. What cannot be understood is read again."""
        if self._kept is None:
            self._kept = {}
            if self._file is not None and self._file.is_file():
                try:
                    kept = parse_json(self._file.read_text(encoding="utf-8"))["files"]
                    self._kept = {
                        path: entry for path, entry in kept.items() if isinstance(entry, list) and entry
                    }
                except (OSError, ValueError, KeyError, TypeError, AttributeError):
                    pass
        return self._kept


def _stamp(path: str) -> Stamp | None:
    """What changes when a file does; None of one that is not there."""
    try:
        status = os.stat(path)  # noqa: PTH116
    except (OSError, ValueError):
        return None
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino, status.st_dev


@lru_cache(maxsize=100_000)
def _hash_of(path: str, stamp: Stamp) -> str:
    """See `file_hash`; read once for each stamp."""
    return file_hash(Path(path))


def _buffers(path: Path) -> list[str]:
    """The files beside a .gltf in which its geometry lies; none of a damaged one, which fails its own pair."""
    from geomoe3d.clouds.formats.gltf import buffer_files

    try:
        return [str(file) for file in buffer_files(path)]
    except Exception:  # whatever a damaged document leads to
        return []
