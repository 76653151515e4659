"""The information of a fit: derivatives, symmetries, what nothing holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from surface_pairs import VOXEL, motion, pair, perturbation, prepared, surfaces

from geomoe3d.decision.information import measure_information
from geomoe3d.geometry.se3 import transform_points


@pytest.mark.parametrize(
    ("kind", "free"), [("plane", 3), ("channel", 1), ("cylinder", 2), ("sphere", 3), ("corner", 0)]
)
def test_surfaces_that_slide_have_as_many_zero_eigenvalues(kind: str, free: int) -> None:
    cloud = prepared(surfaces(kind))
    centre = {"cylinder": np.zeros(3), "sphere": np.zeros(3)}.get(kind)
    if centre is not None:  # the fitted normals of a curved patch are not quite exact
        normals = cloud.points * ([1, 1, 0] if kind == "cylinder" else [1, 1, 1])
        cloud = replace(cloud, normals=normals / np.linalg.norm(normals, axis=1, keepdims=True))
    inner = (cloud.points > 0.4).sum(1) >= {"corner": 2, "channel": 2}.get(kind, 0)  # clear of the edges
    cloud = replace(cloud, points=cloud.points[inner], normals=cloud.normals[inner])
    information = measure_information(np.eye(4), cloud, cloud, VOXEL)
    values = np.linalg.eigvalsh(information.matrix)
    assert (values < 1e-6 * values[-1]).sum() == free
    assert (information.observability > 0.01) == (free == 0)
    assert information.num_matched == len(cloud)
    np.testing.assert_allclose(information.center, cloud.points.mean(0), atol=1e-12)


def test_the_matrix_is_the_curvature_of_the_point_to_plane_cost() -> None:
    """Finite differences of the gaps, matches held fixed, give the same matrix and predict the cost."""
    source, target, T = pair(seed=2)
    information = measure_information(T, source, target, VOXEL)
    moved = transform_points(T, source.points)
    distance, nearest = cKDTree(target.points).query(moved)
    hit = distance < VOXEL
    points, planes, normals = moved[hit], target.points[nearest[hit]], target.normals[nearest[hit]]
    gaps = ((points - planes) * normals).sum(1)
    variance = max((gaps**2).mean(), (0.1 * VOXEL) ** 2)

    def jacobian_column(k: int, h: float = 1e-6) -> np.ndarray:
        values = []
        for step in (h, -h):
            xi = step * np.eye(6)[k]
            P = perturbation(xi[:3], xi[3:], information.center)
            values.append(((transform_points(P, points) - planes) * normals).sum(1))
        return (values[0] - values[1]) / (2 * h)

    J = np.column_stack([jacobian_column(k) for k in range(6)])
    np.testing.assert_allclose(information.matrix, J.T @ J / variance, rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(information.matrix, information.matrix.T, rtol=1e-12)
    # And it predicts how the cost grows, to first and second order, for perturbations in any direction.
    rng = np.random.default_rng(0)
    for _ in range(5):
        xi = rng.normal(size=6) * 1e-4
        P = perturbation(xi[:3], xi[3:], information.center)
        cost = (((transform_points(P, points) - planes) * normals).sum(1) ** 2).sum() / variance
        growth = cost - (gaps @ gaps + 2 * gaps @ J @ xi) / variance
        assert growth == pytest.approx(xi @ information.matrix @ xi, rel=0.02)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_information_follows_the_unit_and_observability_does_not(scale: float) -> None:
    T = motion(3)
    a, b = surfaces("corner", 0), transform_points(T, surfaces("corner", 1))
    T_scaled = T.copy()
    T_scaled[:3, 3] *= scale
    plain = measure_information(T, prepared(a), prepared(b), VOXEL)
    scaled = measure_information(
        T_scaled, prepared(a * scale, VOXEL * scale), prepared(b * scale, VOXEL * scale), VOXEL * scale
    )
    assert scaled.observability == pytest.approx(plain.observability, rel=0.02)
    assert scaled.looseness == pytest.approx(plain.looseness, rel=0.05)
    units = np.array([scale] * 3 + [1.0] * 3)  # a radian moves a point by its radius
    np.testing.assert_allclose(
        scaled.matrix / np.outer(units, units) * scale**2,
        plain.matrix,
        rtol=0.02,
        atol=0.02 * plain.matrix[0, 0],
    )


def test_observability_ignores_where_the_pair_lies_and_how_it_is_turned() -> None:
    source, target, T = pair(seed=4)
    A = motion(9)
    A[:3, 3] *= 100
    moved = replace(target, points=transform_points(A, target.points), normals=target.normals @ A[:3, :3].T)
    a, b = (
        measure_information(T, source, target, VOXEL),
        measure_information(A @ T, source, moved, VOXEL),
    )
    assert a.observability == pytest.approx(b.observability, rel=1e-6)
    assert a.looseness == pytest.approx(b.looseness, rel=1e-6)
    np.testing.assert_allclose(b.center, transform_points(A, a.center[None])[0], atol=1e-9)
    turn = np.kron(np.eye(2), A[:3, :3])
    np.testing.assert_allclose(b.matrix, turn @ a.matrix @ turn.T, rtol=1e-6, atol=1e-3 * abs(a.matrix).max())


def test_a_sensor_at_the_end_of_a_lever_is_held_loosely() -> None:
    """Far from what is shared a small turn moves it far; of no known place, far points stand for it."""
    source, target, T = pair(seed=5)
    centre = source.points.mean(0)
    at = [replace(source, viewpoint=centre + np.array([x, 0, 0])) for x in (0.0, 3.0, 30.0)]
    near, far, further = (measure_information(T, one, target, VOXEL).looseness for one in at)
    assert near < far < further
    assert further / far == pytest.approx(10, rel=0.2)  # the turn's part grows with the lever
    of_all = [
        measure_information(T, replace(source, viewpoint=place), target, VOXEL).looseness
        for place in source.points[::20]
    ]
    unknown = measure_information(T, source, target, VOXEL).looseness
    assert unknown == pytest.approx(np.quantile(of_all, 0.95), rel=0.05)


@pytest.mark.parametrize("kind", ["plane", "channel", "corner"])
def test_looseness_does_not_depend_on_the_unit_even_where_the_surface_slides(kind: str) -> None:
    T = motion(3)
    a, b = surfaces(kind, 0), transform_points(T, surfaces(kind, 1))
    found = []
    for scale in (1.0, 1e4):
        moved = T.copy()
        moved[:3, 3] *= scale
        source, target = (prepared(points * scale, VOXEL * scale) for points in (a, b))
        found.append(measure_information(moved, source, target, VOXEL * scale).looseness)
    assert found[1] == pytest.approx(found[0], rel=0.05)


def test_surfaces_without_normals_hold_nothing() -> None:
    source, target, T = pair()
    blank = replace(target, normals=np.zeros_like(target.normals))
    assert measure_information(T, source, blank, VOXEL).looseness == 1000


def test_too_few_matches_hold_no_information() -> None:
    source, target, T = pair()
    far = perturbation(np.zeros(3), np.array([50.0, 0, 0]), np.zeros(3)) @ T
    information = measure_information(far, source, target, VOXEL)
    assert information.num_matched == 0
    assert information.observability == 0
    assert information.looseness == 1000
    assert np.isnan(information.matrix).all()
    assert np.isnan(information.center).all()


def test_information_says_whether_the_sensors_are_known() -> None:
    source, target, T = pair(seed=5)
    place = np.zeros(3)
    for one, other, known in ((None, None, False), (place, None, False), (place, place, True)):
        two = replace(source, viewpoint=one), replace(target, viewpoint=other)
        assert measure_information(T, *two, VOXEL).sensors_known == known
