"""Size and cost of the GeoMoE network: as published, and by the formula of other widths."""

from __future__ import annotations

import pytest
import torch
from tiny_networks import tiny

from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.counting import count_cost, num_parameters
from geomoe3d.networks.geomoe import GeoMoE

pytestmark = pytest.mark.usefixtures("one_thread")


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
