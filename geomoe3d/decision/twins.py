"""Other places in which a scan that looks all around may lie as well: rooms that look alike after a half turn, rows.

A scan that sees a whole room fits into it as it stands and, where the room repeats, also turned about or moved on.
Matches show that place badly: seen from the same side, features are more alike than the same thing's from two sides,
so the wrong place may have nearly all of them. Surfaces know no sides: the source, turned by the right angles of
the target's walls, is laid on the target wherever most of both coincides. Place: decide, of answers that are likely.
Some 50 ms, and none for scans that look to one side. Of clouds that reach far what lies about the shared surface is
asked alone.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from geomoe3d.config import expert
from geomoe3d.decision.shared_surface import SharedSurface
from geomoe3d.geometry.se3 import make_transform, transform_points
from geomoe3d.types import FloatArray, PreparedCloud


def looks_around(cloud: PreparedCloud) -> bool:
    """Whether a cloud was seen to all sides, or by no one sensor."""
    if cloud.viewpoint is None:
        return True
    rays = cloud.points - cloud.viewpoint
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    return float((rays @ rays.mean(0) < 0).mean()) >= expert().twins.least_behind


def elsewhere(T_target_source: FloatArray, shared: SharedSurface) -> FloatArray:
    """(K, 4, 4) transforms under which the source lies elsewhere in the target, turned by right angles or moved on.

    Source: correlation of occupied cells, by fast Fourier transforms. Within a cell of where the surfaces lie best, to
    be refined; none where the target has no walls at right angles.

    Args:
        T_target_source: the answer, local coordinates.
        shared: of both clouds.
    """
    source, target = shared.source, shared.target
    axes = _axes(shared.directions[1])
    if axes is None:
        return np.zeros((0, 4, 4))
    known, cell = expert().twins, expert().twins.cell * target.voxel_size
    there, ours = target.points @ axes.T, transform_points(T_target_source, source.points) @ axes.T
    shared_points = shared.contact(T_target_source, cell).points @ axes.T
    there, ours = _around(shared_points, there, ours, cell)
    if not min(len(there), len(ours)):
        return np.zeros((0, 4, 4))
    found: list[tuple[float, FloatArray]] = []
    least = np.inf
    for turn in _right_turns():  # the first one turns nothing, and its best shift is the answer itself
        shifts, common = _shifts(there, ours @ turn.T, cell)
        least = min(least, known.least_common * common[0])
        for shift, count in zip(shifts, common, strict=True):
            other = np.trace(turn) < 3 or float(np.linalg.norm(shift)) > known.least_shift * cell
            if other and count >= least:
                moved = make_transform(axes.T @ turn @ axes, axes.T @ shift)
                found.append((count, moved @ T_target_source))
    found.sort(key=lambda one: -one[0])
    return np.array([T for _, T in found[: known.most_asked]]).reshape(-1, 4, 4)


def _around(
    shared: FloatArray, there: FloatArray, ours: FloatArray, cell: float
) -> tuple[FloatArray, FloatArray]:
    """Those of both clouds, (m, 3) and (n, 3), in the largest cube about the middle of what they share (k, 3) of which
    grids are small enough: few points far away would make them larger than any memory."""
    if not len(shared):
        return there[:0], ours[:0]
    middle = np.median(shared, axis=0)
    reach = max(float(np.abs(points - middle).max()) for points in (there, ours))
    while min(len(there), len(ours)):
        sizes = [np.ptp(points, axis=0) / cell + 1 for points in (there, ours)]
        grids = (np.prod(sizes[0] + np.abs(turn) @ sizes[1]) for turn in _right_turns())
        if max(grids) <= expert().twins.most_cells:
            break
        reach /= 2
        there, ours = (points[(np.abs(points - middle) <= reach).all(1)] for points in (there, ours))
    return there, ours


def _axes(directions: FloatArray) -> FloatArray | None:
    """(3, 3) unit rows at right angles, the first two main directions that are; None where there are none."""
    least = np.cos(np.radians(90 - expert().parallel.right_deg))
    for one, other in combinations(directions, 2):
        if abs(one @ other) < least:
            third = np.cross(one, other)
            third /= np.linalg.norm(third)
            return np.array([one, np.cross(third, one), third])
    return None


def _right_turns() -> list[FloatArray]:
    """No turn, and quarter and half turns about each axis, rotations (3, 3)."""
    turns = [np.eye(3)]
    for axis in range(3):
        quarter = np.eye(3)
        quarter[np.ix_([(axis + 1) % 3, (axis + 2) % 3], [(axis + 1) % 3, (axis + 2) % 3])] = [
            [0, -1],
            [1, 0],
        ]
        turns += [quarter, quarter @ quarter, quarter.T]
    return turns


def _shifts(there: FloatArray, ours: FloatArray, cell: float) -> tuple[FloatArray, FloatArray]:
    """(k, 3) shifts of ours (n, 3) by which most of its cells come to lie on cells of theirs (m, 3), best first, and
    how many do (k,)."""
    from scipy import fft

    known = expert().twins
    origins = there.min(0), ours.min(0)
    grids = []
    for points, origin in zip((there, ours), origins, strict=True):
        cells = np.floor((points - origin) / cell).astype(np.int64)
        grids.append(np.zeros(cells.max(0) + 1, dtype=np.float32))
        grids[-1][tuple(cells.T)] = 1
    sizes = [np.array(grid.shape) for grid in grids]
    shape = [fft.next_fast_len(int(size), real=True) for size in sizes[0] + sizes[1]]
    spectra = [fft.rfftn(grid, shape) for grid in grids]
    common = fft.irfftn(spectra[0] * np.conj(spectra[1]), shape)
    best, count = [], []
    for _ in range(known.most_shifts):
        at = np.array(np.unravel_index(int(common.argmax()), common.shape))
        count.append(common[tuple(at)])
        best.append(np.where(at < sizes[0], at, at - shape) * cell + origins[0] - origins[1])
        common[np.ix_(*((at[k] + np.arange(-2, 3)) % shape[k] for k in range(3)))] = 0
    return np.array(best), np.array(count)
