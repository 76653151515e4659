"""The GeoMoE network: padding and order never felt, always finite, every switch of its configuration."""

from __future__ import annotations

import pytest
import torch
from tiny_networks import TINY, sample, settle, tiny

from geomoe3d.config import build_config
from geomoe3d.errors import ConfigError
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.geomoe import GeoMoE, find_neighbors

pytestmark = pytest.mark.usefixtures("one_thread")


def test_order_of_the_correspondences_does_not_matter() -> None:
    model = settle(tiny())
    x = sample(1, 80, 5)
    order = torch.randperm(80, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        straight, shuffled = model(x).logits, model(x[:, order]).logits
    torch.testing.assert_close(shuffled, straight[:, :, order], atol=2e-6, rtol=1e-5)


@pytest.mark.parametrize("prior", ["mask", "soft", "none"])
def test_padded_batch_equals_single_pairs(prior: str) -> None:
    model = settle(tiny(prior=prior))
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
            torch.testing.assert_close(together.logits[:, i, : lengths[i]], alone, atol=2e-5, rtol=1e-4)
    assert bool((together.logits[:, ~mask] == 0).all())


def test_padding_changes_neither_training_outputs_nor_gradients_nor_statistics() -> None:
    x = sample(2, 30, 3)
    mask = torch.ones(2, 30, dtype=torch.bool)
    mask[1, 20:] = False
    results = []
    for num_padding, filler in ((0, 0.0), (7, 0.0), (7, -50.0)):
        model = tiny().train()
        extra = torch.full((2, num_padding, 6), filler)
        padded = torch.cat([torch.where(mask[..., None], x, filler), extra], dim=1)
        wide = torch.cat([mask, torch.zeros(2, num_padding, dtype=torch.bool)], dim=1)
        out = model(padded, mask=wide)
        (out.logits.square().sum() + out.balance).backward()
        grads = torch.cat([p.grad.flatten() for p in model.parameters() if p.grad is not None])
        stats = torch.cat([b.flatten() for n, b in model.named_buffers() if "running" in n])
        results.append((out.logits[:, :, :30], grads, stats, out.kept_fraction))
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            torch.testing.assert_close(a, b, atol=5e-4, rtol=1e-3)


def test_masked_batch_equals_unmasked_training_where_nothing_is_padded() -> None:
    x = sample(2, 30, 4)
    outs = []
    for mask in (None, torch.ones(2, 30, dtype=torch.bool)):
        model = tiny().train()
        out = model(x, mask=mask)
        out.logits.square().sum().backward()
        outs.append(
            (out.logits, model.initialise.embedding.weight.grad, model.layers[1].predict.norm.running_var)
        )
    for a, b in zip(*outs, strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("size", [1, 2])
@pytest.mark.parametrize("num", [3, 9])
def test_training_with_one_pair_and_few_correspondences(size: int, num: int) -> None:
    model = tiny().train()
    out = model(sample(size, num))
    (out.logits.sum() + out.balance).backward()
    assert torch.isfinite(out.logits).all()
    assert all(torch.isfinite(p.grad).all() for p in model.parameters() if p.grad is not None)


def test_identical_correspondences_and_a_prior_that_rejects_all_stay_finite() -> None:
    model = settle(tiny())
    with torch.no_grad():
        for layer in model.layers:
            layer.predict.linear.bias.fill_(-1e3)
        out = model(torch.ones(1, 20, 6))
    assert bool((out.logits < 0).all())
    assert torch.isfinite(out.logits).all()


SWITCHES: list[dict[str, object]] = [
    {"motion_form": "endpoints"},
    {"embedding_norm": False},
    {"knn_space": "motion"},
    {"knn_space": "source"},
    {"local_context": False},
    {"context_residual": False},
    {"prior": "soft"},
    {"prior": "none"},
    {"spatial_path": False},
    {"channel_path": "none"},
    {"channel_path": "channelwise"},
    {"spatial_path": False, "channel_path": "none"},
    {"feed_forward": "dense"},
    {"feed_forward": "none"},
    {"feed_forward_residual": False},
    {"router_order": "softmax_top_k"},
    {"load_balance": "paper"},
    {"num_neighbors": 5, "context_width": 7},
    {"correspondence_dim": 4},
    {"motion_form": "none", "extra_channels": ("ratio",)},
]


@pytest.mark.parametrize("changes", SWITCHES, ids=lambda c: "-".join(f"{k}={v}" for k, v in c.items()))
def test_every_switch_changes_the_network_and_trains(changes: dict[str, object]) -> None:
    model = tiny(**changes).train()
    config = model.config
    x = sample(2, 24, dim=config.correspondence_dim)
    channels = sample(2, 24, 1, 1) if config.extra_channels else None
    out = model(x, channels)
    assert out.logits.shape == (2, 2, 24)
    (out.logits.square().sum() + out.balance).backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
    if config.correspondence_dim == 6 and config.motion_form != "none" and config.load_balance != "paper":
        default = tiny()
        default.load_state_dict({**default.state_dict(), **_common(model, default)})
        with torch.no_grad():
            assert not torch.allclose(default.train()(x).logits, out.logits)


def _common(model: GeoMoE, other: GeoMoE) -> dict[str, torch.Tensor]:
    theirs = other.state_dict()
    return {k: v for k, v in model.state_dict().items() if k in theirs and v.shape == theirs[k].shape}


def test_impossible_configurations_are_refused_by_name() -> None:
    for tree, word in [
        ({"width": 30}, "num_heads"),
        ({"top_k": 5}, "num_experts"),
        ({"motion_form": "none"}, "extra_channels"),
        ({"correspondence_dim": 4, "knn_space": "compatibility"}, "3D"),
        ({"extra_channels": ["ratio", "ratio"]}, "repeats"),
        ({"num_layer": 3}, "num_layers"),
    ]:
        with pytest.raises(ConfigError, match=word):
            build_config(NetworkConfig, tree)


def test_insight_names_a_sub_field_and_an_expert_for_every_correspondence() -> None:
    model = settle(tiny())
    with torch.no_grad():
        out = model(sample(2, 40, 8), insight=True)
    assert len(out.insights) == 2
    last = out.insights[-1]
    assert last.sub_field.shape == (2, 40)
    assert int(last.sub_field.max()) < 6
    assert last.expert is not None
    assert last.expert.shape == (2, 6)
    assert out.usage is not None
    assert out.entropy is not None
    torch.testing.assert_close(out.usage.sum(-1), torch.ones(2, 2))
    assert bool(((out.entropy >= 0) & (out.entropy <= 1)).all())


def test_soft_prior_sends_no_gradient_to_the_logits_and_mask_is_the_sign() -> None:
    decompose = tiny(prior="soft").layers[0].decompose.eval()
    logits = torch.zeros(1, 10, requires_grad=True)
    field = torch.randn(1, 16, 10, requires_grad=True)
    decompose(field, logits, None)[0].sum().backward()
    assert logits.grad is None
    assert field.grad is not None
    hard = tiny(prior="mask").layers[0].decompose.eval()
    with torch.no_grad():
        low = hard(field, torch.full((1, 10), 1e-6), None)[0]
        high = hard(field, torch.full((1, 10), 1e6), None)[0]
    torch.testing.assert_close(low, high)


def test_neighbours_equal_brute_force_and_start_with_the_row_itself() -> None:
    x = sample(1, 50, 9)
    found = find_neighbors(x, TINY)[0]
    distance = torch.cdist(x[0].double(), x[0].double())
    expected = distance.topk(8, largest=False).indices
    assert torch.equal(found, expected)
    duplicates = torch.zeros(1, 20, 6)
    found = find_neighbors(duplicates, TINY)[0]
    assert torch.equal(found[:, 0], torch.arange(20))
    assert all(len(set(row.tolist())) == 8 for row in found)
    few = find_neighbors(sample(1, 3), TINY)[0]
    assert torch.equal(few[:, 3:], torch.arange(3)[:, None].expand(3, 5))


@pytest.mark.parametrize("padded", [False, True])
def test_activation_checkpointing_gives_the_same_gradients_and_statistics(padded: bool) -> None:
    x = sample(2, 30, 2)
    mask = torch.arange(30)[None] < torch.tensor([[30], [18]]) if padded else None
    grads, stats = [], []
    for flag in (False, True):
        model = tiny().train()
        model.checkpoint_activations = flag
        out = model(x, mask=mask)
        (out.logits.square().sum() + out.balance).backward()
        grads.append(torch.cat([p.grad.flatten() for p in model.parameters() if p.grad is not None]))
        stats.append(torch.cat([b.flatten() for b in model.buffers()]))
    torch.testing.assert_close(*grads)
    torch.testing.assert_close(*stats)
