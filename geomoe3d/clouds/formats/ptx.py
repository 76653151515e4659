"""PTX: Leica's text of scans one after the other, each a grid with the pose of its scanner."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from geomoe3d.clouds.formats.raw import RawCloud, cloud_of, header_count, wrong_count
from geomoe3d.clouds.formats.registry import reader
from geomoe3d.clouds.formats.text import DataLines, parse_table
from geomoe3d.errors import FormatError
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray

_NAMES = {
    3: ["x", "y", "z"],
    4: ["x", "y", "z", "intensity"],
    7: ["x", "y", "z", "intensity", "red", "green", "blue"],
}


@reader(".ptx")
def read_ptx(path: Path) -> RawCloud:
    """All scans in the file's global frame; (0, 0, 0) stands for no return and becomes NaN.

    Whatever else a scan holds of a point in the columns that all scans have is kept: intensity in [0, 1], and
    colours.

    Raises:
        FormatError: a line that does not parse, or a scan of fewer points than its grid has places.
    """
    tables: list[FloatArray] = []
    places: list[FloatArray] = []
    grids: list[str] = []
    with path.open(encoding="utf-8-sig", errors="replace") as handle:
        lines = DataLines(handle)
        while (first := next(lines, None)) is not None:
            columns = header_count(first, path, "number of columns")
            num_points = columns * header_count(next(lines, ""), path, "number of rows")
            T = _pose(path, lines)
            places.append(T[:3, 3])
            grids.append(f"grid of {columns} x {num_points // max(columns, 1)}")
            lines.begin(num_points)
            table = _scan(path, lines, num_points)
            lines.begin(1 << 60)
            none = ~table[:, :3].any(axis=1)
            table[:, :3] = transform_points(T, table[:, :3])
            table[none, :3] = np.nan
            tables.append(table)
    width = min((table.shape[1] for table in tables), default=3)
    if width not in _NAMES:
        raise FormatError(f"'{path}': its points have {counted(width, 'column')}, expected 3, 4 or 7")
    whole = np.concatenate([table[:, :width] for table in tables])
    lost = "colours or intensity of some scans"
    some = any(table.shape[1] != width for table in tables)
    cloud = cloud_of(_NAMES[width], list(whole.T), unread=(*grids, lost) if some else tuple(grids))
    return replace(cloud, sensor=places[0] if len(places) == 1 and places[0].any() else None)


def _pose(path: Path, lines: DataLines) -> FloatArray:
    """The affine (4, 4) of a scan: p_file = A p_scan. PTX writes it for rows: [p 1] M."""
    lines.begin(4)
    parse_table(path, lines, None, 3)  # the scanner's place and axes, which the matrix says again
    lines.begin(4)
    rows = parse_table(path, lines, None, 4)
    if rows.shape != (4, 4) or not np.isfinite(rows).all():
        raise FormatError(f"{lines.where(path)}: a scan begins with 4 rows of 3 and 4 rows of 4 numbers")
    matrix: FloatArray = rows.T
    return matrix


def _scan(path: Path, lines: DataLines, num_points: int) -> FloatArray:
    first = next(lines, None)
    if first is None:
        if num_points:
            raise wrong_count(path, num_points, 0)
        return np.empty((0, 7))
    table = parse_table(path, lines.again(), None, len(first.split()))
    if len(table) < num_points:
        raise wrong_count(path, num_points, len(table))
    return table
