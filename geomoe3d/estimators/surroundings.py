"""What the surfaces around the points of correspondences say of pairs of them, and of motions.

Lengths alone say little where inliers are rare: one pair in fifteen of wrong correspondences preserves its
length by chance. A rigid motion also preserves in which plane each point lies and how the planes meet, as in
point pair features (Drost et al., CVPR 2010), and it puts no point where the other sensor looked through.

Place: solve; made by `geomoe3d.estimators.proposals` for the estimator. Cost for 1,000 correspondences: 3 ms
per scan where normals must be fitted to the keypoints, 10 ms for all pairs, 0.05 ms per motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomoe3d.clouds.keypoints import KeypointSurfaces
from geomoe3d.clouds.range_image import RangeImage
from geomoe3d.config import expert
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.runtime.threads import each
from geomoe3d.types import BoolArray, Correspondences, Float32Array, FloatArray, IntArray


@dataclass(frozen=True)
class Surroundings:
    """Normals at N correspondences, and what the two sensors saw where their places are known.

    Lengths are in inlier thresholds.

    Attributes:
        normals: (N, 3) float32 unit normals at the source and at the target points.
        signed: whether both are turned to their sensor; else only the lines of normals are compared.
        points: (N, 3) the source and the target points.
        views: what each sensor saw of its own points, or None.
    """

    normals: tuple[Float32Array, Float32Array]
    signed: bool
    points: tuple[FloatArray, FloatArray]
    views: tuple[RangeImage, RangeImage] | None

    @classmethod
    def of(
        cls, matched: Correspondences, inlier_threshold: float, surfaces: KeypointSurfaces | None = None
    ) -> Surroundings:
        """Of correspondences; where they bring no normals, planes are fitted to the points of each scan.

        Args:
            matched: N finite rows; normals and viewpoints are used where given.
            inlier_threshold: unit of length of the result, same unit as the points.
            surfaces: of the same, in that unit, where somebody has them already; asked where normals lack.
        """
        points = [side / inlier_threshold for side in np.hsplit(matched.points, 2)]
        places = matched.viewpoints or (None, None)
        if matched.normals is None:
            known = surfaces or KeypointSurfaces.of(matched.points, places, inlier_threshold)
            normals = [side.normals[row] for side, row in zip(known.sides, known.rows, strict=True)]
            source_view, target_view = (side.view for side in known.sides)
        else:
            normals = list(matched.normals)

            def view(number: int) -> RangeImage | None:
                place = places[number]
                if place is None:
                    return None
                return RangeImage.of(points[number], place / inlier_threshold, expert().keypoints.pixel_deg)

            source_view, target_view = each(view, (0, 1))
        (p, q), (n, m) = points, normals
        views = None if source_view is None or target_view is None else (source_view, target_view)
        # A zero normal says nothing against any plane or motion in particular.
        n, m = np.nan_to_num(n), np.nan_to_num(m)
        signed = matched.viewpoints is not None if matched.normals is None else matched.normals_signed
        return cls((n.astype(np.float32), m.astype(np.float32)), signed, (p, q), views)

    def take(self, rows: IntArray | BoolArray) -> Surroundings:
        """The same at some of the correspondences; what the sensors saw stays whole."""
        n, m = self.normals
        p, q = self.points
        return Surroundings((n[rows], m[rows]), self.signed, (p[rows], q[rows]), self.views)

    @cached_property
    def _outer(self) -> Float32Array:
        """(9, N) m_i n_j, so that a product with R gives m . R n."""
        n, m = self.normals
        return np.ascontiguousarray((m[:, :, None] * n[:, None, :]).reshape(-1, 9).T)

    def of_pairs(
        self, source: Float32Array, target: Float32Array
    ) -> Callable[[slice, Float32Array], Float32Array]:
        """How well the planes of two correspondences lie to each other in both scans, in [0.1, 1].

        Args:
            source: (N, 3) points near zero, in inlier thresholds.
            target: (N, 3) likewise.

        Returns:
            Of n rows, and the distances (n, m) of their source points from those of the first of them and all after
            it: (n, m).
        """
        places = [np.hstack([x, np.ones_like(x[:, :1])]) for x in (source, target)]
        planes = [
            np.hstack([n, -np.einsum("ni,ni->n", n, x)[:, None]])
            for n, x in zip(self.normals, (source, target), strict=True)
        ]
        known = expert().surroundings
        # Source and negated target side by side: one product gives the difference.
        (places_left, places_right), (planes_left, planes_right), (left, right) = (
            (np.hstack([one, -other]), np.hstack([one, other]))
            for one, other in (places, planes, self.normals)
        )

        def agreement(rows: slice, apart: Float32Array) -> Float32Array:
            # Heights of each point over the plane of a row.
            error = self._difference(planes_left, places_right, rows)
            error *= error
            other = self._difference(places_left, planes_right, rows)
            other *= other
            error += other
            np.maximum(apart, 1.0, out=other)
            other *= other
            other *= np.float32(-2 * known.plane_sigma**2)
            error /= other
            turn = self._difference(left, right, rows)
            turn *= turn
            turn *= np.float32(-0.5 / known.turn_sigma**2)
            error += turn
            np.exp(error, out=error)
            error *= np.float32(1 - known.least_agreement)
            error += np.float32(known.least_agreement)
            return error

        return agreement

    def _difference(self, left: Float32Array, right: Float32Array, rows: slice) -> Float32Array:
        """left right^T of some rows and all from the first of them on, (N, 2k) of source and target side by side; where
        signs mean nothing that of the magnitudes of both products."""
        rest = slice(rows.start, None)
        if self.signed:
            found: Float32Array = left[rows] @ right[rest].T
            return found
        half = left.shape[1] // 2
        found = np.abs(left[rows, :half] @ right[rest, :half].T)
        found -= np.abs(left[rows, half:] @ right[rest, half:].T)
        return found

    def matched(self, R: NDArray[Any]) -> Float32Array:
        """Weights (K, N) in [0.05, 1] of correspondences whose normals meet at a cosine c: 0.3 + 0.7 c.

        Args:
            R: (K, 3, 3) rotations of the source.
        """
        cosine: Float32Array = R.reshape(-1, 9).astype(np.float32, copy=False) @ self._outer
        if not self.signed:
            np.abs(cosine, out=cosine)
        known = expert().surroundings
        cosine *= np.float32(known.matched_slope)
        cosine += np.float32(known.matched_floor)
        np.maximum(cosine, np.float32(known.matched_least), out=cosine)
        return cosine

    def plausibility(self, R: NDArray[Any], t: FloatArray) -> FloatArray:
        """Factors (K,) in [0.02, 1] of motions: exp(-32 v), v how deep points lie in the other's free space.

        v is the mean over the points asked, summed over both scans; a depth counts from one threshold on, up
        to 8, as a share of that; beyond 30 thresholds from the sensor depths are shortened by range / 30. 1
        where the sensors' places are not known.

        Args:
            R: (K, 3, 3).
            t: (K, 3) in inlier thresholds, in the frames of the correspondences.
        """
        if self.views is None:
            return np.ones(len(R))
        (source_view, target_view), known = self.views, expert().surroundings
        rows = drawn_rows(np.hstack(self.points), 1.0, known.most_asked)
        p, q = (points[rows] for points in self.points)
        # R p + t of all motions as one product: einsum takes six times as long.
        moved = _turned(p, R) + t
        back = _turned(q, R.transpose(0, 2, 1)) - np.einsum("kji,kj->ki", R, t)
        asked = [(target_view, moved), (source_view, back)]
        one, other = each(lambda pair: _depth_in_front(*pair), asked)
        through = np.exp(-known.violation_weight * (one + other))
        factors: FloatArray = np.maximum(through, known.least_plausibility)
        return factors


def _turned(points: FloatArray, R: NDArray[Any]) -> FloatArray:
    """(n, K, 3) points (n, 3) under rotations (K, 3, 3)."""
    found: FloatArray = (points @ R.reshape(-1, 3).T).reshape(len(points), len(R), 3)
    return found


def _depth_in_front(view: RangeImage, points: FloatArray) -> FloatArray:
    """Mean over n points of (n, K, 3), for each K, of how far beyond the threshold they lie in front."""
    margin, distance = view.margins(points)
    known = expert().surroundings
    np.maximum(distance / known.near, 1.0, out=distance)  # what depths are shortened by
    # Where nothing was seen the margin is infinite, and no depth in front.
    depth = np.clip(-margin / distance - 1, 0, known.deepest) / known.deepest
    means: FloatArray = depth.mean(0)
    return means
