"""What correspondences, and the surfaces that their points lie on, say of given motions.

Lengths alone cannot tell the true motion from a chance agreement when inliers are rare. Under a hypothesis
there is more to ask: do the keypoints of one scan lie on the surface that those of the other trace, do the
normals agree, and does any of them float where the other scan's sensor looked through? All of it is
computed from the correspondences' own points, so it works for anybody's correspondences; without the
sensors' places the free-space channels are zero. The channels do not change when either scan is moved, but
for the free-space ones, whose pixels lie otherwise then.

Cost: about 10 ms, and 1 ms per motion, for 1,000 correspondences.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomoe3d.clouds.evidence import Met, kernel
from geomoe3d.clouds.keypoints import KeypointSurfaces, Surface
from geomoe3d.estimators.compatibility import bundle_weights, distance_factors, distances
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.runtime.threads import each
from geomoe3d.types import Float32Array, FloatArray

CHANNELS = (
    "residual_narrow", "residual", "residual_wide", "vote", "degree",
    "source_near", "source_in_plane", "source_normal", "source_seen", "source_in_front", "source_on_view",
    "target_near", "target_in_plane", "target_normal", "target_seen", "target_in_front", "target_on_view",
    "matched_normals", "source_planarity", "target_planarity", "source_range", "target_range",
)  # fmt: skip
"""Per correspondence, r its residual in inlier thresholds:

- residual_narrow, residual, residual_wide: exp(-r^2 / (2 s^2)) with s = 0.375, 0.75, 2.
- vote: 1 / sqrt(number of correspondences that share the target); degree: 5 x the share of correspondences
  with which this one preserves length; in [0, 5].
- source_near, source_in_plane, source_normal: for the source point under the motion, the same of its distance
  to the nearest target keypoint (s = 1.5, 0 beyond 3 thresholds), of its distance to that keypoint's plane
  (s = 0.5), and the cosine of the two normals. source_seen: 1 where the target's sensor saw something in its
  direction; source_in_front: how far in front of that, in [0, 1]; source_on_view: how well upon it. target_*:
  the same of the target point in the source's frame.
- matched_normals: cosine of the two matched points' normals; source_planarity, target_planarity: in [0, 1];
  source_range, target_range: distance from the sensor over 40 thresholds, at most 2.
"""

NUM_CHANNELS = len(CHANNELS)
PRIOR_KERNEL = math.exp(-0.5 / 0.75**2)
"""The channel ``residual`` at a residual of one inlier threshold: the network's first prior is what lies below."""


class AlignedChannels:
    """Channels of the correspondences of one pair under any motions; build once per pair.

    Args:
        correspondences: (N, 6) rows [source xyz, target xyz].
        viewpoints: (3,) places of the two sensors, or None for both.
        inlier_threshold: same unit.
        surfaces: of the same, in inlier thresholds, where somebody has them already.
    """

    def __init__(
        self,
        correspondences: FloatArray,
        viewpoints: tuple[FloatArray | None, FloatArray | None],
        inlier_threshold: float,
        surfaces: KeypointSurfaces | None = None,
    ) -> None:
        rows = correspondences / inlier_threshold
        self._threshold = inlier_threshold
        self.rows = rows

        degree = each(lambda job: job(), _degree_jobs(rows))
        known = surfaces or KeypointSurfaces.of(correspondences, viewpoints, inlier_threshold)
        self.source, self.target = known.sides
        self._source_row, self._target_row = known.rows
        self._fixed = self._constant_channels(np.concatenate(degree))

    def _constant_channels(self, degree: Float32Array) -> dict[str, NDArray[Any]]:
        found: dict[str, NDArray[Any]] = {"vote": bundle_weights(self.rows[:, 3:]), "degree": degree}
        for name, surface, row in (
            ("source", self.source, self._source_row),
            ("target", self.target, self._target_row),
        ):
            found[f"{name}_planarity"] = surface.planarity[row]
            reach = np.zeros(len(surface.points))
            if surface.viewpoint is not None:
                reach = np.linalg.norm(surface.points - surface.viewpoint, axis=1) / 40
            found[f"{name}_range"] = np.minimum(reach, 2)[row]
        return found

    def __call__(self, R: FloatArray, t: FloatArray) -> Float32Array:
        """(K, N, C) float32 for K motions p_target = R p_source + t.

        Args:
            R: (K, 3, 3).
            t: (K, 3) in the unit of the correspondences.
        """
        if len(R) == 0:
            return np.zeros((0, len(self.rows), NUM_CHANNELS), dtype=np.float32)
        t = t / self._threshold
        K, N = len(R), len(self.rows)
        out = np.zeros((K, N, NUM_CHANNELS), dtype=np.float32)
        column = {name: i for i, name in enumerate(CHANNELS)}
        for name, values in self._fixed.items():
            out[:, :, column[name]] = values
        moved = np.einsum("kij,nj->kni", R, self.source.points) + t[:, None]
        gap = moved[:, self._source_row] - self.rows[None, :, 3:]
        r2 = np.einsum("kni,kni->kn", gap, gap)
        for name, sigma in (("residual_narrow", 0.375), ("residual", 0.75), ("residual_wide", 2.0)):
            out[:, :, column[name]] = kernel(r2 / sigma**2)
        turned = np.einsum("kij,nj->kni", R, self.source.normals)
        matched = np.einsum("kni,ni->kn", turned[:, self._source_row], self.target.normals[self._target_row])
        back = np.einsum("kji,knj->kni", R, self.target.points[None] - t[:, None])
        signed = self.source.view is not None and self.target.view is not None
        out[:, :, column["matched_normals"]] = matched if signed else np.abs(matched)
        for name, points, normals, row, other in (
            ("source", moved, turned, self._source_row, self.target),
            ("target", back, np.einsum("kji,nj->kni", R, self.target.normals), self._target_row, self.source),
        ):
            for key, values in _ask(points, normals, other, signed).items():
                out[:, :, column[f"{name}_{key}"]] = values.reshape(K, -1)[:, row]
        return out


def _degree_jobs(rows: FloatArray) -> list[Callable[[], Float32Array]]:
    """Parts of (N,): 5 x the share of at most 1,000 correspondences with which each one preserves length."""
    unit = (rows - rows.mean(0)).astype(np.float32)
    chosen = drawn_rows(rows, 1.0, 1000)
    anchors, is_anchor = unit[chosen], np.isin(np.arange(len(unit)), chosen)

    (p, q), (p_anchors, q_anchors) = (
        [distance_factors(side)[k] for side in np.hsplit(some, 2)] for k, some in enumerate((unit, anchors))
    )
    at_once = 125  # rows

    def part(start: int) -> Float32Array:
        some = slice(start, start + at_once)
        itself = is_anchor[some]  # only an anchor meets itself
        gap = distances(p[some], p_anchors)
        gap -= distances(q[some], q_anchors)
        compatible = np.abs(gap, out=gap) < 1.0
        share: Float32Array = (5 * (compatible.sum(1) - itself) / len(anchors)).astype(np.float32)
        return share

    return [partial(part, start) for start in range(0, len(unit), at_once)]


def _ask(points: FloatArray, normals: FloatArray, surface: Surface, signed: bool) -> dict[str, FloatArray]:
    """What a surface says of points (K, n, 3) with normals that are claimed to exist in its frame."""
    met = Met.of(points, surface.tree, 3.0)  # inlier thresholds
    near, plane, cosine = np.zeros((3, points.size // 3))
    near[met.rows] = kernel((met.distance / 1.5) ** 2)
    plane[met.rows] = kernel((met.heights(points, surface.points, surface.normals) / 0.5) ** 2)
    cosine[met.rows] = met.cosines(normals, surface.normals, signed)
    found = {"near": near, "in_plane": plane, "normal": cosine}
    seen, front, on = np.zeros((3, *points.shape[:-1]))
    if surface.view is not None:
        margin, _ = surface.view.margins(points)
        seen = np.isfinite(margin).astype(np.float64)
        front = np.clip(-margin - 1, 0, 8) / 8
        on = seen * kernel(margin**2)
    return {**found, "seen": seen, "in_front": front, "on_view": on}
