"""Motions to learn from: proposed once, kept in shards, chosen for a step, and soon told apart."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from corner_scenes import VOXEL, random_motion, scene, seen_corner
from judged_motions import SMALL, training_pair
from scipy.spatial.transform import Rotation

from geomoe3d.cli.main import geomoe3d
from geomoe3d.config import build_config
from geomoe3d.data.shards import DescribedScene
from geomoe3d.data.shards import write_shard as write_described
from geomoe3d.errors import ConfigError, FormatError, InputError, OutputError
from geomoe3d.geometry.se3 import make_transform, rotation_error_deg, transform_points
from geomoe3d.networks.geomoe import GeoMoE
from geomoe3d.training import motions as motions_module
from geomoe3d.training.batches import choose_motions, make_batch, make_sample
from geomoe3d.training.config import RULES, TrainConfig, load_train_config
from geomoe3d.training.losses import verdict_loss
from geomoe3d.training.measures import evaluate
from geomoe3d.training.motions import propose_motions, with_motions
from geomoe3d.training.pairs import ShardFolder, TrainingPair, write_shard

pytestmark = pytest.mark.usefixtures("one_thread")


def test_motions_are_kept_in_shards(tmp_path: Path) -> None:
    pairs = [with_motions(training_pair(k)) for k in range(3)]
    write_shard(tmp_path / "a", pairs)
    folder = ShardFolder(tmp_path)
    for k, pair in enumerate(pairs):
        back = folder[k]
        assert pair.motions is not None
        assert back.motions is not None
        np.testing.assert_array_equal(back.motions, pair.motions)
        assert rotation_error_deg(back.motions[0], pair.T_target_source) < 2
        np.testing.assert_array_equal(back.viewpoints, np.zeros((2, 3)))
    with pytest.raises(InputError, match="2 of 3 pairs have 'motions'"):
        write_shard(tmp_path / "b", [replace(pairs[0], motions=None), *pairs[1:]])
    (tmp_path / "a" / "motion_start.npy").unlink()
    with pytest.raises(FormatError, match="lacks motion_start"):
        ShardFolder(tmp_path)[0]


def test_every_second_motion_is_drawn_closer(monkeypatch: pytest.MonkeyPatch) -> None:
    rows, T = scene(3, share=0.1)
    pair = TrainingPair(rows.astype(np.float32), np.arange(len(rows)) < 0.1 * len(rows), T, VOXEL)
    drawn = with_motions(pair).motions
    monkeypatch.setattr(motions_module, "KeypointAligner", lambda *_: lambda motion: motion)
    plain = with_motions(pair).motions
    assert drawn is not None
    assert plain is not None
    same = (drawn == plain).all((1, 2))
    assert same[::2].all()
    assert not same[1::2].all()


def test_a_right_motion_is_among_those_chosen_for_training() -> None:
    T = training_pair().T_target_source
    rng = np.random.default_rng(0)
    motions = np.stack([random_motion(rng) for _ in range(20)] + [T])
    pair = replace(training_pair(), motions=motions, viewpoints=np.zeros((2, 3)))
    for seed in range(10):
        chosen, right = choose_motions(pair, 6, np.random.default_rng(seed))
        assert len(chosen) == 6
        assert right.sum() == 1
        np.testing.assert_array_equal(chosen[right][0], T)
        np.testing.assert_array_equal(chosen[:2], motions[:2])
    assert not choose_motions(pair, 6, None)[1].any()  # the first six, in validation
    with pytest.raises(InputError, match="data transforms"):
        choose_motions(training_pair(), 6, None)


def test_a_few_steps_teach_which_motion_is_right() -> None:
    config = build_config(
        TrainConfig,
        {"network": SMALL, "data": {"augmentation": {"rotate": False, "swap": 0, "jitter": 0}}},
    )
    rng = np.random.default_rng(0)
    samples = []
    for k in range(6):
        pair = training_pair(k)
        wrong = [pair.T_target_source @ random_motion(rng) for _ in range(3)]
        motions = np.stack([*wrong[:1], pair.T_target_source, *wrong[1:]])
        samples.append(
            make_sample(replace(pair, motions=motions, viewpoints=np.zeros((2, 3))), config.network)
        )
    model = GeoMoE(config.network).train()
    optimizer = torch.optim.Adam(model.parameters(), lr=5e-3)
    batch = make_batch(samples)
    assert batch.right is not None
    assert batch.input.coordinates.shape[0] == len(batch.right) == 24
    for _ in range(30):
        out = model(batch.input.coordinates, batch.input.channels, batch.input.neighbors)
        loss = verdict_loss(out.verdict, batch.right, batch.pair)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    measures = evaluate(model, samples, torch.device("cpu"), batch_size=4)
    assert measures["verdict_recall"] == 1.0


def test_settings_that_do_not_fit_a_network_that_judges_motions_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"rotate=false"):
        build_config(TrainConfig, {"network": SMALL})
    with pytest.raises(ConfigError, match="best_metric=verdict"):
        build_config(TrainConfig, {"validation": {"best_metric": "verdict"}})
    assert load_train_config("configs/train/transforms.yaml").network.judges_motions


def test_the_old_name_of_the_verb_is_an_error_that_names_the_new_one() -> None:
    for words in (["features", "out", "--pairs", "5"], []):
        refused = CliRunner().invoke(geomoe3d, ["data", "motions", *words])
        assert refused.exit_code == 2
        assert "'data motions' is now 'data transforms'" in refused.output
    assert "motions" not in CliRunner().invoke(geomoe3d, ["data", "--help"]).output


@pytest.fixture
def shards(tmp_path: Path) -> Path:
    """One described scene of two fragments that see one corner."""
    rng = np.random.default_rng(0)
    T = make_transform(Rotation.from_rotvec([0.0, 0.2, 0.0]).as_matrix(), np.array([0.2, 0.0, 0.1]))
    points = [seen_corner(rng, 900), transform_points(T, seen_corner(rng, 900))]
    features = rng.normal(size=(900, 33))
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    described = DescribedScene(
        "corner",
        np.concatenate(points).astype(np.float32),
        np.concatenate([features, features]).astype(np.float16),
        np.array([0, 900, 1800]),
        np.array([[0, 1]]),
        T[None],
        np.array([0.9], dtype=np.float32),
        VOXEL,
    )
    (tmp_path / "features").mkdir()
    write_described(tmp_path / "features" / "corner", described, {}, "")
    return tmp_path / "features"


def test_motions_are_proposed_once_and_the_run_goes_on(shards: Path, tmp_path: Path) -> None:
    out = tmp_path / "motions"
    report = propose_motions(shards, out, 150)
    assert (report.made, report.kept, report.failed) == (2, 0, ())
    folder = ShardFolder(out)
    assert len(folder) == 200
    pair = folder[0]
    assert pair.motions is not None
    assert 1 <= len(pair.motions) <= RULES.num_transforms
    again = propose_motions(shards, out, 250)
    assert (again.made, again.kept) == (1, 2)
    with pytest.raises(OutputError, match="seed"):
        propose_motions(shards, out, 50, seed=3)


def test_pairs_without_a_motion_are_left_out(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, calls = motions_module.propose, []

    def sometimes(*arguments: Any, **named: Any) -> Any:
        calls.append(1)
        return real(*arguments, **named) if len(calls) % 4 else []

    monkeypatch.setattr(motions_module, "propose", sometimes)
    propose_motions(shards, tmp_path / "some", 100)
    folder = ShardFolder(tmp_path / "some")
    assert len(folder) == 75
    assert all(len(folder[i].motions) > 0 for i in range(75))  # type: ignore[arg-type]
    monkeypatch.setattr(motions_module, "propose", lambda *_, **__: [])
    with pytest.raises(InputError, match=r"pairs 0 to 99 .* no transform for any"):
        propose_motions(shards, tmp_path / "none", 100)
