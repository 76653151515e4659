"""Local alignment of two sets of points from a start, by small_gicp: GICP or point-to-plane ICP.

One thread aligns, so that the same input gives the same bytes on any machine. Lengths are in voxels, since
the library's stopping rules are absolute. It calls itself converged even where nothing matched, so what came
of it is checked here.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from geomoe3d.config import expert
from geomoe3d.geometry.se3 import inverse, project_to_so3, rotation_angle_deg
from geomoe3d.runtime.threads import usable_threads
from geomoe3d.types import FloatArray


class LocalCloud(NamedTuple):
    """Points as the library holds them, with covariances where asked for, and their tree (None of no points:
    the library would warn on its own)."""

    cloud: Any
    tree: Any

    @classmethod
    def of(cls, points: FloatArray, num_neighbors: int | None) -> LocalCloud:
        """Points (n, 3); covariances and normals from so many neighbours of each, or none of either."""
        import small_gicp

        made = small_gicp.PointCloud(points)
        tree = small_gicp.KdTree(made, num_threads=1) if len(points) else None
        if num_neighbors is not None:
            # Each point's for itself: the same for any number of threads, unlike the sums of the alignment.
            small_gicp.estimate_normals_covariances(
                made, tree, num_neighbors=num_neighbors, num_threads=usable_threads()
            )
        return cls(made, tree)


class Aligned(NamedTuple):
    """What an alignment came to.

    Attributes:
        T_target_source: (4, 4), or None where it is not to be used.
        problem: why not, or None.
    """

    T_target_source: FloatArray | None
    problem: str | None


def align(
    source: LocalCloud,
    target: LocalCloud,
    start: FloatArray,
    centre: FloatArray,
    *,
    reach: float,
    method: str = "gicp",
    max_iterations: int = 30,
) -> Aligned:
    """The motion near ``start`` that draws the source's points into the target's surface.

    Args:
        source: moving points, in voxels; covariances for GICP.
        target: fixed points, likewise, with covariances and normals.
        start: (4, 4) p_target = R p_source + t.
        centre: (3,) point of the source at which the shift is measured.
        reach: largest distance of matched points.
        method: gicp or icp (point-to-plane).
        max_iterations: most steps.
    """
    import small_gicp

    fewest = min(source.cloud.size(), target.cloud.size())
    if fewest < expert().alignment.least_matched:  # of so few the library warns on its own, again and again
        return Aligned(None, too_few(fewest))
    answer = small_gicp.align(
        target.cloud,
        source.cloud,
        target.tree,
        start,
        registration_type="PLANE_ICP" if method == "icp" else "GICP",
        max_correspondence_distance=reach,
        num_threads=1,
        max_iterations=max_iterations,
        translation_epsilon=expert().alignment.still,
    )
    T = np.array(answer.T_target_source, dtype=np.float64)
    num_matched = answer.num_inliers if np.isfinite(T).all() else 0
    if num_matched < expert().alignment.least_matched:
        return Aligned(None, too_few(num_matched))
    T[:3, :3] = project_to_so3(T[:3, :3])
    shift = float(np.linalg.norm((T - start) @ np.append(centre, 1.0)))
    turn = rotation_angle_deg((inverse(start) @ T)[:3, :3])
    if shift > expert().alignment.most_shift or turn > expert().alignment.most_turn_deg:
        return Aligned(None, f"refinement slid away by {turn:.1f} deg and {shift:.1f} voxels")
    return Aligned(T, None)


def too_few(num_matched: int) -> str:
    """The sentence for so few matching points."""
    least = expert().alignment.least_matched
    return f"refinement found only {num_matched} matching points (it needs {least})"
