"""A model that contradicts its surest pairs is doubted where it hangs together by least."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pose_graphs import RULES, edge, graph, largest_error
from scipy.spatial.transform import Rotation

from geomoe3d.geometry.se3 import inverse, make_transform
from geomoe3d.multiway.cycles import with_cycles
from geomoe3d.multiway.grouping import Growth
from geomoe3d.multiway.revision import agreement, doubted
from geomoe3d.multiway.rules import Group


def repeated_structure():
    """Two blocks of scans; three wrong pairs between them agree with each other, one right pair is surer."""
    shapes, truth, _, rng = graph(count=10)
    exact = {(j, i): inverse(truth[i]) @ truth[j] for j in truth for i in range(j)}
    edges = [edge(j, i, T, 0.9999, rng, 0.002) for (j, i), T in exact.items() if (j < 6) == (i < 6)]
    turned = make_transform(Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix(), np.array([1.0, 0, 0]))
    alike = [edge(6, i, inverse(truth[i]) @ turned @ truth[6], 0.94, rng, 0.002) for i in (1, 2, 3)]
    right = edge(7, 5, exact[7, 5], 0.9995, rng, 0.002)
    edges = with_cycles([*edges, *alike, right], shapes, RULES.tolerance, RULES.turn_deg)
    return shapes, truth, edges


def grown(edges, shapes):
    return Growth([Group({k: np.eye(4)}) for k in range(len(shapes))], edges, shapes, RULES).run()


def test_edges_that_are_wrong_alike_are_left_out_where_a_surer_one_contradicts_them():
    shapes, truth, edges = repeated_structure()
    (wrong,) = grown(edges, shapes)
    assert largest_error(wrong.poses, truth) > 1.0  # each joint by itself takes the three
    first, *_ = doubted([wrong], edges, shapes, RULES)
    left_out = [e for e in edges if not any(e is one for one in first)]
    assert sorted((e.source, e.target) for e in left_out) == [(6, 1), (6, 2), (6, 3)]
    (right,) = grown(first, shapes)
    assert largest_error(right.poses, truth) < 0.1
    told = [agreement(groups, edges, shapes, RULES) for groups in ([wrong], [right])]
    assert told[1] > told[0] + 2.0
    assert not doubted([right], edges, shapes, RULES)


def test_a_model_that_no_sure_pair_contradicts_is_not_doubted():
    shapes, _, edges = repeated_structure()
    edges = [replace(e, confidence=min(e.confidence, 0.97)) for e in edges]
    assert not doubted(grown(edges, shapes), edges, shapes, RULES)
