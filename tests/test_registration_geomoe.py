"""The network plugged into the pipeline: a tiny untrained one must weigh, be shown and be refused."""

from __future__ import annotations

import pytest
import torch

from geomoe3d.cli.errors import run
from geomoe3d.cli.register import command
from geomoe3d.data.sample import make_sample_pair, write_sample_pair
from geomoe3d.errors import CheckpointError
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.geomoe import GeoMoE
from geomoe3d.networks.pretrained import save_pretrained
from geomoe3d.networks.weight_files import WeightCard
from geomoe3d.registration import Registrar


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch.manual_seed(0)
    config = NetworkConfig(num_layers=2, width=32, num_sub_fields=8, num_heads=4)
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_pretrained(path, GeoMoE(config), WeightCard(architecture={}))
    return path


def test_pretrained_registrar_weighs_and_names_the_experts(weights):
    source, target, _ = make_sample_pair(seed=0)
    explained = Registrar.from_pretrained(weights).explain(source, target)
    weighed = explained.weighed
    assert weighed.weights.shape == (len(explained.correspondences),)
    assert ((weighed.weights >= 0) & (weighed.weights < 1)).all()
    assert weighed.groups is not None
    assert len(weighed.group_names) > weighed.groups.max()
    assert explained.result.config["filter"]["name"] == "geomoe"


def test_command_line_takes_weights_and_refuses_broken_ones(weights, tmp_path, capsys):
    pair = write_sample_pair(tmp_path / "pair")
    picture = tmp_path / "experts.png"
    files = [str(pair.source), str(pair.target)]
    code = run(
        command,
        "register",
        [*files, "--filter", "geomoe", "--weights", str(weights), "--picture", str(picture)],
    )
    assert code in (0, 3)
    assert picture.stat().st_size > 10_000
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(weights.read_bytes()[:-100])
    (tmp_path / "broken.json").write_bytes(weights.with_suffix(".json").read_bytes())
    assert run(command, "register", [*files, "--filter", "geomoe", "--weights", str(broken)]) == 2
    assert "broken.safetensors" in capsys.readouterr().err


def test_missing_weights_are_named():
    with pytest.raises(CheckpointError, match="nowhere"):
        Registrar.from_pretrained("nowhere.safetensors")
