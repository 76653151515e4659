"""The scene: thinned evenly, near zero in single precision, with distances that brute force confirms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from registration_views import UTM, room_view

from geomoe3d.geometry.se3 import make_transform, transform_points
from geomoe3d.types import Alternative
from geomoe3d.visual.drawing import build_drawing, distance_to_target, nice_length, thin


def test_thinning_is_even_seeded_bounded_and_finite():
    rng = np.random.default_rng(0)
    sheet = np.column_stack([rng.random((100_000, 2)) * [0.5, 1.0], np.zeros(100_000)])
    far = np.column_stack([rng.random((5_000, 2)) * [0.5, 1.0] + [0.5, 0], np.zeros(5_000)])
    points = np.concatenate([sheet, far])
    points[::1000] = np.nan
    points[5] = 1e9
    rows = thin(points, 3000, np.random.default_rng(1))
    np.testing.assert_array_equal(rows, thin(points, 3000, np.random.default_rng(1)))
    assert 2400 < len(rows) <= 3000
    assert len(np.unique(rows)) == len(rows)
    assert np.isfinite(points[rows]).all()
    # 5 % of the points cover half of the surface: an even choice gives them far more than their share.
    assert np.mean(rows >= 100_000) > 0.25
    assert len(thin(points, 200_000, np.random.default_rng(1))) == len(points) - 105
    assert len(thin(np.ones((500, 3)), 100, np.random.default_rng(1))) == 1


@pytest.mark.parametrize("origin", [np.zeros(3), UTM])
def test_scene_motions_survive_single_precision(origin):
    view = room_view(origin)
    alternative = Alternative(
        view.result.T_target_source @ make_transform(np.diag([-1.0, -1, 1]), np.zeros(3)), 0.9, 180.0, 1.0
    )
    view = replace(view, result=replace(view.result, alternative=alternative))
    scene = build_drawing(view, max_points=2000)
    source = view.source_points[scene.source_rows]
    for motion, T in (
        (scene.after, view.result.T_target_source),
        (scene.alternative, alternative.T_target_source),
    ):
        expected = transform_points(T, source) - scene.target_center
        assert np.abs(expected).max() < 30
        drawn = scene.source.astype(np.float32) @ motion[:3, :3].astype(np.float32).T
        np.testing.assert_allclose(drawn + motion[:3, 3].astype(np.float32), expected, atol=1e-5)
    if origin.any():
        true = np.linalg.norm(scene.source_center - scene.target_center)
        assert scene.apart == pytest.approx(true)
        before = transform_points(scene.before, scene.source)
        assert before.max(axis=0)[0] < scene.target.min(axis=0)[0] + 0.5  # side by side, not on top
        assert np.linalg.norm(before, axis=1).max() < 30
    else:
        assert scene.apart is None
        before = transform_points(scene.before, scene.source) + scene.target_center
        np.testing.assert_allclose(before, source, atol=1e-12)


def test_distance_to_target_against_brute_force():
    view = room_view(UTM, num=1000)
    scene = build_drawing(view, max_points=1000)
    found = distance_to_target(view, scene, scene.after, 0.3)
    moved = view.result.apply(view.source_points[scene.source_rows])
    brute = np.linalg.norm(moved[:, None] - view.target_points[None], axis=2).min(axis=1)
    near = brute < 0.3 - 1e-6
    np.testing.assert_allclose(found[near], brute[near], atol=1e-6)
    assert np.isinf(found[brute > 0.3 + 1e-6]).all()
    assert 0.1 < near.mean() < 1.0


@pytest.mark.parametrize(
    ("length", "nice"), [(1.0, 1.0), (1.99, 1.0), (2.0, 2.0), (49.0, 20.0), (0.07, 0.05)]
)
def test_nice_length(length, nice):
    assert nice_length(length) == pytest.approx(nice)
