"""Poses that fit all edges best, with a line process on every loop: by Open3D's pose graph, or by GTSAM.

Place: after wrong edges have been taken out as far as votes can tell. The line process may still switch off a
loop edge that does not fit. Both minimise the same: the line process is the weight of Geman and McClure, whose scale
is Open3D's, and an edge that it nearly switched off is left out of a second pass. Cost: some 20 ms for 60 scans and
300 edges with Open3D, 50 ms with GTSAM.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Literal

import numpy as np

from geomoe3d.config import expert
from geomoe3d.errors import DependencyError
from geomoe3d.geometry.se3 import inverse, make_transform, project_to_so3
from geomoe3d.multiway.edges import Edge, source_information
from geomoe3d.runtime.open3d_core import open3d_core
from geomoe3d.types import FloatArray

Library = Literal["open3d", "gtsam"]


def optimise(
    poses: dict[int, FloatArray],
    edges: Sequence[Edge],
    tolerance: float,
    *,
    library: Library = "open3d",
) -> dict[int, FloatArray]:
    """Poses T_group_scan optimised over the edges; the scan with the smallest number stays where it is.

    Args:
        poses: (4, 4) by scan, local coordinates.
        edges: between these scans; they connect all of them.
        tolerance: distance at which points count as not matching, cloud units.
        library: that computes it.

    Raises:
        DependencyError: GTSAM is wanted and not installed.

    Source: Choi, Zhou and Koltun, CVPR 2015 (line process), as Open3D implements it.
    """
    if len(poses) < 2 or len(edges) < len(poses):
        return poses
    certain = spanning_tree(edges)
    solve = _by_open3d if library == "open3d" else _by_gtsam
    found = solve(poses, edges, certain, tolerance)
    if not np.isfinite(list(found.values())).all():
        return poses
    # The reference may have moved by rounding; everything is expressed from where it was.
    first = min(poses)
    T = poses[first] @ inverse(found[first])
    moved = {scan: T @ pose for scan, pose in found.items()}
    return {scan: make_transform(project_to_so3(M[:3, :3]), M[:3, 3]) for scan, M in moved.items()}


def _by_open3d(
    poses: dict[int, FloatArray], edges: Sequence[Edge], certain: Collection[int], tolerance: float
) -> dict[int, FloatArray]:
    o3d = open3d_core()
    registration = o3d.pipelines.registration
    scans = sorted(poses)
    number = {scan: k for k, scan in enumerate(scans)}
    graph = registration.PoseGraph()
    for scan in scans:
        graph.nodes.append(registration.PoseGraphNode(poses[scan]))
    for edge in edges:
        graph.edges.append(
            registration.PoseGraphEdge(
                number[edge.source],
                number[edge.target],
                edge.T_target_source,
                source_information(edge) * edge.confidence,
                uncertain=id(edge) not in certain,
            )
        )
    option = registration.GlobalOptimizationOption(
        max_correspondence_distance=tolerance,
        edge_prune_threshold=expert().many_poses.pruned_below,
        preference_loop_closure=expert().many_poses.loop_preference,
        reference_node=0,
    )
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        registration.global_optimization(
            graph,
            registration.GlobalOptimizationLevenbergMarquardt(),
            registration.GlobalOptimizationConvergenceCriteria(),
            option,
        )
    return {scan: np.array(node.pose) for scan, node in zip(scans, graph.nodes, strict=True)}


def require_gtsam() -> None:
    """Raises DependencyError where GTSAM is not installed."""
    try:
        import gtsam  # noqa: F401
    except ImportError:
        raise DependencyError(
            "GTSAM is not installed: pip install gtsam (Python 3.11 and newer), or leave the optimizer to Open3D"
        ) from None


def _by_gtsam(
    poses: dict[int, FloatArray], edges: Sequence[Edge], certain: Collection[int], tolerance: float
) -> dict[int, FloatArray]:
    require_gtsam()
    import gtsam

    information = [source_information(edge) * edge.confidence for edge in edges]
    preference = expert().many_poses.loop_preference
    scale = preference * tolerance**2 * float(np.mean([matrix[5, 5] for matrix in information]))
    robust = gtsam.noiseModel.mEstimator.GemanMcClure.Create(float(np.sqrt(scale)))
    values = gtsam.Values()
    for scan, T in poses.items():
        values.insert(scan, gtsam.Pose3(T))
    used = list(range(len(edges)))
    while True:
        graph = gtsam.NonlinearFactorGraph()
        graph.add(gtsam.NonlinearEqualityPose3(min(poses), gtsam.Pose3(poses[min(poses)])))
        factors = {}
        for k in used:
            edge, model = edges[k], gtsam.noiseModel.Gaussian.Information(information[k])
            measured = gtsam.Pose3(edge.T_target_source)
            factors[k] = gtsam.BetweenFactorPose3(edge.target, edge.source, measured, model)
            if id(edge) in certain:
                graph.add(factors[k])
            else:
                loose = gtsam.noiseModel.Robust.Create(robust, model)
                graph.add(gtsam.BetweenFactorPose3(edge.target, edge.source, measured, loose))
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(expert().many_poses.most_steps)
        values = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        # Twice the error of a factor without the robust weight is its squared residual.
        weights = {k: (scale / (scale + 2 * factors[k].error(values))) ** 2 for k in used}
        kept = [k for k in used if id(edges[k]) in certain or weights[k] >= expert().many_poses.pruned_below]
        if len(kept) == len(used):
            return {scan: values.atPose3(scan).matrix() for scan in poses}
        used = kept


def spanning_tree(edges: Sequence[Edge]) -> set[int]:
    """Ids (`id`) of the edges of a spanning forest of the surest edges."""
    parent: dict[int, int] = {}

    def root(scan: int) -> int:
        while parent.setdefault(scan, scan) != scan:
            scan = parent[scan]
        return scan

    chosen = set()
    for edge in sorted(edges, key=lambda e: -e.worth):
        a, b = root(edge.source), root(edge.target)
        if a != b:
            parent[a] = b
            chosen.add(id(edge))
    return chosen
