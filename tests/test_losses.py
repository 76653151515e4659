"""Losses: equal to hand-made values, blind to padding, finite and useful for every degenerate pair."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.geomoe import GeoMoEOutput
from geomoe3d.networks.inputs import pair_input
from geomoe3d.training.losses import (
    LossConfig,
    classification_loss,
    network_motion,
    regression_loss,
    total_loss,
    verdict_loss,
    virtual_lattice,
)


def pair(num: int = 40, inliers: int = 30, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Network coordinates (1, N, 6), labels (1, N) and true motion (1, 4, 4)."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = rng.normal(size=3) * 4
    source = rng.uniform(-1, 1, (num, 3)) + 7
    target = source @ T[:3, :3].T + T[:3, 3]
    target[inliers:] = rng.uniform(-1, 1, (num - inliers, 3)) + T[:3, 3]
    points = np.concatenate([source, target], 1)
    coordinates = pair_input(points, 0.05, NetworkConfig()).coordinates
    truth = network_motion(torch.tensor(points), torch.tensor(T), 0.05, 20.0)
    return coordinates[None], (torch.arange(num) < inliers)[None], truth[None]


def test_balanced_classification_by_hand() -> None:
    logits = torch.tensor([[2.0, -1.0, 0.5], [0.0, 0.0, 3.0]])
    labels = torch.tensor([[True, False, False], [False, False, False]])
    first = 0.5 * math.log1p(math.exp(-2)) + 0.25 * (math.log1p(math.exp(-1)) + math.log1p(math.exp(0.5)))
    second = (2 * math.log(2) + math.log1p(math.exp(3))) / 6
    assert float(classification_loss(logits, labels)) == pytest.approx((first + second) / 2, rel=1e-6)


def test_classification_is_stable_for_huge_logits() -> None:
    logits = torch.tensor([[1e4, -1e4]], requires_grad=True)
    loss = classification_loss(logits, torch.tensor([[False, True]]))
    assert float(loss) == pytest.approx(1e4)
    loss.backward()
    torch.testing.assert_close(logits.grad, torch.tensor([[0.5, -0.5]]))


def test_padding_counts_nowhere() -> None:
    coordinates, labels, truth = pair()
    logits = torch.randn(2, 1, 40, generator=torch.Generator().manual_seed(0))
    output = GeoMoEOutput(logits, torch.tensor(1.5), None, None, torch.zeros(2))
    plain = total_loss(output, coordinates, labels, truth, None, LossConfig(), 1.0)
    grow = torch.nn.functional.pad
    padded = GeoMoEOutput(grow(logits, (0, 9)), torch.tensor(1.5), None, None, torch.zeros(2))
    mask = grow(torch.ones(1, 40, dtype=torch.bool), (0, 9))
    for filler in (0.0, 77.0):
        wide = grow(coordinates, (0, 0, 0, 9), value=filler)
        other = total_loss(padded, wide, grow(labels, (0, 9)), truth, mask, LossConfig(), 1.0)
        for name in ("total", "classification", "regression", "balance"):
            torch.testing.assert_close(getattr(other, name), getattr(plain, name))


def test_true_weights_give_no_regression_loss_and_wrong_ones_do() -> None:
    coordinates, labels, truth = pair()
    virtual = virtual_lattice(coordinates, None, 4)
    right = torch.where(labels, 3.0, -3.0)[None]
    loss, unsolved = regression_loss(right, coordinates, truth, virtual, LossConfig())
    assert float(loss) < 1e-9
    assert int(unsolved) == 0
    wrong, _ = regression_loss(-right, coordinates, truth, virtual, LossConfig())
    assert float(wrong) > 0.05


@pytest.mark.parametrize("form", ["clamp", "geman_mcclure"])
def test_regression_loss_by_hand(form: str) -> None:
    coordinates, labels, truth = pair()
    shifted = truth.clone()
    shifted[0, :3, 3] += torch.tensor([0.3, 0.0, 0.4])
    virtual = virtual_lattice(coordinates, None, 3)
    config = LossConfig(regression_form=form, regression_margin=0.1)  # type: ignore[arg-type]
    loss, _ = regression_loss(torch.where(labels, 3.0, -3.0)[None], coordinates, shifted, virtual, config)
    expected = 0.1 if form == "clamp" else 0.1 * 0.25 / (0.1 + 0.25)
    assert float(loss) == pytest.approx(expected, rel=1e-4)


def test_regression_gradient_pulls_towards_inliers() -> None:
    coordinates, _, truth = pair(40, 25)
    logits = torch.full((1, 1, 40), 0.5, requires_grad=True)
    virtual = virtual_lattice(coordinates, None, 4)
    loss, _ = regression_loss(
        logits, coordinates, truth, virtual, LossConfig(regression_form="geman_mcclure")
    )
    loss.sum().backward()
    assert logits.grad is not None
    # Descending must lower the loss.
    moved, _ = regression_loss(
        logits.detach() - 1e-2 * logits.grad / logits.grad.norm(), coordinates, truth, virtual,
        LossConfig(regression_form="geman_mcclure"),
    )  # fmt: skip
    assert float(moved) < float(loss)


def degenerate(kind: str) -> tuple[torch.Tensor, torch.Tensor]:
    coordinates, _, _ = pair()
    logits = torch.full((1, 1, 40), 0.7)
    if kind == "no-positive":
        logits = -logits
    elif kind == "exact-zero":
        logits = 0 * logits
    elif kind == "one-positive":
        logits = torch.where(torch.arange(40) == 3, 1.0, -1.0).expand(1, 1, 40)
    elif kind == "two-positive":
        logits = torch.where(torch.arange(40) < 2, 1.0, -1.0).expand(1, 1, 40)
    elif kind == "huge":
        logits = torch.where(torch.arange(40) == 3, 1e20, -1e20).expand(1, 1, 40)
    elif kind == "collinear":
        coordinates = torch.linspace(-1, 1, 40)[None, :, None].expand(1, 40, 6).clone()
    elif kind == "coincident":
        coordinates = torch.zeros(1, 40, 6)
    elif kind == "identity":
        coordinates[..., 3:] = coordinates[..., :3]
    elif kind == "isotropic":
        corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).repeat(5, 1)
        coordinates = torch.cat([corners, corners], 1)[None]
    elif kind == "mirror":
        corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).repeat(5, 1)
        coordinates = torch.cat([corners, -corners], 1)[None]
    return coordinates, logits


@pytest.mark.parametrize(
    "kind",
    ["no-positive", "exact-zero", "one-positive", "two-positive", "huge", "collinear", "coincident",
     "identity", "isotropic", "mirror"],
)  # fmt: skip
@pytest.mark.parametrize("num_labels", [0, 5, 40])
def test_gradients_are_finite_for_every_degenerate_pair(kind: str, num_labels: int) -> None:
    coordinates, logits = degenerate(kind)
    logits = logits.clone().requires_grad_()
    labels = (torch.arange(40) < num_labels)[None]
    output = GeoMoEOutput(logits, torch.tensor(1.0), None, None, torch.zeros(1))
    losses = total_loss(output, coordinates, labels, torch.eye(4)[None], None, LossConfig(), 1.0)
    assert torch.isfinite(losses.total)
    losses.total.backward()
    assert torch.isfinite(logits.grad).all()  # type: ignore[arg-type]
    unsolved = kind in {"no-positive", "exact-zero", "one-positive", "two-positive", "huge", "collinear",
                        "coincident", "mirror"}  # fmt: skip
    assert int(losses.num_unsolved) == int(unsolved)


def test_regression_starts_after_its_share_of_the_schedule() -> None:
    coordinates, labels, truth = pair()
    output = GeoMoEOutput(torch.ones(2, 1, 40), torch.tensor(1.0), None, None, torch.zeros(2))
    config = LossConfig(regression_warmup=0.25)
    early = total_loss(output, coordinates, labels, truth, None, config, 0.24)
    late = total_loss(output, coordinates, labels, truth, None, config, 0.25)
    assert float(early.regression) == 0
    assert float(late.regression) > 0
    assert float(late.total) == pytest.approx(
        float(late.classification + 0.5 * late.regression + 0.01), rel=1e-6
    )


def test_network_motion_carries_the_inliers() -> None:
    coordinates, labels, truth = pair()
    inlier = coordinates[0][labels[0]].double()
    moved = inlier[:, :3] @ truth[0, :3, :3].T + truth[0, :3, 3]
    torch.testing.assert_close(moved, inlier[:, 3:], atol=1e-5, rtol=0)


def test_plain_classification_weighs_rows_and_puts_its_zero_where_the_weight_says() -> None:
    logits = torch.tensor([[[0.5, -1.0, 2.0, 0.0]]])
    labels = torch.tensor([[True, False, False, False]])
    mask = torch.tensor([[True, True, True, False]])
    rows = [3 * np.log1p(np.exp(-0.5)), np.log1p(np.exp(-1.0)), np.log1p(np.exp(2.0))]
    loss = classification_loss(logits, labels, mask, "plain", 3.0)
    assert loss.shape == (1,)
    assert float(loss) == pytest.approx(np.mean(rows), abs=1e-6)
    # A quarter of equal rows are inliers: with a weight of 3 the best logit is 0.
    z = torch.zeros(1, 1, 4, requires_grad=True)
    classification_loss(z, labels, None, "plain", 3.0).sum().backward()
    assert z.grad is not None
    assert float(z.grad.sum()) == pytest.approx(0, abs=1e-6)


def test_verdict_loss_against_a_case_by_hand() -> None:
    verdict = torch.tensor([2.0, 0.0, 1.0, -1.0, 3.0])
    right = torch.tensor([True, False, False, False, True])
    pair = torch.tensor([0, 0, 0, 1, 2])  # the second pair has no right motion, the third no wrong one
    preference = -np.log(np.exp(2) / (np.exp(2) + 1 + np.exp(1)))
    doubt = np.mean([np.log1p(np.exp(-2)), np.log(2), np.log1p(np.exp(1)), np.log1p(np.exp(-1)),
                     np.log1p(np.exp(-3))])  # fmt: skip
    assert float(verdict_loss(verdict, right, pair)) == pytest.approx(preference + doubt, abs=1e-6)
    v = verdict.clone().requires_grad_()
    verdict_loss(v, torch.zeros(5, dtype=torch.bool), pair).backward()
    assert v.grad is not None
    assert torch.isfinite(v.grad).all()
