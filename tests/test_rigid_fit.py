"""Numpy Kabsch: against scipy and torch, reflections, batches, degenerate sets, and its small companions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geomoe3d.geometry.rigid_fit import (
    fit_rigid,
    fit_rigid_shared,
    products,
    spread,
    spread_shared,
    squared_residuals,
    squared_residuals_shared,
)

SEEDS = st.integers(0, 2**32 - 1)


def noisy_set(
    rng: np.random.Generator, count: int = 20, noise: float = 0.1
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    R = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    source = rng.normal(size=(count, 3)) * [3, 2, 1]
    target = source @ R.T + rng.normal(size=3) + noise * rng.normal(size=(count, 3))
    return source, target, rng.uniform(0.01, 1, count)


def cost(
    R: np.ndarray, t: np.ndarray, source: np.ndarray, target: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    moved = np.einsum("...ij,...nj->...ni", R, source) + t[..., None, :]
    return (weights * ((moved - target) ** 2).sum(-1)).sum(-1)


@given(SEEDS, st.integers(3, 40), st.floats(0, 2))
@settings(max_examples=60, deadline=None)
def test_equals_scipy_with_weights(seed: int, count: int, noise: float) -> None:
    source, target, weights = noisy_set(np.random.default_rng(seed), count, noise)
    R, t = fit_rigid(source, target, weights)
    source_mean, target_mean = (np.average(x, axis=0, weights=weights) for x in (source, target))
    oracle, _ = Rotation.align_vectors(target - target_mean, source - source_mean, weights=weights)
    expected = oracle.as_matrix(), target_mean - oracle.as_matrix() @ source_mean
    best = cost(*expected, source, target, weights)
    assert cost(R, t, source, target, weights) <= best * (1 + 1e-9) + 1e-12
    assert np.linalg.det(R) == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    if noise < 0.3 and count >= 8:  # the minimiser is then well conditioned
        np.testing.assert_allclose(R, expected[0], atol=1e-9)
        np.testing.assert_allclose(t, expected[1], atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_mirrored_points_get_the_best_rotation_and_no_reflection(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source, target, weights = noisy_set(rng)
    target = target * [1, 1, -1]
    R, t = fit_rigid(source, target, weights)
    assert np.linalg.det(R) == pytest.approx(1, abs=1e-12)
    source_mean, target_mean = (np.average(x, axis=0, weights=weights) for x in (source, target))
    oracle, _ = Rotation.align_vectors(target - target_mean, source - source_mean, weights=weights)
    np.testing.assert_allclose(R, oracle.as_matrix(), atol=1e-9)
    assert cost(R, t, source, target, weights) > 1


def test_equals_the_differentiable_twin() -> None:
    torch = pytest.importorskip("torch")
    from geomoe3d.geometry.kabsch import weighted_kabsch

    rng = np.random.default_rng(8)
    sets = [noisy_set(rng) for _ in range(6)]
    source, target, weights = (np.stack(part) for part in zip(*sets, strict=True))
    R, t = fit_rigid(source, target, weights)
    T = weighted_kabsch(torch.tensor(source), torch.tensor(target), torch.tensor(weights)).T_target_source
    np.testing.assert_allclose(T[:, :3, :3].numpy(), R, atol=1e-10)
    np.testing.assert_allclose(T[:, :3, 3].numpy(), t, atol=1e-10)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_batch_is_a_loop(dtype: type) -> None:
    rng = np.random.default_rng(9)
    sets = [noisy_set(rng, 12) for _ in range(6)]
    source, target, weights = (np.stack(part).astype(dtype) for part in zip(*sets, strict=True))
    R, t = fit_rigid(source.reshape(2, 3, 12, 3), target.reshape(2, 3, 12, 3), weights.reshape(2, 3, 12))
    assert R.shape == (2, 3, 3, 3)
    assert t.shape == (2, 3, 3)
    assert R.dtype == t.dtype == dtype
    tolerance = 1e-12 if dtype == np.float64 else 1e-5
    for k in range(6):
        single = fit_rigid(source[k], target[k], weights[k])
        np.testing.assert_allclose(R.reshape(6, 3, 3)[k], single[0], atol=tolerance)
        np.testing.assert_allclose(t.reshape(6, 3)[k], single[1], atol=tolerance)


def test_shared_points_give_the_same_as_plain_fits() -> None:
    rng = np.random.default_rng(10)
    source, target, _ = noisy_set(rng, 50)
    source -= source.mean(0)
    target -= target.mean(0)
    weights = rng.uniform(size=(7, 50)) * (rng.random((7, 50)) < 0.5)
    R, t = fit_rigid_shared(products(source, target), weights)
    for k in range(7):
        plain = fit_rigid(source, target, weights[k])
        np.testing.assert_allclose(R[k], plain[0], atol=1e-11)
        np.testing.assert_allclose(t[k], plain[1], atol=1e-11)


@pytest.mark.parametrize("extent", [1.0, 1e4])
def test_residuals_of_products_are_those_of_the_points(extent: float) -> None:
    rng = np.random.default_rng(11)
    R = Rotation.random(5, random_state=11).as_matrix()
    source = extent * rng.normal(size=(40, 3))
    t = 0.3 * rng.normal(size=(5, 3))
    target = source @ R[0].T + rng.normal(size=(40, 3))
    found = squared_residuals_shared(R, t, products(source, target))
    np.testing.assert_allclose(
        found[0], squared_residuals(R, t, source, target)[0], atol=1e-14 * extent**2 + 1e-12
    )
    np.testing.assert_allclose(found, squared_residuals(R, t, source, target), rtol=1e-9, atol=1e-6)
    assert (squared_residuals_shared(R[:1], 0 * t[:1], products(source, source @ R[0].T)) >= 0).all()


@given(SEEDS, st.floats(1e-6, 1e6), st.floats(1e-6, 1e6))
@settings(max_examples=40, deadline=None)
def test_scaling_weights_changes_nothing_and_lengths_only_the_shift(
    seed: int, weight_scale: float, scale: float
) -> None:
    source, target, weights = noisy_set(np.random.default_rng(seed))
    R, t = fit_rigid(source, target, weights)
    R_weights, t_weights = fit_rigid(source, target, weights * weight_scale)
    np.testing.assert_allclose(R_weights, R, atol=1e-10)
    np.testing.assert_allclose(t_weights, t, atol=1e-10)
    R_scaled, t_scaled = fit_rigid(source * scale, target * scale, weights)
    np.testing.assert_allclose(R_scaled, R, atol=1e-9)
    np.testing.assert_allclose(t_scaled / scale, t, atol=1e-9)


@given(SEEDS)
@settings(max_examples=40, deadline=None)
def test_moving_either_set_moves_the_answer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    source, target, weights = noisy_set(rng)
    R, t = fit_rigid(source, target, weights)
    A, B = Rotation.from_quat(rng.normal(size=(2, 4))).as_matrix()
    a, b = rng.normal(size=(2, 3))
    R_moved, t_moved = fit_rigid(source @ A.T + a, target @ B.T + b, weights)
    np.testing.assert_allclose(R_moved, B @ R @ A.T, atol=1e-9)
    np.testing.assert_allclose(t_moved, B @ t + b - R_moved @ a, atol=1e-9)


def test_weight_zero_is_absence_and_weight_two_is_twice() -> None:
    source, target, _ = noisy_set(np.random.default_rng(11))
    weights = np.ones(20)
    weights[:5], weights[5:8] = 0, 2
    twice = np.r_[5:20, 5:8]
    R, t = fit_rigid(source, target, weights)
    R_rows, t_rows = fit_rigid(source[twice], target[twice], np.ones(len(twice)))
    np.testing.assert_allclose(R, R_rows, atol=1e-12)
    np.testing.assert_allclose(t, t_rows, atol=1e-12)


@pytest.mark.parametrize("kind", ["coincident", "collinear", "planar", "no weight", "one point"])
def test_undetermined_sets_give_one_of_the_minimisers(kind: str) -> None:
    """A proper rotation, finite, and no rotation of many does better."""
    rng = np.random.default_rng(12)
    source, target, weights = noisy_set(rng, 10)
    if kind == "coincident":
        source, target = np.ones((10, 3)), np.full((10, 3), 2.0)
    elif kind == "collinear":
        source = np.outer(rng.normal(size=10), [1.0, 2, 3])
        target = source[:, [1, 0, 2]] * [1, -1, 1] + 0.05 * rng.normal(size=(10, 1)) * [2, -1, 3]
    elif kind == "planar":
        source[:, 2] = 0
        target = source[:, [1, 2, 0]] + 1
    elif kind == "no weight":
        weights = np.zeros(10)
    else:
        source, target, weights = source[:1], target[:1], weights[:1]
    for R, t in (
        fit_rigid(source, target, weights),
        [x[0] for x in fit_rigid_shared(products(source, target), weights[None])],
    ):
        assert np.linalg.det(R) == pytest.approx(1, abs=1e-9)
        assert np.isfinite(t).all()
        others = Rotation.random(2000, random_state=0).as_matrix()
        means = [np.average(x, axis=0, weights=weights if weights.any() else None) for x in (source, target)]
        shifts = means[1] - others @ means[0]
        assert (
            cost(R, t, source, target, weights) <= cost(others, shifts, source, target, weights).min() + 1e-9
        )


def test_three_exact_points_are_enough() -> None:
    rng = np.random.default_rng(13)
    R_true = Rotation.random(random_state=13).as_matrix()
    source = rng.normal(size=(3, 3))
    R, t = fit_rigid(source, source @ R_true.T + [1, 2, 3], np.ones(3))
    np.testing.assert_allclose(R, R_true, atol=1e-12)
    np.testing.assert_allclose(t, [1, 2, 3], atol=1e-12)


def test_squared_residuals_equal_a_plain_loop() -> None:
    rng = np.random.default_rng(14)
    R = Rotation.random(4, random_state=14).as_matrix()
    t, source, target = rng.normal(size=(4, 3)), rng.normal(size=(9, 3)), rng.normal(size=(9, 3))
    source_before, target_before = source.copy(), target.copy()
    expected = [
        [((R[k] @ p + t[k] - q) ** 2).sum() for p, q in zip(source, target, strict=True)] for k in range(4)
    ]
    np.testing.assert_allclose(squared_residuals(R, t, source, target), expected, atol=1e-12)
    np.testing.assert_array_equal(source, source_before)
    np.testing.assert_array_equal(target, target_before)


def test_spread_is_the_second_standard_deviation() -> None:
    rng = np.random.default_rng(15)
    turn = Rotation.random(random_state=15).as_matrix()
    corners = np.array([[x, y, z] for x in (-3.0, 3) for y in (-2, 2) for z in (-1, 1)])
    weights = np.ones(8)
    assert spread(corners @ turn.T + 100, weights) == pytest.approx(2, rel=1e-9)
    assert spread(corners @ turn.T, 7 * weights) == pytest.approx(2, rel=1e-9)
    points, w = rng.normal(size=(30, 3)), rng.random(30)
    expected = np.sqrt(np.linalg.eigvalsh(np.cov(points.T, aweights=w, ddof=0))[1])
    assert spread(points, w) == pytest.approx(expected, rel=1e-9)
    line = np.outer(rng.normal(size=20), [1.0, 2, 3]) + 5
    assert spread(line, np.ones(20)) < 1e-6
    assert spread(np.ones((5, 3)), np.ones(5)) == 0
    assert spread(points, np.zeros(30)) == 0
    assert spread(np.zeros((0, 3)), np.zeros(0)) == 0


def test_spread_of_a_line_is_nothing_however_far_the_rows_of_weight_zero_lie() -> None:
    rng = np.random.default_rng(17)
    line = np.outer(rng.uniform(-1, 1, 10), [1.0, 2, 3]) + 1000
    far = rng.normal(size=(200, 3)) * 1000
    weights = np.r_[np.ones(10), np.zeros(200)]
    assert spread(np.vstack([line, far]), weights) < 1e-6


def test_shared_spread_is_the_spread_of_each_weighting() -> None:
    rng = np.random.default_rng(16)
    points = rng.normal(size=(40, 3)) * [5, 3, 0.2]
    weights = rng.random((6, 40)) * (rng.random((6, 40)) < 0.3)
    weights[5] = 0
    np.testing.assert_allclose(spread_shared(points, weights), spread(points, weights), rtol=1e-9)
    line = np.outer(rng.normal(size=40), [1.0, 2, 3])
    assert spread_shared(line, weights).max() < 1e-6
