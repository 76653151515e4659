"""Described fragments: shards that notice damage and age, and pairs drawn fresh from them."""

from __future__ import annotations

import errno
import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomoe3d.cli.errors import run
from geomoe3d.cli.main import geomoe3d
from geomoe3d.clouds.io import save_points
from geomoe3d.data import shards as module
from geomoe3d.data.describe import describe_collection
from geomoe3d.data.draw import DrawSettings, FragmentPool
from geomoe3d.data.shards import DescribedScene, open_shard, shard_folders, write_shard
from geomoe3d.data.statistics import by_band, distance, measure, plane_share
from geomoe3d.data.threedmatch import write_gt_log
from geomoe3d.errors import FormatError, InputError, OutputError
from geomoe3d.geometry.se3 import inverse, make_transform, transform_points
from geomoe3d.training.augment import AugmentationConfig, augment
from geomoe3d.training.fragment_pairs import FragmentPairs


def surface(rng: np.random.Generator, count: int) -> np.ndarray:
    """A bumpy sheet in front of a camera, the same for every call but its sampling."""
    x, y = rng.uniform(-1.2, 1.2, (2, count))
    z = 2.0 + 0.25 * np.sin(3 * x) * np.cos(4 * y) + 0.1 * np.sin(9 * x + 5 * y)
    return np.column_stack([x, y, z])


def motion(k: int) -> np.ndarray:
    R = Rotation.from_euler("xyz", [3.0 * k, -5.0 * k, 8.0 * k], degrees=True).as_matrix()
    return make_transform(R, np.array([0.1 * k, 0.05 * k, -0.04 * k]))


def posed_scene(folder: Path, *, apart: bool = False) -> None:
    """Three views of one surface; ``apart`` moves the third away so that it overlaps with none."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    poses = [motion(k) for k in range(3)]
    for k, pose in enumerate(poses):
        points = surface(rng, 9000)
        if apart and k == 2:
            points[:, 2] += 20.0
        save_points(folder / f"cloud_bin_{k}.ply", transform_points(inverse(pose), points))
    pairs = [(i, j) for i in range(3) for j in range(i + 1, 3)]
    write_gt_log(folder / "gt.log", [(i, j, inverse(poses[i]) @ poses[j]) for i, j in pairs], 3)


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    base = tmp_path_factory.mktemp("shards")
    posed_scene(base / "posed" / "a")
    posed_scene(base / "posed" / "b")
    report = describe_collection(base / "posed", base / "described")
    assert (report.made, report.num_fragments, report.num_pairs) == (2, 6, 6)
    return base / "described"


def test_two_workers_make_the_same_bytes_as_one(shards: Path, tmp_path: Path) -> None:
    report = describe_collection(shards.parent / "posed", tmp_path, workers=2)
    assert (report.made, report.num_fragments, report.num_pairs) == (2, 6, 6)
    files = sorted(path.relative_to(shards) for path in shards.rglob("*") if path.is_file())
    assert len(files) > 6
    for name in files:
        assert (tmp_path / name).read_bytes() == (shards / name).read_bytes(), name
    with pytest.raises(InputError, match="at least one worker"):
        describe_collection(shards.parent / "posed", tmp_path, workers=0)


def test_shard_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    scene = DescribedScene(
        "room",
        rng.normal(size=(10, 3)).astype(np.float32),
        rng.normal(size=(10, 33)).astype(np.float16),
        np.array([0, 4, 10]),
        np.array([[0, 1]]),
        motion(2)[None],
        np.array([0.4], dtype=np.float32),
        0.05,
    )
    write_shard(tmp_path / "s", scene, {"voxel_size": 0.05}, "abc")
    found = open_shard(tmp_path / "s", verify=True)
    for name in ("points", "features", "start", "pair", "T_target_source", "overlap"):
        assert np.array_equal(getattr(found, name), getattr(scene, name))
    assert isinstance(found.points, np.memmap)
    assert len(found.fragment(1)[0]) == 6
    with pytest.raises(OutputError, match="exists"):
        write_shard(tmp_path / "s", scene, {}, "abc")


def copy(shards: Path, target: Path) -> Path:
    import shutil

    shutil.copytree(shards, target)
    return target / "a"


def test_corrupted_shard_is_refused(shards: Path, tmp_path: Path) -> None:
    shard = copy(shards, tmp_path / "flipped")
    data = bytearray((shard / "features.npy").read_bytes())
    data[len(data) // 2] ^= 0x10
    (shard / "features.npy").write_bytes(bytes(data))
    open_shard(shard)  # the header is sound; only the hash tells
    with pytest.raises(FormatError, match=r"features\.npy is damaged"):
        FragmentPairs(shard.parent, verify=True)
    posed = shards.parent / "posed"
    with pytest.raises(FormatError, match=r"features\.npy is damaged"):
        describe_collection(posed, shard.parent)  # started again, it keeps no damaged shard
    for name, change in (("points.npy", lambda d: d[: len(d) // 2]), ("start.npy", lambda d: b"")):
        shard = copy(shards, tmp_path / f"cut-{name}")
        (shard / name).write_bytes(change((shard / name).read_bytes()))
        with pytest.raises(FormatError, match=name.split(".")[0]):
            FragmentPairs(shard.parent)
    shard = copy(shards, tmp_path / "gone")
    (shard / "pair.npy").unlink()
    with pytest.raises(FormatError, match="pair"):
        open_shard(shard)
    shard = copy(shards, tmp_path / "mixed")
    np.save(shard / "overlap.npy", np.zeros(99, dtype=np.float32))
    with pytest.raises(FormatError, match="fit together"):
        open_shard(shard)
    shard = copy(shards, tmp_path / "meta")
    (shard / "shard.json").write_text("{")
    with pytest.raises(FormatError, match=r"shard\.json"):
        open_shard(shard)


def test_other_version_and_stale_shards_are_refused_with_the_reason(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    posed = tmp_path / "posed"
    posed_scene(posed / "a")
    out = tmp_path / "out"
    assert describe_collection(posed, out).made == 1
    assert describe_collection(posed, out).kept == 1
    with pytest.raises(FormatError, match=r"voxel_size \(0\.05 there, 0\.04 now\)"):
        describe_collection(posed, out, voxel_size=0.04)
    save_points(posed / "a" / "cloud_bin_1.ply", surface(np.random.default_rng(9), 4000), force=True)
    with pytest.raises(FormatError, match=r"is stale; remove it.* other fragments now"):
        describe_collection(posed, out)
    monkeypatch.setattr(module, "SHARD_VERSION", 99)
    with pytest.raises(FormatError, match="version 1, this reads version 99"):
        FragmentPairs(shards)


def test_full_disk_leaves_no_half_shard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    posed_scene(tmp_path / "posed" / "a")
    real, calls = np.save, []

    def full(path: Path, array: np.ndarray) -> None:
        calls.append(path)
        if len(calls) == 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(path, array)

    monkeypatch.setattr(module.np, "save", full)
    with pytest.raises(OutputError, match="No space left"):
        describe_collection(tmp_path / "posed", tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


_KILLED = """
import os, signal, sys
import numpy as np
from geomoe3d.data import describe
real, calls = np.save, []
def deadly(path, array):
    calls.append(path)
    if len(calls) == 9:
        os.kill(os.getpid(), signal.SIGKILL)
    real(path, array)
np.save = deadly
describe.describe_collection(sys.argv[1], sys.argv[2])
"""


@pytest.mark.slow
def test_resume_after_sigkill_in_the_middle_of_a_shard(shards: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-c", _KILLED, str(shards.parent / "posed"), str(out)]
    ended = subprocess.run(
        command, capture_output=True, timeout=120, check=False, cwd=Path(__file__).parents[1]
    )
    assert ended.returncode == -signal.SIGKILL, ended.stderr.decode()
    assert sorted(p.name for p in out.iterdir()) == [".writing-b", "a"]
    report = describe_collection(shards.parent / "posed", out)
    assert (report.made, report.kept) == (1, 1)
    assert (
        FragmentPairs(out, verify=True).identity().split(":")[-1]
        == (FragmentPairs(shards, verify=True).identity().split(":")[-1])
    )


def test_pairs_without_overlap_are_left_out(tmp_path: Path) -> None:
    posed_scene(tmp_path / "posed" / "a", apart=True)
    report = describe_collection(tmp_path / "posed", tmp_path / "out")
    assert (report.num_fragments, report.num_pairs) == (3, 1)
    (tmp_path / "lone").mkdir()
    posed_scene(tmp_path / "lone" / "b", apart=True)
    lines = (tmp_path / "lone" / "b" / "gt.log").read_text().splitlines()
    (tmp_path / "lone" / "b" / "gt.log").write_text("\n".join(lines[5:]))  # only the pairs with the third
    report = describe_collection(tmp_path / "lone", tmp_path / "nothing")
    assert report.made == 0
    assert "no pair overlaps" in report.skipped[0]
    with pytest.raises(InputError, match="no shard"):
        FragmentPairs(tmp_path / "nothing")
    with pytest.raises(InputError, match="bands"):
        FragmentPairs(tmp_path / "out", DrawSettings(bands=(0.0, 0.001), band_shares=(1.0,)))


def test_labels_follow_the_true_motion_and_pairs_are_repeatable(shards: Path) -> None:
    pairs = FragmentPairs(shards, DrawSettings(keypoints=(250, 600), usual_keypoints=400))
    one, again, other = pairs[7], pairs[7], pairs[8]
    assert np.array_equal(one.correspondences, again.correspondences)
    assert one.correspondences.shape != other.correspondences.shape or not np.array_equal(
        one.correspondences, other.correspondences
    )
    for index in range(20):
        pair = pairs[index]
        assert 250 <= len(pair) <= 600
        moved = transform_points(pair.T_target_source, pair.correspondences[:, :3].astype(np.float64))
        residual = np.linalg.norm(moved - pair.correspondences[:, 3:], axis=1)
        clear = np.abs(residual - 0.1) > 1e-5
        assert np.array_equal((residual < 0.1)[clear], pair.labels[clear])
        assert pair.labels.sum() >= 3
        assert pair.mutual is not None
        assert 0 < pair.mutual.mean() < 1
    with pytest.raises(IndexError):
        pairs[-1]


def test_every_epoch_has_new_keypoints(shards: Path) -> None:
    pool = FragmentPool(shards)
    drawn = [pool.draw(0, np.random.default_rng(k), 300).correspondences.source for k in range(4)]
    seen = {tuple(row) for points in drawn for row in points.tolist()}
    assert len(seen) > 600


def test_identity_follows_shards_settings_and_seed(shards: Path, tmp_path: Path) -> None:
    base = FragmentPairs(shards).identity()
    assert base == FragmentPairs(shards).identity()
    assert base != FragmentPairs(shards, seed=1).identity()
    assert base != FragmentPairs(shards, DrawSettings(usual_share=0.5)).identity()
    shard = copy(shards, tmp_path / "described")
    meta = json.loads((shard / "shard.json").read_text())
    meta["sha256"]["points"] = "0" * 64
    (shard / "shard.json").write_text(json.dumps(meta))
    assert base != FragmentPairs(shard.parent).identity()


def test_training_reads_the_folder(shards: Path) -> None:
    from geomoe3d.training.batches import open_training, training_loader
    from geomoe3d.training.config import TrainConfig, load_train_config

    config = TrainConfig.model_validate(
        {"batch_size": 2, "steps": 2, "data": {"train": str(shards), "correspondences": 200}}
    )
    pairs = open_training(config)
    assert isinstance(pairs, FragmentPairs)
    batches = list(training_loader(config, pairs, 0))
    assert len(batches) == 2
    assert batches[0].labels.shape == (2, 200)
    drawn = open_training(
        load_train_config(
            None, [f"data.train={shards}", "data.draw.usual_keypoints=150", "data.draw.usual_share=1"]
        )
    )[0]
    assert len(drawn) == 150


def test_augmented_pair_keeps_its_labels(shards: Path) -> None:
    pair = FragmentPairs(shards)[3]
    changed = augment(pair, AugmentationConfig(jitter=0.02), 500, np.random.default_rng(0))
    moved = transform_points(changed.T_target_source, changed.correspondences[:, :3].astype(np.float64))
    residual = np.linalg.norm(moved - changed.correspondences[:, 3:], axis=1)
    clear = np.abs(residual - 0.1) > 0.004
    assert np.array_equal((residual < 0.1)[clear], changed.labels[clear])


def test_statistics(shards: Path) -> None:
    found = measure(shards)
    assert len(found.num_points) == 6
    assert len(found.inlier_ratio) == 6
    assert 0.02 < found.spacing.mean() < 0.05
    assert found.residual.max() < 0.1
    table = by_band(found)
    assert sum(row["pairs"] for row in table) == 6
    assert distance(np.arange(10.0), np.arange(10.0)) == 0
    assert distance(np.arange(10.0), np.arange(10.0) + 20) == 1
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(0, 2, (3000, 2)), np.zeros(3000)])
    assert plane_share(flat, rng) > 0.99
    assert plane_share(rng.uniform(0, 2, (3000, 3)), rng) < 0.2


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    posed_scene(tmp_path / "posed" / "a")
    arguments = ["data", "features", str(tmp_path / "posed"), str(tmp_path / "out")]
    assert run(geomoe3d, "geomoe3d", arguments) == 0
    assert "1 shard made (3 fragments, 3 pairs)" in capsys.readouterr().out
    assert run(geomoe3d, "geomoe3d", [*arguments, "--group", "train_info"]) == 2
    assert run(geomoe3d, "geomoe3d", [*arguments[:3], str(tmp_path / "coarse"), "--voxel-size", "0.1"]) == 0
    fine, coarse = (open_shard(shard_folders(tmp_path / name)[0]) for name in ("out", "coarse"))
    assert (fine.voxel_size, coarse.voxel_size) == (0.05, 0.1)
    assert 0 < len(coarse.points) < 0.5 * len(fine.points)
    capsys.readouterr()
    assert run(geomoe3d, "geomoe3d", [*arguments[:3], str(tmp_path / "x"), "--voxel-size", "inf"]) == 2
    assert "'inf' is not allowed here; give a number, greater than 0" in capsys.readouterr().err
    (tmp_path / "posed" / "a" / "cloud_bin_1.ply").write_text("broken")
    alone = ["data", "features", str(tmp_path / "posed"), str(tmp_path / "none"), "--min-overlap", "1"]
    assert run(geomoe3d, "geomoe3d", alone) == 2
    assert "0 shards made" in capsys.readouterr().out


def test_split_leaves_out_the_other_scenes(tmp_path: Path) -> None:
    for scene in ("7-scenes-chess_1", "7-scenes-heads", "7-scenes-redkitchen"):
        posed_scene(tmp_path / "posed" / scene)
    report = describe_collection(tmp_path / "posed", tmp_path / "out", split="train")
    assert report.made == 1
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["7-scenes-chess_1"]
