"""Local refinement of one motion on the clouds: point-to-plane ICP or GICP, by small_gicp.

Place: refine, between verify and judge. The alignment uses one thread, so that the same input gives the same
bytes on any machine; two clouds of 5,000 points take some 15 ms, since only what lies near the other cloud
takes part: to find that a point is near nothing costs far more than to find its partner, in every step
again. Lengths are passed in voxels, because small_gicp's stopping rule is an absolute length.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from geomoe3d.config import RefinementConfig
from geomoe3d.geometry.se3 import inverse, project_to_so3, rotation_angle_deg, transform_points
from geomoe3d.threads import usable_threads
from geomoe3d.types import FloatArray, IntArray, PreparedCloud

_MAX_TURN_DEG = 15.0  # a local method that turns further has left the hypothesis it was to refine
_MAX_SHIFT_VOXELS = 6.0
_LEAST_MATCHED = 10
_MARGIN_VOXELS = (
    2.5  # beyond the reach: points may come nearer in the course, and normals need their neighbours
)
_NORMAL_NEIGHBORS = 20
# A step that moves less (and turns less than 0.1 deg, the library's own) ends it; ten times less takes twice
# the steps for nothing.
_STILL_VOXELS = 0.01


class Refiner:
    """Polishes motions of one pair of clouds.

    Args:
        source: prepared cloud.
        target: prepared cloud with normals.
        config: method, reach and iterations.
    """

    def __init__(self, source: PreparedCloud, target: PreparedCloud, config: RefinementConfig) -> None:
        from scipy.spatial import cKDTree

        self._config, self._voxel, self._centre = config, source.voxel_size, source.points.mean(0)
        self._source, self._target = (cloud.points / source.voxel_size for cloud in (source, target))
        self._source_tree, self._target_tree = (
            cKDTree(points, balanced_tree=False, compact_nodes=False)
            for points in (self._source, self._target)
        )

    def __call__(self, T_target_source: FloatArray) -> tuple[FloatArray, str | None]:
        """The motion polished so that the source's points lie in the target's surface.

        Args:
            T_target_source: (4, 4) start, local coordinates.

        Returns:
            The refined motion and None; or the start unchanged and a sentence that says why: the library's
            own `converged` is true even where nothing matched, so the number of matched points, finiteness
            and the distance moved are checked here.
        """
        config = self._config
        if config.method == "none":
            return T_target_source, None
        import small_gicp

        voxel = self._voxel
        start = T_target_source.copy()
        start[:3, 3] /= voxel
        near_target = self._near(self._target_tree, transform_points(start, self._source))
        near_source = self._near(self._source_tree, transform_points(inverse(start), self._target))
        num_matched = min(len(near_target), len(near_source))
        if num_matched >= _LEAST_MATCHED:
            target_cloud, target_tree = _cloud(self._target[near_source], normals=True)
            answer = small_gicp.align(
                target_cloud,
                _cloud(self._source[near_target], normals=config.method == "gicp")[0],
                target_tree,
                start,
                registration_type="PLANE_ICP" if config.method == "icp" else "GICP",
                max_correspondence_distance=config.max_distance,
                num_threads=1,
                max_iterations=config.max_iterations,
                translation_epsilon=_STILL_VOXELS,
            )
            T = np.array(answer.T_target_source, dtype=np.float64)
            num_matched = answer.num_inliers if np.isfinite(T).all() else 0
        if num_matched < _LEAST_MATCHED:
            return T_target_source, (
                f"refinement found only {num_matched} matching points (it needs {_LEAST_MATCHED}); "
                "the unrefined motion is given"
            )
        T[:3, :3] = project_to_so3(T[:3, :3])
        T[:3, 3] *= voxel
        shift = float(np.linalg.norm((T - T_target_source) @ np.append(self._centre, 1.0))) / voxel
        turn = rotation_angle_deg((inverse(T_target_source) @ T)[:3, :3])
        if shift > _MAX_SHIFT_VOXELS or turn > _MAX_TURN_DEG:
            return T_target_source, (
                f"refinement slid away by {turn:.1f} deg and {shift:.1f} voxels; "
                "the unrefined motion is given"
            )
        return T, None

    def _near(self, tree: Any, points: FloatArray) -> IntArray:
        """Which points (n, 3) have one of the tree's within the reach of the refinement and some more."""
        reach = self._config.max_distance + _MARGIN_VOXELS
        distance, _ = tree.query(points, distance_upper_bound=reach, workers=usable_threads())
        return np.flatnonzero(np.isfinite(distance))


def refine(
    T_target_source: FloatArray,
    source: PreparedCloud,
    target: PreparedCloud,
    config: RefinementConfig,
) -> tuple[FloatArray, str | None]:
    """One motion (4, 4) polished; see `Refiner`, which does several of one pair."""
    return Refiner(source, target, config)(T_target_source)


def _cloud(points: FloatArray, *, normals: bool) -> tuple[Any, Any]:
    """Points (n, 3) in voxels as the library's cloud, and its tree."""
    import small_gicp

    made = small_gicp.PointCloud(points)
    tree = small_gicp.KdTree(made, num_threads=1)
    if normals:
        # Each point's for itself: the same for any number of threads, unlike the sums of the alignment.
        small_gicp.estimate_normals_covariances(
            made, tree, num_neighbors=_NORMAL_NEIGHBORS, num_threads=usable_threads()
        )
    return made, tree
