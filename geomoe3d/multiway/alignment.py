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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from geomoe3d.config import expert
from geomoe3d.geometry.columns import crossed
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.geometry.se3 import cross_matrix, inverse, make_transform, project_to_so3, transform_points
from geomoe3d.multiway.overlaps import Overlaps
from geomoe3d.runtime.threads import single_blas_thread
from geomoe3d.types import FloatArray, IntArray, PreparedCloud

Pair = tuple[int, int]
Pull = tuple[FloatArray, FloatArray]


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
    def center(self) -> FloatArray:
        """(3,) mean of the points."""
        mean: FloatArray = self.points.mean(0)
        return mean

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
    known = expert().many_poses
    chosen = {k: drawn_rows(surfaces[k].points, voxel_size, known.num_points, seed) for k in scans}
    centers = {k: surfaces[k].center for k in scans}
    radius = float(np.median([np.sqrt(surfaces[k].points.var(0).sum()) for k in scans]))
    current = {k: np.array(poses[k]) for k in scans}
    pairs: list[Pair] = []
    asked: dict[int, IntArray] = {}
    at: dict[int, FloatArray] = {}  # where they stood when it was asked who overlaps whom
    due, still = [0, known.neighbors_again], 0.0
    for number, reach in enumerate(known.reaches):
        if reach == still:
            continue
        if due and number >= due[0]:
            due.pop(0)
            moved = (_apart(current[k], at[k], centers[k], radius) for k in scans)
            if not at or max(moved) > known.moved_again * voxel_size:
                pairs, at = (
                    chosen_neighbors(overlaps.between(current, current, known.least_overlap)),
                    dict(current),
                )
                count = Counter(source for source, _ in pairs)
                asked = {k: _thinned(chosen[k], count[k]) for k in scans}
        about = {k: transform_points(current[k], centers[k][None])[0] for k in scans}
        levers = {k: _lever(about[k], radius) for k in scans}
        pulls = _pulls(pairs, surfaces, asked, current, current, reach * voxel_size)
        steps = _steps(levers, pulls)
        for scan, step in steps.items():
            current[scan] = _moved(current[scan], step[:3] / radius, step[3:], about[scan])
        if max((np.linalg.norm(step) for step in steps.values()), default=0.0) < known.still * voxel_size:
            still = reach  # further steps at this reach would change nothing
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
    known = expert().many_poses
    usable = {k: T for k, T in a.items() if k in surfaces}
    there = {k: T_a_b @ T for k, T in b.items() if k in surfaces}
    shared = overlaps.between(there, usable, known.least_overlap)
    pairs = sorted(sorted(shared, key=lambda pair: (-shared[pair], pair))[: known.most_pairs])
    count = Counter(j for j, _ in pairs)
    chosen = {
        j: _thinned(drawn_rows(surfaces[j].points, voxel_size, known.num_points), count[j]) for j in count
    }
    T = T_a_b
    for reach in known.group_reaches if pairs else ():
        about = np.mean([transform_points(T @ b[j], surfaces[j].center[None])[0] for j, _ in pairs], axis=0)
        lever = _lever(about, 1.0)
        moved = {j: T @ b[j] for j in count}
        pulls = _pulls(pairs, surfaces, chosen, moved, a, reach * voxel_size)
        A = lever.T @ sum(one for one, _ in pulls.values()) @ lever
        slope = lever.T @ sum(two for _, two in pulls.values())
        damping = known.damping * float(np.trace(A)) / 6
        if damping <= 0:
            break
        step: FloatArray = np.linalg.solve(A + damping * np.eye(6), slope).astype(np.float64)
        T = _moved(T, step[:3], step[3:], about)
    return T


def _steps(levers: Mapping[int, FloatArray], pulls: Mapping[Pair, Pull]) -> dict[int, FloatArray]:
    """Damped small motions (6,) [rotation vector, translation] of all scans at once, each about its own centre.

    Args:
        levers: (6, 6) by scan, from `_lever`; in their units are the motions.
        pulls: of the pairs: the source is drawn by the slope, the target pulled back.
    """
    from scipy.sparse import bsr_matrix, identity
    from scipy.sparse.linalg import splu

    if not pulls:
        return {}
    place, L = {scan: n for n, scan in enumerate(levers)}, np.stack(list(levers.values()))
    ends, count = np.array([[place[scan] for scan in pair] for pair in pulls]), len(L)
    A, b = (np.stack(some) for some in zip(*pulls.values(), strict=True))
    slope = np.zeros((count, 6))
    keys, blocks = [], []
    for one, sign in ((ends[:, 0], 1.0), (ends[:, 1], -1.0)):
        lever = L[one].transpose(0, 2, 1)
        np.add.at(slope, one, sign * (lever @ b[:, :, None])[:, :, 0])
        for other, same in ((ends[:, 0], 1.0), (ends[:, 1], -1.0)):
            keys.append(count * one + other)
            blocks.append(sign * same * lever @ A @ L[other])
    # What pairs say of the same two scans is summed first: there are far more pairs than blocks.
    key = np.concatenate(keys)
    order = np.argsort(key, kind="stable")
    known, starts = np.unique(key[order], return_index=True)
    sums = np.add.reduceat(np.concatenate(blocks)[order], starts, axis=0)
    rows = np.searchsorted(known, count * np.arange(count + 1))
    H = bsr_matrix((sums, known % count, rows), shape=(6 * count,) * 2).tocsc()
    damping = expert().many_poses.damping * float(H.diagonal().mean())
    if damping <= 0:  # nothing overlaps
        return {}
    H = H + damping * identity(6 * count, format="csc")
    solved = splu(H, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    found = solved.solve(slope.ravel()).reshape(-1, 6)
    return {scan: found[n] for scan, n in place.items()}


def chosen_neighbors(shared: Mapping[Pair, float]) -> list[Pair]:
    """The pairs (source, target) to lay on each other: of every source so many at most.

    They are taken evenly from those that it overlaps most to those that it overlaps least: with the nearest alone scans
    of one place would hold each other and let go of the next place. So time is linear in the scans, however many stand
    in one place.
    """
    most, some = expert().many_poses.most_neighbors, dict[int, list[Pair]]()
    for pair in sorted(shared, key=lambda pair: (-shared[pair], pair)):
        some.setdefault(pair[0], []).append(pair)
    taken = [np.unique(np.linspace(0, len(lot) - 1, most).astype(np.int64)) for lot in some.values()]
    return sorted(lot[k] for lot, rows in zip(some.values(), taken, strict=True) for k in rows)


def _apart(one: FloatArray, other: FloatArray, center: FloatArray, radius: float) -> float:
    """How far two poses put a scan apart at most, about: its centre, and what a turn moves at its rim."""
    D = one[:3] - other[:3]
    return float(np.linalg.norm(D[:, :3] @ center + D[:, 3]) + radius * np.linalg.norm(D[:, :3]))


def _thinned(rows: IntArray, neighbors: int) -> IntArray:
    """Every so many of some rows, so that a scan with many neighbours is asked no more often than others."""
    most = max(expert().many_poses.points_in_all // max(neighbors, 1), 1)
    return rows[:: -(-len(rows) // most)] if len(rows) else rows


def _pulls(
    pairs: Sequence[Pair],
    surfaces: Mapping[int, Surface],
    asked: Mapping[int, IntArray],
    sources: Mapping[int, FloatArray],
    targets: Mapping[int, FloatArray],
    reach: float,
) -> dict[Pair, Pull]:
    """Curvature (6, 6) and slope (6,), about the group's origin, by which each source is drawn into its target.

    Args:
        pairs: (source, target).
        surfaces: of all scans.
        asked: (n,) points by source.
        sources, targets: poses (4, 4) in the group's frame.
        reach: points farther from the target do not count, cloud units.
    """
    known, found = expert().many_poses, {}
    drawing = dict.fromkeys(k for k, _ in pairs)
    points = {k: transform_points(sources[k], surfaces[k].points[asked[k]]) for k in drawing}
    normals = {k: surfaces[k].normals[asked[k]] @ sources[k][:3, :3].T for k in drawing}
    square = (known.gap_scale * reach) ** 2
    drawn: dict[int, list[int]] = {}
    for source, number in pairs:
        drawn.setdefault(number, []).append(source)
    for number, some in drawn.items():
        target, T = surfaces[number], targets[number]
        there = np.concatenate([points[k] for k in some])
        local = transform_points(inverse(T), there)
        distance, nearest = target.tree.query(local, distance_upper_bound=reach)
        hit = np.flatnonzero(np.isfinite(distance))
        nearest = nearest[hit]
        facing = target.normals[nearest] @ T[:3, :3].T
        cosine = np.einsum("ij,ij->i", np.concatenate([normals[k] for k in some])[hit], facing)
        sizes = [len(points[k]) for k in some]
        signed = np.repeat([target.signed and surfaces[k].signed for k in some], sizes)[hit]
        alike = np.where(signed, cosine, np.abs(cosine)) > known.least_cosine
        gaps = np.einsum("ij,ij->i", local[hit] - target.points[nearest], target.normals[nearest])
        weights = np.where(alike, (square / (square + gaps**2)) ** 2, 0.0)
        J = np.hstack([crossed(there[hit], facing), facing])
        weighted = J * weights[:, None]
        ends = np.searchsorted(hit, np.cumsum(sizes))
        for k, low, high in zip(some, np.append(0, ends), ends):  # noqa: B905
            rows = slice(low, high)
            found[k, number] = weighted[rows].T @ J[rows], -weighted[rows].T @ gaps[rows]
    return found


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
