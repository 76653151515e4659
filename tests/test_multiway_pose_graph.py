"""The pose graph: its reference stays, the error of a loop is spread."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from pose_graphs import edge, graph
from scipy.spatial.transform import Rotation

from geomoe3d.errors import DependencyError
from geomoe3d.geometry.se3 import inverse, make_transform
from geomoe3d.multiway.edges import Edge
from geomoe3d.multiway.pose_graph import optimise, require_gtsam


def test_the_pose_graph_keeps_its_reference_and_spreads_the_error_of_a_loop():
    _, truth, edges, rng = graph(noise=0.0)
    start = {k: truth[k] @ edge(0, 0, np.eye(4), 0.9, rng, 0.03).T_target_source for k in truth}
    found = optimise(start, edges, 0.2)
    assert np.abs(found[0] - start[0]).max() < 1e-9
    T = truth[0] @ inverse(found[0])
    assert max(np.abs(T @ found[k] - truth[k]).max() for k in truth) < 1e-3


def test_an_edge_is_weighed_in_the_frame_in_which_it_was_measured():
    turns = [np.eye(3), *(Rotation.from_rotvec(np.pi / 2 * np.eye(3)[k]).as_matrix() for k in (1, 2))]
    truth = {k: make_transform(turns[1] @ turns[k], np.array([1.0, 0.3, 0.0]) * k) for k in range(3)}
    edges = [Edge(j, i, inverse(truth[i]) @ truth[j], 0.9, 1000 * np.eye(6)) for i, j in ((0, 1), (1, 2))]
    off = inverse(truth[0]) @ truth[2]
    off[0, 3] += 0.05  # along the target's x, which this pair does not hold at all
    edges.append(Edge(2, 0, off, 0.9, 1000 * np.diag([1, 1, 1, 1e-6, 1, 1])))
    found = optimise(dict(truth), edges, 0.5)
    assert max(np.abs(found[k] - truth[k]).max() for k in truth) < 1e-6


def test_gtsam_gives_the_poses_that_open3d_gives():
    """A ring with noise, one loop edge that is far off and one that the line process weighs down.

    What is left are second powers of turns: GTSAM measures a shift along the turn, Open3D after it.
    """
    pytest.importorskip("gtsam")
    _, truth, edges, rng = graph(count=12, noise=0.002)
    wrong = edge(9, 2, inverse(truth[2]) @ truth[9], 0.9, rng, 0.5)
    doubtful = edge(7, 3, inverse(truth[3]) @ truth[7], 0.9, rng, 0.02)
    edges = [*edges, replace(wrong, confidence=0.5), replace(doubtful, confidence=0.5)]
    start = {k: T @ edge(0, 0, np.eye(4), 0.9, rng, 0.03).T_target_source for k, T in truth.items()}
    one, other = (optimise(start, edges, 0.2, library=library) for library in ("open3d", "gtsam"))
    apart = max(np.abs(one[k] - other[k]).max() for k in truth)
    moved = max(np.abs(one[k] - start[k]).max() for k in truth)
    assert apart < 2e-3 < 0.1 < moved
    assert np.abs(other[0] - start[0]).max() < 1e-9


def test_without_gtsam_it_is_said_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(DependencyError, match="pip install gtsam"):
        require_gtsam()
