"""What sensors saw tells wrong places from right ones: of sure pairs that contradict the poses, and of placed scans."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomoe3d.geometry.se3 import inverse, make_transform, transform_points
from geomoe3d.multiway.alignment import Surface
from geomoe3d.multiway.assembly import Assembly
from geomoe3d.multiway.edges import Edge, Shape
from geomoe3d.multiway.free_space import FreeSpace
from geomoe3d.multiway.grouping import Growth
from geomoe3d.multiway.holding import is_denied, loosely_held
from geomoe3d.multiway.overlaps import Overlaps
from geomoe3d.multiway.rules import Group, GroupingRules

SIZE = np.array([6.0, 4.0, 3.0])
VOXEL = 0.1
COUNT = 16


def scan_of_room(rng, count=4000):
    """Points on the walls of an empty room as a sensor in it sees them, their normals, and its pose in the room."""
    stand = SIZE * rng.uniform(0.35, 0.65, 3)
    rays = rng.normal(size=(count, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    reaches = np.where(rays > 0, SIZE - stand, stand) / np.abs(rays)
    walls = reaches.argmin(1)
    points = stand + rays * reaches.min(1)[:, None]
    normals = -np.sign(rays[np.arange(count), walls])[:, None] * np.eye(3)[walls]
    pose = make_transform(Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix(), stand)
    return transform_points(inverse(pose), points), normals @ pose[:3, :3], pose


@pytest.fixture(scope="module")
def room():
    rng = np.random.default_rng(0)
    scans = [scan_of_room(rng) for _ in range(COUNT)]
    points = {k: one[0] for k, one in enumerate(scans)}
    survey = SimpleNamespace(
        scans=scans,
        surfaces={k: Surface(one[0], one[1], True) for k, one in enumerate(scans)},
        shapes=[Shape.of(one[0], np.zeros(3), np.zeros(3)) for one in scans],
        overlaps=Overlaps(points, VOXEL),
        free_space=FreeSpace(points, dict.fromkeys(points, np.zeros(3)), VOXEL),
        voxel_size=VOXEL,
        rules=GroupingRules(*(VOXEL * np.array([4.0, 2.5, 1.5, 3.0]))),
        config=SimpleNamespace(seed=0),
        edges={},
        outcomes={},
        map_edges={},
        odometry=list,
        sequence=False,
    )
    return survey, {k: one[2] for k, one in enumerate(scans)}


def about_middle(degrees):
    """A turn about the upright axis through the middle of the room."""
    R = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return make_transform(R, SIZE / 2 - R @ (SIZE / 2))


def edge(poses, source, target, moved=None, confidence=0.99):
    T = inverse(poses[target]) @ (np.eye(4) if moved is None else moved) @ poses[source]
    return Edge(source, target, T, confidence, 1000 * np.eye(6))


def test_a_pair_is_denied_where_sensors_saw_through_and_not_where_the_room_looks_the_same(room):
    survey, poses = room
    assert is_denied(survey, edge(poses, 5, 0, about_middle(90)), poses)
    assert not is_denied(survey, edge(poses, 5, 0, about_middle(180)), poses)
    assert not is_denied(survey, edge(poses, 5, 0), poses)


def test_a_scan_is_let_go_where_far_more_of_it_is_seen_through_than_of_the_others(room):
    survey, poses = room
    right = [edge(poses, k, k - 1) for k in range(1, COUNT)]
    assert loosely_held(survey, Group(poses, right)) == set()
    wrong = {**poses, 7: about_middle(90) @ poses[7]}
    held = [edge(wrong, k, k - 1) for k in range(1, COUNT)]
    assert loosely_held(survey, Group(wrong, held)) == {7}


def test_one_pair_that_shares_little_must_be_sure_in_the_company_of_others(room):
    survey, poses = room
    aside = {**poses, 11: make_transform(np.eye(3), np.array([5.9, 0, 0])) @ poses[11]}  # the next room
    held = [edge(aside, k, k - 1) for k in range(1, 11)]
    for confidence, evidence, expected, loose in (
        (0.98, 0.0, 0.0, {11}),
        (0.9999, 0.0, 0.0, set()),
        (0.98, 3.0, 0.0, set()),
        (0.98, 0.0, 0.5, set()),  # it is known otherwise that they overlap
    ):
        lone = edge(aside, 11, 10, confidence=confidence)
        lone = Edge(**{**vars(lone), "evidence": evidence, "expected": expected})
        assert loosely_held(survey, Group(aside, [*held, lone])) == loose
    assert (
        loosely_held(survey, Group(aside, [*held, edge(aside, 11, 10, confidence=0.98), edge(aside, 11, 9)]))
        == set()
    )


def test_a_scan_that_is_let_go_finds_its_right_place_without_the_pairs_that_held_it(room):
    """Three pairs alike outvote one that is right; the surfaces and what is seen through do not agree with them."""
    survey, poses = room
    edges = {(k - 1, k): edge(poses, k, k - 1) for k in range(1, COUNT)}
    edges[6, 7] = edge(poses, 7, 6, confidence=0.999)
    del edges[7, 8]
    edges[6, 8] = edge(poses, 8, 6)
    for other in (0, 1, 2, 3, 4, 5):
        edges[other, 7] = edge(poses, 7, other, about_middle(90), confidence=0.9)
    heard = SimpleNamespace(**{**vars(survey), "edges": edges, "outcomes": dict.fromkeys(edges)})
    assembly = Assembly(heard)
    wrong = Group({**poses, 7: about_middle(90) @ poses[7]}, [])
    assembly.edges = assembly._heard()
    parts = assembly._settled(wrong)
    assert sorted(len(part.poses) for part in parts) == [1, COUNT - 1]
    told = assembly._usable(), survey.shapes, survey.rules
    (group,) = Growth(parts, *told).run()
    error = inverse(group.poses[7]) @ group.poses[0] - inverse(poses[7]) @ poses[0]
    assert np.abs(error).max() < 0.05
