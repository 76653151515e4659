"""Blocks and layers of the network: attention, pooling, weights from logits."""

from __future__ import annotations

import pytest
import torch

from geomoe3d.networks.blocks import GraphAttention, SubFieldPool
from geomoe3d.networks.layers import weights_from_logits

pytestmark = pytest.mark.usefixtures("one_thread")


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


def test_weights_are_zero_for_rejected_and_below_one() -> None:
    weights = weights_from_logits(torch.tensor([-5.0, 0.0, 0.5, 3.0]))
    assert weights[:2].tolist() == [0, 0]
    assert bool((weights[2:] > 0).all() and (weights < 1).all())
