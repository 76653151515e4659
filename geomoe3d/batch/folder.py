"""What a batch writes into its folder, and how its own files are told from those of the user.

A folder is that of a batch by its ``run.json``, a page by its generator, a transform by its comments. What is
not a batch's own is never replaced nor removed: it is refused before work begins, or left where it is.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any
from urllib.parse import quote

from geomoe3d.batch.contents import CONTENTS_MARK
from geomoe3d.clouds.transform_files import save_transform
from geomoe3d.errors import FormatError, InputError, OutputError
from geomoe3d.result import RegistrationResult
from geomoe3d.runtime.files import make_folder, refusals, remove
from geomoe3d.runtime.journal import Journal
from geomoe3d.runtime.plain import parse_json
from geomoe3d.runtime.words import counted

RUN_FILE, JOURNAL_FILE = "run.json", "journal.jsonl"
RESULTS_FILE, TABLE_FILE, CONTENTS_FILE = "results.jsonl", "results.csv", "files.json"
PAGE_FILE, TRANSFORMS_FOLDER, PAGES_FOLDER = "page.html", "transforms", "pages"
FORMAT = "geomoe3d batch 1"
TABLE_HEAD = "id,status,confidence,overlap,"
PAGE_MARK = '<meta name="generator" content="geomoe3d batch">'

_KIND = "geomoe3d batch "
_DEVICES = {"CON", "PRN", "AUX", "NUL", *(f"{port}{n}" for port in ("COM", "LPT") for n in range(10))}
_TRANSFORM_HEAD = re.compile(  # the rows stand behind the remarks in batches of old
    r"(?:[^#\n]*\n){0,4}# maps SOURCE \(.*\) into TARGET \(.*\): p_target = (?:[\d.e+-]+ )?R p_source \+ t\r?\n"
    r"# status \w+, confidence [\d.]+\r?\n(?:# pair (.*?)\r?\n)?(?:[^#]|$)"
)


def read_identity(folder: Path) -> dict[str, Any] | None:
    """What the answers of the batch in a folder depend on; None where no batch was begun. Raises FormatError:
    its ``run.json`` is damaged, or of something else."""
    path = folder / RUN_FILE
    try:
        identity = dict(parse_json(path.read_text(encoding="utf-8"))["identity"])
        if str(identity.get("format")).startswith(_KIND):
            return identity
        found = f"its format is {identity.get('format')!r}"
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        found = repr(error)
    raise FormatError(
        f"'{path}' does not describe a batch of geomoe3d ({found}); give another folder, or move the file"
    )


def check_can_be_folder(path: Path, what: str) -> Path:
    """The nearest folder of a path that is there: the path itself, or in what it is to be made.

    Args:
        path: of a folder, there or to be made.
        what: what is said of it where it cannot be one.

    Raises:
        OutputError: a file is in the way.
    """
    with refusals(f"cannot make the folder '{path}'"):  # e.g. a name too long
        there = next(place for place in (path, *path.parents) if place.exists())
    if not there.is_dir():
        raise OutputError(f"'{there}' is a file; {what}")
    return there


def check_extras(
    folder: Path, ids: Iterable[str], *, transforms: bool, page: bool, pages: bool = False
) -> None:
    """Refuse to write pages or transforms over what is not of a batch, before work begins.

    Args:
        folder: of the batch, there or not.
        ids: of its pairs.
        transforms: whether transforms are going to be written.
        page: whether a page is.
        pages: whether a page of every pair is.

    Raises:
        InputError: a file that is not of a batch has such a name, or an id is too long to name a file.
    """
    path = folder / PAGE_FILE
    if page and path.exists() and not has_mark(path, PAGE_MARK):
        raise InputError(f"{foreign(path)}, or leave the page out")
    names = list(ids)
    if transforms:
        _check_files(
            folder / TRANSFORMS_FOLDER, {name: transform_name(name) for name in names}, _is_own_transform
        )
    if pages:
        _check_files(folder / PAGES_FOLDER, {name: page_name(name) for name in names}, is_own_page)


def extras_of(folder: Path) -> tuple[bool, bool, bool]:
    """Whether a batch left transforms, a page, and pages of its pairs in a folder."""
    return (
        any(_is_own_transform(path) for path in files_in(folder / TRANSFORMS_FOLDER)),
        has_mark(folder / PAGE_FILE, PAGE_MARK),
        any(is_own_page(path) for path in files_in(folder / PAGES_FOLDER)),
    )


def _check_files(place: Path, names: dict[str, str], is_own: Callable[[Path], bool]) -> None:
    """Refuse to write files, by id, into a folder where one of them is somebody else's or has too long a name."""
    what = f"or leave the {place.name} out"
    if place.exists() and not place.is_dir():
        raise InputError(f"{foreign(place)}, {what}")
    for name, file in names.items():
        if not _fits(file):
            raise InputError(
                f"the id '{name}' makes a file name of {counted(len(file.encode()), 'byte')}, at most 255 are "
                f"possible; give shorter ones in the column id, {what}"
            )
        path = place / file
        if path.exists() and not is_own(path):
            raise InputError(f"{foreign(path)}, {what}")


def foreign(path: Path, what: str = "a batch") -> str:
    """The beginning of a refusal to overwrite a file."""
    return f"'{path}' is not of {what} of geomoe3d and would be overwritten; move it or give another folder"


def has_mark(path: Path, mark: str) -> bool:
    """Whether a file holds a mark in its first lines."""
    return mark.encode() in _head(path)


def remove_batch(folder: Path) -> None:
    """Delete what a batch left of its own; nothing else in the folder is touched, nor what is no batch.
    Raises FormatError: as `read_identity`; OutputError: a file cannot be removed, or another process is
    writing the journal."""
    if read_identity(folder) is None:
        return
    if (folder / JOURNAL_FILE).is_file():
        Journal(folder / JOURNAL_FILE).close()  # refused while another process holds it
    for place, is_own in (
        (folder / TRANSFORMS_FOLDER, _is_own_transform),
        (folder / PAGES_FOLDER, is_own_page),
    ):
        remove([path for path in files_in(place) if is_own(path)])
        if place.is_dir() and not any(place.iterdir()):
            place.rmdir()
    if has_mark(folder / PAGE_FILE, PAGE_MARK):
        remove([folder / PAGE_FILE])
    # The last one says whose the others are.
    table = [folder / TABLE_FILE] if has_mark(folder / TABLE_FILE, TABLE_HEAD) else []
    table += [folder / CONTENTS_FILE] if has_mark(folder / CONTENTS_FILE, CONTENTS_MARK) else []
    remove([*table, *(folder / name for name in (JOURNAL_FILE, RESULTS_FILE, RUN_FILE))])


def short_transform_name(name: str) -> str:
    """`transform_name`, of a name that is too long for a file its beginning and a hash of the whole."""
    file = transform_name(name)
    if _fits(file):
        return file
    begin = name[:150]
    while len(_stem(begin)) > 150:
        begin = begin[:-1]
    return f"{_stem(begin)}~{hashlib.sha256(name.encode()).hexdigest()[:16]}.txt"


def _fits(file: str) -> bool:
    return len(file.encode()) <= 255  # of nearly every file system


def transform_name(name: str) -> str:
    """The file of the transform of a pair: its id, odd characters as %XX."""
    return f"{_stem(name)}.txt"


def page_name(name: str) -> str:
    """The file of the page of a pair."""
    return f"{_stem(name)}.html"


def _stem(name: str) -> str:
    """An id as a file name that every system takes.

    Odd too are a dot at its beginning, which would hide the file, and, on Windows, names of devices and a blank at
    the beginning.
    """
    stem = quote(name, safe=" +=,@")
    device = stem.split(".")[0].rstrip().upper() in _DEVICES
    return f"%{ord(stem[0]):02X}{stem[1:]}" if device or stem[0] in ". " else stem


def pair_mark(name: str) -> str:
    """What the page of a pair says in its head."""
    return f'<meta name="geomoe3d-pair" content="{page_name(name)}">'


def is_own_page(path: Path) -> bool:
    """By its mark, which names its pair: a copy under another name is the user's."""
    return f'<meta name="geomoe3d-pair" content="{path.name}">'.encode() in _head(path)


def write_transforms(folder: Path, results: Iterable[tuple[str, RegistrationResult]]) -> None:
    """One text file per pair; those that an earlier call wrote of other pairs are removed.

    Args:
        folder: made if missing.
        results: id and answer of the pairs that have a transform.

    Raises:
        OutputError: a file cannot be written or removed.
    """
    make_folder(folder)
    written = set()
    for name, result in results:
        path = folder / transform_name(name)
        names = f"SOURCE ({result.source.name}) into TARGET ({result.target.name})"
        times = "" if result.scale == 1.0 else f"{result.scale:.9g} "
        comments = [
            f"maps {names}: p_target = {times}R p_source + t",
            f"status {result.status}, confidence {result.confidence:.4f}",
            f"pair {path.stem}",
        ]
        save_transform(path, result.T_target_source, comments, force=True)
        written.add(path.name)
    remove([path for path in files_in(folder) if path.name not in written and _is_own_transform(path)])


def _is_own_transform(path: Path) -> bool:
    """By its comments, which name its pair: a copy under another name is the user's."""
    found = _TRANSFORM_HEAD.match(_head(path).decode("utf-8", "replace"))
    return found is not None and found[1] in (None, " ".join(path.stem.split()))


def files_in(folder: Path) -> list[Path]:
    """The files of a folder; none where there is no folder."""
    return [path for path in folder.iterdir() if path.is_file()] if folder.is_dir() else []


def _head(path: Path) -> bytes:
    """The first bytes of a file; none where it cannot be read."""
    try:
        with path.open("rb") as stream:
            # Marks stand in the first lines.
            return stream.read(4096)
    except OSError:
        return b""
