"""Many scans in one model: right poses, no wrong edge, groups kept apart, formats that read back."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from small_scans import SETTINGS, cut, scene

from geomoe3d import register_scans
from geomoe3d.batch.store import JOURNAL_FILE
from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.prepare import prepare
from geomoe3d.config import PreparationConfig, load_config
from geomoe3d.errors import InputError
from geomoe3d.geometry.se3 import (
    inverse,
    make_transform,
    project_to_so3,
    rotation_error_deg,
    transform_points,
)
from geomoe3d.journal import read_journal
from geomoe3d.judge import deviations_at
from geomoe3d.multiway.alignment import Surface, align_scans
from geomoe3d.multiway.edges import Edge, Shape, agrees, displacement, expected_error
from geomoe3d.multiway.formats import quaternion, right_information
from geomoe3d.multiway.grouping import Group, GroupingRules, connected_parts, group_scans, settle
from geomoe3d.multiway.overlaps import Overlaps
from geomoe3d.multiway.page import render_model_page
from geomoe3d.multiway.pose_graph import optimise
from geomoe3d.multiway.proposals import propose_pairs, scan_similarity
from geomoe3d.multiway.scans import choose_common_voxel_size, find_scans
from geomoe3d.types import PointCloud

CONFIG = load_config(None, SETTINGS)
UTM = np.array([583394.0, 5283100.0, 498.0])
RULES = GroupingRules(tolerance=0.2, near_tolerance=0.125, kept_tolerance=0.125, kept_error=0.4)
CUTS = ((0.0, 2.6), (0.5, 3.1), (1.0, 3.6), (1.4, 4.0), (1.8, 4.6))


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """A cache of described clouds of this file's own."""
    kept = os.environ.get("GEOMOE3D_CACHE")
    os.environ["GEOMOE3D_CACHE"] = str(tmp_path_factory.mktemp("cache"))
    yield
    if kept is None:
        del os.environ["GEOMOE3D_CACHE"]
    else:
        os.environ["GEOMOE3D_CACHE"] = kept


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Five scans of one scene at map coordinates, one of another scene, one broken file; true poses."""
    folder = tmp_path_factory.mktemp("room")
    points, poses = scene(), {}
    for number, (low, high) in enumerate(CUTS):
        part, T = cut(points, low, high, seed=number)
        np.save(folder / f"scan_{number}.npy", part + UTM)
        poses[f"scan_{number}"] = T
    np.save(folder / "scan_8.npy", cut(scene(77), 0.0, 3.0, seed=8)[0])
    (folder / "scan_9.ply").write_text("ply\nnothing\n")
    return folder, poses


@pytest.fixture(scope="module")
def model(room, tmp_path_factory):
    return register_scans([room[0]], tmp_path_factory.mktemp("model"), config=CONFIG)


# ---- whole -------------------------------------------------------------------------------------------


def test_every_scan_is_placed_rightly_or_named_with_a_reason(room, model):
    _, truth = room
    (group,) = model.groups
    assert set(group.poses) == set(truth)
    assert group.reference == "scan_0"
    for name, T in group.poses.items():
        expected = inverse(truth["scan_0"]) @ truth[name]
        points = np.random.default_rng(0).uniform(-2, 2, (20, 3))
        found = transform_points(T, points + UTM) - UTM
        assert np.abs(found - transform_points(expected, points)).max() < 0.05, name
    assert set(model.unplaced) == {"scan_8", "scan_9"}
    assert "surest" in model.unplaced["scan_8"]
    assert "scan_9.ply" in model.unplaced["scan_9"]
    assert not model.ok
    for edge in model.edges:
        right = edge.source in truth and edge.target in truth
        if right:
            expected = inverse(truth[edge.target]) @ truth[edge.source]
            right = rotation_error_deg(edge.T_target_source, expected) < 15
        assert right or not edge.kept
        assert edge.kept == (edge.reason == "")
    assert sum(edge.kept for edge in model.edges) >= 4


def test_everything_is_written_and_agrees(room, model):
    folder = model.folder
    stored = json.loads((folder / "poses.json").read_text())
    (group,) = stored["groups"]
    poses = model.groups[0].poses
    for scan in group["scans"]:
        assert np.array(scan["T_reference_scan"]).tobytes() == poses[scan["name"]].tobytes()
        assert Path(scan["path"]).is_file()
    kitti = np.loadtxt(folder / "group1.kitti.txt").reshape(-1, 3, 4)
    assert kitti.tobytes() == np.stack([T[:3] for T in poses.values()]).tobytes()
    tum = np.loadtxt(folder / "group1.tum.txt")
    assert tum[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert tum[:, 1:4].tobytes() == np.ascontiguousarray(kitti[:, :, 3]).tobytes()
    assert np.abs(Rotation.from_quat(tum[:, 4:]).as_matrix() - kitti[:, :, :3]).max() < 1e-12
    merged = load_points(folder / "group1.ply")
    assert np.abs(merged.file_points.mean(0) - UTM).max() < 20
    assert np.abs(merged.file_points * 1e4 - np.round(merged.file_points * 1e4)).max() > 1e-3  # not float32
    inputs = [transform_points(T, np.load(room[0] / f"{name}.npy")) for name, T in poses.items()]
    everything = np.concatenate(inputs) - UTM
    assert len(merged) < len(everything) / 3
    reach = 0.12 * np.sqrt(3)
    assert cKDTree(merged.file_points - UTM).query(everything)[0].max() < reach
    assert cKDTree(everything).query(merged.file_points - UTM)[0].max() < reach


def test_the_g2o_file_holds_the_graph(model):
    lines = (model.folder / "group1.g2o").read_text().splitlines()
    vertices = [line.split() for line in lines if line.startswith("VERTEX_SE3:QUAT")]
    edges = [line.split() for line in lines if line.startswith("EDGE_SE3:QUAT")]
    poses = {int(v[1]): pose_of(v[2:9]) for v in vertices}
    assert sorted(poses) == [0, 1, 2, 3, 4]
    assert lines.count("FIX 0") == 1
    assert len(edges) == sum(edge.kept for edge in model.edges)
    for words in edges:
        i, j = int(words[1]), int(words[2])
        predicted = inverse(poses[i]) @ poses[j]
        assert np.abs(pose_of(words[3:10]) - predicted).max() < 0.1
        information = np.zeros((6, 6))
        information[np.triu_indices(6)] = [float(word) for word in words[10:]]
        information += np.triu(information, 1).T
        assert np.linalg.eigvalsh(information)[0] > 0


def pose_of(words):
    values = np.array([float(word) for word in words])
    return make_transform(Rotation.from_quat(values[3:]).as_matrix(), values[:3])


def test_the_page_is_self_contained_and_lists_every_scan(model):
    page = (model.folder / "page.html").read_text()
    assert page == render_model_page(model)
    for scan in model.scans:
        assert scan.name in page
    assert page.count("data-scan=") == 5
    assert "src=" not in page
    assert "http" not in page.replace("http-equiv", "")
    assert "{{" not in page
    data = json.loads(page.split('type="application/json">', 1)[1].split("</script>", 1)[0])
    assert len(data["clouds"]) == 5
    assert data["lines"]["classes"][0]["drawn"] == sum(edge.kept for edge in model.edges)


def test_adding_a_scan_reuses_every_earlier_pair(room, tmp_path):
    folder, _ = room
    files = [folder / f"scan_{k}.npy" for k in range(5)]
    first = register_scans([files[0], files[1], files[3]], tmp_path, config=CONFIG, page=False)
    before = (tmp_path / "pairs" / JOURNAL_FILE).read_bytes()
    more = register_scans([files[3], files[0], files[1], files[2]], tmp_path, config=CONFIG, page=False)
    after = (tmp_path / "pairs" / JOURNAL_FILE).read_bytes()
    assert first.num_pairs == 3
    assert more.num_pairs == 6
    assert after.startswith(before)
    ids = [record["id"] for record in read_journal(tmp_path / "pairs" / JOURNAL_FILE)]
    assert len(ids) == len(set(ids)) == 6
    assert len(more.groups[0].poses) == 4
    again = register_scans([files[3], files[0], files[1], files[2]], tmp_path, config=CONFIG, page=False)
    assert (tmp_path / "pairs" / JOURNAL_FILE).read_bytes() == after
    assert again.to_json() == more.to_json()


def test_the_command_places_and_exits_with_three(room, tmp_path):
    folder, _ = room
    options = [part for setting in SETTINGS for part in ("--set", setting)]
    files = [str(folder / f"scan_{k}.npy") for k in (0, 1, 8)]
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "geomoe3d",
            "multiway",
            *files,
            str(tmp_path / "o"),
            *options,
            "--workers",
            "1",
        ],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        cwd=Path(__file__).parents[1],
    )
    assert done.returncode == 3, done.stderr
    assert "2 of 3 scans placed" in done.stdout
    assert "scan_8: its surest of 2 pairs" in done.stdout
    assert "1 worker of about" in done.stderr


@pytest.mark.parametrize(
    ("inputs", "named", "message"),
    [
        (["none"], {}, "no file or folder"),
        (["."], {}, "holds no clouds"),
        (["a.npy"], {}, "at least 2 scans"),
        (["a.npy", "a.npy"], {}, "more than once"),
        (["a.npy", "b.npy"], {"pairs": "some"}, "choose auto, all or similar"),
        (["a.npy", "b.npy"], {"neighbors": 0}, "at least 1"),
        (["a.npy", "b.npy"], {}, "fewer than 2 scans can be used"),
    ],
)
def test_unusable_input_is_refused(tmp_path, monkeypatch, inputs, named, message):
    monkeypatch.chdir(tmp_path)
    if inputs != ["."]:
        for name in ("a", "b"):
            (tmp_path / f"{name}.npy").write_bytes(b"broken")
    with pytest.raises(InputError, match=message):
        register_scans(inputs, tmp_path / "out", config=CONFIG, **named)


def test_a_folder_that_holds_something_of_the_users_is_refused(room, tmp_path):
    scans, _ = room
    out = tmp_path / "out"
    out.mkdir()
    kept = [out / "group1.ply", out / "groups.csv"]
    for path in kept:
        path.write_text("mine")
    with pytest.raises(InputError, match=r"group1\.ply' is not of a model"):
        register_scans([scans], out, config=CONFIG)
    with pytest.raises(InputError, match="is a file"):
        register_scans([scans], kept[1], config=CONFIG)
    with pytest.raises(InputError, match="taken for a scan"):
        register_scans([scans], scans, config=CONFIG)
    assert sorted(out.iterdir()) == kept
    assert all(path.read_text() == "mine" for path in kept)


def test_files_of_the_users_beside_a_model_stay(room, tmp_path):
    scans = [room[0] / f"scan_{k}.npy" for k in (0, 1)]
    (tmp_path / "grouping.txt").write_text("mine")
    register_scans(scans, tmp_path, config=CONFIG, page=False)
    (tmp_path / "group7.ply").write_bytes((tmp_path / "group1.ply").read_bytes())  # of a larger model before
    register_scans(scans, tmp_path, config=CONFIG, page=False)
    assert (tmp_path / "grouping.txt").read_text() == "mine"
    assert (tmp_path / "group1.ply").is_file()
    assert not (tmp_path / "group7.ply").exists()


# ---- parts -------------------------------------------------------------------------------------------


def test_scans_are_found_in_natural_order_with_unique_names(tmp_path):
    for name in ("a/s10.npy", "a/s9.npy", "b/s9.npy", "a/notes.md"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    assert [scan.name for scan in find_scans([tmp_path / "a"])] == ["s9", "s10"]
    assert [s.name for s in find_scans([tmp_path / "a", tmp_path / "b"])] == ["a/s9", "a/s10", "b/s9"]


def test_the_common_voxel_size_serves_the_median_scan(room):
    folder, _ = room
    scans = find_scans([folder])
    size, unusable = choose_common_voxel_size(scans, PreparationConfig(voxel_points=500))
    assert list(unusable) == ["scan_9"]
    assert 0.1 < size < 0.6
    assert float(f"{size:.2g}") == size


def test_similar_scans_propose_each_other():
    rng = np.random.default_rng(0)
    kinds = [rng.normal(size=(40, 33)) for _ in range(3)]
    features = []
    for kind in kinds:
        for _ in range(3):
            f = kind[rng.integers(0, 40, 300)] + 0.2 * rng.normal(size=(300, 33))
            features.append((f / np.linalg.norm(f, axis=1, keepdims=True)).astype(np.float32))
    within = {(i, j) for j in range(9) for i in range(j) if i // 3 == j // 3}
    assert propose_pairs(features, 2) == within
    assert propose_pairs(features, 99) == {(i, j) for j in range(9) for i in range(j)}
    similarity = scan_similarity(features)
    assert np.allclose(similarity, similarity.T)
    assert np.array_equal(similarity, scan_similarity(features))


def graph(seed=0, *, count=8, noise=0.01):
    """A ring of scans: shapes, true poses, and an edge for every two that are at most two steps apart."""
    rng = np.random.default_rng(seed)
    shapes, poses = [], {}
    for k in range(count):
        points = rng.uniform(-1, 1, (200, 3))
        shapes.append(Shape.of(points, np.zeros(3)))
        poses[k] = make_transform(Rotation.random(random_state=k).as_matrix(), rng.uniform(-4, 4, 3))
    edges = []
    for j in range(count):
        for i in range(j):
            if min(j - i, count - j + i) <= 2:
                edges.append(edge(j, i, inverse(poses[i]) @ poses[j], 0.999, rng, noise))
    return shapes, poses, edges, rng


def edge(source, target, T, confidence, rng, noise=0.0):
    turn = Rotation.from_rotvec(noise * rng.normal(size=3)).as_matrix()
    moved = make_transform(turn @ T[:3, :3], T[:3, 3] + noise * rng.normal(size=3))
    return Edge(source, target, moved, confidence, np.eye(6) * 1000)


def largest_error(poses, truth):
    T = truth[0] @ inverse(poses[0])
    return max(np.abs(T @ poses[k] - truth[k]).max() for k in poses)


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


def test_looseness_is_the_deviation_of_the_sensor():
    rng = np.random.default_rng(4)
    points, normals = rng.normal((0, 0, 2), 1, (300, 3)), rng.normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    J = np.hstack([np.cross(points, normals), normals])
    sensor = np.array([0.3, -0.2, 0.1])
    moved = []
    for _ in range(4000):  # noise of every gap, the motion that fits it best, and where that puts the sensor
        w, v = np.split(np.linalg.lstsq(J, 0.01 * rng.normal(size=300), rcond=None)[0], 2)
        moved.append(np.cross(w, sensor) + v)
    expected = np.sqrt((np.array(moved) ** 2).sum(1).mean())
    assert deviations_at(J.T @ J / 0.01**2, np.zeros(3), sensor[None])[0] == pytest.approx(expected, rel=0.03)
    center = np.array([0.5, 0.2, 2.0])  # the same information about another point
    J = np.hstack([np.cross(points - center, normals), normals])
    assert deviations_at(J.T @ J / 0.01**2, center, sensor[None])[0] == pytest.approx(expected, rel=0.03)
    shape = Shape.of(points, np.zeros(3), sensor)
    T = make_transform(Rotation.from_rotvec([0.1, 0, 0]).as_matrix(), np.array([0.2, 0, 0]))
    one = Edge(1, 0, T, 0.9, np.eye(6), looseness=0.02)
    apart = np.linalg.norm((T - np.eye(4)) @ np.append(sensor, 1))
    poses = {0: np.eye(4), 1: np.eye(4)}
    assert expected_error(one, poses, shape, 20.0) == pytest.approx(np.hypot(apart, 0.4))


@pytest.fixture(scope="module")
def surfaces():
    """Six scans of one scene as surfaces, and one of another scene; true poses."""
    points, truth, made = scene(3), {}, {}
    for k, (low, high) in enumerate([*CUTS, (2.0, 4.4)]):
        part, truth[k] = cut(points, low, high, seed=20 + k)
        cloud = prepare(PointCloud(part), 0.12, CONFIG.preparation, viewpoint=None, seed=0)
        made[k] = Surface(cloud.points, cloud.normals, signed=False)
    elsewhere = prepare(PointCloud(scene(5) + 50), 0.12, CONFIG.preparation, viewpoint=None, seed=0)
    made[6], truth[6] = Surface(elsewhere.points, elsewhere.normals, signed=False), np.eye(4)
    return made, truth, Overlaps({k: s.points for k, s in made.items()})


def moved_about(truth, rng, turn=0.02, shift=0.1):
    poses = {}
    for k, T in truth.items():
        R = Rotation.from_rotvec(turn * rng.normal(size=3)).as_matrix()
        poses[k] = T @ make_transform(R, shift * rng.normal(size=3))
    return poses


def test_surfaces_draw_scans_into_place(surfaces):
    made, truth, overlaps = surfaces
    start = moved_about({k: truth[k] for k in range(6)}, np.random.default_rng(1))
    found = align_scans(start, made, overlaps, 0.12)
    assert np.abs(found[0] - start[0]).max() < 1e-12
    assert largest_error(start, truth) > 0.15
    assert largest_error(found, truth) < 0.03
    for T in found.values():
        assert np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-12
    # The frame of the group changes nothing: it may lie far away and be turned.
    away = make_transform(Rotation.random(random_state=9).as_matrix(), np.array([300.0, -40.0, 7.0]))
    far = align_scans({k: away @ T for k, T in start.items()}, made, overlaps, 0.12)
    assert max(np.abs(inverse(away) @ far[k] - found[k]).max() for k in found) < 1e-6


def test_a_scan_that_overlaps_nothing_stays_where_it_was(surfaces):
    made, truth, overlaps = surfaces
    start = {0: truth[0], 6: truth[6]}
    found = align_scans(start, made, overlaps, 0.12)
    assert all(np.abs(found[k] - start[k]).max() < 1e-12 for k in start)
    one = align_scans({3: truth[3]}, made, overlaps, 0.12)
    assert np.abs(one[3] - truth[3]).max() < 1e-12
    among = align_scans(moved_about(truth, np.random.default_rng(2), 0.01, 0.05), made, overlaps, 0.12)
    assert largest_error({k: among[k] for k in range(6)}, truth) < 0.03


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


def test_the_pose_graph_keeps_its_reference_and_spreads_the_error_of_a_loop():
    _, truth, edges, rng = graph(noise=0.0)
    start = {k: truth[k] @ edge(0, 0, np.eye(4), 0.9, rng, 0.03).T_target_source for k in truth}
    found = optimise(start, edges, 0.2)
    assert np.abs(found[0] - start[0]).max() < 1e-9
    T = truth[0] @ inverse(found[0])
    assert max(np.abs(T @ found[k] - truth[k]).max() for k in truth) < 1e-3


def test_displacement_is_the_root_mean_square_of_the_points():
    rng = np.random.default_rng(3)
    points = rng.normal(size=(400, 3)) * [2, 1, 0.3] + [5, 0, -1]
    shape = Shape.of(points, np.zeros(3))
    A, B = (make_transform(Rotation.random(random_state=k).as_matrix(), rng.normal(size=3)) for k in (1, 2))
    away = transform_points(A, points) - transform_points(B, points)
    assert displacement(A, B, shape) == pytest.approx(np.sqrt((away**2).sum(1).mean()), rel=1e-12)
    assert agrees(A, A, shape, 1e-6, 1e-3)
    turned = A @ make_transform(Rotation.from_rotvec([0, 0, 0.2]).as_matrix(), np.zeros(3))
    assert not agrees(A, turned, shape, 100.0, 10.0)


def test_quaternions_and_right_information_against_their_definitions():
    for k in range(30):
        R = Rotation.random(random_state=k).as_matrix()
        q = quaternion(R)
        assert q[3] >= 0
        assert np.abs(Rotation.from_quat(q).as_matrix() - R).max() < 1e-12
    rng = np.random.default_rng(0)
    L = rng.normal(size=(6, 6))
    T = make_transform(Rotation.random(random_state=1).as_matrix(), rng.normal(size=3))
    one = Edge(1, 0, T, 0.9, L @ L.T)
    small = 1e-6 * rng.normal(size=6)  # on the right: translation, half turn
    moved = T @ make_transform(Rotation.from_rotvec(2 * small[3:]).as_matrix(), small[:3])
    D = moved @ inverse(T)  # the same on the left
    left = np.concatenate([Rotation.from_matrix(project_to_so3(D[:3, :3])).as_rotvec(), D[:3, 3]])
    expected = left @ one.information @ left
    assert small @ right_information(one) @ small == pytest.approx(expected, rel=1e-4)
