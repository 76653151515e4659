"""Sweeps of KITTI (x y z intensity) and nuScenes (and a ring) as bare little-endian floats: .bin."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geomoe3d.clouds.formats.raw import RawCloud, cloud_of
from geomoe3d.clouds.formats.registry import reader
from geomoe3d.errors import FormatError
from geomoe3d.runtime.words import counted

_NAMES = ("x", "y", "z", "intensity", "ring")


@reader(".bin")
def read_bin(path: Path) -> RawCloud:
    """Four or five float32 per point, whichever the file's size and content allow.

    Five where the fifth is a whole number from 0 to 255 in every row, as a ring is.

    Raises:
        FormatError: neither or both are possible.
    """
    with path.open("rb") as handle:
        values = np.fromfile(handle, dtype=np.uint8)
    if values[:4].tobytes() == b"CCB2":
        raise FormatError(
            f"'{path}' is CloudCompare's own BIN, which is not read here; save it as PLY or E57"
        )
    possible = []
    for width in (4, 5):
        if len(values) % (4 * width) == 0:
            table = values.view("<f4").reshape(-1, width)
            with np.errstate(invalid="ignore"):
                places = np.abs(table[:, :3])
                # No such sensor reaches 10 km, and bits that are no floats do.
                is_sweep = bool((~(places > 1e4)).all() and np.isfinite(table[:, 3]).all())
                rings = table[:, 4] if width == 5 else np.zeros(1)
                has_rings = bool(((rings == np.rint(rings)) & (rings >= 0) & (rings <= 255)).all())
            if is_sweep and has_rings:
                possible.append(table)
    if len(possible) == 2 and (possible[1][:, 4] != possible[1][0, 4]).any():
        possible = possible[1:]  # whole numbers all the way down are no chance
    if len(possible) != 1:
        raise FormatError(
            f"'{path}' holds {counted(len(values), 'byte')}: "
            f"{'as well' if possible else 'neither'} rows of 4 floats (x y z intensity, as of KITTI) "
            f"{'as' if possible else 'nor'} of 5 (and a ring, as of nuScenes); save it as .npy, shape (N, 3)"
        )
    table = possible[0]
    return cloud_of(_NAMES[: table.shape[1]], list(table.T))
