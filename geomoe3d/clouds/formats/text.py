"""Text tables: XYZ, TXT, ASC, CSV and PTS, and the parsing of numbers that ASCII PLY and PCD share.

About 0.5 million rows per second; memory is the parsed table. A line that does not parse is named.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from geomoe3d.clouds.formats.raw import RawCloud, columns_by_name, header_count, split_columns, wrong_count
from geomoe3d.clouds.formats.registry import reader, writer
from geomoe3d.errors import FormatError
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray

_COMMENTS = ("#", "//")
_ODD = re.compile(r"[^\d\s.,;eE+-]")
_SPELLINGS = (  # how C libraries and languages other than Python write numbers, and how Python does
    (re.compile(r"[-+]?(?:nan\([^)\s]*\)|1\.#(?:[qs]?nan|ind)\d*)", re.I), "nan"),
    (re.compile(r"1\.#inf\d*", re.I), "inf"),
    (re.compile(r"(?<![^\s,;])(?:NA|N/A|null|none)(?![^\s,;])", re.I), "nan"),
    (re.compile(r"(?<=[\d.])[dD](?=[-+]?\d)"), "e"),  # Fortran's double precision
)
_COUNTED = {  # columns of files that begin with a count of points, as Leica writes them
    4: ["x", "y", "z", "intensity"],
    6: ["x", "y", "z", "red", "green", "blue"],
    7: ["x", "y", "z", "intensity", "red", "green", "blue"],
    9: ["x", "y", "z", "red", "green", "blue", "nx", "ny", "nz"],
    10: ["x", "y", "z", "intensity", "red", "green", "blue", "nx", "ny", "nz"],
}


class DataLines:
    """Lines that hold data, with the place of the last one handed out.

    numpy's parser asks for one line at a time, so when it fails the last line handed out is the guilty one.

    Args:
        lines: of a text.
        number: how many lines of the file came before.
        comments: what a line that is passed over begins with.
        odd: whether numbers may be written as `plain` undoes it.

    Attributes:
        number: 1-based number of the last line in its file.
        text: its text.
        taken: data lines handed out so far, or since `begin`.
    """

    def __init__(
        self, lines: Iterable[str], number: int = 0, comments: tuple[str, ...] = (), odd: bool = True
    ) -> None:
        self.number = number
        self.text = ""
        self.taken = 0
        self._limit: int | None = None
        self._lines = iter(lines)
        self._comments = comments
        self._odd = odd

    def begin(self, limit: int) -> None:
        """Start a section of at most ``limit`` data lines."""
        self.taken = 0
        self._limit = limit

    def again(self) -> DataLines:
        """The same lines from the last one on."""
        self._lines = chain([self.text], self._lines)
        self.number -= 1
        self.taken -= 1
        return self

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        if self.taken == self._limit:
            raise StopIteration
        for line in self._lines:
            self.number += 1
            self.text = line.strip()
            if self.text and not self.text.startswith(self._comments):
                self.taken += 1
                return plain(self.text) if self._odd else self.text
        raise StopIteration

    def where(self, path: Path) -> str:
        """The last line, for messages."""
        return _where(path, self.number, self.text)


def _where(path: Path, number: int, line: str) -> str:
    shown = line if len(line) <= 60 else line[:57] + "..."
    return f"'{path}' line {number}: '{shown}'"


def plain(text: str) -> str:
    """Numbers as Python writes them: Fortran exponents, and the many spellings of nan and infinity."""
    if _ODD.search(text):
        for spelling, ours in _SPELLINGS:
            text = spelling.sub(ours, text)
    return text


def parse_table(
    path: Path, lines: DataLines, delimiter: str | None, width: int, columns: list[int] | None = None
) -> FloatArray:
    """Numbers of the remaining lines (rows, ``width``), or some of their columns; no lines give no rows.
    Raises FormatError: a line is not ``width`` numbers; the message names it."""
    first = next(lines, None)
    if first is None:
        return np.empty((0, width if columns is None else len(columns)))
    found = len(first.split(delimiter))
    if found != width:
        raise FormatError(f"{lines.where(path)} has {counted(found, 'column')}, expected {width}")
    try:
        table: FloatArray = np.loadtxt(
            chain([first], lines),
            dtype=np.float64,
            delimiter=delimiter,
            comments=None,
            usecols=columns,
            ndmin=2,
        )
    except ValueError:
        found = len(lines.text.split(delimiter))
        problem = (
            f"has {counted(found, 'column')}, expected {width}" if found != width else "is not all numbers"
        )
        raise FormatError(f"{lines.where(path)} {problem}") from None
    return table


def parse_numbers(path: Path, body: bytes, num_lines: int) -> FloatArray:
    """All numbers (n,) of a text, wherever its lines end.

    Args:
        path: for messages.
        body: the text behind a header.
        num_lines: lines of that header.

    Raises:
        FormatError: something is no number; the message names its line.
    """
    for text in (body, plain(body.decode("latin-1"))):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                return np.fromstring(text, sep=" ")
        except (ValueError, DeprecationWarning):
            continue
    for number, line in enumerate(body.decode("latin-1").splitlines(), num_lines + 1):
        if not all(map(_is_number, plain(line).split())):
            raise FormatError(f"{_where(path, number, line.strip())} is not all numbers")
    raise FormatError(f"'{path}' is not all numbers behind its header")


@reader(".xyz", ".txt", ".asc", ".csv", ".pts")
def read_text(path: Path) -> RawCloud:
    """XYZ, TXT, ASC, CSV or PTS: one point per line.

    Separated by semicolons, commas or blanks, whichever the first data line shows in that order; where commas
    do not separate they are decimal points. Empty lines and lines that start with # or // are skipped. A
    header (also behind # or //) must name x, y and z, and its names decide the columns; where the first line
    is the number of points, as in PTS, Leica's columns hold; else `split_columns` states the rule. Columns of
    words are left out if a header names them.

    Raises:
        FormatError: a line that does not parse (named), fewer than three columns, or a number of points that
            the file does not hold.
    """
    try:
        with _open_text(path) as handle:
            return _read_table(path, handle, False)
    except (
        FormatError
    ):  # perhaps for numbers that are not written as Python does, which costs time to look for
        with _open_text(path) as handle:
            return _read_table(path, handle, True)


def _open_text(path: Path) -> IO[str]:
    with path.open("rb") as handle:
        wide = handle.read(2) in (b"\xff\xfe", b"\xfe\xff")  # what Windows calls Unicode
    return path.open(encoding="utf-16" if wide else "utf-8-sig", errors="replace")


def _read_table(path: Path, handle: IO[str], odd: bool) -> RawCloud:
    header: list[str] | None = None
    remark: list[str] | None = None  # a comment that reads like a header; it counts if its length fits
    counts: list[int] = []
    lines = DataLines(handle)
    for line in lines:
        body = line.lstrip("#/ \t")
        delimiter = _delimiter(body)
        tokens = [token.strip() for token in body.rstrip(delimiter).split(delimiter)] or [""]
        if line.startswith(_COMMENTS):
            if "points" in columns_by_name(tokens):
                remark = tokens
        elif tokens[0].isdigit() and len(tokens) == 1 and not counts:
            counts.append(header_count(tokens[0], path, "number of points"))
        elif header is None and "points" in columns_by_name(tokens):
            header = tokens
        elif header is not None or remark is not None or _is_number(tokens[0]):
            break
        else:
            raise FormatError(
                f"{lines.where(path)} is neither numbers nor a header that names the columns x, y and z"
                + (": an ESRI grid of heights, no points" if tokens[0].lower() == "ncols" else "")
            )
    else:
        return RawCloud(np.empty((0, 3)))
    if len(tokens) < 3:
        raise FormatError(
            f"{lines.where(path)} has {counted(len(tokens), 'column')}, a point needs at least 3"
        )
    if header is None and remark is not None and len(remark) == len(tokens):
        header = remark
    if header is None and counts:
        header = _COUNTED.get(len(tokens))
    if header is not None and len(header) != len(tokens):
        raise FormatError(
            f"{lines.where(path)} has {counted(len(tokens), 'column')} but the header names {len(header)}: "
            f"{' '.join(header)}"
        )
    words = [k for k, token in enumerate(tokens) if not _is_number(token)] if header is not None else []
    kept = [k for k in range(len(tokens)) if k not in words]
    again = _cleaned(chain([lines.text], handle), delimiter, body.endswith(delimiter or "\n"), counts)
    rest = DataLines(again, lines.number - 1, _COMMENTS, odd)
    table = parse_table(path, rest, delimiter, len(tokens), kept if words else None)
    if counts and sum(counts) != len(table):
        raise wrong_count(path, sum(counts), len(table))
    names = None if header is None else [header[k] for k in kept]
    if names is not None and "points" not in columns_by_name(names):
        raise FormatError(f"{_where(path, lines.number, line)} has no numbers for x, y and z")
    cloud = split_columns(table, names, f"'{path}'")
    return replace(cloud, unread=(*cloud.unread, *(header[k] for k in words))) if header else cloud


def _delimiter(line: str) -> str | None:
    """What separates the values of a line; None for blanks."""
    if ";" in line:
        return ";"
    words = line.split()
    decimal = len(words) >= 3 and all(word.count(",") <= 1 and word.strip(",") == word for word in words)
    return "," if "," in line and not decimal else None


def _cleaned(lines: Iterator[str], delimiter: str | None, trailing: bool, counts: list[int]) -> Iterator[str]:
    """Undo decimal commas and a delimiter at the end of each line, where the first line showed them.

    Where the file began with a number of points, further such lines begin further scans; they are collected.
    """
    for line in lines:
        if delimiter != "," and "," in line:
            line = line.replace(",", ".")
        if counts and line.strip().isdigit():
            counts.append(int(line))
            line = ""
        yield line.rstrip().rstrip(delimiter) if trailing else line


def _is_number(token: str) -> bool:
    try:
        float(plain(token).replace(",", "."))
    except ValueError:
        return False
    return True


@writer(".xyz", ".txt")
def write_blanks(handle: BinaryIO, cloud: RawCloud) -> tuple[str, ...]:
    """As `write_csv` with blanks between the columns; the header is a remark, and only there if needed.

    No blank may follow the #: CloudCompare would count one column more than the rows have, and find no point.
    """
    return _write_text(handle, cloud, " ", "#")


@writer(".asc")
def write_asc(handle: BinaryIO, cloud: RawCloud) -> tuple[str, ...]:
    """As `write_blanks`, with the header in which CloudCompare finds colours too."""
    return _write_text(handle, cloud, " ", "//")


@writer(".csv")
def write_csv(handle: BinaryIO, cloud: RawCloud) -> tuple[str, ...]:
    """Enough digits (up to 17) that every float64 returns bit for bit; a header names the columns.

    Normals, colours (fractions in [0, 1]) and fields follow the coordinates.
    """
    return _write_text(handle, cloud, ",", "")


def _write_text(handle: BinaryIO, cloud: RawCloud, separator: str, remark: str) -> tuple[str, ...]:
    names = ["X", "Y", "Z"]
    parts: list[NDArray[Any]] = [cloud.points]
    if cloud.normals is not None:
        names += ["Nx", "Ny", "Nz"]
        parts.append(cloud.normals)
    if cloud.colors is not None:
        names += ["Rf", "Gf", "Bf"]
        parts.append(cloud.colors)
    for name, values in cloud.fields.items():
        names.append(re.sub(r"[\s,;]+|^[=+@-]", "_", name))  # also what spreadsheets take for a formula
        parts.append(values[:, None])
    if not remark or len(names) > 3:
        handle.write((remark + separator.join(names) + "\n").encode())
    write_rows(handle, parts, separator)
    return ()


def write_rows(
    handle: BinaryIO, parts: Sequence[NDArray[Any]], separator: str = " ", prefix: str = ""
) -> None:
    """Rows of the arrays side by side, in the shortest digits that return every number bit for bit."""
    for start in range(0, len(parts[0]), 50_000):
        columns = [column.tolist() for part in parts for column in part[start : start + 50_000].T]
        rows = zip(*columns, strict=True)
        text = "\n".join([prefix + separator.join(map(repr, row)) for row in rows])
        handle.write((text + "\n").encode("ascii"))
