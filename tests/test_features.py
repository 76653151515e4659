"""Features of prepared points: of unit length, turned with nothing, zero for what has no neighbours."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from surface_pairs import corner

from geomoe3d.clouds.prepare import prepare
from geomoe3d.config import PreparationConfig
from geomoe3d.features.base import mirrored, with_features, with_normals_flipped
from geomoe3d.features.fpfh import FpfhDescriptor
from geomoe3d.features.multiscale import MultiscaleDescriptor
from geomoe3d.types import PointCloud

FPFH = FpfhDescriptor()
CONFIG = PreparationConfig(viewpoint="centroid")  # a guess costs time and is tested by itself


def test_features_are_unit_and_turn_with_nothing() -> None:
    points = corner(np.random.default_rng(11), noise=0.003)
    made = with_features(prepare(PointCloud(points), 0.1, CONFIG), FPFH)
    assert made.features.shape == (len(made), 33)
    assert made.features.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(made.features, axis=1), 1, atol=1e-4)
    R = Rotation.random(random_state=11).as_matrix()
    from dataclasses import replace

    moved = replace(made, points=made.points @ R.T + [1, 2, 3], normals=made.normals @ R.T)
    again = with_features(moved, FPFH)
    distance = np.linalg.norm(again.features - made.features, axis=1)
    assert np.median(distance) < 1e-3
    assert (distance < 0.1).mean() > 0.98


def test_a_point_without_neighbours_has_a_zero_feature() -> None:
    from dataclasses import replace

    made = prepare(PointCloud(corner(np.random.default_rng(12))), 0.1, CONFIG)
    lonely = replace(
        made,
        points=np.vstack([made.points, [[90.0, 0, 0]]]),
        normals=np.vstack([made.normals, [[0.0, 0, 1]]]),
    )
    features = with_features(lonely, FPFH).features
    assert np.isfinite(features).all()
    assert (features[-1] == 0).all()


def test_normals_turned_over_are_another_cloud_and_turned_back_the_same() -> None:
    config = PreparationConfig(viewpoint="origin")
    cloud = PointCloud(corner(np.random.default_rng(13), noise=0.003) + 1.0)
    made = with_features(prepare(cloud, 0.1, config, viewpoint=np.zeros(3)), FPFH)
    over = with_normals_flipped(made, FPFH)
    np.testing.assert_array_equal(over.normals, -made.normals)
    assert over.viewpoint is None
    changed = np.linalg.norm(over.features - made.features, axis=1)
    assert (changed > 0.1).mean() > 0.1  # plain walls look alike from both sides, edges do not
    back = with_normals_flipped(over, FPFH)
    np.testing.assert_array_equal(back.features, made.features)


def test_a_mirrored_cloud_has_the_features_that_it_would_get_anew() -> None:
    cloud = PointCloud(corner(np.random.default_rng(14), noise=0.01) + 1.0, origin=np.array([5.0, 6, 7]))
    made = with_features(prepare(cloud, 0.1, CONFIG, viewpoint=np.zeros(3)), FPFH)
    turned = mirrored(made, FPFH)
    np.testing.assert_array_equal(turned.points + turned.origin, (made.points + made.origin) * [-1, 1, 1])
    again = with_features(turned, FPFH).features
    # Angles that lie between two bins may fall into either.
    assert (np.abs(turned.features - again).max(1) < 1e-4).mean() > 0.98
    assert (np.abs(turned.features - made.features).max(1) > 0.01).mean() > 0.2
    np.testing.assert_array_equal(mirrored(turned, FPFH).features, made.features)
    wider = MultiscaleDescriptor()  # cannot tell, and describes the cloud once more
    assert mirrored(with_features(made, wider), wider).features.shape == (len(made), wider.dimension)
