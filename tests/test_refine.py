"""Refinement: the motion found from nearby, in any unit, or the start given back with a reason."""

from __future__ import annotations

import re

import numpy as np
import pytest
from surface_pairs import VOXEL, motion, pair, perturbation, prepared, surfaces

from geomoe3d.clouds.pair import Pair
from geomoe3d.config import RefinementConfig
from geomoe3d.geometry.se3 import rotation_error_deg, transform_points, translation_error
from geomoe3d.refinement.base import NoRefiner
from geomoe3d.refinement.icp import CloudAligner
from geomoe3d.types import Correspondences, Hypothesis, PreparedCloud


def refine(T, source, target, config):
    """One transform polished."""
    return CloudAligner(source, target, config)(T)


METHODS = ["icp", "gicp"]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("seed", range(3))
def test_refinement_finds_the_motion_from_nearby(method: str, seed: int) -> None:
    source, target, T = pair(seed=seed)
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    centre = transform_points(T, source.points.mean(0)[None])[0]
    start = perturbation(np.radians(2) * axis / np.linalg.norm(axis), rng.normal(size=3) * 0.03, centre) @ T
    refined, note = refine(start, source, target, RefinementConfig(name=method))
    assert note is None
    assert rotation_error_deg(refined, T) < 0.2 < rotation_error_deg(start, T)
    assert translation_error(refined, T) < 0.02
    np.testing.assert_allclose(refined[:3, :3] @ refined[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(refined[:3, :3]) == pytest.approx(1)
    np.testing.assert_array_equal(refined[3], [0, 0, 0, 1])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_refinement_does_not_mind_the_unit(method: str, scale: float) -> None:
    T = motion(1)
    a, b = surfaces("corner", 0), transform_points(T, surfaces("corner", 1))
    start = perturbation(np.radians([1.0, -1, 1]), np.full(3, 0.02), b.mean(0)) @ T
    config = RefinementConfig(name=method)
    plain, _ = refine(start, prepared(a), prepared(b), config)
    scaled_start = start.copy()
    scaled_start[:3, 3] *= scale
    scaled, note = refine(
        scaled_start, prepared(a * scale, VOXEL * scale), prepared(b * scale, VOXEL * scale), config
    )
    assert note is None
    assert rotation_error_deg(plain, scaled) < 0.01
    np.testing.assert_allclose(scaled[:3, 3] / scale, plain[:3, 3], atol=1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_refinement_gives_the_same_bytes_twice_and_changes_no_input(method: str) -> None:
    source, target, T = pair()
    start, points = T.copy(), source.points.copy()
    config = RefinementConfig(name=method)
    a, b = (refine(start, source, target, config)[0] for _ in range(2))
    assert a.tobytes() == b.tobytes()
    np.testing.assert_array_equal(start, T)
    np.testing.assert_array_equal(source.points, points)


@pytest.mark.parametrize("method", METHODS)
def test_where_nothing_matches_the_start_is_given_with_a_reason(
    method: str, capfd: pytest.CaptureFixture[str]
) -> None:
    source, target, T = pair()
    start = perturbation(np.zeros(3), np.array([100.0, 0, 0]), np.zeros(3)) @ T
    found, note = refine(start, source, target, RefinementConfig(name=method))
    np.testing.assert_array_equal(found, start)
    assert re.search(r"found only 0 matching points \(it needs 10\)", note)
    assert capfd.readouterr().err == ""  # of an empty cloud the library warns on its own


def test_a_refinement_that_slides_away_is_thrown_away() -> None:
    """On a plane's edge with a huge reach the source is drawn far from where it was put."""
    source, target, T = pair()
    start = perturbation(np.radians([0.0, 0, 60]), np.zeros(3), np.zeros(3)) @ T
    found, note = refine(start, source, target, RefinementConfig(max_distance=50, max_iterations=200))
    np.testing.assert_array_equal(found, start)
    assert re.search(r"slid away by [\d.]+ deg and [\d.]+ voxels", note)


def test_no_refinement_gives_the_very_start() -> None:
    source, target, T = pair()
    hypothesis = Hypothesis(T)
    seen = Pair(Correspondences(np.zeros((0, 6))), source.voxel_size, 1.0, 0, source, target)
    assert NoRefiner().about(seen)(hypothesis) == (T, None)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("count", [3, 5, 12])
def test_tiny_clouds_do_not_bring_refinement_down(method: str, count: int) -> None:
    points = np.random.default_rng(count).uniform(0, 0.3, (count, 3))
    tiny = PreparedCloud(points, np.tile([0.0, 0, 1], (count, 1)), None, VOXEL, None, np.zeros(3))
    found, note = refine(np.eye(4), tiny, tiny, RefinementConfig(name=method))
    assert np.isfinite(found).all()
    assert note is not None or count >= 10
    np.testing.assert_allclose(found, np.eye(4), atol=1e-3)
