#!/usr/bin/env bash
# Open3D 0.20.0 makes information matrices of edges in one frame and its pose graph weighs with them in another.
#
# Guess: what get_information_matrix_from_point_clouds gives can be put into a PoseGraphEdge as it is, as the
# documentation's own examples do. It is made of the target's points, so its translation part weighs along the
# target's axes.
# Seen: global_optimization weighs along the source's axes. Two edges between the same two nodes, the source turned by
# 90 degrees about z: one holds x of the target and says 1, the other holds y of the target and says 1; where they hold
# nothing they say 0. The optimum is (1, 1) by the target's axes and (0, 0) by the source's. It comes out (0, 0), and
# (1, 1) once each matrix is carried over with the adjoint of its edge. With edges that agree it does not matter.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check open3d-cpu==0.20.0
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import open3d as o3d

registration = o3d.pipelines.registration

# Which frame the matrix is made in: a target that is a line along its own x says nothing of turns about x.
target = np.zeros((200, 3))
target[:, 0] = np.linspace(-1, 1, 200)
T = np.eye(4)
T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # target from source: 90 degrees about z
source = target @ T[:3, :3]
clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (source, target)]
made = registration.get_information_matrix_from_point_clouds(*clouds, 0.05, T)
print("turns about the axes, as made:", np.round(np.diag(made)[:3], 1).tolist())
assert made[0, 0] < 1e-6 < made[1, 1], "the matrix is not in the target's frame"


def edge(shift, held, carried):
    """Target from source with a shift, holding one axis of the target."""
    transform = T.copy()
    transform[:3, 3] = shift
    weights = np.array([1e4, 1e4, 1e4, 1e-3, 1e-3, 1e4])
    weights[3 + held] = 1e4
    information = np.diag(weights)
    if carried:
        R, t = transform[:3, :3], transform[:3, 3]
        cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
        adjoint = np.zeros((6, 6))  # order: turn, shift
        adjoint[:3, :3] = adjoint[3:, 3:] = R
        adjoint[3:, :3] = cross @ R
        information = adjoint.T @ information @ adjoint
    return registration.PoseGraphEdge(1, 0, transform, information, False)


found = {}
for carried in (False, True):
    graph = registration.PoseGraph()
    start = T.copy()
    start[:3, 3] = [0.5, 0.5, 0]
    graph.nodes.append(registration.PoseGraphNode(np.eye(4)))
    graph.nodes.append(registration.PoseGraphNode(start))
    graph.edges.append(edge([1, 0, 0], 0, carried))
    graph.edges.append(edge([0, 1, 0], 1, carried))
    registration.global_optimization(
        graph,
        registration.GlobalOptimizationLevenbergMarquardt(),
        registration.GlobalOptimizationConvergenceCriteria(),
        registration.GlobalOptimizationOption(reference_node=0),
    )
    between = np.linalg.inv(graph.nodes[0].pose) @ graph.nodes[1].pose
    found[carried] = between[:2, 3]
    print("carried over by the adjoint" if carried else "as made", "->", np.round(found[carried], 3).tolist())
assert np.allclose(found[False], 0, atol=0.02), "as made no longer comes out at (0, 0): the behaviour has changed"
assert np.allclose(found[True], 1, atol=0.02), "carried over no longer comes out at (1, 1)"
PYTHON
