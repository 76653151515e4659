"""The table of pairs: read, checked as a whole before any work begins, every row with a fingerprint.

A broken table is refused with the line that is at fault. A broken or missing cloud is not looked for here: it
fails its own pair later.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
from collections.abc import Iterable, Mapping, Sequence, Sized
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.batch.contents import Contents
from geomoe3d.clouds.transform_files import load_transform
from geomoe3d.errors import FormatError, GeoMoE3DError, InputError, cannot_read
from geomoe3d.geometry.se3 import check_motion
from geomoe3d.types import FloatArray

MATRIX_COLUMNS = tuple(f"T{row}{column}" for row in range(4) for column in range(4))
"""Sixteen columns of an initial value, row by row."""

_COLUMNS = ("source", "target", "id", "initial", *MATRIX_COLUMNS)

PairLike = Sequence[Any]
_OPEN_QUOTE = (
    "a cell begins with a quote that is not closed before the next separator; close it, or write two quotes "
    "for one that belongs to the cell"
)
_EXPECTED = "(source, target) or (source, target, first guess)"


@dataclass(frozen=True)
class PairRow:
    """One pair to be registered.

    Attributes:
        id: unique in its table.
        source: absolute path.
        target: absolute path.
        initial: 16 numbers, row by row, of a first guess in file coordinates, or None.
    """

    id: str
    source: str
    target: str
    initial: tuple[float, ...] | None = None

    @property
    def matrix(self) -> FloatArray | None:
        """(4, 4) first guess, or None."""
        return None if self.initial is None else np.array(self.initial).reshape(4, 4)

    def fingerprint(self, contents: Contents) -> str:
        """Hash of what decides the answer: names and content of both files, and the first guess; not where they lie."""
        files = [(Path(path).name, contents.of(path)) for path in (self.source, self.target)]
        says = [*files, self.initial]
        return hashlib.sha256(json.dumps(says).encode()).hexdigest()[:16]


def read_pairs(path: str | os.PathLike[str]) -> list[PairRow]:
    """The rows of a CSV file with the columns source, target and, if wanted, id and initial values.

    Separated by comma, semicolon or tab; relative paths are relative to the file. ``id`` is made of source
    and target where it is not given. A first guess is the path of a transform file in the column
    ``initial``, or 16 numbers in the columns T00 T01 ... T33; empty cells mean none. Other columns are
    ignored, but not those whose name is nearly one of these.

    Raises:
        InputError: no such file, no rows, a duplicate id, a row without source or target, or a first guess
            that is no rigid transform; names the line.
        FormatError: no header with the two columns, a name that is nearly a known one, a row with more cells
            than the header, or no text.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise FormatError(f"'{path}' is no text in UTF-8; save the table as 'CSV UTF-8'") from None
    except OSError as error:
        if Path(path).is_dir():
            raise InputError(
                f"'{path}' is a folder, not a table of pairs; all scans of a folder are registered by `multiway`"
            ) from None
        raise cannot_read(error, f"cannot read '{path}': {error.strerror}") from None
    head = text.partition("\n")[0]
    separator = max(",;\t", key=head.count)
    reader = csv.DictReader(io.StringIO(text), delimiter=separator, skipinitialspace=True, strict=True)
    folder = path.parent.resolve()
    rows, lines = [], []
    try:
        columns = [name.strip() for name in reader.fieldnames or []]
        reader.fieldnames = columns
        _check_columns(path, columns)
        for cells in reader:
            where = f"'{path}' line {reader.line_num}"
            surplus = [cell for cell in cells.pop(None, []) if cell.strip()]
            if surplus:
                raise FormatError(
                    f"{where} has more cells than the {len(columns)} that the first line names, the first "
                    f"of them '{surplus[0]}'; put a cell that holds the separator '{separator}' in quotes"
                )
            values = {key: (cells[key] or "").strip() for key in columns}
            if any("\n" in value for value in values.values()):
                raise FormatError(f"{where}: {_OPEN_QUOTE}")
            if any(values.values()):
                rows.append(_row(values, folder, where))
                lines.append(where)
    except csv.Error as error:
        raise FormatError(f"'{path}' line {reader.reader.line_num}: {_OPEN_QUOTE} ({error})") from None
    return check_rows(rows, lines, str(path))


def as_rows(pairs: Iterable[PairLike | PairRow]) -> list[PairRow]:
    """Rows of (source path, target path) or (source, target, first guess (4, 4)) in memory. Raises
    InputError: none, a duplicate, or something else than paths; a batch sends paths to its workers."""
    numbers = getattr(getattr(pairs, "dtype", None), "kind", "O") not in "OSU"  # an array may hold paths too
    if numbers or isinstance(pairs, (bytes, Mapping)) or not isinstance(pairs, Iterable):
        raise InputError(
            f"pairs must be a CSV file or a list of {_EXPECTED}, found {kind_of(pairs)}; clouds in memory go "
            "through Registrar.register_many"
        )
    rows = []
    for number, pair in enumerate(pairs, start=1):
        where = f"pair {number}"
        if isinstance(pair, PairRow):
            rows.append(pair)
            continue
        parts: Any = pair
        if isinstance(parts, np.ndarray):
            parts = parts.tolist()
        if not isinstance(parts, Sequence) or isinstance(parts, (str, bytes)) or not 2 <= len(parts) <= 3:
            raise InputError(f"{where}: expected {_EXPECTED}, found {kind_of(pair)}")
        source, target = parts[0], parts[1]
        for side in (source, target):
            if not isinstance(side, (str, os.PathLike)):
                raise InputError(
                    f"{where}: source and target must be paths of files, found {kind_of(side)}; clouds in "
                    "memory go through Registrar.register_many"
                )
        initial = None
        if len(parts) == 3 and parts[2] is not None:
            initial = _motion(parts[2], where)
        name = f"{os.fspath(source)}+{os.fspath(target)}"
        rows.append(PairRow(name, str(Path(source).resolve()), str(Path(target).resolve()), initial))
    return check_rows(rows, [f"pair {number}" for number in range(1, len(rows) + 1)], "the list of pairs")


def kind_of(value: Any) -> str:
    """What somebody gave instead of a path, in a few words."""
    if value is None or isinstance(value, str):
        return repr(value)
    kind = type(value).__name__
    if getattr(value, "shape", ()):
        return f"{kind} of shape {tuple(value.shape)}"
    return f"{kind} of {len(value)}" if isinstance(value, Sized) else f"{kind} {value!r}"


def check_rows(rows: list[PairRow], lines: list[str], what: str) -> list[PairRow]:
    """The rows, if there are any and no two share an id. Raises InputError: none, or two."""
    if not rows:
        raise InputError(f"{what} holds no pairs; give at least one row with source and target")
    seen: dict[str, str] = {}
    for row, line in zip(rows, lines, strict=True):
        name = os.path.normcase(row.id)  # ids name files, and Windows knows no capitals in their names
        if name in seen:
            raise InputError(
                f"{line}: the id '{row.id}' is that of {seen[name]} too; give every pair its own in the column id"
            )
        seen[name] = line
    return rows


def _check_id(name: str, where: str) -> None:
    """An id names files: it is no path out of their folder, and hides none. Raises InputError: it begins with
    a dot, or holds the part ``..``."""
    if name.startswith(".") or ".." in name.replace("\\", "/").split("/"):
        raise InputError(
            f"{where}: the id '{name}' cannot name files: it must not begin with a dot nor hold the part '..'; "
            "give another one in the column id"
        )


def _check_columns(path: Path, columns: list[str]) -> None:
    if not any(columns):
        raise InputError(f"'{path}' is empty; its first line must name the columns source and target")
    for wanted in _COLUMNS:
        count = columns.count(wanted)
        if count > 1 or (count == 0 and wanted in ("source", "target")):
            close = get_close_matches(wanted, columns, n=1)
            hint = f"; is '{close[0]}' meant?" if close and close[0] != wanted else ""
            problem = "more than one column" if count else "no column"
            raise FormatError(
                f"'{path}' has {problem} '{wanted}' among {', '.join(columns)}{hint}; the first line must "
                "name source and target, and may name id, initial, or T00 to T33"
            )
    known = {name.casefold(): name for name in _COLUMNS}
    for name in columns:
        # 0.82 of difflib: one letter wrong, missing or exchanged; 'source_id' and 'ids' have less.
        close = get_close_matches(name.casefold(), known, n=1, cutoff=0.82)
        if close and name not in _COLUMNS:
            raise FormatError(
                f"'{path}' has the column '{name}', which is nearly '{known[close[0]]}'; name it so, or "
                "give a column that is to be ignored a name of its own"
            )
    present = [name for name in MATRIX_COLUMNS if name in columns]
    if present and len(present) < 16:
        missing = next(name for name in MATRIX_COLUMNS if name not in columns)
        raise FormatError(
            f"'{path}' has the column {present[0]} but not {missing}; a first guess needs all 16"
        )
    if present and "initial" in columns:
        raise FormatError(f"'{path}' has both the column initial and T00 to T33; keep one of the two")


def _row(values: dict[str, str], folder: Path, where: str) -> PairRow:
    source, target = values["source"], values["target"]
    for name in ("source", "target"):
        if not values[name]:
            raise InputError(f"{where}: the cell '{name}' is empty")
    initial = None
    cells = [values.get(name, "") for name in MATRIX_COLUMNS]
    if values.get("initial"):
        file = folder / values["initial"]
        try:
            initial = _motion(load_transform(file), where)
        except GeoMoE3DError as error:
            raise InputError(f"{where}: the first guess cannot be used: {error}") from None
    elif any(cells):
        try:
            numbers = [float(cell) for cell in cells]
        except ValueError:
            raise InputError(
                f"{where}: the first guess must be 16 numbers in T00 to T33, or none; found {cells}"
            ) from None
        initial = _motion(np.reshape(numbers, (4, 4)), where)
    of_files = f"{source}+{target}"
    name = values.get("id") or of_files
    if name != of_files:
        _check_id(name, where)
    return PairRow(name, str((folder / source).resolve()), str((folder / target).resolve()), initial)


def _motion(matrix: Any, where: str) -> tuple[float, ...]:
    try:
        return tuple(float(value) for value in check_motion(matrix).ravel())
    except InputError as error:
        raise InputError(f"{where}: the first guess cannot be used: {error}") from None
