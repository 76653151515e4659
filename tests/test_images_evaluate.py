"""Evaluation of images: areas exact on hand-made cases, all methods on the same pairs, truth that is measured."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner
from image_scenes import FOCAL, SIZE, corner_room, texture, write_published

from geomoe3d.cli.main import geomoe3d
from geomoe3d.errors import FormatError, InputError
from geomoe3d.images.cases import read_pair_list
from geomoe3d.images.config import MEASURE
from geomoe3d.images.evaluate import (
    Outcome,
    area_under_recall,
    evaluate,
    summarise,
)
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.build import build_network
from geomoe3d.networks.pretrained import save_pretrained
from geomoe3d.networks.weight_files import WeightCard

cv2 = pytest.importorskip("cv2")
pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize(
    ("errors", "limit", "area"),
    [
        ([], 5, math.nan),
        ([0.0], 5, 1.0),
        ([math.inf], 5, 0.0),
        ([5.0], 5, 0.0),  # a limit is not reached by what lies on it
        ([4.0], 5, (4 * 1 / 2 + 1) / 5),
        ([1.0, 3.0, 9.0, math.inf], 5, (1 * 0.125 + 2 * 0.375 + 2 * 0.5) / 5),
        ([2.0, 2.0], 4, (2 * 0.25 + 2 * 1.0) / 4),
    ],
)
def test_areas_of_hand_made_cases(errors, limit, area):
    assert area_under_recall(errors, limit)[0] == pytest.approx(area, abs=1e-12, nan_ok=True)
    if errors:  # drawn twice is listed twice
        counts = np.arange(len(errors))[None] + 1.0
        listed = np.repeat(errors, counts[0].astype(int))
        assert area_under_recall(errors, limit, counts) == pytest.approx(area_under_recall(listed, limit))
        ordered = np.sort(np.append(0.0, listed))
        shares = np.arange(len(ordered)) / len(listed)
        places = np.append(ordered[ordered < limit], limit)
        shares = np.append(shares[ordered < limit], shares[ordered < limit][-1])
        assert area_under_recall(listed, limit)[0] == pytest.approx(np.trapezoid(shares, places) / limit)


def outcome(method, scene, pair, error, status="ok"):
    return Outcome(scene, pair, method, error, status, 0.1, 10, 0.5, 0.5, 1.0, 2 / 3)


def test_gains_are_paired_and_methods_must_see_the_same_pairs():
    some = [outcome("all, RANSAC", f"s{k % 3}", str(k), 4.0 + k) for k in range(12)]
    better = [outcome("net, RANSAC", f"s{k % 3}", str(k), 3.0 + k) for k in range(12)]
    table = summarise(some + better, (5.0, 10.0, 20.0))
    gain = table["net, RANSAC"]["gain 20 over all, RANSAC"]
    assert gain.value == pytest.approx(
        table["net, RANSAC"]["auc 20"].value - table["all, RANSAC"]["auc 20"].value
    )
    assert 0 < gain.interval[0] <= gain.value <= gain.interval[1] < 8
    assert table["net, RANSAC"]["right of ok"].value == pytest.approx(100 * 7 / 12)
    with pytest.raises(InputError, match="same pairs"):
        summarise(some + better[1:], (5.0, 10.0, 20.0))
    with pytest.raises(InputError, match="no pairs"):
        summarise([], (5.0, 10.0, 20.0))


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return corner_room(tmp_path_factory.mktemp("corner"))


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "w.safetensors"
    config = NetworkConfig(correspondence_dim=4, num_layers=1, width=16, num_sub_fields=4, num_heads=2)
    save_pretrained(path, build_network(config), WeightCard(architecture={}))
    return path


def run(*words):
    return CliRunner().invoke(geomoe3d, [str(word) for word in words], standalone_mode=False)


def test_truth_is_measured_and_wrong_cameras_are_refused(room, tmp_path):
    done = run("data", "check", room, "--json")
    found = json.loads(done.output)
    assert found["usable"], found
    assert found["share"] > 0.9
    assert found["median"] < 0.5
    whole = json.loads((room / "transforms.json").read_text())
    order = [whole["frames"][k]["transform_matrix"] for k in (2, 0, 3, 1)]
    for frame, T in zip(whole["frames"], order, strict=True):
        frame["transform_matrix"] = T
        frame["file_path"] = str(room / frame["file_path"])
    (tmp_path / "transforms.json").write_text(json.dumps(whole))
    refused = run("data", "check", tmp_path)
    assert "not usable" in refused.output
    assert refused.return_value == 2


def test_poses_of_a_scene_from_the_command_line(room, weights, tmp_path):
    done = run(
        "evaluate", "images", room, "--pairs", 6, "--weights", weights, "--output", tmp_path / "out.json"
    )
    assert done.exception is None, done.exception
    table = json.loads((tmp_path / "out.json").read_text())["summary"]
    which = ("all", "ratio test", "GeoMoE", "GeoMoE and loose ratio test")
    assert set(table) == {
        f"{one}, {estimator}" for one in which for estimator in ("RANSAC", "MAGSAC++", "eight-point")
    }
    assert "gain 5 over ratio test, MAGSAC++" in table["GeoMoE, RANSAC"]
    assert "GeoMoE, eight-point: all, eight-point" in done.output
    assert table["ratio test, MAGSAC++"]["auc 20"]["value"] > 75
    assert "ratio test, RANSAC" in done.output


def test_a_list_of_pairs_as_published(room, tmp_path):
    frames = json.loads((room / "transforms.json").read_text())["frames"]
    world = [np.linalg.inv(np.array(f["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])) for f in frames]
    K = [FOCAL, 0, 239.5, 0, FOCAL, 179.5, 0, 0, 1]
    rows = [["0.png", "1.png", 0, 0, *K, *K, *(world[1] @ np.linalg.inv(world[0])).ravel()]]
    listed = tmp_path / "pairs.txt"
    listed.write_text("\n".join(" ".join(map(str, row)) for row in rows) + "\n")
    done = run("evaluate", "images", listed, "--images", room)
    assert "1 pair;" in done.output, done.exception
    listed.write_text("a.png b.png 0 0 1 2\n")
    with pytest.raises(FormatError, match="has 6 words a line; a pair has 38"):
        read_pair_list(listed)


def test_a_scene_as_published_for_yfcc_and_sun3d(room, tmp_path):
    pytest.importorskip("h5py")
    frames = json.loads((room / "transforms.json").read_text())["frames"]
    poses = [np.linalg.inv(np.array(f["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])) for f in frames]
    names = [f["file_path"] for f in frames]
    for name in names:
        (tmp_path / name).write_bytes((room / name).read_bytes())
    visible = 100 * (np.abs(np.subtract.outer(range(4), range(4))) == 1)
    write_published(tmp_path, names, np.diag([FOCAL, FOCAL, 1.0]), poses, visible, SIZE)
    done = run("evaluate", "images", tmp_path, "--pairs", 1000, "--output", tmp_path / "out.json")
    assert "6 pairs;" in done.output, done.exception
    table = json.loads((tmp_path / "out.json").read_text())["summary"]
    assert table["ratio test, MAGSAC++"]["auc 20"]["value"] > 75


def test_homographies_of_all_three_kinds(tmp_path):
    H = np.array([[0.9, -0.1, 40], [0.15, 1.0, -30], [1e-4, -5e-5, 1]])
    image = texture()
    sequence, models = tmp_path / "v_wall", tmp_path / "models"
    sequence.mkdir()
    models.mkdir()
    cv2.imwrite(str(sequence / "1.ppm"), np.dstack([image] * 3))
    for k in range(2, 7):
        cv2.imwrite(str(sequence / f"{k}.ppm"), np.dstack([cv2.warpPerspective(image, H, SIZE)] * 3))
        np.savetxt(sequence / f"H_1_{k}", H)
    cv2.imwrite(str(models / "wallA.png"), image)
    np.savetxt(models / "wall_model.txt", np.linalg.inv(H))  # of the second image into the first
    rng = np.random.default_rng(0)
    first = np.column_stack([rng.uniform(0, 300, (80, 2)), np.ones(80)])
    second = first @ H.T
    second = second / second[:, 2:]
    second[60:] = rng.uniform(0, 300, (20, 3))
    np.savetxt(models / "wall_pts.txt", np.hstack([first, second, np.ones((80, 1))]))
    plain = tmp_path / "plain"
    plain.mkdir()
    cv2.imwrite(str(plain / "any.png"), image)
    for folder, pairs in ((sequence, 5), (models, 1), (plain, 2)):
        done = run("evaluate", "images", folder, "--homographies", "--output", tmp_path / "h.json", "--force")
        assert done.exception is None, done.exception
        found = json.loads((tmp_path / "h.json").read_text())
        assert len({one["pair"] for one in found["pairs"]}) == pairs
        assert found["summary"]["ratio test, RANSAC"][f"auc {MEASURE.corner[1]:g}"]["value"] > 60


@pytest.mark.parametrize("rows", [np.zeros((3, 3)), np.eye(2, 3), np.ones((4, 3)), np.diag([1, 1, np.nan])])
def test_a_model_that_is_no_homography_is_refused(rows, tmp_path):
    cv2.imwrite(str(tmp_path / "wallA.png"), texture())
    np.savetxt(tmp_path / "wall_model.txt", rows)
    np.savetxt(tmp_path / "wall_pts.txt", np.ones((20, 6)))
    done = run("evaluate", "images", tmp_path, "--homographies")
    assert isinstance(done.exception, FormatError)
    assert "wall_model.txt' holds no homography: three rows of three numbers" in str(done.exception)


def test_a_scene_that_is_given_twice_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "any.png"), texture())
    done = run("evaluate", "images", tmp_path, f"{tmp_path}/../{tmp_path.name}", "--homographies")
    assert "is given more than once; its pairs would count twice" in str(done.exception.message)


def test_what_was_finished_before_a_stop_is_kept_and_other_settings_are_refused(tmp_path, monkeypatch):
    folder, kept = tmp_path / "plain", tmp_path / "kept"
    folder.mkdir()
    cv2.imwrite(str(folder / "any.png"), texture())
    words = (
        "evaluate",
        "images",
        folder,
        "--homographies",
        "--keep",
        kept,
        "--output",
        tmp_path / "h.json",
        "--force",
    )
    assert run(*words).exception is None
    whole = json.loads((tmp_path / "h.json").read_text())["pairs"]
    journal = kept / "1-plain" / "predictions.jsonl"
    lines = journal.read_text().splitlines(keepends=True)
    assert len(lines) == 2
    journal.write_text(lines[0] + lines[1][:50])  # as a stop in the middle leaves it
    asked = []

    def counting(scene, cases, network):
        cases = list(cases)
        asked.extend(case.name for case in cases)
        return evaluate(scene, cases, network)

    monkeypatch.setattr("geomoe3d.images.evaluate.evaluate", counting)
    assert run(*words).exception is None
    assert asked == ["any/1"]
    again = json.loads((tmp_path / "h.json").read_text())["pairs"]
    assert [{**one, "seconds": 0} for one in again] == [{**one, "seconds": 0} for one in whole]
    done = run(*words, "--pairs", "4")
    assert isinstance(done.exception, InputError) and "pairs (200 there, 4 now)" in str(done.exception)
    assert "give another folder, or remove this one" in str(done.exception)
    assert "--fresh" not in str(done.exception)  # which this verb does not have
    for words in (("score", kept), ("score", kept / "1-plain"), ("compare", kept, kept)):
        done = run("evaluate", *words)
        assert isinstance(done.exception, InputError) and not isinstance(done.exception, FormatError)
        assert "keeps pairs of photographs" in str(done.exception)
        assert "evaluate images` with --keep" in str(done.exception)
    assert len(journal.read_text().splitlines()) == 2
