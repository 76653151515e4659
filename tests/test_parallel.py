"""An answer made parallel: walls and floors decide what a small, bent overlap leaves open, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from surface_pairs import motion, pair, perturbation, prepared, surfaces

from geomoe3d.decision.parallel import Parallel, made_parallel, with_right_angles
from geomoe3d.decision.shared_surface import SharedSurface, main_directions
from geomoe3d.geometry.se3 import rotation_error_deg, transform_points

VOXEL = 0.1


def test_directions_of_a_corner_are_its_normals() -> None:
    found = main_directions(prepared(surfaces("corner") @ motion(3)[:3, :3].T))
    cosines = np.abs(found @ motion(3)[:3, :3])
    assert found.shape == (3, 3)
    np.testing.assert_allclose(np.sort(cosines.max(1)), 1, atol=2e-3)
    assert len(set(cosines.argmax(1))) == 3


def test_a_ball_has_no_direction() -> None:
    assert len(main_directions(prepared(surfaces("sphere")))) == 0


def test_a_third_direction_joins_two_at_right_angles_only() -> None:
    x, y, askew = np.eye(3)[0], np.eye(3)[1], np.array([0.8, 0.6, 0])
    np.testing.assert_allclose(np.abs(with_right_angles(np.array([x, y]))), np.eye(3), atol=1e-12)
    assert len(with_right_angles(np.array([x, askew]))) == 2
    assert with_right_angles(np.zeros((0, 3))).shape == (0, 3)


def two_views() -> tuple[np.ndarray, np.ndarray]:
    """A floor and a wall of a room 9 m long: its first 5 m and, in the same coordinates, its last 5 m. They share a
    metre, which is bent in both."""
    rng = np.random.default_rng(0)
    count = 60_000
    points = rng.uniform([0, 0, 0], [9, 3, 3], (count, 3))
    points[: count // 2, 2] = 0
    points[count // 2 :, 1] = 0
    views = []
    for low, high, bend in ((0, 5, 0.05), (4, 9, -0.05)):
        view = points[(low <= points[:, 0]) & (points[:, 0] <= high)].copy()
        shared = np.clip(1 - np.abs(view[:, 0] - 4.5) / 0.5, 0, 1)
        view[:, 2] += bend * shared * np.sin(2 * view[:, 1]) * (view[:, 2] == 0)
        view[:, 1] += bend * shared * np.sin(2 * view[:, 2]) * (view[:, 1] == 0)
        views.append(view + 0.005 * rng.normal(size=view.shape))
    return views[0], views[1]


def test_a_loose_answer_is_made_parallel() -> None:
    source, target = two_views()
    T = motion(5)
    clouds = prepared(source), prepared(transform_points(T, target))
    truth = T.copy()
    truth[:3, 3] += T[:3, :3] @ clouds[0].origin - clouds[1].origin
    middle = transform_points(T, np.array([[4.5, 1.5, 0.0]]))[0] - clouds[1].origin
    for turn in np.radians(6) * np.eye(3):
        start = perturbation(T[:3, :3] @ turn, np.zeros(3), middle) @ truth
        found = made_parallel(start, SharedSurface(*clouds), 2 * VOXEL)
        assert rotation_error_deg(start, truth) == pytest.approx(6, abs=1e-6)
        assert rotation_error_deg(found, truth) < 2.5


def test_transforms_that_become_one_are_not_different() -> None:
    source, target = two_views()
    clouds = prepared(source), prepared(target)
    truth = np.eye(4)
    truth[:3, 3] = clouds[0].origin - clouds[1].origin
    middle = np.array([4.5, 1.5, 0.0]) - clouds[1].origin
    one, other = (perturbation(np.radians([0, turn, 0]), np.zeros(3), middle) @ truth for turn in (-7.8, 7.8))
    shared = SharedSurface(*clouds)
    parallel = Parallel(shared, 2 * VOXEL)
    assert rotation_error_deg(one, other) > 15 and not parallel.differ(one, other)
    assert rotation_error_deg(parallel(one), parallel(other)) < 5
    assert Parallel(shared, 2 * VOXEL, wanted=False).differ(one, other)
    far = perturbation(np.radians([0, 0, 90]), np.zeros(3), middle) @ truth
    assert parallel.differ(one, far) and not parallel.differ(one, one)


def test_a_firm_answer_stays_whatever_is_askew() -> None:
    source, target, T = pair()
    shift = T.copy()
    shift[:3, 3] += T[:3, :3] @ source.origin - target.origin
    assert rotation_error_deg(made_parallel(shift, SharedSurface(source, target), 2 * VOXEL), shift) < 0.01
    source, target, T = pair("cylinder")  # its sides face everywhere, and none of them is a wall
    T[:3, 3] += T[:3, :3] @ source.origin - target.origin
    assert rotation_error_deg(made_parallel(T, SharedSurface(source, target), 2 * VOXEL), T) < 0.1
    source, target, T = pair()
    # A second floor, askew by ten degrees, that the source alone saw.
    askew = transform_points(
        perturbation(np.radians([10, 0, 0]), np.array([0, 0, -4.0]), np.zeros(3)), surfaces("plane")
    )
    more = prepared(np.vstack([surfaces("corner"), askew]))
    start = T.copy()
    start[:3, 3] += T[:3, :3] @ more.origin - target.origin
    assert rotation_error_deg(made_parallel(start, SharedSurface(more, target), 2 * VOXEL), start) < 0.05


def test_without_directions_or_without_contact_it_stays() -> None:
    ball, corner = prepared(surfaces("sphere")), prepared(surfaces("corner"))
    far = perturbation(np.zeros(3), np.array([100.0, 0, 0]), np.zeros(3))
    for T, clouds in ((np.eye(4), (ball, ball)), (far, (corner, corner))):
        np.testing.assert_array_equal(made_parallel(T, SharedSurface(*clouds), 2 * VOXEL), T)
