"""The pose graph: its reference stays, the error of a loop is spread."""

from __future__ import annotations

import numpy as np
from pose_graphs import edge, graph

from geomoe3d.geometry.se3 import inverse
from geomoe3d.multiway.pose_graph import optimise


def test_the_pose_graph_keeps_its_reference_and_spreads_the_error_of_a_loop():
    _, truth, edges, rng = graph(noise=0.0)
    start = {k: truth[k] @ edge(0, 0, np.eye(4), 0.9, rng, 0.03).T_target_source for k in truth}
    found = optimise(start, edges, 0.2)
    assert np.abs(found[0] - start[0]).max() < 1e-9
    T = truth[0] @ inverse(found[0])
    assert max(np.abs(T @ found[k] - truth[k]).max() for k in truth) < 1e-3
