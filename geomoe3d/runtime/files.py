"""Writing a file completely or not at all, and never over one that was there, unless told to.

At the bottom of the import order: every writer of the package (clouds, pictures, pages, results, reports)
goes through `write_atomically`, texts through `write_text`. The bytes first go to a hidden neighbour in the
same folder, so that a reader, a full disk or an interrupt never meets half a file.
"""

from __future__ import annotations

import errno
import hashlib
import os
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from geomoe3d.errors import ExistingFileError, GeoMoE3DError, InputError, OutputError


def check_output(path: str | os.PathLike[str], *, force: bool) -> Path:
    """Say before a long computation whether its result could be written to ``path``.

    Args:
        path: the file to be written.
        force: True allows an existing regular file to be replaced.

    Returns:
        The path. A symbolic link is followed, so that writing replaces what it points to, not the link.

    Raises:
        OutputError: the path is a folder or a device, its folder is missing or cannot be written, or the
            file exists and ``force`` is False.
    """
    path = Path(path)
    try:
        if path.is_symlink():
            path = path.resolve()
            if path.is_symlink():  # as Python says from 3.13 on
                raise OSError(errno.ELOOP, "symbolic links in a loop")
        if path.is_dir():
            raise OutputError(f"cannot write '{path}': it is a folder; give a file name inside it")
        folder = path.parent
        if not folder.is_dir():
            what = "is not a folder" if folder.exists() else "does not exist"
            raise OutputError(f"cannot write '{path}': '{folder}' {what}; create it first")
        if path.exists():
            if not path.is_file():
                raise OutputError(f"cannot write '{path}': it is not a regular file; give another name")
            if not force:
                raise ExistingFileError(
                    f"'{path}' exists; pass --force (force=True) to replace it, or another name"
                )
    except OutputError:
        raise
    except (OSError, RuntimeError) as error:  # e.g. a name too long, a loop of links, no right to look
        raise OutputError(f"cannot write '{path}': {_reason(error)}") from None
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"cannot write '{path}': no right to write into the folder '{folder}'")
    return path


def write_atomically(path: str | os.PathLike[str], write: Callable[[Path], None], *, force: bool) -> None:
    """Create ``path`` from what ``write`` puts into a temporary file of the same folder and suffix.

    Args:
        path: the file to be written.
        write: called once with the temporary path (an empty file, same suffix), fills it.
        force: True replaces an existing regular file, keeping its permissions.

    Raises:
        OutputError: as `check_output`, or the system refuses to write. Any other exception of ``write``
            passes through. In either case nothing new is left in the folder and an old file is untouched.
    """
    path = check_output(path, force=force)
    temporary = path.with_name(f".writing-{secrets.token_hex(8)}{path.suffix}")
    try:
        # Not tempfile.mkstemp: its mode 0600 would survive the move and hide the file from others.
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        if path.exists():
            temporary.chmod(path.stat().st_mode & 0o777)
        write(temporary)
        _move(temporary, path, force=force)
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"cannot write '{path}': {_reason(error)}") from error
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: str | os.PathLike[str], text: str, *, force: bool) -> None:
    """Create ``path`` with ``text`` in UTF-8; line ends stay as they are in it, on every system. Raises
    OutputError: as `write_atomically`."""

    def write(temporary: Path) -> None:
        temporary.write_text(text, encoding="utf-8", newline="\n")

    write_atomically(path, write, force=force)


def file_hash(path: Path, unreadable: type[GeoMoE3DError] = InputError) -> str:
    """sha256 of a file, hexadecimal, read in pieces. Raises unreadable: it cannot be read."""
    digest = hashlib.sha256()
    try:
        with path.open("rb") as stream:
            while piece := stream.read(1 << 24):
                digest.update(piece)
    except OSError as error:
        raise unreadable(f"cannot read '{path}': {error.strerror or error}") from None
    return digest.hexdigest()


def _move(temporary: Path, path: Path, *, force: bool) -> None:
    """Rename; without ``force`` in a way that fails if somebody created ``path`` in the meantime."""
    if not force:
        try:
            os.link(temporary, path)  # unlike a rename, a hard link never replaces
            return
        except FileExistsError:
            raise ExistingFileError(
                f"'{path}' exists now, it appeared meanwhile; pass --force (force=True) to replace it, "
                "or another name"
            ) from None
        except (OSError, NotImplementedError, AttributeError):
            check_output(path, force=False)  # no hard links on this file system
    temporary.replace(path)


@contextmanager
def refusals(message: str) -> Iterator[None]:
    """What the system refuses inside is an `OutputError`: the message, and the reason."""
    try:
        yield
    except GeoMoE3DError:
        raise
    except OSError as error:
        raise OutputError(f"{message}: {_reason(error)}") from error


def make_folder(folder: Path) -> None:
    """Make a folder if it is not there, and those that it lies in. Raises OutputError: it cannot be made."""
    with refusals(f"cannot make the folder '{folder}'"):
        folder.mkdir(parents=True, exist_ok=True)


@contextmanager
def new_folder(folder: Path, what: str) -> Iterator[Path]:
    """A hidden folder to be filled, which then takes the name ``folder``: completely or not at all.

    Args:
        folder: that is not there yet; its parent must exist.
        what: the word for it in messages.

    Raises:
        OutputError: it is there, or the system refuses.
    """
    if folder.exists():
        raise OutputError(f"'{folder}' exists; remove it to make it anew, or give another name")
    temporary = folder.with_name(f".writing-{folder.name}")
    shutil.rmtree(temporary, ignore_errors=True)  # the rest of a run that was killed
    try:
        with refusals(f"cannot write {what} '{folder}'"):
            temporary.mkdir()
            yield temporary
            temporary.rename(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def remove(paths: Iterable[Path]) -> None:
    """Delete files, if they are there. Raises OutputError: one cannot be removed."""
    for path in paths:
        with refusals(f"cannot remove '{path}'"):
            path.unlink(missing_ok=True)


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error) or type(error).__name__
