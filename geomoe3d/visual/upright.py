"""A frame in which a cloud looks upright: which way is up, and how the walls run.

Files differ: scanners write z up, games and some phones y up, depth cameras y down with z forward, and a
building rarely stands parallel to its axes. The frame found here only decides from where a cloud is looked
at, never a number of the result. Cost: neighbours of a few thousand points, about 50 ms.
"""

from __future__ import annotations

import numpy as np

from geomoe3d.types import FloatArray

# Rows right, forward, up; right x forward = up. The tilt is how far the file's up may be from the true one:
# scanners are levelled, hand-held cameras look down.
_CONVENTIONS: dict[str, tuple[FloatArray, float]] = {
    "z up": (np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]), 12.0),
    "y up": (np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]), 12.0),
    "camera, y down": (np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]), 40.0),
}


def upright_axes(points: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, str]:
    """Rows right, forward, up in the axes of the given points (file coordinates, not centred).

    Up is the axis that the file's convention suggests, turned to the nearest large plane (floor, table);
    right is the nearest direction perpendicular to many walls, else the long axis of the ground plan.

    Args:
        points: (N, 3) finite.
        rng: chooses the points whose normals are looked at.

    Returns:
        (3, 3) rotation with determinant +1, and the convention found: "z up", "y up" or "camera, y down".
        Fewer than 50 points give the file's own axes and "z up".
    """
    if len(points) < 50:
        return _CONVENTIONS["z up"][0].copy(), "z up"
    convention = _convention(points)
    base, tilt_deg = _CONVENTIONS[convention]
    normals = _normals(points, rng)
    up = _plane_direction(normals, base[2], tilt_deg)
    right = base[0] - up * (base[0] @ up)
    right /= np.linalg.norm(right)
    forward = np.cross(up, right)

    level = normals[np.abs(normals @ up) < 0.2]
    turn = 0.0
    if len(level) >= 30:  # walls: their normals repeat every 90 degrees
        fourfold = np.mean(np.exp(4j * np.arctan2(level @ forward, level @ right)))
        if np.abs(fourfold) > 0.2:
            turn = float(np.angle(fourfold)) / 4.0
    if turn == 0.0:
        plan = np.stack([points @ right, points @ forward])
        (a, b), (_, c) = np.cov(plan)
        spread = np.hypot((a - c) / 2.0, b)
        if spread > 0.2 * (a + c):  # clearly longer one way than the other
            long = 0.5 * np.arctan2(2.0 * b, a - c)
            turn = float((long + np.pi / 4.0) % (np.pi / 2.0) - np.pi / 4.0)
    turned = np.cos(turn) * right + np.sin(turn) * forward
    return np.stack([turned, np.cross(up, turned), up]), convention


def _convention(points: FloatArray) -> str:
    x, y, z = np.abs(points[:, 0]), np.abs(points[:, 1]), points[:, 2]
    low, high = np.percentile(z, [3, 97])
    in_front = np.mean((z > 0) & (x < 1.2 * z) & (y < 1.2 * z))
    if in_front > 0.95 and low < 0.6 * high:  # everything inside one field of view, at varied depth
        return "camera, y down"
    extent = np.ptp(np.percentile(points, [2, 98], axis=0), axis=0)
    # Rooms, streets and floors are wider than high; only a clear contradiction overrules z.
    return "y up" if extent[2] > 1.5 * extent[1] and extent[0] > 1.2 * extent[1] else "z up"


def _normals(points: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(n, 3) unit normals, sign arbitrary, of the flat ones among some randomly chosen points."""
    from scipy.spatial import cKDTree

    centred = points - points.mean(axis=0)
    chosen = rng.choice(len(points), size=min(2000, len(points)), replace=False)
    _, neighbours = cKDTree(centred).query(centred[chosen], k=16)
    patches = centred[neighbours]
    patches = patches - patches.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", patches, patches))
    flat = values[:, 0] < 0.1 * values[:, 1]
    return np.asarray(vectors[flat, :, 0])


def _plane_direction(normals: FloatArray, near: FloatArray, tilt_deg: float) -> FloatArray:
    """The most frequent normal within ``tilt_deg`` of ``near``; ``near`` itself where there is none."""
    signed = normals * np.where(normals @ near < 0, -1.0, 1.0)[:, None]
    candidates = signed[signed @ near > np.cos(np.radians(tilt_deg))]
    if len(candidates) < max(10, 0.04 * len(normals)):
        return near
    agree = candidates @ candidates.T > np.cos(np.radians(5.0))
    best = candidates[agree[agree.sum(axis=1).argmax()]].mean(axis=0)
    return np.asarray(best / np.linalg.norm(best))
