"""GeoMoE as a filter, and weights on disk that are verified before they are used."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from geomoe3d.config import build_config
from geomoe3d.errors import CheckpointError, InputError, OutputError
from geomoe3d.filters.geomoe import GeoMoEFilter
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.geomoe import GeoMoE
from geomoe3d.networks.inputs import collate, pair_input
from geomoe3d.networks.pretrained import load_pretrained, save_pretrained
from geomoe3d.networks.weight_files import WeightCard, read_card
from geomoe3d.training.synthetic import SyntheticConfig, SyntheticPairs
from geomoe3d.types import Correspondences

SMALL = {"num_layers": 2, "width": 16, "num_sub_fields": 6, "num_heads": 2, "expert_width": 4}


pytestmark = pytest.mark.usefixtures("one_thread")


def network(**changes: object) -> GeoMoE:
    torch.manual_seed(0)
    model = GeoMoE(build_config(NetworkConfig, {**SMALL, **changes})).train()
    pair = SyntheticPairs(SyntheticConfig())[0]
    n = len(pair)
    batch = collate(
        [pair_input(pair.correspondences, pair.voxel_size, model.config, ratio=np.ones(n), mutual=np.ones(n))]
    )
    model(batch.coordinates, batch.channels, batch.neighbors)
    return model.eval()


def correspondences(num: int = 100) -> tuple[Correspondences, float]:
    pair = SyntheticPairs(SyntheticConfig(correspondences=(num, num)), seed=2)[0]
    return Correspondences(pair.correspondences.astype(np.float64)), pair.voxel_size


@pytest.mark.parametrize("changes", [{}, {"extra_channels": ["compatibility"], "knn_space": "compatibility"}])
def test_filter_gives_the_networks_own_verdict(changes: dict[str, object]) -> None:
    model = network(**changes)
    points, voxel_size = correspondences()
    out = GeoMoEFilter(model)(points, voxel_size=voxel_size, seed=1)
    batch = collate([pair_input(points.points, voxel_size, model.config)])
    with torch.no_grad():
        logits = model(batch.coordinates, batch.channels, batch.neighbors).logits[-1, 0].double().numpy()
    assert out.logits is not None
    np.testing.assert_allclose(out.logits, logits, atol=1e-4)
    np.testing.assert_allclose(out.weights, np.maximum(np.tanh(logits), 0), atol=1e-4)
    assert out.weights.dtype == np.float64
    assert out.groups is not None
    assert set(np.unique(out.groups)) <= {0, 1, 2, 3}
    assert out.group_names == ("expert 1", "expert 2", "expert 3", "expert 4", "not seen")


def test_bad_rows_get_no_weight_and_do_not_disturb_the_others() -> None:
    model = network()
    points, voxel_size = correspondences()
    clean = GeoMoEFilter(model)(points, voxel_size=voxel_size)
    array = np.insert(points.points, [0, 50], np.full((2, 6), np.nan), axis=0)
    dirty = GeoMoEFilter(model)(Correspondences(array), voxel_size=voxel_size)
    bad = ~np.isfinite(array).all(axis=1)
    assert (dirty.weights[bad] == 0).all()
    assert dirty.logits is not None
    assert clean.logits is not None
    np.testing.assert_allclose(dirty.logits[~bad], clean.logits, atol=1e-5)
    assert dirty.groups is not None
    assert {dirty.group_names[g] for g in dirty.groups[bad]} == {"not seen"}


@pytest.mark.parametrize("num", [0, 1, 2])
def test_too_few_correspondences_all_weigh_nothing(num: int) -> None:
    out = GeoMoEFilter(network())(Correspondences(np.zeros((num, 6))), voxel_size=0.05)
    assert out.weights.tolist() == [0.0] * num


def test_three_correspondences_and_no_experts_work() -> None:
    points, voxel_size = correspondences(3)
    out = GeoMoEFilter(network(feed_forward="dense"))(points, voxel_size=voxel_size)
    assert np.isfinite(out.weights).all()
    assert out.groups is None
    assert out.group_names == ()


def test_channel_that_is_not_there_is_named() -> None:
    points, voxel_size = correspondences()
    used = GeoMoEFilter(network(extra_channels=["ratio", "mutual"]))
    with pytest.raises(InputError, match="'ratio'"):
        used(points, voxel_size=voxel_size)
    full = Correspondences(
        points.points, ratio=np.ones(100, dtype=np.float32), mutual=np.zeros(100, dtype=bool)
    )
    assert np.isfinite(used(full, voxel_size=voxel_size).weights).all()


def save(folder: Path, **changes: object) -> Path:
    path = folder / "w.safetensors"
    save_pretrained(path, network(**changes), WeightCard({}, (0.02, 0.3), "made up", 7, {"f1": 0.5}, "abc"))
    return path


def test_weights_come_back_as_they_were(tmp_path: Path) -> None:
    path = save(tmp_path)
    model, card = load_pretrained(path)
    original = network()
    assert model.config == original.config
    assert all(torch.equal(v, original.state_dict()[k]) for k, v in model.state_dict().items())
    assert not model.training
    assert (card.steps, card.metrics, card.commit, card.training_data) == (7, {"f1": 0.5}, "abc", "made up")
    points, voxel_size = correspondences()
    first = GeoMoEFilter.from_pretrained(path)(points, voxel_size=voxel_size)
    second = GeoMoEFilter(original)(points, voxel_size=voxel_size)
    np.testing.assert_array_equal(first.weights, second.weights)
    with pytest.raises(OutputError, match="exists"):
        save(tmp_path)


def test_weights_and_card_are_written_both_or_neither(tmp_path: Path) -> None:
    (tmp_path / "w.json").write_text("precious")
    with pytest.raises(OutputError, match=r"w.json' exists"):
        save(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["w.json"]


def edit_card(path: Path, **changes: object) -> None:
    card = path.with_suffix(".json")
    card.write_text(json.dumps({**json.loads(card.read_text()), **changes}))


def test_weights_that_do_not_fit_are_refused_with_a_reason(tmp_path: Path) -> None:
    path = save(tmp_path)
    good = path.read_bytes()
    path.write_bytes(good[:-1] + bytes([good[-1] ^ 1]))
    with pytest.raises(CheckpointError, match="does not match its card"):
        load_pretrained(path)
    path.write_bytes(good)
    architecture = read_card(path).architecture
    edit_card(path, architecture={**architecture, "width": 32})
    with pytest.raises(CheckpointError, match="does not fit its architecture"):
        load_pretrained(path)
    edit_card(path, architecture={**architecture, "colour": 1})
    with pytest.raises(CheckpointError, match="unknown key 'colour'"):
        load_pretrained(path)
    edit_card(path, architecture=architecture, version=99)
    with pytest.raises(CheckpointError, match="version 99"):
        load_pretrained(path)
    edit_card(path, format="other")
    with pytest.raises(CheckpointError, match="no card of geomoe3d"):
        load_pretrained(path)
    path.with_suffix(".json").unlink()
    with pytest.raises(CheckpointError, match="has no card"):
        load_pretrained(path)


def test_missing_weights_say_what_there_is(tmp_path: Path) -> None:
    for name in ("nothing-like-it", str(tmp_path / "none.safetensors")):
        with pytest.raises(CheckpointError, match="packaged weights are"):
            load_pretrained(name)


def test_pickled_files_are_not_read(tmp_path: Path) -> None:
    path = save(tmp_path)
    pickled = tmp_path / "p.safetensors"
    torch.save({"x": torch.zeros(3)}, pickled)
    shutil.copy(path.with_suffix(".json"), pickled.with_suffix(".json"))
    import hashlib

    edit_card(pickled, sha256=hashlib.sha256(pickled.read_bytes()).hexdigest())
    with pytest.raises(CheckpointError):
        load_pretrained(pickled)


@pytest.mark.slow
def test_using_a_filter_imports_no_training_and_no_compiler() -> None:
    code = (
        "import sys, numpy as np\n"
        "from geomoe3d.networks.geomoe import GeoMoE\n"
        "from geomoe3d.filters.geomoe import GeoMoEFilter\n"
        "from geomoe3d.types import Correspondences\n"
        "points = Correspondences(np.random.default_rng(0).normal(size=(50, 6)))\n"
        "GeoMoEFilter(GeoMoE())(points, voxel_size=0.1)\n"
        "unwanted = ('torch._dynamo', 'open3d', 'matplotlib', 'geomoe3d.training')\n"
        "sys.exit(', '.join(m for m in unwanted if m in sys.modules) or 0)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[1],
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
