"""The folded network in numpy gives the logits of the plain one in torch, for every configuration and every prior."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from geomoe3d.config import build_config
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.folded import FoldedGeoMoE
from geomoe3d.networks.geomoe import GeoMoE, find_neighbors

SMALL = {"num_layers": 3, "width": 32, "num_sub_fields": 10, "num_heads": 4, "expert_width": 6}
SWITCHES: list[dict[str, object]] = [
    {},
    {"motion_form": "endpoints"},
    {"embedding_norm": False},
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
    {"num_neighbors": 5, "context_width": 7},
    {"correspondence_dim": 4},
    {"motion_form": "none", "extra_channels": ("ratio",)},
    {"extra_channels": ("ratio", "mutual")},
]


pytestmark = pytest.mark.usefixtures("one_thread")


def trained(changes: dict[str, object]) -> GeoMoE:
    """A network whose norms have statistics, and whose biases and gains are no longer trivial."""
    torch.manual_seed(0)
    model = GeoMoE(build_config(NetworkConfig, {**SMALL, **changes})).train()
    with torch.no_grad():
        for module in model.modules():
            if isinstance(module, torch.nn.BatchNorm1d):
                module.weight.uniform_(0.5, 1.5)
                module.bias.uniform_(-0.5, 0.5)
    for _ in range(3):
        x, channels = inputs(model.config, 64, 1)
        model(x[None], None if channels is None else channels[None])
    return model.eval()


def inputs(config: NetworkConfig, num: int, seed: int) -> tuple[torch.Tensor, torch.Tensor | None]:
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(num, config.correspondence_dim, generator=generator)
    width = config.num_extra_channels
    return x, torch.randn(num, width, generator=generator) if width else None


def both(model: GeoMoE, num: int, seed: int = 5) -> tuple[torch.Tensor, torch.Tensor]:
    x, channels = inputs(model.config, num, seed)
    neighbors = find_neighbors(x[None], model.config)
    with torch.no_grad():
        plain = model(x[None], None if channels is None else channels[None], neighbors).logits[:, 0]
    given = None if channels is None else channels.numpy()
    return plain, torch.from_numpy(FoldedGeoMoE.of(model)(x.numpy(), given, neighbors[0].numpy()).logits)


@pytest.mark.parametrize(
    "changes", SWITCHES, ids=lambda c: "-".join(f"{k}={v}" for k, v in c.items()) or "default"
)
def test_same_logits_for_every_switch(changes: dict[str, object]) -> None:
    plain, folded = both(trained(changes), 50)
    assert float(plain.abs().max()) > 0.1
    torch.testing.assert_close(folded, plain, atol=1e-5, rtol=1e-6)


@pytest.mark.parametrize("num", [3, 7, 400])
def test_same_logits_for_any_number(num: int) -> None:
    plain, folded = both(trained({}), num)
    torch.testing.assert_close(folded, plain, atol=1e-5, rtol=1e-6)


@pytest.mark.parametrize("bias", [-100.0, 100.0])
def test_same_logits_when_the_prior_rejects_or_keeps_all(bias: float) -> None:
    model = trained({})
    with torch.no_grad():
        for layer in model.layers:
            layer.predict.linear.bias.fill_(bias)
    plain, folded = both(model, 40)
    torch.testing.assert_close(folded, plain, atol=1e-5, rtol=1e-6)


def test_full_size_agrees_to_1e_5_and_insight_is_the_same() -> None:
    torch.manual_seed(1)
    model = GeoMoE().train()
    model(torch.randn(2, 100, 6))
    model.eval()
    x = torch.randn(300, 6)
    neighbors = find_neighbors(x[None], model.config)
    with torch.no_grad():
        plain = model(x[None], None, neighbors, insight=True)
    folded = FoldedGeoMoE.of(model)(x.numpy(), None, neighbors[0].numpy())
    torch.testing.assert_close(torch.from_numpy(folded.logits), plain.logits[:, 0], atol=1e-5, rtol=1e-6)
    last = plain.insights[-1]
    assert folded.expert is not None
    assert last.expert is not None
    assert float((folded.sub_field == last.sub_field[0].numpy()).mean()) > 0.99
    np.testing.assert_array_equal(folded.expert, last.expert[0])


def test_later_changes_to_the_model_are_not_seen_and_input_is_untouched() -> None:
    model = trained({})
    x, _ = inputs(model.config, 30, 2)
    neighbors = find_neighbors(x[None], model.config)[0]
    folded = FoldedGeoMoE.of(model)
    before = x.clone()
    given = x.numpy(), None, neighbors.numpy()
    first = folded(*given).logits
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.zero_()
    np.testing.assert_array_equal(folded(*given).logits, first)
    assert torch.equal(x, before)
