"""The mixture of experts: equal to a plain loop, and its load balance."""

from __future__ import annotations

import itertools

import pytest
import torch

from geomoe3d.networks.moe import FMoE

pytestmark = pytest.mark.usefixtures("one_thread")


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
