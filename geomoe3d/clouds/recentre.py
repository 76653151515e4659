"""Where a cloud's local frame lies: a whole-unit float64 shift that makes coordinates small and exact.

Single precision and the libraries that use it lose decimetres at map coordinates such as (583394, 5283100,
498). Everything after loading therefore works on points minus an origin. O(N) time, one column of extra
memory.
"""

from __future__ import annotations

import numpy as np

from geomoe3d.config import expert
from geomoe3d.types import FloatArray


def choose_origin(points: FloatArray) -> FloatArray:
    """The shift to remove from points: zero near zero, else the median rounded to whole units.

    The spread of a cloud is the largest, over the axes, of its 5 % to 95 % range, which a few stray points
    do not move. A cloud is near zero when no coordinate of its median exceeds 10 spreads: a float32 then
    rounds its points by less than 1e-6 of the spread (6e-8 * 11), and the file's zero, often the sensor,
    stays in place.

    Far from zero, subtracting whole units from float64 coordinates is exact, and so is adding them again.
    Rounding is floor(median + 1/2), so a copy moved by whole units gets an origin moved by the same units
    and, up to the rounding of the copy's own coordinates, the same local points; a copy moved by a fraction
    differs by at most one unit. The order of the points does not matter.

    Args:
        points: (N, 3) finite file coordinates, N >= 1.

    Returns:
        (3,) whole numbers.
    """
    median, spread = _median_and_spread(points)
    if float(np.abs(median).max()) <= expert().loading.near_zero * spread:
        return np.zeros(3)
    origin: FloatArray = np.floor(median + 0.5)
    return origin + 0.0  # no negative zeros


def fits_single_precision(points: FloatArray) -> bool:
    """Whether float32 moves no coordinate of points (N, 3), N >= 1, by more than 1e-6 of the spread."""
    _, spread = _median_and_spread(points)
    with np.errstate(over="ignore"):
        return all(
            float(np.abs(points[:, k].astype(np.float32) - points[:, k]).max()) <= 1e-6 * spread
            for k in range(3)
        )


def _median_and_spread(points: FloatArray) -> tuple[FloatArray, float]:
    tail = expert().loading.outside_spread
    low, median, high = np.array([np.percentile(points[:, k], (tail, 50, 100 - tail)) for k in range(3)]).T
    return median, float(np.max(high - low))
