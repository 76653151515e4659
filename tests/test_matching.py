"""Matching in feature space: against brute force, for every method, in blocks of any size."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geomoe3d.config import MatchingConfig
from geomoe3d.errors import InputError
from geomoe3d.matching import nearest as matching
from geomoe3d.matching.nearest import match, nearest_features
from geomoe3d.types import PreparedCloud

SEEDS = st.integers(0, 2**32 - 1)


def unit_features(rng: np.random.Generator, count: int, dimension: int = 33) -> np.ndarray:
    features = np.abs(rng.normal(size=(count, dimension))).astype(np.float32)
    return features / np.linalg.norm(features, axis=1, keepdims=True)


def cloud(features: np.ndarray, seed: int = 0) -> PreparedCloud:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(len(features), 3))
    return PreparedCloud(points, np.tile([0.0, 0, 1], (len(features), 1)), features, 0.1, None, np.zeros(3))


def brute_force(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    return np.linalg.norm(source[:, None].astype(float) - target[None].astype(float), axis=2)


def pair(seed: int = 0, n: int = 60, m: int = 50) -> tuple[PreparedCloud, PreparedCloud]:
    """Clouds with about half of the features in common, so that there are mutual and one-way matches."""
    rng = np.random.default_rng(seed)
    target = unit_features(rng, m)
    source = unit_features(rng, n)
    half = min(n, m) // 2
    source[:half] = target[:half] + 0.02 * rng.normal(size=(half, 33))
    source /= np.linalg.norm(source, axis=1, keepdims=True)
    return cloud(source, 1), cloud(target, 2)


# ---- nearest neighbours against brute force ------------------------------------------------------------


@given(SEEDS, st.integers(1, 40), st.integers(1, 40), st.integers(1, 3))
@settings(max_examples=60, deadline=None)
def test_neighbours_distances_ratios_and_mutuality_equal_brute_force(
    seed: int, n: int, m: int, k: int
) -> None:
    rng = np.random.default_rng(seed)
    source, target = unit_features(rng, n), unit_features(rng, m)
    index, distance, ratio, mutual = nearest_features(source, target, k)
    all_distances = brute_force(source, target)
    order = np.argsort(all_distances, axis=1)
    ranked = np.take_along_axis(all_distances, order, 1)
    k = min(k, m)
    assert index.shape == distance.shape == ratio.shape == mutual.shape == (n, k)
    np.testing.assert_array_equal(index, order[:, :k])
    np.testing.assert_allclose(distance, ranked[:, :k], atol=1e-4)
    if m > k:
        np.testing.assert_allclose(ratio, ranked[:, :k] / ranked[:, k : k + 1], atol=1e-3)
    else:
        np.testing.assert_array_equal(ratio, 1)
    nearest_source = all_distances.argmin(0)
    np.testing.assert_array_equal(mutual[:, 0], nearest_source[index[:, 0]] == np.arange(n))
    assert not mutual[:, 1:].any()
    assert ((ratio >= 0) & (ratio <= 1)).all()
    assert (np.diff(distance, axis=1) >= 0).all()


@pytest.mark.parametrize("entries", [1, 7, 60, 1000])
@pytest.mark.parametrize("k", [1, 3])
def test_small_blocks_give_the_same(monkeypatch: pytest.MonkeyPatch, entries: int, k: int) -> None:
    source, target = pair(n=70, m=31)
    whole = nearest_features(source.features, target.features, k)
    monkeypatch.setattr(matching, "BLOCK_ENTRIES", entries)
    parts = nearest_features(source.features, target.features, k)
    np.testing.assert_array_equal(parts[0], whole[0])
    np.testing.assert_allclose(parts[1], whole[1], atol=1e-4)
    np.testing.assert_allclose(parts[2], whole[2], atol=2e-2)  # ratios of tiny distances
    np.testing.assert_array_equal(parts[3], whole[3])


def test_blocks_stay_within_their_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """Peak memory grows with the block, not with the product of the sizes."""
    import tracemalloc

    rng = np.random.default_rng(3)
    source, target = unit_features(rng, 3000, 8), unit_features(rng, 2000, 8)
    monkeypatch.setattr(matching, "BLOCK_ENTRIES", 100_000)
    tracemalloc.start()
    nearest_features(source, target, 2)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4e6  # the whole table takes 24 MB


def test_identical_features_are_at_distance_zero_and_tell_nothing_by_ratio() -> None:
    features = np.repeat(unit_features(np.random.default_rng(4), 1), 5, axis=0)
    index, distance, ratio, mutual = nearest_features(features, features, 1)
    assert (distance < 1e-3).all()
    assert ((ratio >= 0) & (ratio <= 1)).all()
    assert mutual.all()
    assert ((index >= 0) & (index < 5)).all()


def test_zero_features_are_equally_far_from_all() -> None:
    rng = np.random.default_rng(5)
    source = np.zeros((2, 33), dtype=np.float32)
    _, distance, ratio, _ = nearest_features(source, unit_features(rng, 10), 1)
    np.testing.assert_allclose(distance, np.sqrt(2), atol=1e-6)
    np.testing.assert_array_equal(ratio, 1)


# ---- methods ------------------------------------------------------------------------------------------


def test_one_way_gives_every_source_point_its_nearest_target() -> None:
    source, target = pair()
    found = match(source, target, MatchingConfig(name="one_way"))
    distances = brute_force(source.features, target.features)
    np.testing.assert_array_equal(found.source_index, np.arange(60))
    np.testing.assert_array_equal(found.target_index, distances.argmin(1))
    np.testing.assert_array_equal(found.source, source.points[found.source_index])
    np.testing.assert_array_equal(found.target, target.points[found.target_index])
    np.testing.assert_allclose(
        found.feature_distance, distances[found.source_index, found.target_index], atol=1e-3
    )


@pytest.mark.parametrize("k", [2, 3])
def test_more_neighbours_give_more_rows_each(k: int) -> None:
    source, target = pair()
    found = match(source, target, MatchingConfig(name="one_way", neighbors=k))
    order = np.argsort(brute_force(source.features, target.features), axis=1)[:, :k]
    np.testing.assert_array_equal(found.source_index, np.repeat(np.arange(60), k))
    np.testing.assert_array_equal(found.target_index, order.ravel())


def test_mutual_keeps_pairs_that_are_each_others_nearest_and_does_not_mind_the_direction() -> None:
    source, target = pair()
    distances = brute_force(source.features, target.features)
    expected = {(i, j) for i, j in enumerate(distances.argmin(1)) if distances[:, j].argmin() == i}
    assert 20 < len(expected) < 60
    config = MatchingConfig(name="mutual")
    forth, back = match(source, target, config), match(target, source, config)
    assert set(zip(forth.source_index, forth.target_index, strict=True)) == expected
    assert set(zip(back.target_index, back.source_index, strict=True)) == expected
    assert forth.mutual.all()


def test_mutual_with_more_neighbours_still_means_each_others_nearest() -> None:
    source, target = pair()
    one, three = (match(source, target, MatchingConfig(name="mutual", neighbors=k)) for k in (1, 3))
    assert set(zip(three.source_index, three.target_index, strict=True)) == set(
        zip(one.source_index, one.target_index, strict=True)
    )


@pytest.mark.parametrize("limit", [0.3, 0.8, 1.0])
def test_ratio_keeps_the_clearly_better(limit: float) -> None:
    source, target = pair()
    ranked = np.sort(brute_force(source.features, target.features), axis=1)
    expected = np.flatnonzero(ranked[:, 0] <= limit * ranked[:, 1])
    found = match(source, target, MatchingConfig(name="ratio", max_ratio=limit))
    np.testing.assert_array_equal(found.source_index, expected)
    assert (found.ratio <= limit).all()
    assert limit == 1.0 or 0 < len(found) < 60


def test_single_points_match() -> None:
    features = unit_features(np.random.default_rng(6), 1)
    for method in ("one_way", "mutual", "ratio"):
        found = match(cloud(features), cloud(features), MatchingConfig(name=method, max_ratio=1, neighbors=3))
        assert len(found) == 1


def test_clouds_without_features_are_refused() -> None:
    source, target = pair()
    from dataclasses import replace

    for a, b in ((replace(source, features=None), target), (source, replace(target, features=None))):
        with pytest.raises(InputError, match="with_features"):
            match(a, b, MatchingConfig())


# ---- the limit on correspondences ------------------------------------------------------------------------


def test_the_limit_keeps_mutual_ones_first_in_source_order_by_seed() -> None:
    source, target = pair(n=300, m=200)
    everything = match(source, target, MatchingConfig(max_correspondences=300))
    num_mutual = int(everything.mutual.sum())
    assert 90 < num_mutual < 200
    rows = {
        (i, j): k
        for k, (i, j) in enumerate(zip(everything.source_index, everything.target_index, strict=True))
    }
    for limit in (20, num_mutual, num_mutual + 30):
        config = MatchingConfig(max_correspondences=limit)
        a, b, c = (match(source, target, config, seed=seed) for seed in (0, 0, 1))
        assert len(a) == limit
        assert a.mutual.sum() == min(limit, num_mutual)
        assert (np.diff(a.source_index) > 0).all()
        picked = [rows[key] for key in zip(a.source_index, a.target_index, strict=True)]
        for name in ("points", "feature_distance", "ratio", "mutual"):
            np.testing.assert_array_equal(getattr(a, name), getattr(everything, name)[picked])
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        if limit != num_mutual:
            assert set(a.source_index) != set(c.source_index)
        else:
            np.testing.assert_array_equal(a.source_index, c.source_index)


def test_the_filling_choice_is_spread_over_the_cloud() -> None:
    """Not the first rows, and not the most distinctive ones: each part of the cloud has its share."""
    rng = np.random.default_rng(7)
    source, target = cloud(unit_features(rng, 2000)), cloud(unit_features(rng, 20))
    found = match(source, target, MatchingConfig(max_correspondences=500))
    shares = np.histogram(found.source_index, bins=4, range=(0, 2000))[0]
    assert (np.abs(shares - 125) < 50).all()


@pytest.mark.parametrize("method", ["mutual", "ratio"])
def test_the_limit_applies_after_the_method(method: str) -> None:
    source, target = pair(n=300, m=200)
    plain = match(source, target, MatchingConfig(name=method, max_ratio=0.9))
    few = match(source, target, MatchingConfig(name=method, max_ratio=0.9, max_correspondences=10))
    assert len(plain) > 10 == len(few)
    assert set(few.source_index) <= set(plain.source_index)


THREADS_SCRIPT = """
import sys
import numpy as np
from geomoe3d.matching.nearest import nearest_features
rng = np.random.default_rng(0)
a, b = (np.abs(rng.normal(size=(k, 33))).astype(np.float32) for k in (3000, 2500))
a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b))
np.savez(sys.argv[1], *nearest_features(a, b, 2))
"""


def test_matches_do_not_depend_on_the_number_of_threads(tmp_path: Path) -> None:
    """The same pairs exactly; their distances may differ in the last digits of float32."""
    answers = []
    for threads in ("1", "2"):
        names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
        subprocess.run(
            [sys.executable, "-c", THREADS_SCRIPT, str(tmp_path / f"{threads}.npz")],
            env={**os.environ, **dict.fromkeys(names, threads)},
            timeout=120,
            check=True,
        )
        with np.load(tmp_path / f"{threads}.npz") as data:
            answers.append([data[f"arr_{k}"] for k in range(4)])
    for k, tolerance in enumerate((0, 1e-5, 1e-5, 0)):
        np.testing.assert_allclose(answers[0][k], answers[1][k], rtol=0, atol=tolerance)


def test_blocks_share_the_best_of_every_column(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many small blocks, on several threads, say the same of mutual matches as one; no source is no error."""
    rng = np.random.default_rng(4)
    a, b = (rng.normal(size=(n, 33)).astype(np.float32) for n in (300, 200))
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b))
    whole = matching.nearest_features(a, b, 2)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.setattr(matching, "BLOCK_ENTRIES", 1000)
    parts = matching.nearest_features(a, b, 2)
    for x, y in zip(whole, parts, strict=True):
        np.testing.assert_allclose(x, y, atol=1e-6)
    assert 0 < parts[3].sum() < 300
    assert len(matching.nearest_features(a[:0], b, 1)[0]) == 0


# ---- matches of two kinds together ---------------------------------------------------------------------


def test_matches_of_two_kinds_stand_together_once_each() -> None:
    source, target = pair(4)
    first = match(source, target, MatchingConfig(name="mutual"), seed=0)
    second = match(source, target, MatchingConfig(name="ratio", max_ratio=0.9))
    both = first.with_others(second)
    rows = [set(zip(m.source_index, m.target_index, strict=True)) for m in (first, second, both)]
    assert rows[2] == rows[0] | rows[1] and len(both) == len(rows[2]) > len(first)
    np.testing.assert_array_equal(both.take(slice(len(first))).points, first.points)
    np.testing.assert_array_equal(both.source, source.points[both.source_index])
    np.testing.assert_array_equal(both.normals[1], target.normals[both.target_index])
    for name in ("feature_distance", "ratio", "mutual"):
        assert len(getattr(both, name)) == len(both)
    bare = first.with_others(replace(second, mutual=None, normals=None))
    assert bare.mutual is None and bare.normals is None and len(bare) == len(both)


@pytest.mark.parametrize("step", [7, 1_000_000])
def test_dual_softmax_is_the_product_of_both_softmaxes(step: int, monkeypatch) -> None:
    from geomoe3d.matching import dual_softmax

    monkeypatch.setattr(dual_softmax, "BLOCK_ENTRIES", step * 40)
    rng = np.random.default_rng(3)
    a, b = (rng.normal(size=(n, 8)) for n in (30, 40))
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b))
    e = np.exp(a @ b.T / 0.1)
    product = e / e.sum(1, keepdims=True) * e / e.sum(0, keepdims=True)
    column, log_score = dual_softmax.best_by_dual_softmax(a.astype(np.float32), b.astype(np.float32), 0.1)
    assert np.array_equal(column, product.argmax(1))
    assert np.allclose(log_score, np.log(product.max(1)), atol=1e-4)
