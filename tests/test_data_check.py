"""Layouts of posed fragments, pickles read safely, and `data check` naming what is wrong."""

from __future__ import annotations

import json
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomoe3d.cli.errors import run
from geomoe3d.cli.main import geomoe3d
from geomoe3d.clouds.io import save_points
from geomoe3d.data.check import check_folder
from geomoe3d.data.collection import load_fragment, open_collection
from geomoe3d.data.safe_pickle import load_pickle
from geomoe3d.data.splits import (
    TEST_FRAGMENTS,
    TEST_PAIRS,
    TEST_SCENES,
    TRAIN_SCENES,
    VALIDATION_SCENES,
    split_of,
)
from geomoe3d.data.threedmatch import write_gt_log, write_gt_overlap
from geomoe3d.errors import FormatError, InputError
from geomoe3d.geometry.se3 import inverse, make_transform


def cloud(seed: int, count: int = 200) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3)).astype(np.float32).astype(np.float64)


def motion(seed: int) -> np.ndarray:
    t = np.random.default_rng(seed).normal(size=3)
    return make_transform(Rotation.random(random_state=seed).as_matrix(), t)


def posed_scene(folder: Path, count: int = 3) -> None:
    folder.mkdir(parents=True)
    for k in range(count):
        save_points(folder / f"cloud_bin_{k}.ply", cloud(k))
    write_gt_log(folder / "gt.log", [(k, k + 1, motion(k)) for k in range(count - 1)], count)
    write_gt_overlap(folder / "gt_overlap.log", {(k, k + 1): 0.5 for k in range(count - 1)})


def test_splits_have_the_published_sizes() -> None:
    assert (len(TRAIN_SCENES), len(VALIDATION_SCENES), len(TEST_SCENES)) == (48, 6, 8)
    assert len({*TRAIN_SCENES, *VALIDATION_SCENES, *TEST_SCENES}) == 62
    assert (sum(TEST_FRAGMENTS.values()), sum(TEST_PAIRS.values())) == (433, 1623)
    assert split_of("7-scenes-chess@seq-01") == "train"
    assert split_of("somewhere") is None


def test_split_of_names_with_sequences() -> None:
    assert split_of("7-scenes-chess@seq-01") == split_of("sun3d-brown_cs_2-brown_cs2_0") == "train"
    assert split_of("rgbd-scenes-v2-scene_10") == "validation"
    assert split_of("rgbd-scenes-v2-scene_10_1") == "validation"
    assert split_of("7-scenes-redkitchen") == "test"
    assert split_of("elsewhere_1") is None


def test_posed_folder(tmp_path: Path) -> None:
    posed_scene(tmp_path / "kitchen")
    posed_scene(tmp_path / "hall", 4)
    collection = open_collection(tmp_path)
    assert collection.layout == "posed"
    assert {name: len(paths) for name, paths in collection.fragments.items()} == {"hall": 4, "kitchen": 3}
    pair = collection.pairs[0]
    assert (pair.scene, pair.source.name, pair.target.name) == ("hall", "cloud_bin_0.ply", "cloud_bin_1.ply")
    assert np.allclose(pair.T_target_source, inverse(motion(0)))
    assert pair.overlap == 0.5
    assert np.array_equal(load_fragment(pair.source).file_points, cloud(0))
    report = check_folder(tmp_path)
    assert report.usable
    assert report.num_pairs == {"pairs": 5}


def test_clouds_with_poses(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    for k in range(3):
        np.save(folder / f"scan{k}.npy", cloud(k))
    np.savetxt(folder / "poses.txt", [motion(k).ravel() for k in range(3)])
    for root in (tmp_path, folder):
        collection = open_collection(root)
        assert (collection.layout, len(collection.pairs)) == ("posed", 3)
        pair = collection.pairs[1]
        assert (pair.source.name, pair.target.name) == ("scan0.npy", "scan2.npy")
        # A point of the world, seen from both: p_fragment = inverse(T_world_fragment) p_world.
        world = np.array([0.3, -2.0, 1.0, 1.0])
        seen = inverse(motion(0)) @ world
        assert np.allclose(pair.T_target_source @ seen, inverse(motion(2)) @ world)
    np.savetxt(folder / "poses.txt", [motion(k).ravel() for k in range(2)])
    assert "2 finite poses for 3 clouds" in open_collection(tmp_path).problems[0]


def test_evaluation_layout_names_what_the_published_counts_lack(tmp_path: Path) -> None:
    scene = "sun3d-hotel_umd-maryland_hotel3"
    posed_scene(tmp_path / scene)
    (tmp_path / f"{scene}-evaluation").mkdir()
    (tmp_path / scene / "gt.log").rename(tmp_path / f"{scene}-evaluation" / "gt.log")
    report = check_folder(tmp_path)
    assert report.layout == "evaluation"
    assert any("3 fragments, published are 37" in line for line in report.missing)
    assert any("2 pairs of 3DMatch, published are 54" in line for line in report.missing)
    assert not report.usable


def test_training_archive(tmp_path: Path) -> None:
    for k in range(2):
        np.savez(tmp_path / f"7-scenes-chess@seq-01_00{k}.npz", pcd=cloud(k), color=cloud(k))
    (tmp_path / "7-scenes-chess@seq-01-0.30.txt").write_text(
        "7-scenes-chess@seq-01_000.npz 7-scenes-chess@seq-01_001.npz 0.61\nbroken line\n"
    )
    report = check_folder(tmp_path)
    assert (report.layout, report.num_fragments, report.num_pairs) == ("archive", 2, {"archive": 1})
    assert any("line 2" in line for line in report.broken)
    (pair,) = open_collection(tmp_path).pairs
    assert np.array_equal(pair.T_target_source, np.eye(4))
    assert np.array_equal(load_fragment(pair.target).file_points, cloud(1))


def predator(folder: Path) -> None:
    (folder / "train" / "7-scenes-fire").mkdir(parents=True)
    for k in range(2):
        with (folder / "train" / "7-scenes-fire" / f"cloud_bin_{k}.pth").open("wb") as stream:
            pickle.dump(cloud(k), stream)
    T = motion(4)
    info = {
        "src": ["train/7-scenes-fire/cloud_bin_0.pth"],
        "tgt": ["train/7-scenes-fire/cloud_bin_1.pth"],
        "rot": T[None, :3, :3],
        "trans": T[None, :3, 3:],
        "overlap": np.array([0.4]),
    }
    with (folder / "train_info.pkl").open("wb") as stream:
        pickle.dump(info, stream)


def test_predator_pickles(tmp_path: Path) -> None:
    predator(tmp_path)
    report = check_folder(tmp_path)
    assert (report.layout, report.num_pairs, report.broken, report.missing) == (
        "predator",
        {"train_info": 1},
        [],
        [],
    )
    (pair,) = open_collection(tmp_path).pairs
    assert np.allclose(pair.T_target_source, motion(4))
    lost = tmp_path / "lost"
    predator(lost)
    info = load_pickle(lost / "train_info.pkl")
    with (lost / "train_info.pkl").open("wb") as stream:
        pickle.dump({**info, "trans": np.full((1, 3, 1), np.nan)}, stream)
    assert "not finite" in check_folder(lost).broken[0]
    assert np.array_equal(load_fragment(pair.source).file_points, cloud(0))


@pytest.mark.parametrize("zipped", [True, False])
def test_torch_files_without_torch_objects(tmp_path: Path, zipped: bool) -> None:
    import torch

    torch.save(cloud(3), tmp_path / "c.pth", _use_new_zipfile_serialization=zipped)
    assert np.array_equal(load_pickle(tmp_path / "c.pth"), cloud(3))


class Harmful:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):  # type: ignore[no-untyped-def]
        return os.mkdir, (str(self.path),)


def test_pickle_that_would_run_code_is_refused(tmp_path: Path) -> None:
    (tmp_path / "bad.pkl").write_bytes(pickle.dumps({"src": Harmful(tmp_path / "made")}))
    with pytest.raises(FormatError, match="mkdir"):
        load_pickle(tmp_path / "bad.pkl")
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_pickled_arrays_round_trip(tmp_path: Path, protocol: int) -> None:
    value = {"a": np.arange(12.0).reshape(3, 4), "b": ["x", 1, None], "c": np.float64(2.5)}
    (tmp_path / "v.pkl").write_bytes(pickle.dumps(value, protocol=protocol))
    found = load_pickle(tmp_path / "v.pkl")
    assert np.array_equal(found["a"], value["a"])
    assert found["b"] == value["b"]
    assert found["c"] == 2.5


def test_cut_pickle_is_a_format_error(tmp_path: Path) -> None:
    data = pickle.dumps(cloud(0))
    for size in (0, 1, 10, len(data) // 2, len(data) - 1):
        (tmp_path / "cut.pkl").write_bytes(data[:size])
        with pytest.raises(FormatError, match=r"cut\.pkl"):
            load_pickle(tmp_path / "cut.pkl")


def test_broken_and_missing_files_are_named(tmp_path: Path) -> None:
    posed_scene(tmp_path / "room", 4)
    (tmp_path / "room" / "cloud_bin_1.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 9\n")
    (tmp_path / "room" / "cloud_bin_3.ply").unlink()
    save_points(tmp_path / "room" / "cloud_bin_2.ply", np.zeros((5, 3)), force=True)
    report = check_folder(tmp_path)
    assert len(report.broken) == 2
    assert any("cloud_bin_1.ply" in line for line in report.broken)
    assert any("cloud_bin_2.ply" in line and "equal" in line for line in report.broken)
    assert len(report.missing) == 1
    assert "cloud_bin_3.ply" in report.missing[0]


def test_broken_ground_truth_is_named(tmp_path: Path) -> None:
    posed_scene(tmp_path / "room")
    text = (tmp_path / "room" / "gt.log").read_text()
    (tmp_path / "room" / "gt.log").write_text(text[: len(text) - 40])
    report = check_folder(tmp_path, open_files=False)
    assert "gt.log" in report.broken[0]
    assert not report.usable


def test_unknown_layout(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="known layouts"):
        open_collection(tmp_path)
    with pytest.raises(InputError, match="not a folder"):
        open_collection(tmp_path / "absent")


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    posed_scene(tmp_path / "room")
    assert run(geomoe3d, "geomoe3d", ["data", "check", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["num_pairs"] == {"pairs": 2}
    (tmp_path / "room" / "cloud_bin_2.ply").unlink()
    assert run(geomoe3d, "geomoe3d", ["data", "check", str(tmp_path), "--quick"]) == 2
    assert "cloud_bin_2.ply" in capsys.readouterr().out
