"""A place of the user's own where there is none: without HOME, without an account, on a read-only root."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

_IN_MEMORY = "/dev/shm"  # containers with a read-only root still have it


def ensure_home() -> None:
    """Give the process a HOME and a folder for temporary files where it has none.

    matplotlib and others end where they find neither.
    """
    try:
        tempfile.gettempdir()
    except FileNotFoundError:
        if os.access(_IN_MEMORY, os.W_OK | os.X_OK):
            os.environ["TMPDIR"] = tempfile.tempdir = _IN_MEMORY
    try:
        Path.home()
    except RuntimeError:
        os.environ["HOME"] = str(own_temporary_folder() or os.sep)


def own_temporary_folder() -> Path | None:
    """A folder for temporary things that belongs to this user alone; None where nothing can be written."""
    user = os.getuid() if hasattr(os, "getuid") else None
    try:
        folder = Path(tempfile.gettempdir(), "geomoe3d" if user is None else f"geomoe3d-{user}")
        folder.mkdir(mode=0o700, exist_ok=True)
        is_own = user is None or folder.stat().st_uid == user
    except OSError:
        return None
    return folder if is_own and os.access(folder, os.W_OK | os.X_OK) else None
