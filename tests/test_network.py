"""The GeoMoE network: size and cost as published, padding never felt, order never felt, always finite."""

from __future__ import annotations

import itertools

import pytest
import torch

from geomoe3d.config import build_config
from geomoe3d.errors import ConfigError
from geomoe3d.filters.architecture import NetworkConfig
from geomoe3d.filters.blocks import GraphAttention, SubFieldPool
from geomoe3d.filters.counting import count_cost, num_parameters
from geomoe3d.filters.geomoe import GeoMoE, find_neighbors
from geomoe3d.filters.layers import weights_from_logits
from geomoe3d.filters.moe import FMoE
from geomoe3d.filters.norms import (
    BatchNorm,
    ContextNorm,
    Pointwise,
    frozen_statistics,
    norm_relu_linear,
)

TINY = NetworkConfig(num_layers=2, width=16, num_sub_fields=6, num_heads=2, expert_width=4)


pytestmark = pytest.mark.usefixtures("one_thread")


def tiny(**changes: object) -> GeoMoE:
    torch.manual_seed(0)
    return GeoMoE(build_config(NetworkConfig, {**TINY.model_dump(), **changes}))


def sample(size: int, num: int, seed: int = 0, dim: int = 6) -> torch.Tensor:
    return torch.randn(size, num, dim, generator=torch.Generator().manual_seed(seed))


def settle(model: GeoMoE) -> GeoMoE:
    """Give the batch norms statistics of their own, so that evaluation is no trivial case."""
    model.train()
    for seed in range(3):
        model(sample(4, 60, seed, model.config.correspondence_dim))
    return model.eval()


@pytest.mark.parametrize(("dim", "expected"), [(6, 5_552_536), (4, 5_552_280)])
def test_number_of_parameters_is_the_published_one(dim: int, expected: int) -> None:
    assert num_parameters(GeoMoE(NetworkConfig(correspondence_dim=dim))) == expected


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"expert_width": 8}, 5_420_696),
        ({"expert_width": 32}, 5_815_448),
        ({"num_neighbors": 10, "context_width": 10}, 5_558_024),
        ({"channel_path": "channelwise"}, None),
    ],
)
def test_size_follows_the_formula_of_other_widths(changes: dict[str, int], expected: int | None) -> None:
    count = num_parameters(GeoMoE(NetworkConfig(correspondence_dim=4, **changes)))
    # Channel-wise modulation: 128 -> 128 instead of 128 -> 1, without the batch norm, in 8 layers.
    assert count == (5_552_280 + 8 * (127 * 129 - 2 * 128) if expected is None else expected)


def test_multiply_accumulates_are_the_published_ones() -> None:
    cost = count_cost(GeoMoE(NetworkConfig(correspondence_dim=4)), 2000)
    assert cost.layers == 3_106_224_128
    assert 2 * cost.products == pytest.approx(7.10e9, rel=1e-3)


def test_counting_leaves_the_model_as_it_was() -> None:
    model = tiny()
    before = {k: v.clone() for k, v in model.state_dict().items()}
    first, second = count_cost(model, 50), count_cost(model, 50)
    assert first == second
    assert model.training
    assert all(torch.equal(v, before[k]) for k, v in model.state_dict().items())


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


def test_masked_norms_equal_the_norms_of_the_real_entries_and_their_gradients() -> None:
    x = torch.randn(
        3, 4, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True
    )
    mask = torch.arange(9)[None, None] < torch.tensor([9, 4, 2])[:, None, None]
    norm, plain = BatchNorm(4).double(), torch.nn.BatchNorm1d(4).double()
    for module in (norm, plain):
        with torch.no_grad():
            module.weight.copy_(torch.tensor([1.0, 2, 3, 4]))
            module.bias.copy_(torch.tensor([0.5, 0, -1, 2]))
    real = x.transpose(1, 2)[mask[:, 0]]
    torch.testing.assert_close(norm(x, mask).transpose(1, 2)[mask[:, 0]], plain(real))
    torch.testing.assert_close(norm.running_mean, plain.running_mean)
    torch.testing.assert_close(norm.running_var, plain.running_var)
    context = ContextNorm()
    for i, n in enumerate((9, 4, 2)):
        torch.testing.assert_close(context(x, mask)[i, :, :n], context(x[i : i + 1, :, :n])[0])

    def real_part(x: torch.Tensor) -> torch.Tensor:
        return torch.cat([torch.masked_select(f(x, mask), mask) for f in (norm, context)])

    assert torch.autograd.gradcheck(real_part, (x,))


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


def test_attention_ignores_padding_and_becomes_uniform_when_all_is_rejected() -> None:
    torch.manual_seed(0)
    block = GraphAttention(8, 2).eval()
    a, b = torch.randn(1, 8, 3), torch.randn(1, 8, 5)
    real = torch.tensor([[[True, True, True, True, False]]])
    kept = torch.tensor([[[True, False, True, False, True]]])
    _, attention = block(a, b, b_mask=real, b_kept=kept)
    assert bool((attention[..., [1, 3, 4]] == 0).all())
    torch.testing.assert_close(attention.sum(-1), torch.ones(1, 2, 3))
    _, attention = block(a, b, b_mask=real, b_kept=torch.zeros_like(kept))
    torch.testing.assert_close(attention[..., :4], torch.full((1, 2, 3, 4), 0.25))


def test_pooling_weights_sum_to_one_over_the_real_points() -> None:
    torch.manual_seed(0)
    mask = torch.arange(12)[None, None] < torch.tensor([12, 7])[:, None, None]
    x = torch.randn(2, 8, 12)
    z, weights = SubFieldPool(8, 5)(x, mask)
    torch.testing.assert_close(weights.sum(2), torch.ones(2, 5))
    assert bool((weights[1, :, 7:] == 0).all())
    torch.testing.assert_close(z, torch.einsum("bcn,bmn->bcm", x, weights))


@pytest.mark.parametrize("order", ["top_k_softmax", "softmax_top_k"])
def test_experts_equal_a_plain_loop(order: str) -> None:
    torch.manual_seed(0)
    moe = FMoE(8, 4, 2, 3, order, "normalised").eval()  # type: ignore[arg-type]
    z = torch.randn(2, 8, 5)
    out, routing = moe(z)
    logits = moe.router(z)
    for i, m in itertools.product(range(2), range(5)):
        best = logits[i, :, m].topk(2)
        gains = (
            best.values.softmax(0) if order == "top_k_softmax" else logits[i, :, m].softmax(0)[best.indices]
        )
        expected = sum(
            g
            * (
                moe.down_weight[e] @ torch.relu(moe.up_weight[e] @ z[i, :, m] + moe.up_bias[e])
                + moe.down_bias[e]
            )
            for g, e in zip(gains, best.indices, strict=True)
        )
        torch.testing.assert_close(out[i, :, m], expected)
        assert int((routing.weights[i, :, m] > 0).sum()) == 2
    if order == "top_k_softmax":
        torch.testing.assert_close(routing.weights.sum(1), torch.ones(2, 5))
    else:
        assert bool((routing.weights.sum(1) < 1).all())


def test_load_balance_is_one_when_balanced_and_two_when_two_experts_take_all() -> None:
    for wanted, expected in (([0.0, 0, 0, 0], None), ([9.0, 9.0, -9.0, -9.0], 2.0)):
        moe = FMoE(8, 4, 2, 3, "top_k_softmax", "normalised").eval()
        with torch.no_grad():
            moe.router.linear2.weight.zero_()
            moe.router.linear2.bias.copy_(torch.tensor(wanted))
        if expected is not None:
            assert float(moe.route(torch.randn(1, 8, 6)).balance) == pytest.approx(expected)
    spread = FMoE(4, 4, 2, 3, "top_k_softmax", "normalised").eval()
    with torch.no_grad():  # each pair of experts is chosen equally often
        spread.router = torch.nn.Identity()  # type: ignore[assignment]
    z = torch.tensor([[1.0, 1, 0, 0], [0, 0, 1, 1], [1, 0, 1, 0], [0, 1, 0, 1]]).t()[None]
    routing = spread.route(z)
    assert float(routing.balance) == pytest.approx(1.0)
    assert routing.usage.sum() == pytest.approx(1.0)
    spread.load_balance = "paper"
    assert float(spread.route(z).balance) == pytest.approx(1 / 16)


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


def test_weights_are_zero_for_rejected_and_below_one() -> None:
    weights = weights_from_logits(torch.tensor([-5.0, 0.0, 0.5, 3.0]))
    assert weights[:2].tolist() == [0, 0]
    assert bool((weights[2:] > 0).all() and (weights < 1).all())


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


@pytest.mark.parametrize("shape", [(3, 4, 7), (1, 4, 5)])
def test_recomputed_norm_relu_linear_equals_the_plain_chain(shape: tuple[int, int, int]) -> None:
    torch.manual_seed(0)
    norm, linear = BatchNorm(4).double().train(), Pointwise(4, 3).double()
    with torch.no_grad():
        norm.weight.copy_(torch.tensor([0.5, -1, 2, 1]))
        norm.bias.copy_(torch.tensor([0.1, 0.2, -0.3, 0]))
    x = torch.randn(shape, dtype=torch.float64, requires_grad=True)
    inputs = (x, norm.weight, norm.bias, linear.weight, linear.bias)
    plain = torch.nn.BatchNorm1d(4).double()
    plain.load_state_dict(norm.state_dict())
    expected = torch.nn.functional.conv1d(torch.relu(plain(x)), linear.weight, linear.bias)
    got = norm_relu_linear(x, norm, linear)
    torch.testing.assert_close(got, expected)
    torch.testing.assert_close(norm.running_mean, plain.running_mean)
    torch.testing.assert_close(norm.running_var, plain.running_var)
    assert norm.num_batches_tracked == 1
    before = norm.running_mean.clone()
    with frozen_statistics():
        torch.testing.assert_close(norm_relu_linear(x, norm, linear), expected)
        norm(x)
    assert torch.equal(norm.running_mean, before)
    assert torch.autograd.gradcheck(lambda *_: norm_relu_linear(x, norm, linear), inputs)
