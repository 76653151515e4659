"""Photographs to train on: matches with labels, whole scenes left out, every network by one file."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from image_scenes import corner_room
from tiny_networks import SMALL

from geomoe3d.cli.main import geomoe3d
from geomoe3d.errors import InputError, OutputError
from geomoe3d.geometry.essential import essential_of, symmetric_distance
from geomoe3d.images.network import ImageNetwork
from geomoe3d.networks.pretrained import load_network
from geomoe3d.training.augment import AugmentationConfig, augment
from geomoe3d.training.batches import make_batch, make_sample
from geomoe3d.training.config import load_train_config
from geomoe3d.training.pairs import ShardFolder
from geomoe3d.training.photographs import write_training_set
from geomoe3d.training.trainer import TrainingRun

pytest.importorskip("cv2")
pytestmark = pytest.mark.usefixtures("one_thread")
CONFIGS = Path("configs/train/images")
TINY = [
    "steps=2", "batch_size=2", "data.correspondences=200", "device=cpu", "validation.num_pairs=2",
    "logging.tensorboard=false",
]  # fmt: skip


class Silent:
    def started(self, *_):
        pass

    stepped = validated = started


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    return [corner_room(folder / name) for name in ("hall", "attic")]


@pytest.fixture(scope="module")
def shards(scenes, tmp_path_factory):
    out = tmp_path_factory.mktemp("set") / "out"
    words = ["data", "images", *scenes, out, "--pairs", "4", "--leave-out", "attic"]
    done = CliRunner().invoke(geomoe3d, [str(word) for word in words], standalone_mode=False)
    assert done.exception is None, done.exception
    assert done.stdout.splitlines() == ["hall: 3 pairs", "attic: 3 pairs, left out"]
    return out


def test_scenes_are_left_out_whole_and_labels_are_those_of_the_pose(shards):
    assert [path.name for path in (shards / "train").iterdir()] == ["hall"]
    assert [path.name for path in (shards / "validation").iterdir()] == ["attic"]
    pairs = ShardFolder(shards / "train")
    for pair in map(pairs.__getitem__, range(len(pairs))):
        assert pair.correspondences.shape == (len(pair), 4)
        assert np.linalg.norm(pair.T_target_source[:3, 3]) == pytest.approx(1)
        far = symmetric_distance(
            essential_of(torch.from_numpy(pair.T_target_source)),
            torch.from_numpy(pair.correspondences).double(),
        ).numpy()
        assert far[pair.labels].max() <= 1e-4 < far[~pair.labels].min() * (1 + 1e-3)
        assert 0.05 < pair.labels.mean() < 0.95
        swapped = augment(pair, AugmentationConfig(swap=1.0), 100, np.random.default_rng(0))
        again = symmetric_distance(
            essential_of(torch.from_numpy(swapped.T_target_source)),
            torch.from_numpy(swapped.correspondences).double(),
        ).numpy()
        assert len(swapped) == 100
        assert (again[swapped.labels] < 1.01e-4).all()


def test_pairs_of_several_lengths_make_one_batch_and_those_of_clouds_are_refused(shards):
    network = load_train_config(CONFIGS / "geomoe.yaml", []).network
    pair = ShardFolder(shards / "train")[0]
    batch = make_batch([make_sample(pair.take(np.arange(n)), network) for n in (20, 50)])
    assert batch.input.mask.sum(1).tolist() == [20, 50]
    assert torch.equal(batch.input.neighbors[0, :20, 0], torch.arange(20))
    with pytest.raises(InputError, match=r"7 matches; .* at least 8"):
        make_sample(pair.take(np.arange(7)), network)
    with pytest.raises(InputError, match="4 columns, and the network takes 6"):
        make_sample(pair, load_train_config(None, []).network)


@pytest.mark.parametrize("kind", ["geomoe", "pointcn", "oanet", "umatch", "dematch", "demo"])
def test_every_network_trains_by_one_file_on_photographs_and_weighs_matches(kind, shards, tmp_path):
    size = SMALL.get(kind, {"num_layers": 1, "width": 16, "num_heads": 2, "num_sub_fields": 6})
    given = [f"data.train={shards / 'train'}", f"data.validation={shards / 'validation'}", *TINY]
    given += [f"network.{key}={value}" for key, value in size.items()]
    config = load_train_config(CONFIGS / f"{kind}.yaml", given)
    TrainingRun(config, tmp_path / "run").train(Silent())
    rows = list(csv.DictReader((tmp_path / "run" / "validation.csv").open()))
    assert 0 <= float(rows[-1]["f1"]) <= 1
    model, _ = load_network(tmp_path / "run" / "weights.safetensors")
    assert model.config.kind == kind
    verdict = ImageNetwork(tmp_path / "run" / "weights.safetensors")(
        ShardFolder(shards / "validation")[0].correspondences.astype(np.float64)
    )
    assert np.isfinite(verdict.logits).all()
    assert (verdict.sub_field is not None) == (kind == "geomoe")


def test_what_cannot_be_a_training_set_is_refused_before_anything_is_written(scenes, tmp_path):
    out = tmp_path / "out"
    for folders, left_out, words in (
        ([scenes[0]] * 2, (), "one name"),
        (scenes, ("cellar",), "no scene 'cellar'"),
        (scenes[:1], ("hall",), "no scene remains"),
    ):
        with pytest.raises(InputError, match=words):
            write_training_set(folders, out, count=4, left_out=left_out)
        assert not out.exists()
    out.mkdir()
    with pytest.raises(OutputError, match="exists"):
        write_training_set(scenes[:1], out, count=4)
