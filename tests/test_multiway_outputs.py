"""What a model says of itself: loops, tables, merged cloud, posed scans, and poses given beforehand."""

from __future__ import annotations

import csv
import html
import json
import shutil
from dataclasses import replace
from urllib.parse import unquote

import numpy as np
import pytest
from pose_graphs import edge, graph
from scipy.spatial.transform import Rotation
from small_scans import SETTINGS, UTM

from geomoe3d import register_scans
from geomoe3d.batch.folder import short_transform_name
from geomoe3d.cli.multiway import summary
from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.loading import read_raw
from geomoe3d.clouds.transform_files import load_transform
from geomoe3d.config import load_config
from geomoe3d.errors import InputError
from geomoe3d.geometry.se3 import inverse, make_transform, transform_points
from geomoe3d.multiway.formats import tum_text
from geomoe3d.multiway.free_space import FreeSpace, told_by
from geomoe3d.multiway.initial import read_poses
from geomoe3d.multiway.loops import find_loops
from geomoe3d.multiway.report import contradicted_steps
from geomoe3d.multiway.scans import Scan, find_copies

CONFIG = load_config(None, SETTINGS)

pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.fixture(scope="module")
def model(scanned_room, tmp_path_factory):
    files = [scanned_room[0] / f"scan_{k}.npy" for k in (0, 1, 2, 3)]
    return register_scans(files, tmp_path_factory.mktemp("model"), config=CONFIG, page=False, sequence=True)


def test_a_scan_under_a_second_name_is_named_everywhere_and_both_are_placed(scanned_room, tmp_path):
    files = [tmp_path / name for name in ("first.npy", "second.npy", "again.npy")]
    for file, k in zip(files, (0, 1, 1), strict=True):
        shutil.copy(scanned_room[0] / f"scan_{k}.npy", file)
    said = []
    made = register_scans(files, tmp_path / "out", config=CONFIG, workers=1, say=said.append)
    told = "'again' is 'second' once more: the files are the same, byte for byte"
    assert made.copies == {"again": "second"}
    assert {"again", "second"} <= made.groups[0].poses.keys()
    np.testing.assert_allclose(made.groups[0].poses["again"], made.groups[0].poses["second"], atol=0.02)
    assert [line for line in said if line.startswith(f"note: {told}")]
    assert told in summary(made)
    assert told in html.unescape((tmp_path / "out" / "page.html").read_text())
    assert json.loads((tmp_path / "out" / "poses.json").read_text())["copies"] == {"again": "second"}
    rows = {row["scan"]: row for row in csv.DictReader((tmp_path / "out" / "scans.csv").open())}
    assert "the same file as 'second'" in rows["again"]["reason"]
    assert "same" not in rows["second"]["reason"]


def test_no_scan_is_the_copy_of_one_that_cannot_be_read_and_three_are_copies_of_the_first():
    scans = [Scan(name, f"/{name}") for name in "abcd"]
    assert find_copies(scans, {"/a": "x", "/b": "x", "/d": "x"}.get) == {"b": "a", "d": "a"}
    assert find_copies(scans, {}.get) == {}


def test_a_loop_that_does_not_close_is_told_with_what_it_is_off():
    shapes, truth, edges, rng = graph(noise=0.0)
    loops = find_loops(truth, edges, shapes, 0.05)
    assert len(loops) == len(edges) - 7  # a tree of eight scans has seven edges
    assert all(loop.closes and loop.shift < 1e-9 for loop in loops)
    turned = edge(4, 0, inverse(truth[0]) @ truth[4] @ make_transform(np.eye(3), np.ones(3)), 0.999, rng)
    worst = find_loops(truth, [*edges, turned], shapes, 0.05)[0]
    assert not worst.closes
    assert {worst.scans[0], worst.scans[-1]} == {0, 4}
    assert worst.shift == pytest.approx(np.sqrt(3))
    assert len(set(worst.scans)) == len(worst.scans) >= 3
    # What all others contradict is followed where registration was sure of it, and only there.
    for confidence, told in ((0.995, True), (0.97, False)):
        doubted = replace(turned, confidence=confidence, evidence=-9.0)
        loops = find_loops(truth, [*edges, doubted], shapes, 0.05)
        assert all(loop.closes for loop in loops) != told


def test_a_scan_in_front_of_what_another_saw_contradicts_it():
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-1, 1, (3000, 2)), np.full(3000, 3.0)])
    box = np.column_stack([rng.uniform(-0.3, 0.3, (3000, 2)), np.full(3000, 3.0)])
    free = FreeSpace({0: wall, 1: box}, {0: np.zeros(3), 1: np.zeros(3)}, 0.05)
    before = make_transform(np.eye(3), np.array([0, 0, -1.0]))
    poses = {0: np.eye(4)}, {1: np.eye(4)}
    seen, through = free.between(*poses, np.eye(4))
    assert seen > 1
    assert through == 0
    assert told_by(seen, through, 0.01) > 0
    seen, through = free.between(*poses, before)
    assert through > 0.5
    assert told_by(seen, through, 0.01) < -3
    assert FreeSpace({0: wall, 1: box}, {}, 0.05).between(*poses, before) == (0.0, 0.0)


def test_tables_and_matrices_say_what_the_model_says(model):
    (group,) = model.groups
    with (model.folder / "scans.csv").open(newline="") as stream:
        scans = list(csv.DictReader(stream))
    assert [row["scan"] for row in scans] == [f"scan_{k}" for k in range(4)]
    with (model.folder / "edges.csv").open(newline="") as stream:
        edges = list(csv.DictReader(stream))
    assert len(edges) == len(model.edges)
    for row, one in zip(edges, model.edges, strict=True):
        assert (row["source"], row["target"], row["fate"]) == (one.source, one.target, one.fate)
        assert one.kept or row["reason"]
        assert not one.kept or (float(row["shift"]) < 0.2 and row["reason"] == "")
    for row in scans:
        T = group.poses[row["scan"]]
        assert [float(row[axis]) for axis in "xyz"] == T[:3, 3].tolist()
        held = sum(e.kept and row["scan"] in (e.source, e.target) for e in model.edges)
        assert int(row["edges_kept"]) == held
        assert np.array_equal(load_transform(model.folder / "matrices" / f"{row['scan']}.txt"), T)
    stored = json.loads((model.folder / "poses.json").read_text())
    assert len(stored["groups"][0]["loops"]) == len(group.loops) > 0
    assert stored["groups"][0]["bent"] == group.bent == ""


def test_the_merged_cloud_tells_the_scan_of_every_point(model):
    raw = read_raw(model.folder / "group1.ply")
    assert set(np.unique(raw.fields["scan"])) == {0, 1, 2, 3}
    assert raw.fields["num_scans"].max() > 1
    alone = raw.fields["num_scans"] == 1
    for number in range(4):
        name = f"scan_{number}"
        source = load_points(model.scans[number].path)
        moved = transform_points(model.groups[0].poses[name], source.file_points) - UTM
        mine = raw.points[alone & (raw.fields["scan"] == number)] - UTM
        low, high = moved.min(0) - 0.01, moved.max(0) + 0.01
        assert ((mine >= low) & (mine <= high)).all()


def test_all_scans_stand_in_one_e57_file_with_their_poses(scanned_room, tmp_path):
    pytest.importorskip("pye57")
    files = [scanned_room[0] / f"scan_{k}.npy" for k in (0, 1)]
    model = register_scans(files, tmp_path / "m", config=CONFIG, page=False, e57=True)
    found = read_raw(tmp_path / "m" / "group1.e57").points
    poses = model.groups[0].poses.items()
    expected = [
        transform_points(T, load_points(scanned_room[0] / f"{name}.npy").file_points) for name, T in poses
    ]
    assert np.abs(found - np.concatenate(expected)).max() < 1e-5


@pytest.mark.parametrize("marked", [False, True])
@pytest.mark.parametrize("kind", ["tum", "kitti", "json", "names", "model"])
def test_poses_are_read_as_they_were_written(tmp_path, kind, marked):
    poses = [make_transform(Rotation.random(random_state=k).as_matrix(), UTM * k) for k in range(3)]
    names = ["a", "b", "c"]
    scans = [{"name": n, "T_reference_scan": T.tolist()} for n, T in zip(names, poses, strict=True)]
    text = {
        "tum": tum_text(names, [0, 1, 2], poses),
        "kitti": "\n".join(" ".join(f"{value:.17g}" for value in T[:3].ravel()) for T in poses),
        "json": json.dumps([T.tolist() for T in poses]),
        "names": json.dumps({n: T.tolist() for n, T in zip(names, poses, strict=True)}),
        "model": json.dumps({"groups": [{"scans": scans}]}),
    }[kind]
    (tmp_path / "poses").write_text(text, encoding="utf-8-sig" if marked else "utf-8")
    for found, T in zip(read_poses(tmp_path / "poses", names), poses, strict=True):
        assert np.abs(found - T).max() < 1e-9


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n", "TUM hold 8, all of KITTI 12"),
        ("0 0 0 0 0 0 0 1\n", "1 pose for 2 scans"),
        ('{"a": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}', "no pose for 'b'"),
        (
            "[[[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]],[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]]",
            "a scale of 2",
        ),
    ],
)
def test_poses_that_cannot_be_used_are_refused(tmp_path, text, message):
    (tmp_path / "poses").write_text(text)
    with pytest.raises(InputError, match=message):
        read_poses(tmp_path / "poses", ["a", "b"])
    with pytest.raises(InputError, match="cannot read"):
        read_poses(tmp_path / "none", ["a", "b"])


def test_given_poses_place_scans_that_follow_each_other(scanned_room, tmp_path):
    folder, truth = scanned_room
    rng = np.random.default_rng(0)
    names = [f"scan_{k}" for k in range(4)]
    given = {}
    for name in names:  # p_world = T_scene_scan (p - UTM), a little off
        off = make_transform(Rotation.from_rotvec(rng.normal(0, 0.01, 3)).as_matrix(), rng.normal(0, 0.05, 3))
        given[name] = (off @ truth[name] @ make_transform(np.eye(3), -UTM)).tolist()
    (tmp_path / "given.json").write_text(json.dumps(given))
    model = register_scans(
        [folder / f"{name}.npy" for name in names],
        tmp_path / "m",
        config=CONFIG,
        page=False,
        initial=tmp_path / "given.json",
        initial_error=(0.2, 2.0),
    )
    (group,) = model.groups
    points = rng.uniform(-2, 2, (20, 3))
    for name in names:
        expected = transform_points(inverse(truth["scan_0"]) @ truth[name], points)
        assert np.abs(transform_points(group.poses[name], points + UTM) - UTM - expected).max() < 0.05


def test_wrong_initial_poses_are_no_repeated_structure_and_are_named(scanned_room, tmp_path):
    folder, _ = scanned_room
    files = [folder / f"scan_{k}.npy" for k in range(3)]
    far = [make_transform(np.eye(3), np.array([50.0 * k, 0, 0])).tolist() for k in range(3)]
    (tmp_path / "given.json").write_text(json.dumps(far))
    said: list[str] = []
    model = register_scans(
        files, tmp_path / "m", config=CONFIG, page=False, initial=tmp_path / "given.json", say=said.append
    )
    assert not any(group.repeated for group in model.groups)
    assert any("the initial poses contradict the scans: 2 of their 2 steps" in one for one in said)
    steps = [edge for edge in model.edges if edge.given]
    assert {edge.fate for edge in steps} == {"rejected"}
    assert all(edge.reason.startswith("as the initial poses have it: ") for edge in steps)
    assert contradicted_steps([edge for edge in model.edges if not edge.given]) == ""


def test_names_too_long_for_a_file_are_shortened_to_different_ones():
    names = ["点" * 30 + end for end in "ab"]
    files = [short_transform_name(name) for name in names]
    assert len(set(files)) == 2
    assert all(len(file) <= 255 and file.startswith("%E7%82%B9%E7%82%B9") for file in files)
    assert {unquote(file.split("~")[0], errors="strict") for file in files} == {"点" * 16}
    assert short_transform_name("scan 1") == "scan 1.txt"


def test_files_in_another_unit_than_the_earlier_model_are_told_of_its_grid(scanned_room, tmp_path):
    folder, _ = scanned_room
    for k in range(2):
        np.save(tmp_path / f"s{k}.npy", 1000 * np.load(folder / f"scan_{k}.npy"))
    config = CONFIG.model_copy(update={"voxel_size": None})
    register_scans(
        [tmp_path / "s0.npy", tmp_path / "s1.npy"], tmp_path / "m", config=config, page=False, rounds=0
    )
    for k in range(2):
        np.save(tmp_path / f"s{k}.npy", np.load(folder / f"scan_{k}.npy"))
    with pytest.raises(InputError, match=r"is that of the earlier model in .*--fresh"):
        register_scans([tmp_path / "s0.npy", tmp_path / "s1.npy"], tmp_path / "m", config=config, page=False)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"1 2 3\n", "its lines hold 3 numbers; all lines of TUM hold 8, all of KITTI 12"),
        (b"# nothing\n", "its lines hold no numbers"),
        (b"\xff\xfe", "it is no text in UTF-8"),
        (b'{"groups": [{"a": 1}]}', "the key 'scans' is missing"),
        *(
            (b'{"groups": %s}' % of, "its 'groups' are not those of a poses.json")
            for of in (b'["a"]', b"7", b"[[1]]")
        ),
        (b"", r"an empty file \(0 bytes\)"),
        (b"null", "line 1: 'null' is no number"),
        (b"[" * 100_000, "its brackets are nested too deeply"),
        (
            b"[[%s]]" % (b"[1, 0, 0, 0]," * 7 + b"[0, 0, 0, 1" + b"0" * 400 + b"]"),
            "pose 1 is 8 rows of 4 numbers",
        ),
        (b"[%s]" % b",".join([b"[1%s, 0, 0, 0]" % (b"0" * 400)] * 4), "it holds 4 rows of 4 numbers"),
        (b"[[[1%s,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]],null]" % (b"0" * 400), "pose 2 is null"),
        (
            b'{"a": [1%s,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1], "b": [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]}'
            % (b"0" * 400),
            "pose of 'a': a transform must be 4 rows of 4 finite numbers",
        ),
        (b"3 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n", "the time 0 stands behind 3"),
        (b"0 0 0 0 0 0 0 1\n1 1e300 0 0 0 0 0 1\n", r"pose of 'b' has the translation \[1e\+300, 0.0, 0.0\]"),
        (b"0 0 0 0 1e300 0 0 1\n1 0 0 0 0 0 0 1\n", "the quaternion has the length inf, expected 1"),
    ],
)
def test_poses_that_are_none_are_refused_in_plain_words(tmp_path, content, words):
    (tmp_path / "poses").write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_poses(tmp_path / "poses", ["a", "b"])
