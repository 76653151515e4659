"""Local refinement of one motion on the clouds: point-to-plane ICP or GICP, by small_gicp.

Place: refine, between verify and judge. One thread, so that the same input gives the same bytes on any
machine; 5,000 points take some 20 ms. Lengths are passed in voxels, because small_gicp's stopping rule is
an absolute length.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from geomoe3d.config import RefinementConfig
from geomoe3d.geometry.se3 import inverse, project_to_so3, rotation_angle_deg
from geomoe3d.types import FloatArray, PreparedCloud

_MAX_TURN_DEG = 15.0  # a local method that turns further has left the hypothesis it was to refine
_MAX_SHIFT_VOXELS = 6.0
_LEAST_MATCHED = 10


class Refiner:
    """Polishes motions of one pair of clouds; trees and covariances are made once, at the first motion.

    Args:
        source: prepared cloud.
        target: prepared cloud with normals.
        config: method, reach and iterations.
    """

    def __init__(self, source: PreparedCloud, target: PreparedCloud, config: RefinementConfig) -> None:
        self._source, self._target, self._config = source, target, config
        self._made: tuple[Any, Any, Any] | None = None

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

        voxel = self._source.voxel_size
        start = T_target_source.copy()
        start[:3, 3] /= voxel
        source_cloud, target_cloud, target_tree = self._clouds()
        answer = small_gicp.align(
            target_cloud,
            source_cloud,
            target_tree,
            start,
            registration_type="PLANE_ICP" if config.method == "icp" else "GICP",
            max_correspondence_distance=config.max_distance,
            num_threads=1,
            max_iterations=config.max_iterations,
        )
        T = np.array(answer.T_target_source, dtype=np.float64)
        if not np.isfinite(T).all() or answer.num_inliers < _LEAST_MATCHED:
            return T_target_source, (
                f"refinement found only {answer.num_inliers} matching points (it needs {_LEAST_MATCHED}); "
                "the unrefined motion is given"
            )
        T[:3, :3] = project_to_so3(T[:3, :3])
        T[:3, 3] *= voxel
        centre = self._source.points.mean(0)
        shift = float(np.linalg.norm((T - T_target_source) @ np.append(centre, 1.0))) / voxel
        turn = rotation_angle_deg((inverse(T_target_source) @ T)[:3, :3])
        if shift > _MAX_SHIFT_VOXELS or turn > _MAX_TURN_DEG:
            return T_target_source, (
                f"refinement slid away by {turn:.1f} deg and {shift:.1f} voxels; "
                "the unrefined motion is given"
            )
        return T, None

    def _clouds(self) -> tuple[Any, Any, Any]:
        if self._made is None:
            voxel = self._source.voxel_size
            target, tree = _cloud(self._target, voxel, normals=True)
            source, _ = _cloud(self._source, voxel, normals=self._config.method == "gicp")
            self._made = source, target, tree
        return self._made


def refine(
    T_target_source: FloatArray,
    source: PreparedCloud,
    target: PreparedCloud,
    config: RefinementConfig,
) -> tuple[FloatArray, str | None]:
    """One motion (4, 4) polished; see `Refiner`, which does several of one pair."""
    return Refiner(source, target, config)(T_target_source)


def _cloud(cloud: PreparedCloud, voxel: float, *, normals: bool) -> tuple[Any, Any]:
    import small_gicp

    made = small_gicp.PointCloud(cloud.points / voxel)
    tree = small_gicp.KdTree(made, num_threads=1)
    if normals:
        small_gicp.estimate_normals_covariances(made, tree, num_neighbors=20, num_threads=1)
    return made, tree
