"""Text tables: XYZ, TXT and CSV, and the numbered parsing that ASCII PLY and PCD share.

About 0.5 million rows per second; memory is the parsed table. A line that does not parse is named.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import BinaryIO

import numpy as np

from geomoe3d.clouds.formats.raw import RawCloud, columns_by_name, split_columns
from geomoe3d.errors import FormatError
from geomoe3d.types import FloatArray

_COMMENTS = ("#", "//")


class DataLines:
    """Lines that hold data, with the place of the last one handed out.

    numpy's parser asks for one line at a time, so when it fails the last line handed out is the guilty one.

    Attributes:
        number: 1-based number of the last line in its file.
        text: its text.
        taken: data lines handed out so far, or since `begin`.
    """

    def __init__(self, lines: Iterable[str], number: int = 0, comments: tuple[str, ...] = ()) -> None:
        self.number = number
        self.text = ""
        self.taken = 0
        self._limit: int | None = None
        self._lines = iter(lines)
        self._comments = comments

    def begin(self, limit: int) -> None:
        """Start a section of at most ``limit`` data lines."""
        self.taken = 0
        self._limit = limit

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
                return self.text
        raise StopIteration

    def where(self, path: Path) -> str:
        """The last line, for messages."""
        shown = self.text if len(self.text) <= 60 else self.text[:57] + "..."
        return f"'{path}' line {self.number}: '{shown}'"


def parse_table(path: Path, lines: DataLines, delimiter: str | None, width: int) -> FloatArray:
    """Numbers of the remaining lines (rows, ``width``); no lines give (0, ``width``).

    Raises:
        FormatError: a line is not ``width`` numbers; the message names it.
    """
    first = next(lines, None)
    if first is None:
        return np.empty((0, width))
    found = len(first.split(delimiter))
    if found != width:
        raise FormatError(f"{lines.where(path)} has {found} columns, expected {width}")
    try:
        table: FloatArray = np.loadtxt(
            chain([first], lines), dtype=np.float64, delimiter=delimiter, comments=None, ndmin=2
        )
    except ValueError:
        found = len(lines.text.split(delimiter))
        problem = f"has {found} columns, expected {width}" if found != width else "is not all numbers"
        raise FormatError(f"{lines.where(path)} {problem}") from None
    return table


def read_text(path: Path) -> RawCloud:
    """XYZ, TXT or CSV: one point per line.

    Separated by semicolons, commas or blanks, whichever the first data line shows in that order; with
    semicolons a comma is the decimal point. Empty lines and lines that start with # or // are skipped.
    A header (also behind # or //) must name x, y and z, and its names decide the columns; without one
    `split_columns` states the rule.

    Raises:
        FormatError: a line that does not parse (named), or fewer than three columns.
    """
    header: list[str] | None = None
    remark: list[str] | None = None  # a comment that reads like a header; it counts if its length fits
    with path.open(encoding="utf-8-sig", errors="replace") as handle:
        lines = DataLines(handle)
        for line in lines:
            body = line.lstrip("#/ \t")
            delimiter = ";" if ";" in body else "," if "," in body else None
            tokens = [token.strip() for token in body.rstrip(delimiter).split(delimiter)]
            if line.startswith(_COMMENTS):
                if "points" in columns_by_name(tokens):
                    remark = tokens
            elif _is_number(tokens[0]):
                break
            elif header is None and "points" in columns_by_name(tokens):
                header = tokens
            else:
                raise FormatError(
                    f"{lines.where(path)} is neither numbers nor a header that names the columns x, y and z"
                )
        else:
            return RawCloud(np.empty((0, 3)))
        if len(tokens) < 3:
            raise FormatError(f"{lines.where(path)} has {len(tokens)} columns, a point needs at least 3")
        if header is None and remark is not None and len(remark) == len(tokens):
            header = remark
        if header is not None and len(header) != len(tokens):
            raise FormatError(
                f"{lines.where(path)} has {len(tokens)} columns but the header names {len(header)}: "
                f"{' '.join(header)}"
            )
        again = _cleaned(chain([lines.text], handle), delimiter, body.endswith(delimiter or "\n"))
        rest = DataLines(again, lines.number - 1, _COMMENTS)
        table = parse_table(path, rest, delimiter, len(tokens))
    return split_columns(table, header)


def _cleaned(lines: Iterator[str], delimiter: str | None, trailing: bool) -> Iterator[str]:
    """Undo decimal commas and a delimiter at the end of each line, where the first line showed them."""
    for line in lines:
        if delimiter == ";" and "," in line:
            line = line.replace(",", ".")
        yield line.rstrip().rstrip(delimiter) if trailing else line


def _is_number(token: str) -> bool:
    try:
        float(token.replace(",", "."))
    except ValueError:
        return False
    return True


def write_text(handle: BinaryIO, cloud: RawCloud, suffix: str) -> None:
    """XYZ, TXT (blanks) or CSV (commas): enough digits (up to 17) that every float64 returns bit for bit.

    Normals and colours (fractions in [0, 1]) follow the coordinates and are named in a header; CSV always
    has one, XYZ and TXT only when there is something to name.
    """
    separator = "," if suffix == ".csv" else " "
    names = ["x", "y", "z"]
    parts = [cloud.points]
    if cloud.normals is not None:
        names += ["nx", "ny", "nz"]
        parts.append(cloud.normals)
    if cloud.colors is not None:
        names += ["red", "green", "blue"]
        parts.append(cloud.colors)
    if suffix == ".csv" or len(parts) > 1:
        handle.write((("" if suffix == ".csv" else "# ") + separator.join(names) + "\n").encode("ascii"))
    write_rows(handle, parts, separator)


def write_rows(handle: BinaryIO, parts: list[FloatArray], separator: str = " ", prefix: str = "") -> None:
    """Rows of the arrays side by side, in the shortest digits that return every float64 bit for bit."""
    for start in range(0, len(parts[0]), 50_000):
        block = np.concatenate([part[start : start + 50_000] for part in parts], axis=1).tolist()
        text = "\n".join([prefix + separator.join(map(repr, row)) for row in block])
        handle.write((text + "\n").encode("ascii"))
