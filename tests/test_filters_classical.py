"""Filters that need no training: the form they share, the choice by name, spectral matching by definition."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from geomoe3d.config import FilterConfig, load_config
from geomoe3d.errors import ConfigError
from geomoe3d.filters.base import NoFilter, outlier_filter
from geomoe3d.filters.spectral import SpectralFilter
from geomoe3d.pipeline import resolved
from geomoe3d.types import Correspondences, FilterOutput

VOXEL = 0.05


def problem(seed: int, count: int = 300, inliers: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    source = rng.uniform(0, 4, (count, 3))
    R = Rotation.random(random_state=seed).as_matrix()
    target = source @ R.T + [1, 2, 3]
    true = np.zeros(count, dtype=bool)
    true[rng.permutation(count)[: round(inliers * count)]] = True
    target[~true] = rng.uniform(0, 4, ((~true).sum(), 3)) @ R.T + [1, 2, 3]
    return np.hstack([source, target]), true


SPECTRAL = SpectralFilter()


def weights(rows: np.ndarray, made: SpectralFilter = SPECTRAL, seed: int = 0) -> np.ndarray:
    return made(Correspondences(rows), voxel_size=VOXEL, seed=seed).weights


@pytest.mark.parametrize("name", ["none", "spectral"])
@pytest.mark.parametrize("count", [0, 1, 2, 3, 50])
def test_one_weight_in_range_for_every_correspondence(name: str, count: int) -> None:
    rows, _ = problem(0, max(count, 1))
    rows = rows[:count]
    before = rows.copy()
    output = outlier_filter.make(FilterConfig(name=name))(Correspondences(rows), voxel_size=VOXEL)
    assert isinstance(output, FilterOutput)
    assert output.weights.shape == (count,)
    assert output.weights.dtype == np.float64
    assert ((output.weights >= 0) & (output.weights <= 1)).all()
    np.testing.assert_array_equal(rows, before)


def test_no_filter_gives_all_the_same() -> None:
    rows, _ = problem(0)
    np.testing.assert_array_equal(NoFilter()(Correspondences(rows), voxel_size=VOXEL).weights, np.ones(300))


def test_names_are_those_that_can_be_made_and_others_name_the_nearest() -> None:
    assert {"none", "spectral"} <= set(outlier_filter.names())
    with pytest.raises(ConfigError, match="'spectrl'; did you mean 'spectral'"):
        outlier_filter.make(FilterConfig(name="spectrl"))
    with pytest.raises(ConfigError, match=r"known: .*none.*spectral"):
        outlier_filter.make(FilterConfig(name="zzzzzz"))


def test_auto_takes_the_network_where_it_can_be_had(monkeypatch: pytest.MonkeyPatch) -> None:
    def scorers(*assignments: str) -> object:
        return resolved(load_config(None, list(assignments))).scoring.scorers

    assert scorers() == ("surfaces", "network")
    assert scorers("scoring.scorers=[surfaces]") == ("surfaces",)
    monkeypatch.setattr("geomoe3d.pipeline.packaged_names", list)
    assert scorers() == ("surfaces",)
    assert scorers("scoring.weights=mine.safetensors") == ("surfaces", "network")  # and says what lacks


@pytest.mark.parametrize("seed", range(4))
def test_spectral_weights_tell_inliers_from_outliers(seed: int) -> None:
    rows, true = problem(seed)
    w = weights(rows)
    assert w.max() == 1
    assert w[true].min() > w[~true].max()


def test_spectral_weights_are_the_leading_eigenvector() -> None:
    rows, _ = problem(5)
    d = 2.0 * VOXEL
    difference = cdist(rows[:, :3], rows[:, :3]) - cdist(rows[:, 3:], rows[:, 3:])
    C = np.maximum(1 - (difference / d) ** 2, 0)
    np.fill_diagonal(C, 0)
    leading = np.abs(np.linalg.eigh(C)[1][:, -1])
    w = weights(rows, SpectralFilter(iterations=100))
    np.testing.assert_allclose(w, leading / leading.max(), atol=1e-3)
    assert np.corrcoef(weights(rows), leading)[0, 1] > 0.999


@pytest.mark.parametrize("kind", ["moved", "scaled", "permuted", "far away"])
def test_spectral_weights_do_not_mind(kind: str) -> None:
    rows, _ = problem(6)
    expected = weights(rows)
    if kind == "moved":
        A, B = Rotation.random(2, random_state=6).as_matrix()
        got = weights(np.hstack([rows[:, :3] @ A.T + 3, rows[:, 3:] @ B.T - 5]))
    elif kind == "scaled":
        got = SpectralFilter()(Correspondences(rows * 1000), voxel_size=VOXEL * 1000).weights
    elif kind == "permuted":
        order = np.random.default_rng(6).permutation(len(rows))
        got, expected = weights(rows[order]), expected[order]
    else:
        got = weights(rows + np.tile([583394.0, 5283100, 498], 2))
    np.testing.assert_allclose(got, expected, atol=1e-3)


def test_nothing_compatible_weighs_nothing() -> None:
    rng = np.random.default_rng(7)
    source = rng.uniform(0, 4, (40, 3))
    np.testing.assert_array_equal(weights(np.hstack([source, 5 * source])), np.zeros(40))
    np.testing.assert_array_equal(weights(np.ones((1, 6))), [0])


def test_more_rows_than_anchors_are_weighed_alike_in_bounded_memory() -> None:
    rows, true = problem(8, 3000)
    whole = weights(rows)
    few = SpectralFilter(max_anchors=400)
    tracemalloc.start()
    sampled = weights(rows, few)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10e6  # a float32 table of all pairs takes 36 MB
    assert sampled.max() == 1
    assert sampled[true].mean() > 5 * sampled[~true].mean()
    assert np.corrcoef(sampled, whole)[0, 1] > 0.97
    np.testing.assert_array_equal(weights(rows, few, seed=3), weights(rows, few, seed=3))
    assert (weights(rows, few, seed=3) != weights(rows, few, seed=4)).any()
