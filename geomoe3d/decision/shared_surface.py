"""Points of two clouds that lie on each other under a transform: what scale and accuracy are fitted to.

Both directions: each cloud's points beside the other's nearest ones, with gaps along the normals of the cloud that is
asked. One for all who ask about a pair; a question costs some 3 ms.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from geomoe3d.clouds.evidence import Met
from geomoe3d.config import expert
from geomoe3d.geometry.columns import crossed
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.runtime.threads import each
from geomoe3d.types import FloatArray, PreparedCloud


@dataclass(frozen=True)
class Contact:
    """Where two surfaces lie on each other; n rows, target local coordinates.

    Attributes:
        points: (n, 3) of the moved source.
        normals: (n, 3) that the gaps are measured along.
        gaps: (n,) from the source's surface to the target's.
        shares: of the source's points and of the target's that have a point of the other within reach, whichever
            way they face.
    """

    points: FloatArray
    normals: FloatArray
    gaps: FloatArray
    shares: tuple[float, float]


class SharedSurface:
    """Asks two clouds on one grid where they lie on each other; build once per pair.

    Attributes:
        source, target: the clouds.
    """

    def __init__(self, source: PreparedCloud, target: PreparedCloud) -> None:
        self.source, self.target = self._clouds = source, target
        known = expert().shared_surface
        self._asked, self._few = (
            tuple(drawn_rows(cloud.points, cloud.voxel_size, most) for cloud in self._clouds)
            for most in (known.most_asked, known.few_asked)
        )

    @cached_property
    def directions(self) -> tuple[FloatArray, FloatArray]:
        """`main_directions` of source and target."""
        ours, theirs = each(main_directions, self._clouds)
        return ours, theirs

    def contact(
        self, T_target_source: FloatArray, reach: float, scale: float = 1.0, *, few: bool = False
    ) -> Contact:
        """Points within ``reach``, cloud units, whose normals agree up to sign, under a similarity.

        Args:
            T_target_source: (4, 4) rigid part R, t of p_target = scale R p_source + t.
            reach: largest distance of points, in the target's units.
            scale: of the similarity.
            few: asks fewer points of each cloud.
        """
        (source, target), (rows, back_rows) = self._clouds, self._few if few else self._asked
        R, t = T_target_source[:3, :3], T_target_source[:3, 3]
        moved, turned = source.points @ (scale * R).T + t, source.normals @ R.T
        ours = Met.of(moved[rows], target.tree, reach)
        back = Met.of((target.points[back_rows] - t) @ R / scale, source.tree, reach / scale)
        first = np.concatenate([rows[ours.rows], back.nearest])
        second = np.concatenate([ours.nearest, back_rows[back.rows]])
        here, there = turned.take(first, axis=0), target.normals.take(second, axis=0)
        cosines = np.abs(np.einsum("ij,ij->i", here, there))
        there[len(ours.rows) :] = here[len(ours.rows) :]  # gaps are along normals of the cloud that is asked
        agree = np.flatnonzero(cosines > expert().shared_surface.least_cosine)
        points, normals = moved.take(first[agree], axis=0), there.take(agree, axis=0)
        gaps = np.einsum("ij,ij->i", target.points.take(second[agree], axis=0) - points, normals)
        return Contact(points, normals, gaps, (len(ours.rows) / len(rows), len(back.rows) / len(back_rows)))


def main_directions(cloud: PreparedCloud) -> FloatArray:
    """Unit normals (k, 3), of either sign, that many points share within some degrees; most shared first."""
    known = expert().parallel
    left = cloud.normals[drawn_rows(cloud.points, cloud.voxel_size, known.most_asked)]
    least = max(known.least_share * len(left), 3)
    near, wide = np.cos(np.radians([known.width_deg, 2 * known.width_deg]))
    found: list[FloatArray] = []
    while len(left) >= least and len(found) < known.most_directions:
        seeds = left[:: max(1, len(left) // known.num_seeds)]
        direction = seeds[(np.abs(seeds @ left.T) > near).sum(1).argmax()]
        for _ in range(known.shifts):
            weights = np.maximum((np.abs(left @ direction) - wide) / (1 - wide), 0.0) ** 2
            direction = np.linalg.eigh((left * weights[:, None]).T @ left)[1][:, -1]
        cosines = np.abs(left @ direction)
        inside, around = (cosines > near).sum(), (cosines > wide).sum()
        if around < least:
            break
        if inside >= known.least_density * around:  # else a round surface
            found.append(direction)
        left = left[cosines <= wide]
    return np.array(found).reshape(-1, 3)


def robust_weights(gaps: FloatArray, voxel_size: float) -> FloatArray:
    """(n,) in [0, 1], Tukey's: gaps beyond some robust deviations, ``cut``, count for nothing."""
    known = expert().shared_surface
    spread = max(1.4826 * float(np.median(np.abs(gaps))), known.least_deviation * voxel_size)
    weights: FloatArray = np.maximum(1 - (gaps / (known.cut * spread)) ** 2, 0.0) ** 2
    return weights


def distortion_of(
    X: FloatArray, normals: FloatArray, gaps: FloatArray, weights: FloatArray, radius: float
) -> float:
    """How differently the surfaces stretch along different directions: the norm of the strain without its trace.

    Args:
        X: (n, 3) points about their centre, over their radius.
        normals, gaps, weights: (n, 3), (n,), (n,).
        radius: cloud units.
    """
    (x, y, z), (u, v, w) = X.T, normals.T
    strain = np.stack([x * u, y * v, z * w, x * v + y * u, x * w + z * u, y * w + z * v], axis=1)
    fitted, _, _ = solved(np.hstack([crossed(X, normals), normals, strain]), gaps, weights)
    xx, yy, zz, xy, xz, yz = fitted[6:] / radius
    E = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return float(np.linalg.norm(E - np.trace(E) / 3 * np.eye(3)))


def solved(J: FloatArray, gaps: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Weighted least squares of J x = gaps, the inverse of the normal matrix, and the variance that is left."""
    weighted = J * weights[:, None]
    A = weighted.T @ J
    # What nothing holds stays where it is.
    inverse: FloatArray = np.linalg.inv(A + 1e-7 * np.trace(A) * np.eye(len(A)))
    x = inverse @ (weighted.T @ gaps)
    return x, inverse, float(weights @ (gaps - J @ x) ** 2 / weights.sum())
