"""Weighted Kabsch: exact against scipy, right about reflections, finite for every degenerate input."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geomoe3d.errors import InputError
from geomoe3d.geometry.kabsch import weighted_kabsch


def random_motion(rng: np.random.Generator) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=int(rng.integers(1 << 31))).as_matrix()
    T[:3, 3] = rng.normal(size=3) * 3
    return T


def noisy_pair(seed: int, num_points: int = 30, noise: float = 0.1) -> tuple[torch.Tensor, ...]:
    rng = np.random.default_rng(seed)
    T = random_motion(rng)
    source = rng.normal(size=(num_points, 3))
    target = source @ T[:3, :3].T + T[:3, 3] + noise * rng.normal(size=source.shape)
    weights = rng.uniform(0.01, 1, num_points)
    return torch.tensor(source), torch.tensor(target), torch.tensor(weights), torch.tensor(T)


def rotation_of(covariance: torch.Tensor) -> torch.Tensor:
    """The rotation that the fit finds for points whose covariance is a third of this one (..., 3, 3)."""
    axes = torch.eye(3, dtype=covariance.dtype)
    fit = weighted_kabsch(torch.cat([axes, -axes]), torch.cat([covariance, -covariance], dim=-2))
    return fit.T_target_source[..., :3, :3]


@pytest.mark.parametrize("seed", range(5))
def test_equals_scipy_on_noisy_weighted_points(seed: int) -> None:
    source, target, weights, _ = noisy_pair(seed)
    fit = weighted_kabsch(source, target, weights)
    w = weights / weights.sum()
    source_c, target_c = source - w @ source, target - w @ target
    oracle, _ = Rotation.align_vectors(target_c.numpy(), source_c.numpy(), weights=weights.numpy())
    T = fit.T_target_source.numpy()
    np.testing.assert_allclose(T[:3, :3], oracle.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], (w @ target).numpy() - T[:3, :3] @ (w @ source).numpy(), atol=1e-12)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
    assert fit.valid


def test_recovers_the_exact_motion_far_from_the_origin() -> None:
    source, target, weights, _ = noisy_pair(7, noise=0.0)
    shift = torch.tensor([1e3, -2e3, 5e2], dtype=torch.float64)
    fit = weighted_kabsch(source + shift, target, weights)
    moved = fit.T_target_source[:3, :3] @ (source + shift).T + fit.T_target_source[:3, 3:]
    torch.testing.assert_close(moved.T, target, atol=1e-9, rtol=0)


def test_any_leading_dimensions_equal_single_calls() -> None:
    singles = [noisy_pair(seed) for seed in range(6)]
    source, target, weights = (torch.stack([s[i] for s in singles]).unflatten(0, (2, 3)) for i in range(3))
    fit = weighted_kabsch(source, target, weights)
    assert fit.T_target_source.shape == (2, 3, 4, 4)
    assert fit.valid.shape == (2, 3)
    for i, (p, q, w, _) in enumerate(singles):
        torch.testing.assert_close(
            fit.T_target_source[i // 3, i % 3], weighted_kabsch(p, q, w).T_target_source
        )


@pytest.mark.parametrize("seed", range(4))
def test_mirrored_points_still_give_the_best_proper_rotation(seed: int) -> None:
    source, target, weights, _ = noisy_pair(seed)
    target = target * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    R = weighted_kabsch(source, target, weights).T_target_source[:3, :3]
    assert float(torch.linalg.det(R.detach())) == pytest.approx(1.0)
    w = weights / weights.sum()
    oracle, _ = Rotation.align_vectors(
        (target - w @ target).numpy(), (source - w @ source).numpy(), weights=weights.numpy()
    )
    np.testing.assert_allclose(R.numpy(), oracle.as_matrix(), atol=1e-10)


def test_planar_points_are_determined_and_proper() -> None:
    source, target, _, T = noisy_pair(3, noise=0.0)
    source = source.clone()
    source[:, 2] = 0
    target = source @ T[:3, :3].T + T[:3, 3]
    fit = weighted_kabsch(source, target)
    assert fit.valid
    torch.testing.assert_close(fit.T_target_source, T, atol=1e-10, rtol=0)


def test_gradient_equals_finite_differences() -> None:
    source, target, weights, _ = noisy_pair(11, num_points=6)
    inputs = (source.requires_grad_(), target.requires_grad_(), weights.requires_grad_())
    assert torch.autograd.gradcheck(lambda p, q, w: weighted_kabsch(p, q, w).T_target_source, inputs)


@pytest.mark.parametrize("mirrored", [False, True])
def test_gradient_through_the_covariance_equals_finite_differences(mirrored: bool) -> None:
    H = torch.randn(4, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    flip = torch.where((torch.linalg.det(H) < 0) == mirrored, 1.0, -1.0)
    H = (H * flip[:, None, None]).requires_grad_()
    assert bool(((torch.linalg.det(H) < 0) == mirrored).all())
    assert torch.autograd.gradcheck(rotation_of, (H,))


def test_closed_form_gradient_equals_autograd_through_the_decomposition() -> None:
    H = torch.randn(
        20, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    ).requires_grad_()
    G = torch.randn(20, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    (ours,) = torch.autograd.grad(rotation_of(H), H, G)
    U, _, Vt = torch.linalg.svd(H)
    d = torch.sign(torch.linalg.det(U) * torch.linalg.det(Vt)).detach()
    D = torch.diag_embed(torch.stack([torch.ones_like(d), torch.ones_like(d), d], -1))
    (plain,) = torch.autograd.grad(Vt.transpose(1, 2) @ D @ U.transpose(1, 2), H, G)
    torch.testing.assert_close(ours, plain, atol=1e-9, rtol=1e-9)


def diagonal(*values: float) -> torch.Tensor:
    return torch.diag(torch.tensor(values, dtype=torch.float64))


@pytest.mark.parametrize(
    "covariance",
    [
        diagonal(1, 1, 1),
        diagonal(2, 1, 1),
        diagonal(2, 2, 1),
        diagonal(3, 0, 0),
        diagonal(0, 0, 0),
        diagonal(2, 1, -1),
        diagonal(1, 1, -1),
        diagonal(1, 1, 0),
        diagonal(1e-150, 1e-150, 1e-150),
        diagonal(1e20, 1, 1),
    ],
    ids=["identity", "two-equal-low", "two-equal-high", "rank-one", "zero", "reflection-tie", "mirror",
         "planar", "tiny", "huge-spread"],
)  # fmt: skip
def test_rotation_gradient_is_finite_for_degenerate_covariances(covariance: torch.Tensor) -> None:
    H = covariance.clone().requires_grad_()
    R = rotation_of(H)
    assert torch.isfinite(R).all()
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=torch.float64))
    assert float(torch.linalg.det(R.detach())) == pytest.approx(1.0)
    (gradient,) = torch.autograd.grad(R, H, torch.arange(9, dtype=torch.float64).reshape(3, 3))
    assert torch.isfinite(gradient).all()


def test_gradient_at_equal_singular_values_is_the_true_one() -> None:
    H = diagonal(1, 1, 1).requires_grad_()
    assert torch.autograd.gradcheck(rotation_of, (H,))


def degenerate_weights(kind: str) -> torch.Tensor:
    weights = torch.zeros(10, dtype=torch.float64)
    if kind == "one":
        weights[3] = 1.0
    elif kind == "two":
        weights[:2] = 1.0
    elif kind == "huge":
        weights[3] = 1e20
    elif kind == "nan":
        weights[:] = float("nan")
    return weights


@pytest.mark.parametrize("kind", ["zero", "one", "two", "huge", "nan"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_too_few_weights_are_invalid_with_finite_gradients(kind: str, dtype: torch.dtype) -> None:
    source, target, _, _ = noisy_pair(4, num_points=10)
    inputs = [x.to(dtype).requires_grad_() for x in (source, target, degenerate_weights(kind))]
    fit = weighted_kabsch(*inputs)
    assert not fit.valid
    assert torch.isfinite(fit.T_target_source).all()
    for gradient in torch.autograd.grad(fit.T_target_source.square().sum(), inputs):
        assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_collinear_and_coincident_points_are_invalid_with_finite_gradients(dtype: torch.dtype) -> None:
    line = torch.linspace(0, 3, 12, dtype=dtype)[:, None] * torch.tensor([0.3, -0.5, 0.8], dtype=dtype)
    for source in (line, torch.ones(12, 3, dtype=dtype)):
        target = (source + torch.tensor([1.0, 2.0, 3.0], dtype=dtype)).requires_grad_()
        fit = weighted_kabsch(source, target)
        assert not fit.valid
        (gradient,) = torch.autograd.grad(fit.T_target_source.square().sum(), target)
        assert torch.isfinite(gradient).all()


def test_non_finite_rows_are_left_out() -> None:
    source, target, weights, _ = noisy_pair(9)
    expected = weighted_kabsch(source[2:], target[2:], weights[2:]).T_target_source
    source, target = source.clone(), target.clone()
    source[0, 1] = float("nan")
    target[1, 2] = float("inf")
    fit = weighted_kabsch(source, target, weights)
    assert fit.valid
    torch.testing.assert_close(fit.T_target_source, expected, atol=1e-12, rtol=0)


def test_scaling_all_weights_changes_nothing() -> None:
    source, target, weights, _ = noisy_pair(12)
    expected = weighted_kabsch(source, target, weights).T_target_source
    for factor in (1e-200, 1e-8, 1e200):
        torch.testing.assert_close(
            weighted_kabsch(source, target, weights * factor).T_target_source, expected
        )


def test_no_rows_and_wrong_shapes_are_refused() -> None:
    for source, target in [((0, 3), (0, 3)), ((4, 2), (4, 2)), ((4, 3), (5, 3))]:
        with pytest.raises(InputError, match="same N >= 1"):
            weighted_kabsch(torch.zeros(source), torch.zeros(target))
