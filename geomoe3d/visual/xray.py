"""Both clouds projected onto a plane like an X-ray, as a raster of colours.

Each cloud's ink adds up along the line of sight, so that a wall seen edge-on is a dark line, a wall that is
doubled by a wrong transform is two, and a ceiling hides nothing; where both clouds lie on each other their
colours mix to a dark one.
"""

from __future__ import annotations

import numpy as np

from geomoe3d.types import FloatArray
from geomoe3d.visual.drawing import SOURCE_COLOR, TARGET_COLOR, rgb


def xray(
    source: FloatArray, target: FloatArray, center: FloatArray, half: FloatArray, unit: float, spacing: float
) -> FloatArray:
    """Both clouds projected onto a plane, as ink on white paper.

    Args:
        source, target: (N, 2) and (M, 2) right and up coordinates.
        center: (2,) middle of the picture.
        half: (2,) half its width and height.
        unit: cloud units per raster point.
        spacing: distance between neighbouring points; ink is spread to close the gaps.

    Returns:
        (rows, columns, 3) colours in [0, 1], first row at the top. White where no point falls.
    """
    columns, rows = np.maximum(np.round(2.0 * half / unit).astype(int), 1)
    paper = np.ones((rows, columns, 3))
    for points, color in ((source, SOURCE_COLOR), (target, TARGET_COLOR)):
        position = (points - (center - half)) / unit - 0.5
        ink = _ink(position, rows, columns, float(np.clip(0.7 * spacing / unit, 0.6, 2.5)))
        paper *= 1.0 - ink[:, :, None] * (1.0 - rgb(color))
    return paper[::-1]


def _ink(position: FloatArray, rows: int, columns: int, blur: float) -> FloatArray:
    """(rows, columns) in [0, 1): points spread over their four nearest raster points, blurred, saturating."""
    from scipy.ndimage import gaussian_filter

    density = np.zeros(rows * columns)
    corner = np.floor(position).astype(np.int64)
    rest = position - corner
    for right in (0, 1):
        for up in (0, 1):
            x, y = corner[:, 0] + right, corner[:, 1] + up
            share = np.abs(1 - right - rest[:, 0]) * np.abs(1 - up - rest[:, 1])
            inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
            density += np.bincount(
                y[inside] * columns + x[inside], weights=share[inside], minlength=rows * columns
            )
    smooth = np.asarray(gaussian_filter(density.reshape(rows, columns), blur))
    inked = smooth[smooth > 0.02 * smooth.max(initial=0.0)]
    if not len(inked):
        return smooth
    # A typical surface seen face-on takes 45 % of the ink; one seen edge-on, many times as dense, all of it.
    ink = 1.0 - np.exp(-0.6 * smooth / np.median(inked))
    return np.asarray(np.round(48.0 * ink) / 48.0)  # finer steps cannot be seen and double the file
