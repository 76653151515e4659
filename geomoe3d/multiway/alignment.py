"""All scans of a group laid on each other at once: the points of each into the surfaces of all it overlaps.

Place: after the pose graph, which knows of every pair one motion and how firmly it was held; here the
surfaces themselves decide, so that the error of one pair is not handed on along a chain. Point-to-plane
Gauss-Newton over the poses of all scans with a robust weight, the reach shrinking from step to step. Cost:
about 1 ms per overlapping pair and step, some 8 s for 60 scans.
Source: multiview registration after Pulli, 3DIM 1999, with the linearised point-to-plane error of Chen and
Medioni, 1992, and the weights of Geman and McClure.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from geomoe3d.config import expert
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.geometry.se3 import cross_matrix, inverse, make_transform, project_to_so3, transform_points
from geomoe3d.multiway.overlaps import Overlaps
from geomoe3d.runtime.threads import single_blas_thread
from geomoe3d.types import FloatArray, IntArray, PreparedCloud


@dataclass(frozen=True)
class Surface:
    """A scan as the alignment sees it, local coordinates.

    Attributes:
        points: (N, 3) voxel points.
        normals: (N, 3) unit normals.
        signed: whether normals point to the sensor, so that the two sides of a wall differ.
    """

    points: FloatArray
    normals: FloatArray
    signed: bool

    @classmethod
    def of(cls, cloud: PreparedCloud) -> Surface:
        """Of a prepared cloud."""
        return cls(cloud.points, cloud.normals, cloud.viewpoint is not None)

    @cached_property
    def tree(self) -> Any:
        """A `scipy.spatial.cKDTree` of the points, built when first asked."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points)


@single_blas_thread()
def align_scans(
    poses: Mapping[int, FloatArray],
    surfaces: Mapping[int, Surface],
    overlaps: Overlaps,
    voxel_size: float,
    *,
    seed: int = 0,
) -> dict[int, FloatArray]:
    """Poses T_group_scan (4, 4) at which the scans lie in each other's surfaces best.

    Args:
        poses: start, right to about three voxels; local coordinates. The smallest number stays in place.
        surfaces: of these scans.
        overlaps: tells which of them see the same.
        voxel_size: of the common grid, cloud units.
        seed: decides which points are asked.

    Returns:
        The poses; a scan that overlaps no other by its pose stays where it was.
    """
    scans = sorted(poses)
    most = expert().many_poses.num_points
    chosen = {k: drawn_rows(surfaces[k].points, voxel_size, most, seed) for k in scans}
    centers = {k: surfaces[k].points.mean(0) for k in scans}
    radius = float(np.median([np.sqrt(surfaces[k].points.var(0).sum()) for k in scans]))
    current = {k: np.array(poses[k]) for k in scans}
    pairs: list[tuple[int, int]] = []
    asked: dict[int, IntArray] = {}
    for number, reach in enumerate(expert().many_poses.reaches):
        if number in (0, expert().many_poses.neighbors_again):
            pairs = _overlapping(current, overlaps)
            count = Counter(source for source, _ in pairs)
            asked = {k: _thinned(chosen[k], count[k]) for k in scans}
        about = {k: transform_points(current[k], centers[k][None])[0] for k in scans}
        system = _System(scans, {k: _lever(about[k], radius) for k in scans})
        for source, target in pairs:
            pull = _pull(
                surfaces[source], surfaces[target], asked[source],
                current[source], current[target], reach * voxel_size,
            )  # fmt: skip
            system.add(source, target, *pull)
        for scan, step in system.solve().items():
            current[scan] = _moved(current[scan], step[:3] / radius, step[3:], about[scan])
    # All may have drifted together; everything is told from where the first scan was.
    back = poses[scans[0]] @ inverse(current[scans[0]])
    return {k: back @ T for k, T in current.items()}


@single_blas_thread()
def align_groups(
    a: Mapping[int, FloatArray],
    b: Mapping[int, FloatArray],
    T_a_b: FloatArray,
    surfaces: Mapping[int, Surface],
    overlaps: Overlaps,
    voxel_size: float,
) -> FloatArray:
    """The motion T_a_b (4, 4) at which two groups, each rigid, lie in each other's surfaces best.

    Args:
        a, b: poses T_group_scan of their scans.
        T_a_b: start, right to about three voxels.
        surfaces, overlaps, voxel_size: as in `align_scans`.
    """
    shared = [
        (overlaps.of(j, i, inverse(a[i]) @ T_a_b @ b[j]), i, j)
        for i in a
        for j in b
        if i in surfaces and j in surfaces
    ]
    known = expert().many_poses
    pairs = [
        (i, j) for o, i, j in sorted(shared, reverse=True)[: known.most_pairs] if o >= known.least_overlap
    ]
    count = Counter(j for _, j in pairs)
    chosen = {
        j: _thinned(drawn_rows(surfaces[j].points, voxel_size, known.num_points), count[j]) for j in count
    }
    T = T_a_b
    for reach in known.group_reaches if pairs else ():
        A, slope = np.zeros((6, 6)), np.zeros(6)
        about = np.mean(
            [transform_points(T @ b[j], surfaces[j].points.mean(0)[None])[0] for _, j in pairs], axis=0
        )
        lever = _lever(about, 1.0)
        for i, j in pairs:
            one, two = _pull(surfaces[j], surfaces[i], chosen[j], T @ b[j], a[i], reach * voxel_size)
            A += lever.T @ one @ lever
            slope += lever.T @ two
        damping = expert().many_poses.damping * float(np.trace(A)) / 6
        if damping <= 0:
            break
        step: FloatArray = np.linalg.solve(A + damping * np.eye(6), slope).astype(np.float64)
        T = _moved(T, step[:3], step[3:], about)
    return T


class _System:
    """Normal equations over small motions of all scans, each about its own centre.

    Args:
        scans: their numbers.
        levers: (6, 6) by scan, from `_lever`.
    """

    def __init__(self, scans: list[int], levers: Mapping[int, FloatArray]) -> None:
        self._place = {scan: n for n, scan in enumerate(scans)}
        self._levers = levers
        self._blocks: dict[tuple[int, int], FloatArray] = {}
        self._slope = np.zeros((len(scans), 6))

    def add(self, source: int, target: int, A: FloatArray, b: FloatArray) -> None:
        """Curvature (6, 6) and slope (6,) of one pair: the source is drawn by b, the target pulled back."""
        for one, sign in ((source, 1.0), (target, -1.0)):
            self._slope[self._place[one]] += sign * self._levers[one].T @ b
            for other, same in ((source, 1.0), (target, -1.0)):
                key = self._place[one], self._place[other]
                block = sign * same * self._levers[one].T @ A @ self._levers[other]
                self._blocks[key] = self._blocks.get(key, 0.0) + block

    def solve(self) -> dict[int, FloatArray]:
        """Damped steps (6,) [rotation vector, translation] in the units of the levers, by scan."""
        from scipy.sparse import coo_matrix, identity
        from scipy.sparse.linalg import spsolve

        count = 6 * len(self._slope)
        keys = np.array(list(self._blocks), dtype=np.int64).reshape(-1, 2)
        rows, columns = np.mgrid[:6, :6]
        values = np.array(list(self._blocks.values())).reshape(-1, 6, 6)
        where = (6 * keys[:, 0, None, None] + rows).ravel(), (6 * keys[:, 1, None, None] + columns).ravel()
        H = coo_matrix((values.ravel(), where), shape=(count, count)).tocsc()
        damping = expert().many_poses.damping * float(H.diagonal().mean())
        if damping <= 0:  # nothing overlaps
            return {}
        found = spsolve(H + damping * identity(count, format="csc"), self._slope.ravel()).reshape(-1, 6)
        return {scan: found[n] for scan, n in self._place.items()}


def _thinned(rows: IntArray, neighbors: int) -> IntArray:
    """Every so many of some rows, so that a scan with many neighbours is asked no more often than others."""
    most = max(expert().many_poses.points_in_all // max(neighbors, 1), 1)
    return rows[:: -(-len(rows) // most)] if len(rows) else rows


def _overlapping(poses: Mapping[int, FloatArray], overlaps: Overlaps) -> list[tuple[int, int]]:
    """Pairs (source, target), both ways, of scans that see the same by the poses.

    All of them: with the nearest alone, scans of one place hold each other and let go of the next place.
    """
    return [
        (source, target)
        for source in poses
        for target in poses
        if source != target
        and overlaps.of(source, target, inverse(poses[target]) @ poses[source])
        >= expert().many_poses.least_overlap
    ]


def _pull(
    source: Surface,
    target: Surface,
    chosen: IntArray,
    T_source: FloatArray,
    T_target: FloatArray,
    reach: float,
) -> tuple[FloatArray, FloatArray]:
    """Curvature (6, 6) and slope (6,), about the group's origin, by which a source is drawn into a target.

    Args:
        source, target: the scans.
        chosen: (n,) points of the source that are asked.
        T_source, T_target: poses T_group_scan.
        reach: points farther from the target do not count, cloud units.
    """
    T_target_source = inverse(T_target) @ T_source
    moved = transform_points(T_target_source, source.points[chosen])
    distance, nearest = target.tree.query(moved, distance_upper_bound=reach)
    hit = np.flatnonzero(np.isfinite(distance))
    nearest = nearest[hit]
    normals = target.normals[nearest]
    cosine = np.einsum("ij,ij->i", source.normals[chosen[hit]] @ T_target_source[:3, :3].T, normals)
    alike = (cosine if source.signed and target.signed else np.abs(cosine)) > expert().many_poses.least_cosine
    gaps = np.einsum("ij,ij->i", moved[hit] - target.points[nearest], normals)
    square = (expert().many_poses.gap_scale * reach) ** 2
    weights = np.where(alike, (square / (square + gaps**2)) ** 2, 0.0)
    points, normals = transform_points(T_target, moved[hit]), normals @ T_target[:3, :3].T
    J = np.hstack([np.cross(points, normals), normals])
    return (J * weights[:, None]).T @ J, -J.T @ (weights * gaps)


def _lever(center: FloatArray, radius: float) -> FloatArray:
    """(6, 6) from a small motion about a scan's centre (3,) to the same about the group's origin.

    About a far origin a turn would look like a large shift, and damping would hold back the wrong one. Turns
    are counted by how far they move a point ``radius`` away.
    """
    M = np.eye(6)  # p + w x (p - c) + v moves the origin by v + c x w
    M[:3, :3] /= radius
    M[3:, :3] = cross_matrix(center) / radius
    return M


def _moved(T: FloatArray, turn: FloatArray, shift: FloatArray, center: FloatArray) -> FloatArray:
    """A pose after a small turn (rotation vector) about a centre, and a shift, in the group's frame."""
    # To first order; the projection makes it a rotation, and the next step corrects what is left.
    R = project_to_so3(np.eye(3) + cross_matrix(turn))
    return make_transform(project_to_so3(R @ T[:3, :3]), R @ (T[:3, 3] - center) + center + shift)
