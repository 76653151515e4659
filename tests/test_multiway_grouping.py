"""Groups of scans: right edges join them, wrong ones do not, however many; rivals keep them apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pose_graphs import RULES, edge, graph, largest_error
from scipy.spatial.transform import Rotation

from geomoe3d.geometry.se3 import inverse, make_transform
from geomoe3d.multiway.cycles import closes, find_triangles, propagate, with_cycles
from geomoe3d.multiway.grouping import Growth
from geomoe3d.multiway.rules import Group
from geomoe3d.multiway.second_thoughts import reconsidered
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
    assert 0 < added[0] < np.log(0.9 / 0.02)
    assert propagate(np.array([0.0, 9.0, 9.0]), np.array([[0, 1, 2]]), np.array([False]))[0] < 0


def test_doubtful_edges_that_are_wrong_alike_lose_against_one_that_is_sure():
    """A scan that looks like a place is deceived by all scans of that place: many voices, one witness."""
    shapes, truth, _, rng = graph(count=6)
    exact = {(j, i): inverse(truth[i]) @ truth[j] for j in truth for i in range(j)}
    right = [edge(j, i, exact[j, i], 0.999, rng, 0.002) for j in range(4) for i in range(j)]
    right += [edge(5, 4, exact[5, 4], 0.997, rng, 0.002), edge(5, 0, exact[5, 0], 0.99, rng, 0.002)]
    elsewhere = anywhere(rng)
    wrong = [edge(4, i, inverse(truth[i]) @ elsewhere, 0.5, rng, 0.002) for i in range(4)]
    (group,) = grown(shapes, [*right, *wrong])
    assert largest_error(group.poses, truth) < 0.05
    told = with_cycles([*right, *wrong], shapes, RULES.tolerance, RULES.turn_deg)
    assert max(e.worth for e in told[-4:]) < 0 < min(e.worth for e in told[:-4])


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


def test_free_space_finds_the_right_motion_though_it_is_the_quietest():
    shapes, truth, _, rng = graph()
    start = [Group({k: truth[k] for k in range(4)}), Group({k: truth[k] for k in range(4, 8)})]
    wrong = [edge(k, i, anywhere(rng), 0.98, rng) for k, i in ((4, 0), (5, 1), (6, 2), (7, 3), (4, 2))]
    right = edge(6, 1, inverse(truth[1]) @ truth[6], 0.8, rng)

    def witness(a, b, T):
        return T, 3.5 if np.allclose(T, np.eye(4), atol=1e-6) else -8.0

    (group,) = grown(shapes, [*wrong, right], start, witness)
    assert largest_error(group.poses, truth) < 1e-6
    assert len(grown(shapes, [*wrong, right], start)) == 2  # no scan is asked


def test_many_edges_that_are_wrong_alike_do_not_outvote_what_the_scans_saw():
    shapes, truth, _, rng = graph()
    start = [Group({k: truth[k] for k in range(4)}), Group({k: truth[k] for k in range(4, 8)})]
    alias = anywhere(rng)
    wrong = [
        edge(j, i, inverse(truth[i]) @ alias @ truth[j], 0.9999, rng) for j in range(4, 8) for i in range(4)
    ]
    assert len(grown(shapes, wrong, start, lambda a, b, T: (T, -5.0))) == 1
    assert len(grown(shapes, wrong, start, lambda a, b, T: (T, -9.0))) == 2


def test_groups_bend_where_two_edges_far_apart_agree_but_for_drift():
    shapes, _, _, rng = graph(count=20)
    truth = {k: make_transform(np.eye(3), np.array([0.5 * k, 0.0, 0.0])) for k in range(20)}
    stretched = {k: make_transform(np.eye(3), np.array([0.535 * (k - 10), 0.0, 0.0])) for k in range(10, 20)}
    start = []
    for poses in ({k: truth[k] for k in range(10)}, stretched):
        chain = [(k, k - 1) for k in poses if k - 1 in poses]
        held = [edge(j, i, inverse(poses[i]) @ poses[j], 0.99, rng) for j, i in chain]
        start.append(Group(dict(poses), held))
    sure, weak = (
        edge(j, i, inverse(truth[i]) @ truth[j], c, rng) for j, i, c in ((10, 0, 0.986), (19, 9, 0.75))
    )
    wrong = [edge(k, 19 - k, anywhere(rng), 0.9, rng) for k in (12, 15)]
    asked = []

    def witness(a, b, T):
        asked.append(T)
        away = (
            max(abs(b[j][0, 3] - a[i][0, 3] - 0.5 * (j - i)) for j, i in ((10, 0), (19, 9)))
            if T is None
            else 9
        )
        return np.eye(4) if T is None else T, 1.0 if away < 0.2 else -9.0

    (group,) = grown(shapes, [*wrong, sure, weak], start, witness)
    assert any(T is None for T in asked)
    assert largest_error(group.poses, truth) < 0.2
    assert weak.worth < 0 < min(e.worth for e in group.edges)  # what agrees is believed together
    assert len(grown(shapes, [*wrong, sure], start, witness)) == 2
    beside = edge(11, 0, inverse(truth[0]) @ truth[11], 0.75, rng)  # shares a scan: no witness of its own
    assert len(grown(shapes, [*wrong, sure, beside], start, witness)) == 2


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
