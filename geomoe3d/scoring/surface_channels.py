"""What the points of two clouds show of each other under given transforms, one row of numbers per point.

`scoring/surfaces.py` sums up what it asks; here nothing is summed, so that a network can tell a wall that lies on a
wall from a room that lies on itself. Asked are points of both clouds alike, each in the other's frame. What it
costs stands in docs/network.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomoe3d.clouds.evidence import Met, kernel
from geomoe3d.clouds.pair import Pair
from geomoe3d.clouds.range_image import RangeImage
from geomoe3d.features.learned import LEARNED
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.geometry.se3 import inverse
from geomoe3d.runtime.threads import each
from geomoe3d.types import Float32Array, FloatArray, PreparedCloud

NUM_POINTS = 768
RAW = (
    "hit", "distance", "off_plane", "normal", "similarity", "fpfh", "better_there", "better_here", "surprise",
    "seen", "margin", "planarity", "planarity_there", "range", "best",
)  # fmt: skip
"""Per point x of one cloud under a transform, y its nearest point of the other one; lengths in inlier thresholds:

- hit: whether y lies within 3; distance: to y, at most 3; off_plane: to the plane at y, at most 3.
- normal: cosine of both normals, its magnitude where the sensors are not known.
- similarity: of the features of x and y; fpfh: of their FPFH alone; better_there: how much more similar another point
  of y's cloud is to x; better_here: how much more similar a point of x's cloud is to y; surprise: -ln p that a random
  point of y's cloud is as similar to x; best: largest similarity of x to any point there.
- seen: whether the other sensor saw something in the direction of x; margin: how far behind that x lies, negative in
  front of it, at most 20; 0 where not seen.
- planarity, planarity_there: mean cosine of the normals around x, and around y.
- range: distance of x from its own sensor over 40.
"""
NUM_RAW = len(RAW)
NUM_CHANNELS = 19
_REACH = 3.0


@dataclass(frozen=True)
class _Side:
    """Points of one cloud, and the other cloud in which they are sought."""

    points: FloatArray
    normals: FloatArray
    features: Float32Array
    other: PreparedCloud
    similarity: Float32Array
    best: Float32Array
    best_there: Float32Array
    of_random: Float32Array
    planarity: FloatArray
    planarity_there: FloatArray
    away: FloatArray
    view: RangeImage | None


class SurfaceChannels:
    """Raw channels of a pair under any transforms; build once per pair.

    Args:
        pair: its clouds with features of the learned descriptor; sensors by ``matched.viewpoints``, or not known.
    """

    def __init__(self, pair: Pair) -> None:
        clouds, self._threshold = pair.clouds, pair.inlier_threshold
        places = pair.matched.viewpoints
        self._signed = places is not None
        # Small clouds give points twice, so that there are always as many.
        rows = [np.resize(drawn_rows(c.points, pair.voxel_size, NUM_POINTS, 3), NUM_POINTS) for c in clouds]
        planarity = each(_planarity, clouds)

        def side(k: int) -> _Side:
            cloud, other = clouds[k], clouds[1 - k]
            assert cloud.features is not None and other.features is not None
            points, features = cloud.points[rows[k]], cloud.features[rows[k]]
            random = drawn_rows(other.points, pair.voxel_size, 256, 4)
            similarity = features @ other.features.T
            away = np.zeros(NUM_POINTS)
            view = None
            if places is not None:
                away = np.linalg.norm(points - places[k], axis=1) / self._threshold / 40
                view = RangeImage.of(other.points, places[1 - k], 2.5)  # degrees, as the network was trained
            return _Side(
                points,
                cloud.normals[rows[k]],
                features,
                other,
                similarity,
                similarity.max(1),
                similarity.max(0),
                similarity[:, random],
                planarity[k][rows[k]],
                planarity[1 - k],
                away,
                view,
            )

        self._sides = each(side, (0, 1))

    def __call__(self, transforms: FloatArray) -> Float32Array:
        """(K, 2, `NUM_POINTS`, `NUM_RAW`) for transforms (K, 4, 4) in local coordinates: source, then target."""
        back = np.array([inverse(T) for T in transforms]).reshape(-1, 4, 4)
        asked = [(self._sides[0], transforms), (self._sides[1], back)]
        return np.stack(each(lambda one: self._ask(*one), asked), axis=1)

    def _ask(self, side: _Side, motions: FloatArray) -> Float32Array:
        R, t, other = motions[:, :3, :3], motions[:, None, :3, 3], side.other
        shape = (len(motions), NUM_POINTS)
        moved = side.points @ R.transpose(0, 2, 1) + t
        turned = side.normals @ R.transpose(0, 2, 1)
        reach = _REACH * self._threshold
        met = Met.of(moved, other.tree, reach)
        hit, y, distance, off, cosine = (
            np.zeros(shape, kind) for kind in (bool, np.int64, float, float, float)
        )
        hit.flat[met.rows], y.flat[met.rows], distance.flat[met.rows] = True, met.nearest, met.distance
        off.flat[met.rows] = np.abs(met.heights(moved, other.points, other.normals))
        cosine.flat[met.rows] = met.cosines(turned, other.normals, self._signed)
        x = np.broadcast_to(np.arange(NUM_POINTS), shape)
        similar = side.similarity[x, y]
        assert other.features is not None
        # Of the features that the network was trained with 0.3 were FPFH.
        fpfh = np.einsum("kni,kni->kn", side.features[x, LEARNED:], other.features[y, LEARNED:]) / 0.3
        more_similar = np.count_nonzero(side.of_random[None] > similar[:, :, None], axis=2)
        seen: FloatArray = np.zeros(shape)
        margin: FloatArray = np.zeros(shape)
        if side.view is not None:
            behind, _ = side.view.margins(moved)
            saw = np.isfinite(behind)
            seen = saw.astype(np.float64)
            margin = np.clip(np.where(saw, behind, 0.0) / self._threshold, -20.0, 20.0)
        columns = (
            hit,
            np.where(hit, distance, reach) / self._threshold,
            np.minimum(off / self._threshold, _REACH),
            cosine,
            similar,
            fpfh,
            side.best - similar,
            side.best_there[y] - similar,
            -np.log((1 + more_similar) / (1 + side.of_random.shape[1])),
            seen,
            margin,
            np.broadcast_to(side.planarity, shape),
            side.planarity_there[y],
            np.broadcast_to(side.away, shape),
            np.broadcast_to(side.best, shape),
        )
        return np.stack([np.asarray(c, dtype=np.float32) for c in columns], axis=2)


def channels_of(raw: Float32Array) -> Float32Array:
    """(..., `NUM_CHANNELS`) what the network sees of raw channels (..., `NUM_RAW`): kernels of the lengths, and nothing
    of what was not hit."""
    (hit, r, off, normal, similarity, fpfh, there, here, surprise, seen, margin, planarity, planarity_there, away,
     best) = np.moveaxis(raw, -1, 0)  # fmt: skip
    near, wide, in_plane, on_view = (kernel(x * x, -np.inf) for x in (r / 0.5, r / 1.5, off / 0.3, margin))
    near, surprise = near * hit, surprise / 5
    columns = (
        hit, near, wide * hit, in_plane * hit, normal * hit, similarity * hit, fpfh * hit,
        there * hit, here * hit, surprise * hit, surprise * near, seen, seen * np.clip(-margin - 1, 0, 8) / 8,
        seen * on_view, seen * np.clip(margin - 1, 0, 8) / 8, planarity, planarity_there * hit, away, best,
    )  # fmt: skip
    return np.stack(columns, axis=-1)


def _planarity(cloud: PreparedCloud) -> FloatArray:
    """(n,) mean magnitude of the cosines between a point's normal and those around it."""
    _, around = cloud.tree.query(cloud.points, k=min(12, len(cloud)))
    around = np.asarray(around).reshape(len(cloud), -1)
    found: FloatArray = np.abs(np.einsum("nki,ni->nk", cloud.normals[around], cloud.normals)).mean(1)
    return found
