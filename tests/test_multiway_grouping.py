"""Groups of scans: right edges join them, wrong ones do not, however many; rivals keep them apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pose_graphs import RULES, edge, graph, largest_error
from scipy.spatial.transform import Rotation

from geomoe3d.geometry.se3 import inverse, make_transform
from geomoe3d.multiway.cycles import closes, find_triangles, propagate, with_cycles
from geomoe3d.multiway.doubtful import doubtful_pairs
from geomoe3d.multiway.edges import Shape
from geomoe3d.multiway.grouping import Growth, reconsidered
from geomoe3d.multiway.rules import Group
from geomoe3d.multiway.settling import connected_parts, is_kept, settle


def grown(shapes, edges, start=None, witness=None):
    alone = [Group({k: np.eye(4)}) for k in range(len(shapes))]
    told = with_cycles(edges, shapes, RULES.tolerance, RULES.turn_deg)
    return Growth(start or alone, told, shapes, RULES, witness).run()


def anywhere(rng):
    turn = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    return make_transform(turn, rng.uniform(-4, 4, 3))


def test_a_ring_of_good_edges_becomes_one_group_with_small_errors():
    shapes, truth, edges, _ = graph()
    (group,) = grown(shapes, edges)
    (group,) = settle(group, edges, shapes, RULES)
    assert len(group.edges) == len(edges)
    assert largest_error(group.poses, truth) < 0.06


def test_one_group_comes_of_edges_of_which_four_in_five_are_wrong():
    shapes, truth, edges, rng = graph(count=21, noise=0.005)
    edges = [replace(e, confidence=0.9) for e in edges]
    pairs = {(e.source, e.target) for e in edges}
    others = [(j, i) for j in range(21) for i in range(j) if (j, i) not in pairs]
    wrong = [edge(j, i, anywhere(rng), 0.9, rng) for j, i in others]  # as sure as the right ones
    assert len(wrong) == 4 * len(edges)
    (group,) = grown(shapes, [*wrong, *edges])
    assert sorted(group.poses) == list(range(21))
    (group,) = settle(group, [*wrong, *edges], shapes, RULES)
    assert largest_error(group.poses, truth) < 0.1
    kept = {id(e) for e in group.edges}
    assert not kept & {id(e) for e in wrong}


def test_triangles_tell_right_edges_from_surer_wrong_ones():
    shapes, _, edges, rng = graph(noise=0.002)
    wrong = [edge(6, 1, anywhere(rng), 0.99999, rng), edge(5, 2, anywhere(rng), 0.99999, rng)]
    told = with_cycles([*wrong, *edges], shapes, RULES.tolerance, RULES.turn_deg)
    assert min(e.worth for e in told[2:]) > max(e.worth for e in told[:2])
    triangles = find_triangles(edges)
    assert len(triangles) == 8  # of a ring of eight with edges over one and two steps
    assert closes(edges, triangles, shapes, RULES.tolerance, RULES.turn_deg).all()
    # An edge is not told what it said itself: one triangle gives what its other two edges are worth, no more.
    added = propagate(np.array([0.0, 9.0, 9.0]), np.array([[0, 1, 2]]), np.array([True]))
    assert 0 < added[0] < 0.5 * np.log(1 / 0.02)
    assert propagate(np.array([0.0, 9.0, 9.0]), np.array([[0, 1, 2]]), np.array([False]))[0] < 0


def test_an_edge_away_from_the_final_poses_is_not_kept():
    shapes, truth, edges, rng = graph(noise=0.002)
    bent = inverse(truth[0]) @ truth[4]
    bent[:3, 3] += [0.1, 0, 0]  # near enough for the pose graph, not for what the surfaces say
    edges = [*edges, edge(4, 0, bent, 0.9999, rng)]
    rules = replace(RULES, kept_tolerance=0.06)
    (group,) = settle(Group(dict(truth), list(edges)), edges, shapes, rules, lambda poses: dict(truth))
    kept = [e for e in group.edges if is_kept(e, group.poses, shapes, rules)]
    assert {id(e) for e in kept} == {id(e) for e in edges[:-1]}
    assert largest_error(group.poses, truth) < 1e-12
    loose = replace(edges[3], looseness=0.03)  # times the correlation, 20: more than 0.4
    assert is_kept(edges[3], truth, shapes, RULES)
    assert not is_kept(loose, truth, shapes, RULES)


def test_scans_that_no_edge_near_the_poses_holds_part():
    shapes, truth, edges, rng = graph(noise=0.002)
    off = {**truth, 4: truth[4] @ make_transform(np.eye(3), np.array([0.5, 0, 0]))}
    alone = [e for e in edges if 4 not in (e.source, e.target)]
    far = edge(4, 0, anywhere(rng), 0.9999, rng)
    groups = settle(Group(off, []), [*alone, far], shapes, RULES)
    assert [sorted(group.poses) for group in groups] == [[0, 1, 2, 3, 5, 6, 7], [4]]


def test_two_motions_that_compete_keep_groups_apart_until_the_scans_decide():
    shapes, truth, _, rng = graph(count=2)
    right = inverse(truth[0]) @ truth[1]
    rivals = [edge(1, 0, right, 0.9999, rng), edge(1, 0, anywhere(rng), 0.9999, rng)]
    assert len(grown(shapes, rivals[:1])) == 1
    assert len(grown(shapes, rivals)) == 2

    def witness(a, b, T):
        return T, 0.0 if np.allclose(T, right) else -5.0

    (group,) = grown(shapes, rivals, witness=witness)
    assert largest_error(group.poses, truth) < 1e-9
    assert len(grown(shapes, rivals[:1], witness=lambda a, b, T: (T, -20.0))) == 2


def test_a_scan_with_a_rival_place_is_put_where_the_whole_model_wants_it():
    shapes, truth, edges, rng = graph(noise=0.002)
    wrong = edge(5, 0, anywhere(rng), 0.9999, rng)
    misplaced = {**truth, 5: truth[0] @ wrong.T_target_source}
    held = [e for e in edges if 5 not in (e.source, e.target)]

    def witness(a, b, T):
        return T, 0.0

    (group, *released) = reconsidered(
        Group(misplaced, [*held, wrong]), [*edges, wrong], shapes, RULES, witness
    )
    assert not released
    assert largest_error(group.poses, truth) < 0.05
    few = [*held, wrong, next(e for e in edges if 5 in (e.source, e.target))]  # one against one: nobody knows
    (group, *released) = reconsidered(Group(misplaced, [*held, wrong]), few, shapes, RULES, witness)
    assert len(released) <= 1


def test_groups_are_gone_on_with():
    shapes, truth, edges, _ = graph()
    halves = [grown(shapes, [e for e in edges if side(e)]) for side in (lower, upper)]
    start = [group for half in halves for group in half if len(group.poses) == 4]
    assert [sorted(group.poses) for group in start] == [[0, 1, 2, 3], [4, 5, 6, 7]]
    (group,) = grown(shapes, edges, start)
    assert largest_error(group.poses, truth) < 0.1
    assert [sorted(g.poses) for g in grown(shapes, [], start)] == [[0, 1, 2, 3], [4, 5, 6, 7]]


def lower(edge):
    return edge.source < 4 and edge.target < 4


def upper(edge):
    return edge.source >= 4 and edge.target >= 4


def test_parts_without_edges_between_them_stay_apart():
    assert connected_parts(range(5), []) == [[0], [1], [2], [3], [4]]
    rng = np.random.default_rng(0)
    links = [edge(a, b, np.eye(4), 0.9, rng) for a, b in ((3, 1), (4, 3), (0, 2))]
    assert connected_parts(range(6), links) == [[1, 3, 4], [0, 2], [5]]


def bent_chain(count=12, bend_deg=0.6):
    """Two groups side by side, of which the first drifts, each pair a little.

    Returns shapes, truth, the edges of either group, and right ones between them at both ends.
    """
    rng = np.random.default_rng(3)
    shapes = [Shape.of(rng.uniform(-1, 1, (200, 3)), np.zeros(3)) for _ in range(2 * count)]
    places = [np.array([0.5 * (k % count), 0.2 * (k // count), 0]) for k in range(2 * count)]
    truth = {k: make_transform(np.eye(3), place) for k, place in enumerate(places)}
    drift = make_transform(Rotation.from_rotvec([0, 0, np.radians(bend_deg)]).as_matrix(), np.zeros(3))

    def exact(j, i, confidence, off):
        return edge(j, i, inverse(truth[i]) @ truth[j] @ off, confidence, rng)

    first = [exact(k + 1, k, 0.999, drift) for k in range(count - 1)]
    second = [exact(k + 1, k, 0.999, np.eye(4)) for k in range(count, 2 * count - 1)]
    between = [exact(k + count, k, 0.95, np.eye(4)) for k in (0, count - 1)]
    return shapes, truth, first, second, between


def chained(edges, start):
    poses = {start: np.eye(4)}
    for e in edges:
        poses[e.source] = poses[e.target] @ e.T_target_source
    return Group(poses, list(edges))


def test_a_group_that_drifted_is_unbent_as_it_joins_another():
    shapes, truth, first, second, between = bent_chain()
    a, b = chained(first, 0), chained(second, 12)

    def witness(one, other, T_a_b):  # against all that is not about right
        off = largest_error({**one, **{k: T_a_b @ T for k, T in other.items()}}, truth)
        return T_a_b, 1.0 if off < 0.2 else -20.0

    def run(edges, align=lambda poses: poses):
        return Growth([a, b], edges, shapes, RULES, witness, align).run()

    assert len(run(between, align=None)) == 2  # either place by itself contradicts the surfaces
    (joined,) = run(between)
    assert sorted(joined.poses) == list(range(24)) and len(joined.edges) == len(first) + len(second) + 2
    rigid = {**a.poses, **{k: between[0].T_target_source @ T for k, T in b.poses.items()}}
    assert largest_error(joined.poses, truth) < 0.2 < largest_error(rigid, truth)
    wrong = replace(between[1], T_target_source=anywhere(np.random.default_rng(0)))
    assert len(run([between[0], wrong])) == 2  # no drift makes these one


def test_pairs_are_looked_at_again_between_groups_alone_the_likely_and_the_alike():
    groups = [Group({k: np.eye(4) for k in range(20)}), Group({20: np.eye(4)}), Group({21: np.eye(4)})]
    rng = np.random.default_rng(0)
    similarity = rng.uniform(size=(22, 22))
    likely, sure = {(3, 20): 0.4, (20, 21): 0.3}, {(5, 20)}

    def confidence(pair):
        return None if pair in sure else likely.get(pair, 0.0)

    found = doubtful_pairs(groups, range(21), similarity, confidence)  # scan 21 cannot be used
    assert (3, 20) in found and not sure & set(found)
    assert all(pair[1] == 20 for pair in found) and 5 <= len(found) <= 13
    alike = sorted((k for k in range(20) if k != 5), key=lambda k: -similarity[k, 20])
    assert {(k, 20) for k in alike[:6]} <= set(found)
    assert (19, 20) in doubtful_pairs(groups, range(21), similarity, confidence, sequence=True)
