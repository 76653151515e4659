"""A place of the user's own where there is none: without HOME, without an account, on a read-only root.

What is put elsewhere, or not kept, is said once by a RuntimeWarning.
"""

from __future__ import annotations

import os
import tempfile
import warnings
from functools import cache
from pathlib import Path

_IN_MEMORY = "/dev/shm"  # containers with a read-only root still have it
_made_up: set[str] = set()  # the HOME that was given to this process here


def ensure_home() -> None:
    """Give the process a HOME and a folder for temporary files where it has none.

    matplotlib and others end where they find neither.
    """
    if _temporary() is None and os.access(_IN_MEMORY, os.W_OK | os.X_OK):
        os.environ["TMPDIR"] = tempfile.tempdir = _IN_MEMORY
    try:
        Path.home()
    except RuntimeError:
        os.environ["HOME"] = str(own_temporary_folder() or os.sep)
        _made_up.add(os.environ["HOME"])


def _temporary() -> str | None:
    """Python's folder for temporary files, which is the folder at work where it finds no better; or None."""
    try:
        found = tempfile.gettempdir()
    except FileNotFoundError:
        return None
    wanted = [os.environ.get(name) for name in ("TMPDIR", "TEMP", "TMP")]
    return None if found == str(Path.cwd()) and found not in wanted else found


def ensure_font_cache() -> None:
    """Give matplotlib a folder for its list of fonts where its own cannot be written."""
    ensure_home()
    if os.environ.get("MPLCONFIGDIR"):
        return
    for variable, name in (("XDG_CONFIG_HOME", ".config"), ("XDG_CACHE_HOME", ".cache")):
        base = os.environ.get(variable)
        wanted = (Path(base) if base else Path.home() / name) / "matplotlib"
        folder = folder_for(wanted, "matplotlib", "the list of fonts is", "MPLCONFIGDIR")
        if folder not in (None, wanted):
            os.environ["MPLCONFIGDIR"] = str(folder)
            return


def folder_for(wanted: Path, name: str, what: str, variable: str) -> Path | None:
    """A folder that can be written: the wanted one, else one among temporary files, which is said.

    Args:
        wanted: made if missing.
        name: of the folder among temporary files.
        what: is kept there, as the sentence begins: "descriptions are".
        variable: of the environment, by which the user can name a folder.

    Returns:
        None where nothing can be written, which is said too.
    """
    hindrance = _hindrance(wanted)
    if hindrance is None:
        return wanted
    own = own_temporary_folder()
    folder = None if own is None else own / name
    if folder is None or _hindrance(folder, made_up=True) is not None:
        _say(
            f"{hindrance}, nor a folder for temporary files, so {what} not kept; {variable} can name a folder"
        )
        return None
    _say(f"{hindrance}, so {what} kept in '{folder}'; {variable} can name another folder")
    return folder


@cache
def _say(sentence: str) -> None:
    warnings.warn(sentence, RuntimeWarning, stacklevel=4)


def _hindrance(folder: Path, made_up: bool = False) -> str | None:
    """Why nothing can be kept in a folder, which is made if missing; None where nothing hinders."""
    if not made_up and str(Path.home()) in _made_up and folder.is_relative_to(Path.home()):
        return "this user has no home folder (HOME)"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        return f"'{folder}' cannot be made ({error.strerror})"
    if not os.access(folder, os.W_OK | os.X_OK):
        return f"'{folder}' cannot be written"
    return None


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
