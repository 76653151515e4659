"""Edges between scans: how far two poses are apart, and how loosely an edge holds the sensor."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomoe3d.decision.information import deviations_at
from geomoe3d.geometry.se3 import make_transform, transform_points
from geomoe3d.multiway.edges import Edge, Shape, agrees, displacement, expected_error


def test_looseness_is_the_deviation_of_the_sensor():
    rng = np.random.default_rng(4)
    points, normals = rng.normal((0, 0, 2), 1, (300, 3)), rng.normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    J = np.hstack([np.cross(points, normals), normals])
    sensor = np.array([0.3, -0.2, 0.1])
    moved = []
    for _ in range(4000):  # noise of every gap, the motion that fits it best, and where that puts the sensor
        w, v = np.split(np.linalg.lstsq(J, 0.01 * rng.normal(size=300), rcond=None)[0], 2)
        moved.append(np.cross(w, sensor) + v)
    expected = np.sqrt((np.array(moved) ** 2).sum(1).mean())
    assert deviations_at(J.T @ J / 0.01**2, np.zeros(3), sensor[None])[0] == pytest.approx(expected, rel=0.03)
    center = np.array([0.5, 0.2, 2.0])  # the same information about another point
    J = np.hstack([np.cross(points - center, normals), normals])
    assert deviations_at(J.T @ J / 0.01**2, center, sensor[None])[0] == pytest.approx(expected, rel=0.03)
    shape = Shape.of(points, np.zeros(3), sensor)
    T = make_transform(Rotation.from_rotvec([0.1, 0, 0]).as_matrix(), np.array([0.2, 0, 0]))
    one = Edge(1, 0, T, 0.9, np.eye(6), looseness=0.02)
    apart = np.linalg.norm((T - np.eye(4)) @ np.append(sensor, 1))
    poses = {0: np.eye(4), 1: np.eye(4)}
    assert expected_error(one, poses, shape, 20.0) == pytest.approx(np.hypot(apart, 0.4))


def test_displacement_is_the_root_mean_square_of_the_points():
    rng = np.random.default_rng(3)
    points = rng.normal(size=(400, 3)) * [2, 1, 0.3] + [5, 0, -1]
    shape = Shape.of(points, np.zeros(3))
    A, B = (make_transform(Rotation.random(random_state=k).as_matrix(), rng.normal(size=3)) for k in (1, 2))
    away = transform_points(A, points) - transform_points(B, points)
    assert displacement(A, B, shape) == pytest.approx(np.sqrt((away**2).sum(1).mean()), rel=1e-12)
    assert agrees(A, A, shape, 1e-6, 1e-3)
    turned = A @ make_transform(Rotation.from_rotvec([0, 0, 0.2]).as_matrix(), np.zeros(3))
    assert not agrees(A, turned, shape, 100.0, 10.0)
