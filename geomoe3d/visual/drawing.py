"""Derived once, drawn by every display: thinned, centred points and the motions between them.

Each cloud is centred on itself in float64 and the motions are expressed between the centred clouds, so
that georeferenced coordinates (583394, 5283100, 498) survive the float32 of a graphics card. Cost: linear
in the points, plus a k-d tree of at most 200k target points where distances are asked for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from geomoe3d.geometry.se3 import make_transform, shift_frames, transform_points
from geomoe3d.types import FloatArray, IntArray
from geomoe3d.visual.upright import upright_axes
from geomoe3d.visual.view import RegistrationView

# Distinguishable with every common kind of colour blindness; the same in every display.
SOURCE_COLOR = "#e8790c"
TARGET_COLOR = "#2274c4"
KEPT_COLOR = "#0b9b6b"
REJECTED_COLOR = "#a9a9b0"
GROUP_COLORS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#8c6bb1", "#7f6000")
STATUS_COLORS = {"ok": "#18794e", "low_confidence": "#8a6100", "ambiguous": "#8a6100", "failed": "#c02626"}
STATUS_WORDS = {
    "ok": "ok",
    "low_confidence": "low confidence",
    "ambiguous": "ambiguous",
    "failed": "failed",
}


@dataclass(frozen=True)
class Drawing:
    """Points and motions in *drawing* coordinates: the target's file axes, about the target's centre.

    Attributes:
        source: (n, 3) source points minus ``source_center``, the source's file axes.
        target: (m, 3) target points minus ``target_center``.
        source_rows: (n,) rows of the view's source_points that are drawn.
        target_rows: (m,) rows of the view's target_points that are drawn.
        source_center: (3,) source file coordinates.
        target_center: (3,) target file coordinates.
        before: (4, 4) centred source -> drawing, nothing aligned.
        after: (4, 4) centred source -> drawing by the answer, or None where there is none.
        alternative: (4, 4) the same by the second hypothesis, or None.
        apart: distance of the two centres in the files where it is too far to be drawn; ``before`` then
            lays the source beside the target. None where ``before`` is what the files say.
        axes: (3, 3) rows right, forward, up in drawing coordinates, in which the target looks upright.
        up_words: the convention of the target's file, e.g. "z up".
        radius: half the size of the target and the moved source, cloud units, more than 0.
        spacing: typical distance between neighbouring drawn points, cloud units, more than 0.
    """

    source: FloatArray
    target: FloatArray
    source_rows: IntArray
    target_rows: IntArray
    source_center: FloatArray
    target_center: FloatArray
    before: FloatArray
    after: FloatArray | None
    alternative: FloatArray | None
    apart: float | None
    axes: FloatArray
    up_words: str
    radius: float
    spacing: float


def build_drawing(view: RegistrationView, *, max_points: int) -> Drawing:
    """Thin (seeded), centre and orient the clouds of a view.

    Args:
        view: what to show; rows with a non-finite coordinate are left out.
        max_points: drawn per cloud at most.
    """
    rng = np.random.default_rng(view.result.seed)
    source_rows = thin(view.source_points, max_points, rng)
    target_rows = thin(view.target_points, max_points, rng)
    source, target = view.source_points[source_rows], view.target_points[target_rows]
    source_center, target_center = _center(source), _center(target)
    axes, up_words = upright_axes(target, rng)
    source, target = source - source_center, target - target_center

    def between_centred(T: FloatArray) -> FloatArray:
        return shift_frames(T, -source_center, -target_center)

    source_radius, target_radius = _radius(source), _radius(target)
    before = between_centred(np.eye(4))
    distance = float(np.linalg.norm(before[:3, 3]))
    apart = None
    if len(source) and len(target) and distance > 3.0 * (source_radius + target_radius):
        apart = distance
        before = make_transform(np.eye(3), -1.1 * (source_radius + target_radius) * axes[0])
    after = between_centred(view.result.T_target_source) if view.has_transform else None
    other = view.result.alternative
    alternative = None
    if after is not None and other is not None and np.isfinite(other.T_target_source).all():
        alternative = between_centred(other.T_target_source)
    shown = [target]
    if len(source):
        shown.append(transform_points(before if after is None else after, source))
    return Drawing(
        source=source,
        target=target,
        source_rows=source_rows,
        target_rows=target_rows,
        source_center=source_center,
        target_center=target_center,
        before=before,
        after=after,
        alternative=alternative,
        apart=apart,
        axes=axes,
        up_words=up_words,
        radius=_radius(np.concatenate(shown)),
        spacing=spacing_of(target if len(target) >= len(source) else source),
    )


def thin(points: FloatArray, max_points: int, rng: np.random.Generator) -> IntArray:
    """Rows of at most ``max_points`` finite points, spread evenly over the surface rather than over the rows.

    A scanner measures near surfaces a thousand times denser than far ones; a plain random choice would show
    little else. So: a random choice of eight times as many, then one point per cell of the finest grid that
    leaves few enough. Returns sorted rows; all finite rows where there are few enough.
    """
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(rows) <= max_points:
        return rows
    if len(rows) > 8 * max_points:
        rows = rng.choice(rows, 8 * max_points, replace=False)
    else:
        rows = rng.permutation(rows)
    local = points[rows] - points[rows].min(axis=0)
    bulk = np.percentile(local, 99, axis=0) - np.percentile(local, 1, axis=0)  # strays may be very far away
    low, high = 0.0, float(bulk.max()) or 1.0  # cell edges that leave too many, and few enough
    cell = high / np.sqrt(max_points)
    for _ in range(8):
        occupied = len(np.unique(_cell_keys(local, cell)))
        if occupied > max_points:
            low = cell
        else:
            high = cell
            if occupied > 0.93 * max_points:
                break
        guess = cell * np.sqrt(occupied / (0.97 * max_points))  # scans are surfaces: cells go as 1 / edge^2
        cell = guess if low < guess < high else (low + high) / 2.0
    first = np.unique(_cell_keys(local, high), return_index=True)[1]
    return np.sort(rows[first[:max_points]])


def _cell_keys(points: FloatArray, cell: float) -> IntArray:
    """(N,) one integer per occupied cell of a grid; a rare collision only costs a drawn point."""
    return np.asarray(np.floor(points / cell).astype(np.int64) @ np.array([73856093, 19349663, 83492791]))


def distance_to_target(
    view: RegistrationView, drawing: Drawing, motion: FloatArray, limit: float
) -> FloatArray:
    """(n,) distance of each drawn, moved source point to the nearest target point, cloud units.

    The target is represented by at most 200k random points. Infinite where no target point lies within
    ``limit``, which saves most of the time.
    """
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(view.result.seed)
    target = view.target_points[np.isfinite(view.target_points).all(axis=1)]
    if not len(target) or not len(drawing.source):
        return np.full(len(drawing.source), np.inf)
    most = 200_000
    if len(target) > most:
        target = target[rng.choice(len(target), most, replace=False)]
    distance, _ = cKDTree(target - drawing.target_center).query(
        transform_points(motion, drawing.source), distance_upper_bound=limit
    )
    return np.asarray(distance)


def choose_rows(mask: np.ndarray[tuple[int], np.dtype[np.bool_]], most: int, seed: int) -> IntArray:
    """Sorted rows where ``mask`` holds, a seeded choice of them where they are more than ``most``."""
    rows = np.flatnonzero(mask)
    if len(rows) <= most:
        return rows
    return np.sort(np.random.default_rng(seed).choice(rows, most, replace=False))


def rgb(color: str) -> FloatArray:
    """(3,) red, green and blue in [0, 1] of a colour #rrggbb."""
    return np.array([int(color[i : i + 2], 16) / 255.0 for i in (1, 3, 5)])


def nice_length(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not longer than ``length`` (more than 0)."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(factor * power for factor in (1.0, 2.0, 5.0) if factor * power <= length * (1 + 1e-9)))


def camera_fit(*clouds: FloatArray) -> dict[str, Any]:
    """Middle (3,) and half size of the bulk of clouds in one frame, for a camera; as plain JSON."""
    points = np.concatenate([*clouds, np.zeros((0, 3))])
    center = _center(points)
    return {"center": center.tolist(), "radius": _radius(points - center)}


def spacing_of(points: FloatArray) -> float:
    """Typical distance of neighbouring points (n, 3), more than 0; 1 for fewer than two."""
    from scipy.spatial import cKDTree

    if len(points) < 2:
        return 1.0
    distance = np.asarray(cKDTree(points).query(points[:: max(1, len(points) // 2000)], k=2)[0])[:, 1]
    positive = distance[distance > 0]
    return float(np.median(positive)) if len(positive) else 1.0


def _center(points: FloatArray) -> FloatArray:
    """(3,) middle of the bulk, so that a few stray points do not move it; zeros for no points."""
    if not len(points):
        return np.zeros(3)
    return np.asarray(np.percentile(points, [1, 99], axis=0).mean(axis=0))


def _radius(points: FloatArray) -> float:
    if not len(points):
        return 1.0
    return float(np.percentile(np.linalg.norm(points, axis=1), 98)) or 1.0
