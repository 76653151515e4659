"""Many scans in one model: right poses, no wrong edge, files that agree, earlier pairs used again."""

from __future__ import annotations

import base64
import inspect
import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from headless_browser import HAND, browse, check_card_without_ink, check_hand, turned_by_hand
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from small_scans import SETTINGS, UTM, everything

from geomoe3d import register_scans
from geomoe3d.batch.folder import JOURNAL_FILE
from geomoe3d.cli.multiway import command
from geomoe3d.clouds.io import load_points
from geomoe3d.config import load_config
from geomoe3d.errors import ConfigError, DependencyError, InputError, OutputError
from geomoe3d.geometry.se3 import inverse, make_transform, rotation_error_deg, transform_points
from geomoe3d.multiway.edges import Edge
from geomoe3d.multiway.page import render_model_page
from geomoe3d.multiway.report import _why_unplaced
from geomoe3d.multiway.rules import GroupingRules
from geomoe3d.multiway.scans import Scan
from geomoe3d.runtime.journal import read_journal

CONFIG = load_config(None, SETTINGS)


pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.fixture(scope="module")
def model(scanned_room, tmp_path_factory):
    return register_scans([scanned_room[0]], tmp_path_factory.mktemp("model"), config=CONFIG)


def test_every_scan_is_placed_rightly_or_named_with_a_reason(scanned_room, model):
    _, truth = scanned_room
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


def test_everything_is_written_and_agrees(scanned_room, model):
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
    inputs = [transform_points(T, np.load(scanned_room[0] / f"{name}.npy")) for name, T in poses.items()]
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


def page_data(page):
    return json.loads(page.split('type="application/json">', 1)[1].split("</script>", 1)[0])


def test_the_page_is_self_contained_and_lists_every_scan(model):
    page = (model.folder / "page.html").read_text()
    assert page == render_model_page(model)
    for scan in model.scans:
        assert scan.name in page
    assert page.count("data-scan=") == 5
    loops = [loop for group in model.groups for loop in group.loops]
    assert page.count("<td>closes</td>") == sum(loop.closes for loop in loops) > 0
    assert page.count("<td>open</td>") == sum(not loop.closes for loop in loops)
    assert "src=" not in page
    assert "http" not in page.replace("http-equiv", "")
    assert "{{" not in page
    data = page_data(page)
    assert len(data["clouds"]) == 5
    assert data["lines"]["classes"][0]["drawn"] == sum(edge.kept for edge in model.edges)


@pytest.mark.parametrize("webgl", [True, False], ids=["webgl2", "canvas2d"])
def test_the_page_obeys_the_hand(model, tmp_path, webgl):
    page = render_model_page(model)
    log, data = turned_by_hand(tmp_path, page, webgl=webgl), page_data(page)
    check_hand(log["views"], data["axes"], data["radius"], pitch=0.6)
    why = "the graphics card was lost" if webgl else "no WebGL 2"
    assert log["notice"] == f"Drawn without a graphics card ({why}): slower, otherwise the same."


def test_the_page_draws_without_a_card_that_draws_nothing(model, tmp_path):
    said = check_card_without_ink(tmp_path, render_model_page(model))
    assert said == "Drawn without a graphics card (it drew nothing): slower, otherwise the same."


def test_the_page_shows_the_scans_and_edges_that_are_chosen(model, tmp_path):
    page = render_model_page(model)
    script = """
(async () => {
  const log = [], { dataset } = document.body;
  const note = async () => { await settle(); log.push([dataset.drawnPoints, dataset.drawnLines]); };
  await note();
  for (const one of ["#none", '[data-scan="scan_1"]', "#classes input", "#all", "button.pair"]) {
    document.querySelector(one).click();
    await note();
  }
  dataset.log = JSON.stringify(log);
})();
"""
    seen = browse(tmp_path, page, script=HAND + script, wish="?renderer=canvas2d&side=top")
    assert "error" not in seen, seen["error"]
    assert (seen["ready"], seen["renderer"]) == ("true", "canvas2d")
    data = page_data(page)
    sizes = {cloud["name"]: len(base64.b64decode(cloud["points"])) // 12 for cloud in data["clouds"]}
    num, edges = sum(sizes.values()), data["lines"]["classes"][0]["drawn"]
    first = max((e for e in model.edges if e.kept), key=lambda edge: edge.shift)
    alone = sizes[first.source] + sizes[first.target]
    shown = [(num, edges), (0, edges), (sizes["scan_1"], edges), (sizes["scan_1"], 0), (num, 0), (alone, 0)]
    assert json.loads(seen["log"]) == [[str(points), str(lines)] for points, lines in shown]


def test_adding_a_scan_reuses_every_earlier_pair(scanned_room, tmp_path):
    folder, _ = scanned_room
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
    there = shutil.copytree(folder, tmp_path / "there")  # the same scans are known wherever they lie
    moved = [there / files[k].name for k in (3, 0, 1, 2)]
    register_scans(moved, tmp_path, config=CONFIG, page=False)
    assert (tmp_path / "pairs" / JOURNAL_FILE).read_bytes() == after


def test_the_command_places_and_exits_with_three(scanned_room, tmp_path):
    folder, _ = scanned_room
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
        (["a.npy", "b.npy"], {"merged_voxel_size": 0.0}, "must be positive"),
        ("a.npy", {}, "at least 2 scans"),
        (Path("none"), {}, "no file or folder 'none'"),
        (None, {}, "scans must be paths of files or of folders, found None"),
        ([], {}, "no scans are given"),
        (np.zeros((5, 3)), {}, "scan 1 must be the path .* found ndarray of shape .3,."),
        (["a.npy", np.zeros((5, 3))], {}, "scan 2 must be the path .* found ndarray of shape .5, 3."),
        (["a.npy", "b.npy"], {}, "fewer than 2 scans can be used"),
    ],
)
def test_unusable_input_is_refused(tmp_path, monkeypatch, inputs, named, message):
    monkeypatch.chdir(tmp_path)
    if not isinstance(inputs, list) or inputs != ["."]:
        for name in ("a", "b"):
            (tmp_path / f"{name}.npy").write_bytes(b"broken")
    with pytest.raises(InputError, match=message):
        register_scans(inputs, tmp_path / "out", config=CONFIG, **named)
    assert not (tmp_path / "out").exists()


@pytest.fixture
def copied(model, tmp_path):
    """A finished model of the test's own."""
    shutil.copytree(model.folder, tmp_path / "copied")
    return tmp_path / "copied"


@pytest.mark.parametrize(
    ("named", "kind", "message"),
    [
        ({"workers": 1000}, InputError, "1,000 workers would take"),
        ({"workers": 1, "scheduler": "tcp://127.0.0.1:1"}, InputError, "either workers or a scheduler"),
        ({"scheduler": "tcp://127.0.0.1:1"}, DependencyError, "needs Dask"),
        ({"cache": __file__}, OutputError, "is a file; the cache of features is a folder"),
        ({"config": load_config(None, [*SETTINGS, "filter.name=nothing"])}, ConfigError, "unknown filter"),
        ({"scans": ["scan_0.npy", "scan_9.ply"]}, InputError, "fewer than 2 scans can be used"),
    ],
)
def test_what_is_refused_is_before_anything_is_removed(
    scanned_room, copied, monkeypatch, named, kind, message
):
    def absent(name):
        raise ImportError(name)

    monkeypatch.setattr("geomoe3d.runtime.optional.import_module", absent)
    monkeypatch.setattr("geomoe3d.runtime.machine.Machine.memory", lambda self: (8 << 30, 16 << 30))
    named = {"config": CONFIG, **named}
    scans = [scanned_room[0] / name for name in named.pop("scans", ["scan_0.npy", "scan_1.npy"])]
    before = everything(copied)
    with pytest.raises(kind, match=message):
        register_scans(scans, copied, fresh=True, **named)
    assert everything(copied) == before
    with pytest.raises(kind, match=message):
        register_scans(scans, copied.with_name("new"), **named)
    assert not copied.with_name("new").exists()


def test_beginning_anew_removes_what_the_model_left_and_nothing_else(scanned_room, copied):
    scans = [scanned_room[0] / f"scan_{k}.npy" for k in (0, 1)]
    (copied / "group7.ply").write_bytes((copied / "group1.ply").read_bytes())
    (copied / "notes.txt").write_text("mine")
    (copied / "pairs" / "notes.txt").write_text("mine")
    register_scans(scans, copied, config=CONFIG)  # what is its own it replaces unasked
    assert (copied / "page.html").read_text().count("data-scan=") == 2
    assert not (copied / "group7.ply").exists()
    model = register_scans(scans, copied, config=CONFIG, fresh=True, page=False)
    assert model.num_pairs == len(list(read_journal(copied / "pairs" / JOURNAL_FILE))) == 1
    group = {f"group1.{suffix}" for suffix in ("tum.txt", "kitti.txt", "g2o", "gtsam.g2o", "ply")}
    tables = {"scans.csv", "edges.csv", "matrices"}
    assert {path.name for path in copied.iterdir()} == {"poses.json", "pairs", "notes.txt", *group, *tables}
    assert (copied / "pairs" / "notes.txt").read_text() == "mine"


def test_the_command_knows_the_defaults_without_what_computes():
    code = "import sys, geomoe3d.cli.multiway; sys.exit('numpy' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
    given = {option.name: option.default for option in command.params}
    wanted = {name: value.default for name, value in inspect.signature(register_scans).parameters.items()}
    for name in ("pairs", "neighbors", "rounds"):
        assert given[name] == wanted[name]


def test_why_a_scan_is_not_placed_names_its_likely_pairs():
    scans = [Scan(name, f"/{name}.ply") for name in "abc"]
    edges = [Edge(2, k, np.eye(4), confidence, np.eye(6)) for k, confidence in ((0, 0.95), (1, 0.9))]
    survey = SimpleNamespace(
        unusable={}, outcomes=[(0, 2), (1, 2)], scans=scans, rules=GroupingRules(1.0, 1.0, 1.0, 1.0)
    )
    reason = _why_unplaced(survey, edges, 2)
    assert reason.startswith("its surest of 2 pairs, with 'a', has confidence 0.950")
    assert "its 2 likely pairs do not agree" in reason
    assert "nothing agrees with it" in _why_unplaced(survey, edges[:1], 2)


def test_pairs_whose_names_read_alike_are_two_pairs(scanned_room, tmp_path):
    folder, truth = scanned_room
    made = tmp_path / "scans"
    made.mkdir()
    for number, name in enumerate(("a", "b+a", "c", "c+b")):  # c with b+a, and c+b with a: "c+b+a" both
        (made / f"{name}.npy").write_bytes((folder / f"scan_{number}.npy").read_bytes())
    told = []
    model = register_scans(
        [made],
        tmp_path / "out",
        config=CONFIG,
        page=False,
        workers=1,
        progress=lambda done, total: told.append((done, total)),
    )
    journal = list(read_journal(tmp_path / "out" / "pairs" / JOURNAL_FILE))
    assert len(journal) == model.num_pairs == 6
    (group,) = model.groups
    for number, name in enumerate(("a", "b+a", "c", "c+b")):
        expected = inverse(truth["scan_0"]) @ truth[f"scan_{number}"]
        assert rotation_error_deg(group.poses[name], expected) < 1.0, name
    assert told == sorted(told)
    assert told[-1] == (6, 6)


def test_a_scan_of_the_same_stem_leaves_the_pairs_of_others(scanned_room, tmp_path):
    folder, _ = scanned_room
    for place, number in (("a/s.npy", 0), ("a/t.npy", 1), ("b/s.npy", 2)):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).write_bytes((folder / f"scan_{number}.npy").read_bytes())
    out = tmp_path / "out"
    register_scans([tmp_path / "a"], out, config=CONFIG, page=False, workers=1)
    model = register_scans([tmp_path / "a", tmp_path / "b"], out, config=CONFIG, page=False, workers=1)
    assert model.num_pairs == 3
    assert len(list(read_journal(out / "pairs" / JOURNAL_FILE))) == 3
