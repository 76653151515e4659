"""Poses that fit all edges best, by Open3D's pose graph with a line process on every loop.

Place: after wrong edges have been taken out as far as votes can tell. The line process may still switch off a
loop edge that does not fit. Cost: some 20 ms for 60 scans and 300 edges.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomoe3d.geometry.se3 import inverse, make_transform, project_to_so3
from geomoe3d.multiway.edges import Edge, source_information
from geomoe3d.types import FloatArray

_LOOP_PREFERENCE = 2.0
_PRUNED_BELOW = 0.25


def optimise(poses: dict[int, FloatArray], edges: Sequence[Edge], tolerance: float) -> dict[int, FloatArray]:
    """Poses T_group_scan optimised over the edges; the scan with the smallest number stays where it is.

    Args:
        poses: (4, 4) by scan, local coordinates.
        edges: between these scans; they connect all of them.
        tolerance: distance at which points count as not matching, cloud units.

    Source: Choi, Zhou and Koltun, CVPR 2015 (line process), as Open3D implements it.
    """
    if len(poses) < 2 or len(edges) < len(poses):
        return poses
    import open3d as o3d

    registration = o3d.pipelines.registration
    scans = sorted(poses)
    number = {scan: k for k, scan in enumerate(scans)}
    tree = spanning_tree(edges)
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
                uncertain=id(edge) not in tree,
            )
        )
    option = registration.GlobalOptimizationOption(
        max_correspondence_distance=tolerance,
        edge_prune_threshold=_PRUNED_BELOW,
        preference_loop_closure=_LOOP_PREFERENCE,
        reference_node=0,
    )
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        registration.global_optimization(
            graph,
            registration.GlobalOptimizationLevenbergMarquardt(),
            registration.GlobalOptimizationConvergenceCriteria(),
            option,
        )
    found = [np.asarray(node.pose) for node in graph.nodes]
    if not np.isfinite(found).all():
        return poses
    # The reference may have moved by rounding; everything is expressed from where it was.
    T = poses[scans[0]] @ inverse(found[0])
    moved = {scan: T @ pose for scan, pose in zip(scans, found, strict=True)}
    return {scan: make_transform(project_to_so3(M[:3, :3]), M[:3, 3]) for scan, M in moved.items()}


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
