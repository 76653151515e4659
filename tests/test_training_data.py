"""Training data: generated pairs, shards, augmentation and the order of samples."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from geomoe3d.config import build_config
from geomoe3d.errors import ConfigError, FormatError, InputError, OutputError
from geomoe3d.geometry.se3 import rotation_error_deg
from geomoe3d.training.augment import AugmentationConfig, augment
from geomoe3d.training.batches import StepSampler, TrainingSamples, make_batch, open_training
from geomoe3d.training.config import TrainConfig, load_train_config
from geomoe3d.training.pairs import ShardFolder, TrainingPair, write_shard
from geomoe3d.training.schedule import learning_rate
from geomoe3d.training.synthetic import SyntheticConfig, SyntheticPairs

CONFIGS = sorted((Path(__file__).parents[1] / "configs" / "train").glob("**/*.yaml"))


def residual(pair: TrainingPair) -> np.ndarray:
    T = pair.T_target_source
    points = pair.correspondences.astype(np.float64)
    moved = points[:, :3] @ T[:3, :3].T + T[:3, 3]
    return np.linalg.norm(moved - points[:, 3:], axis=1)


def equal(a: TrainingPair, b: TrainingPair) -> bool:
    return all(
        np.array_equal(getattr(a, name), getattr(b, name))
        for name in ("correspondences", "labels", "T_target_source", "voxel_size")
    )


def test_generated_pairs_are_labelled_right_and_seeded() -> None:
    pairs = SyntheticPairs(SyntheticConfig(correspondences=(200, 900)), seed=3)
    for index in range(12):
        pair = pairs[index]
        assert equal(pair, pairs[index])
        assert 200 <= len(pair) <= 900
        T = pair.T_target_source
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(T[:3, :3]) > 0
        clear = np.abs(residual(pair) / pair.voxel_size - 2.0) > 1e-3
        np.testing.assert_array_equal(pair.labels[clear], (residual(pair) < 2 * pair.voxel_size)[clear])
    assert not equal(pairs[0], pairs[1])
    assert not equal(pairs[0], SyntheticPairs(pairs.config, seed=4)[0])


@pytest.mark.parametrize("ratio", [0.005, 0.05, 0.6])
def test_share_of_true_matches_is_the_one_asked_for(ratio: float) -> None:
    pairs = SyntheticPairs(SyntheticConfig(inlier_ratio=(ratio, ratio), noise=(0.2, 0.4)))
    measured = np.mean([pairs[i].labels.mean() for i in range(10)])
    assert measured == pytest.approx(ratio, rel=0.1, abs=0.002)


def test_density_of_the_source_points_does_not_give_the_true_ones_away() -> None:
    """A network would learn such a giveaway instead of geometry, and fail on real scans."""
    from scipy.spatial import cKDTree

    config = SyntheticConfig(inlier_ratio=(0.1, 0.3), near_misses=(0.0, 0.0), voxel_size=(0.05, 0.05))
    ratios = []
    for i in range(25):
        pair = SyntheticPairs(config, seed=8)[i]
        source = pair.correspondences[:, :3]
        spacing = cKDTree(source).query(source, 6)[0][:, 5]
        ratios.append(np.median(spacing[pair.labels]) / np.median(spacing[~pair.labels]))
    assert np.median(ratios) == pytest.approx(1.0, abs=0.15)


def test_structured_outliers_agree_on_another_motion() -> None:
    from geomoe3d.networks.architecture import NetworkConfig
    from geomoe3d.networks.inputs import pair_input

    network = NetworkConfig(extra_channels=("compatibility", "hypothesis"), knn_space="compatibility")

    def wrong_support(structured: float) -> float:
        config = SyntheticConfig(
            inlier_ratio=(0.02, 0.02), structured_fraction=structured, surface_fraction=0.0,
            correspondences=(500, 500),
        )  # fmt: skip
        scores = []
        for i in range(6):
            pair = SyntheticPairs(config)[i]
            channels = pair_input(pair.correspondences, pair.voxel_size, network).channels
            assert channels is not None
            scores.append(float(channels[~pair.labels, 6].quantile(0.95)))
        return float(np.mean(scores))

    assert wrong_support(0.9) > wrong_support(0.0) + 0.2


def test_impossible_settings_are_refused() -> None:
    for tree in ({"inlier_ratio": [0.5, 0.1]}, {"inlier_ratio": [0.0, 0.1]}, {"correspondences": [2, 5]}):
        with pytest.raises(ConfigError):
            build_config(SyntheticConfig, tree)


def test_a_bend_is_smooth_small_and_keeps_equal_points_equal() -> None:
    rng = np.random.default_rng(3)
    rows = rng.uniform(-3, 3, (400, 6)).astype(np.float32)
    rows[200:, 3:] = rows[:200, 3:]
    pair = TrainingPair(rows, np.ones(400, dtype=bool), np.eye(4), 0.05)
    config = AugmentationConfig(rotate=False, swap=0, jitter=0, bend=1.5)
    shifts = []
    for seed in range(20):
        bent = augment(pair, config, None, np.random.default_rng(seed)).correspondences
        assert (bent[200:, 3:] == bent[:200, 3:]).all()
        shift = bent - rows
        shifts.append(np.linalg.norm(shift[:, :3], axis=1).max())
        apart = np.linalg.norm(rows[:, None, :3] - rows[None, :, :3], axis=2)
        change = np.linalg.norm(shift[:, None, :3] - shift[None, :, :3], axis=2)
        # Three waves of at least 1.5 m, amplitudes 1.5 voxels over sqrt(3) each: close points move together.
        assert (change <= np.sqrt(3) * 0.075 * 2 * np.pi / 1.5 * apart + 1e-5).all()
    assert 0.3 * 0.075 < max(shifts) <= 0.075 * np.sqrt(3)
    plain = augment(pair, AugmentationConfig(rotate=False, swap=0, jitter=0), None, np.random.default_rng(0))
    assert (plain.correspondences == rows).all()


def test_augmentation_keeps_labels_true_and_rows_together() -> None:
    pair = SyntheticPairs(SyntheticConfig(voxel_size=(0.1, 0.1)))[0]
    tagged = TrainingPair(
        pair.correspondences, pair.labels, pair.T_target_source, pair.voxel_size,
        ratio=residual(pair).astype(np.float32),
    )  # fmt: skip
    config = AugmentationConfig(jitter=0.0)
    for seed in range(6):
        changed = augment(tagged, config, 300, np.random.default_rng(seed))
        assert len(changed) == 300
        np.testing.assert_allclose(residual(changed), changed.ratio, atol=1e-4)
        R = changed.T_target_source[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    moved = augment(
        tagged, AugmentationConfig(jitter=0.1, rotate=False, swap=0), None, np.random.default_rng(0)
    )
    shift = np.abs(moved.correspondences - tagged.correspondences).max()
    assert 0.005 < shift <= 0.0101
    same = augment(tagged, AugmentationConfig(jitter=0, rotate=False, swap=0), None, np.random.default_rng(0))
    assert equal(same, tagged)


def test_the_target_alone_is_turned_and_no_further_than_asked() -> None:
    pair = SyntheticPairs(SyntheticConfig(voxel_size=(0.1, 0.1)))[0]
    config = AugmentationConfig(swap=0, jitter=0, turned="target", largest_rotation_deg=30)
    angles = []
    for seed in range(30):
        changed = augment(pair, config, None, np.random.default_rng(seed))
        angles.append(rotation_error_deg(changed.T_target_source, pair.T_target_source))
        source, before = changed.correspondences[:, :3], pair.correspondences[:, :3]
        np.testing.assert_allclose(source - source[0], before - before[0], atol=1e-5)
        np.testing.assert_allclose(residual(changed), residual(pair), atol=1e-4)
    assert 20 < max(angles) <= 30


def test_shards_give_back_what_was_written(tmp_path: Path) -> None:
    source = SyntheticPairs(SyntheticConfig(correspondences=(20, 60)))
    pairs = [source[i] for i in range(7)]
    write_shard(tmp_path / "a", pairs[:4])
    write_shard(tmp_path / "b", pairs[4:6])
    start = np.array([0, len(pairs[6])])
    np.savez(
        tmp_path / "c.npz", start=start, correspondences=pairs[6].correspondences, labels=pairs[6].labels,
        T_target_source=pairs[6].T_target_source[None], voxel_size=np.array([pairs[6].voxel_size]),
    )  # fmt: skip
    folder = ShardFolder(tmp_path)
    assert len(folder) == 7
    for i in (6, 0, 3, 4, 5, 2, 1):
        assert equal(folder[i], pairs[i])
        assert folder[i].ratio is None
    with pytest.raises(IndexError):
        folder[7]
    sizes = [pair.voxel_size for pair in pairs]
    assert folder.voxel_sizes() == (min(sizes), max(sizes))
    before = folder.identity()
    write_shard(tmp_path / "d", pairs[:1])
    assert ShardFolder(tmp_path).identity() != before
    with pytest.raises(OutputError, match="exists"):
        write_shard(tmp_path / "a", pairs)


def test_shards_may_lie_in_subfolders(tmp_path: Path) -> None:
    pairs = [SyntheticPairs(SyntheticConfig(correspondences=(20, 60)))[i] for i in range(3)]
    for name, pair in zip(("a/b", "rooms/a", "scans/a"), pairs, strict=True):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write_shard(tmp_path / name, [pair])
    folder = ShardFolder(tmp_path)
    assert [equal(folder[i], pairs[i]) for i in range(3)] == [True] * 3
    before = folder.identity()
    (tmp_path / "scans").rename(tmp_path / "tripod")
    assert ShardFolder(tmp_path).identity() != before
    write_shard(tmp_path / "loose", pairs[:1])
    with pytest.raises(InputError, match=r"'loose'.*'a'.*keep them apart"):
        ShardFolder(tmp_path)


def test_shards_carry_optional_channels(tmp_path: Path) -> None:
    pair = SyntheticPairs(SyntheticConfig(correspondences=(20, 60)))[0]
    mutual = np.arange(len(pair)) % 3 == 0
    full = TrainingPair(
        pair.correspondences, pair.labels, pair.T_target_source, pair.voxel_size, mutual=mutual
    )
    write_shard(tmp_path / "a", [full])
    back = ShardFolder(tmp_path)[0].mutual
    assert back is not None
    np.testing.assert_array_equal(back, mutual)
    with pytest.raises(InputError, match="1 of 2 pairs have 'mutual'"):
        write_shard(tmp_path / "b", [full, pair])
    assert not (tmp_path / "b").exists()


def test_broken_shards_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a folder"):
        ShardFolder(tmp_path / "none")
    with pytest.raises(InputError, match="no shard"):
        ShardFolder(tmp_path)
    write_shard(tmp_path / "a", [SyntheticPairs(SyntheticConfig(correspondences=(20, 60)))[0]])
    (tmp_path / "a" / "labels.npy").unlink()
    with pytest.raises(FormatError, match=r"a' lacks labels"):
        ShardFolder(tmp_path)[0]
    np.save(tmp_path / "a" / "labels.npy", np.ones(3, dtype=bool))
    with pytest.raises(FormatError, match="labels has shape"):
        ShardFolder(tmp_path)[0]
    (tmp_path / "b.npz").write_bytes(b"nonsense")
    with pytest.raises(FormatError, match=r"b\.npz"):
        ShardFolder(tmp_path)


def config_of(**changes: object) -> TrainConfig:
    tree = {"batch_size": 2, "steps": 6, "data": {"correspondences": 50}, **changes}
    return build_config(TrainConfig, tree)


def test_two_processes_see_what_one_sees_with_twice_the_accumulation() -> None:
    one = list(StepSampler(config_of(accumulation=2), 0))
    first = list(StepSampler(config_of(), 0, rank=0, world=2))
    second = list(StepSampler(config_of(), 0, rank=1, world=2))
    assert one == [block for pair in zip(first, second, strict=True) for block in pair]
    assert list(StepSampler(config_of(accumulation=2), 4)) == one[8:]


def test_every_pair_is_seen_once_per_epoch_and_samples_do_not_depend_on_history(tmp_path: Path) -> None:
    source = SyntheticPairs(SyntheticConfig(correspondences=(60, 90)))
    write_shard(tmp_path / "a", [source[i] for i in range(5)])
    config = config_of(data={"train": str(tmp_path), "correspondences": 50})
    samples = TrainingSamples(open_training(config), config)
    epochs = [[samples._index(e * 5 + i) for i in range(5)] for e in range(4)]
    assert all(sorted(epoch) == [0, 1, 2, 3, 4] for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 1
    late = TrainingSamples(open_training(config), config)[17]
    for number in range(17):
        samples[number]
    assert (samples[17].inputs[0].coordinates == late.inputs[0].coordinates).all()


def test_batches_of_unequal_pairs_are_padded() -> None:
    config = config_of(data={"correspondences": None, "synthetic": {"correspondences": [20, 60]}})
    samples = TrainingSamples(open_training(config), config)
    batch = make_batch([samples[i] for i in range(4)])
    assert batch.input.mask is not None
    assert not bool(batch.labels[~batch.input.mask].any())


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.stem)
def test_every_shipped_configuration_is_valid(path: Path) -> None:
    config = load_train_config(str(path))
    assert config.steps >= 1


def test_every_row_of_the_paper_is_shipped_with_one_budget() -> None:
    rows = {path.stem: load_train_config(str(path)) for path in CONFIGS if path.parent.name == "paper"}
    rows.pop("narrow")  # a run in small, no row
    kinds = {row.network.kind for row in rows.values()}
    assert kinds == {"geomoe", "pointcn", "oanet", "umatch", "dematch", "demo", "pointdsc"}
    assert {f"ablation-{row}" for row in ("i", "ii", "iii", "iv", "v", "vi")} <= rows.keys()
    assert rows["ablation-vi"] == rows["geomoe"]
    assert rows["ablation-i"].network.prior == "none"
    assert len({(r.steps, r.batch_size, r.data.model_dump_json(), r.optimizer) for r in rows.values()}) == 1


def test_a_base_gives_what_a_file_leaves_out(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("steps: 7\nnetwork: {width: 32, num_layers: 3}\n")
    (tmp_path / "b.yaml").write_text("base: a.yaml\nnetwork: {num_layers: 5}\n")
    config = load_train_config(str(tmp_path / "b.yaml"), ["seed=4"])
    assert (config.steps, config.network.width, config.network.num_layers, config.seed) == (7, 32, 5, 4)
    (tmp_path / "c.yaml").write_text("base: gone.yaml\n")
    with pytest.raises(ConfigError, match=r"gone\.yaml"):
        load_train_config(str(tmp_path / "c.yaml"))


def test_published_schedule() -> None:
    optimizer = TrainConfig().optimizer
    assert learning_rate(optimizer, 0.0) == pytest.approx(1e-4)
    assert learning_rate(optimizer, 0.159) == pytest.approx(1e-4)
    half = 1e-4 * 0.999996 ** (250_000 - 80_000)
    assert learning_rate(optimizer, 0.5) == pytest.approx(half, rel=2e-3)
    assert learning_rate(optimizer, 1.0) == pytest.approx(1.86e-5, rel=1e-3)


@pytest.mark.parametrize("schedule", ["cosine", "one_cycle", "constant", "exponential"])
def test_schedules_rise_once_and_stay_within_bounds(schedule: str) -> None:
    optimizer = TrainConfig().optimizer.model_copy(update={"schedule": schedule, "warmup": 0.1})
    rates = np.array([learning_rate(optimizer, x) for x in np.linspace(0, 1, 400)])
    assert rates.max() == pytest.approx(1e-4, rel=1e-3)
    assert (rates > 0).all()
    turns = np.sign(np.diff(rates))
    turns = turns[turns != 0]
    assert (np.diff(turns) != 0).sum() <= 1
    if schedule in ("cosine", "one_cycle"):
        assert rates[-1] == pytest.approx(0.186e-4, rel=1e-2)
