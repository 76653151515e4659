"""Groups of scans: good edges join them, wrong and doubtful ones do not, rivals keep them apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pose_graphs import RULES, edge, graph, largest_error
from scipy.spatial.transform import Rotation

from geomoe3d.geometry.se3 import inverse, make_transform, transform_points
from geomoe3d.multiway.grouping import Group, connected_parts, group_scans, settle
from geomoe3d.multiway.overlaps import Overlaps


def test_a_ring_of_good_edges_becomes_one_group_with_small_errors():
    shapes, truth, edges, _ = graph()
    (group,) = group_scans(shapes, edges, RULES)
    (group,) = settle(group, edges, shapes, RULES)
    assert len(group.edges) == len(edges)
    assert largest_error(group.poses, truth) < 0.06


def test_wrong_edges_are_rejected_however_confident():
    shapes, truth, edges, rng = graph()
    wrong = [
        edge(
            6,
            1,
            make_transform(Rotation.random(random_state=k).as_matrix(), rng.uniform(-4, 4, 3)),
            0.99999,
            rng,
        )
        for k in range(3)
    ]
    (group,) = group_scans(shapes, [*wrong, *edges], RULES)
    (group,) = settle(group, [*wrong, *edges], shapes, RULES)
    kept = {id(e) for e in group.edges}
    assert not kept & {id(e) for e in wrong[1:]}
    assert largest_error(group.poses, truth) < 0.1
    assert not kept & {id(e) for e in wrong}


def test_an_edge_that_the_aligned_surfaces_contradict_is_not_kept():
    shapes, truth, edges, rng = graph(noise=0.002)
    bent = inverse(truth[0]) @ truth[4]
    bent[:3, 3] += [0.1, 0, 0]  # near enough for the pose graph, not for what the surfaces say
    edges = [*edges, edge(4, 0, bent, 0.9999, rng)]
    poses = dict(truth)
    rules = replace(RULES, kept_tolerance=0.06)
    (group,) = settle(Group(poses, list(edges)), edges, shapes, rules, lambda poses: dict(truth))
    assert {id(e) for e in group.edges} == {id(e) for e in edges[:-1]}
    assert largest_error(group.poses, truth) < 1e-12
    # A scan that hung on such an edge alone is let go.
    alone = [e for e in edges[:-1] if 4 not in (e.source, e.target)]
    groups = settle(
        Group(poses, []), [*alone, edges[-1]], shapes, rules, lambda poses: {k: truth[k] for k in poses}
    )
    assert [sorted(group.poses) for group in groups] == [[0, 1, 2, 3, 5, 6, 7], [4]]


def test_an_edge_whose_surfaces_hold_the_sensor_loosely_is_not_kept():
    shapes, truth, edges, _ = graph(noise=0.002)
    edges[3] = replace(edges[3], looseness=0.03)  # times the correlation, 20: more than 0.4
    (group,) = settle(Group(dict(truth), list(edges)), edges, shapes, RULES)
    assert {id(e) for e in group.edges} == {id(e) for k, e in enumerate(edges) if k != 3}


def test_two_motions_that_compete_keep_groups_apart():
    shapes, truth, _, rng = graph(count=2)
    right = inverse(truth[0]) @ truth[1]
    other = make_transform(Rotation.random(random_state=5).as_matrix(), np.ones(3))
    rivals = [edge(1, 0, right, 0.9999, rng), edge(1, 0, other, 0.9999, rng)]
    assert len(group_scans(shapes, rivals[:1], RULES)) == 1
    assert len(group_scans(shapes, rivals, RULES)) == 2


def test_one_doubtful_edge_is_not_enough_and_silent_pairs_speak_against_it():
    shapes, truth, _, rng = graph(count=3)
    sure = [edge(j, i, inverse(truth[i]) @ truth[j], 0.9999, rng) for i, j in ((0, 1), (0, 2))]
    doubtful = edge(2, 0, inverse(truth[0]) @ truth[2], 0.95, rng)
    assert [len(g.poses) for g in group_scans(shapes, [sure[0], doubtful], RULES)] == [2, 1]
    assert [len(g.poses) for g in group_scans(shapes, sure, RULES)] == [3]
    # All three scans show the same place; the pair 1, 2 was registered and says nothing: that speaks against.
    common = np.random.default_rng(1).uniform(-1, 1, (500, 3))
    overlaps = Overlaps({k: transform_points(inverse(truth[k]), common) for k in truth})
    assert overlaps.of(2, 1, inverse(truth[1]) @ truth[2]) > 0.9
    assert overlaps.of(2, 1, np.eye(4) + np.eye(4)[:, [3, 3, 3, 3]] * 0) < 0.9
    tried = {(0, 1), (0, 2), (1, 2)}
    strict = replace(RULES, silent_worth=20.0)
    assert [len(g.poses) for g in group_scans(shapes, sure, strict, tried, overlaps)] == [2, 1]


def test_groups_are_gone_on_with():
    shapes, truth, edges, _ = graph()
    halves = [group_scans(shapes, [e for e in edges if side(e)], RULES) for side in (lower, upper)]
    start = [
        group for half, size in zip(halves, (4, 4), strict=True) for group in half if len(group.poses) == size
    ]
    assert [sorted(group.poses) for group in start] == [[0, 1, 2, 3], [4, 5, 6, 7]]
    (group,) = group_scans(shapes, edges, RULES, start=start)
    assert largest_error(group.poses, truth) < 0.1
    assert [sorted(g.poses) for g in group_scans(shapes, [], RULES, start=start)] == [
        [0, 1, 2, 3],
        [4, 5, 6, 7],
    ]


def lower(edge):
    return edge.source < 4 and edge.target < 4


def upper(edge):
    return edge.source >= 4 and edge.target >= 4


def test_parts_without_edges_between_them_stay_apart():
    assert connected_parts(range(5), []) == [[0], [1], [2], [3], [4]]
    rng = np.random.default_rng(0)
    links = [edge(a, b, np.eye(4), 0.9, rng) for a, b in ((3, 1), (4, 3), (0, 2))]
    assert connected_parts(range(6), links) == [[1, 3, 4], [0, 2], [5]]
