"""Rigid motions: group laws, angles near 0 and 180 degrees, nearest rotations, frames of files."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from geomoe3d.errors import InputError
from geomoe3d.geometry.se3 import (
    check_motion,
    inverse,
    is_motion,
    is_rotation,
    make_transform,
    project_to_so3,
    rotation_angle_deg,
    rotation_error_deg,
    shift_frames,
    transform_points,
    translation_error,
)

SEEDS = st.integers(0, 2**32 - 1)


def random_motion(rng: np.random.Generator, reach: float = 5.0) -> np.ndarray:
    R = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    return make_transform(R, rng.normal(size=3) * reach)


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_composing_matrices_is_moving_one_after_the_other(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, S, points = random_motion(rng), random_motion(rng), rng.normal(size=(7, 3))
    np.testing.assert_allclose(
        transform_points(T @ S, points), transform_points(T, transform_points(S, points)), atol=1e-12
    )
    np.testing.assert_allclose(transform_points(inverse(T), transform_points(T, points)), points, atol=1e-12)
    np.testing.assert_allclose(inverse(T) @ T, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(inverse(T @ S), inverse(S) @ inverse(T), atol=1e-12)
    np.testing.assert_allclose(inverse(T), np.linalg.inv(T), atol=1e-11)


def test_points_follow_the_equation() -> None:
    T = make_transform(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([10.0, 20, 30]))
    np.testing.assert_array_equal(transform_points(T, np.array([[1.0, 2, 3]])), [[8, 21, 33]])
    assert transform_points(T, np.zeros((0, 3))).shape == (0, 3)


def test_make_transform_takes_any_leading_dimensions() -> None:
    rng = np.random.default_rng(0)
    R = Rotation.random(6, random_state=0).as_matrix().reshape(2, 3, 3, 3)
    t = rng.normal(size=(2, 3, 3))
    T = make_transform(R, t)
    assert T.shape == (2, 3, 4, 4)
    assert T.dtype == np.float64
    for i in np.ndindex(2, 3):
        np.testing.assert_array_equal(T[i], make_transform(R[i], t[i]))
        np.testing.assert_array_equal(T[i][3], [0, 0, 0, 1])


@pytest.mark.parametrize(
    "angle", [0.0, 1e-9, 1e-6, 1e-3, 1.0, 45.0, 90.0, 135.0, 179.0, 179.999, 180 - 1e-6, 180.0]
)
def test_angle_is_right_from_0_to_180(angle: float) -> None:
    for axis in np.random.default_rng(0).normal(size=(5, 3)):
        R = Rotation.from_rotvec(np.radians(angle) * axis / np.linalg.norm(axis)).as_matrix()
        measured = rotation_angle_deg(R)
        assert measured == pytest.approx(angle, rel=1e-6, abs=1e-12 if angle < 1e-3 else 1e-8)
        assert 0 <= measured <= 180


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_rotation_error_is_a_distance_that_ignores_the_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, B, C, M = (random_motion(rng) for _ in range(4))
    error = rotation_error_deg(A, B)
    scipy_error = (Rotation.from_matrix(A[:3, :3]).inv() * Rotation.from_matrix(B[:3, :3])).magnitude()
    assert error == pytest.approx(np.degrees(scipy_error), abs=1e-7)
    assert error == pytest.approx(rotation_error_deg(B, A), abs=1e-7)
    assert error == pytest.approx(rotation_error_deg(M @ A, M @ B), abs=1e-7)
    assert error == pytest.approx(rotation_error_deg(A @ M, B @ M), abs=1e-7)
    assert error <= rotation_error_deg(A, C) + rotation_error_deg(C, B) + 1e-7
    assert rotation_error_deg(A, A) == pytest.approx(0, abs=1e-7)
    assert translation_error(A, B) == pytest.approx(np.sqrt(((A - B)[:3, 3] ** 2).sum()))


@pytest.mark.parametrize("kind", ["noisy", "mirrored", "scaled", "rank 2", "rank 1"])
def test_projection_is_the_nearest_rotation(kind: str) -> None:
    """No rotation of a fine sample around it, nor any random one, is nearer in the Frobenius norm."""
    rng = np.random.default_rng(3)
    R = Rotation.random(random_state=4).as_matrix()
    M = {
        "noisy": R + 0.1 * rng.normal(size=(3, 3)),
        "mirrored": R @ np.diag([1.0, 0.9, -0.8]),
        "scaled": 7 * R,
        "rank 2": R @ np.diag([1.0, 0.5, 0.0]),
        "rank 1": R @ np.diag([1.0, 0.0, 0.0]),
    }[kind]
    nearest = project_to_so3(M)
    np.testing.assert_allclose(nearest @ nearest.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(nearest) == pytest.approx(1, abs=1e-12)
    distance = np.linalg.norm(nearest - M)
    others = Rotation.random(3000, random_state=5).as_matrix()
    close = nearest @ Rotation.from_rotvec(rng.normal(size=(3000, 3)) * 0.01).as_matrix()
    assert distance <= np.linalg.norm(np.concatenate([others, close]) - M, axis=(1, 2)).min() + 1e-12
    if kind in ("noisy", "scaled"):
        np.testing.assert_allclose(nearest, polar(M)[0], atol=1e-12)


def test_projection_leaves_a_rotation_alone() -> None:
    for R in Rotation.random(20, random_state=6).as_matrix():
        np.testing.assert_allclose(project_to_so3(R), R, atol=1e-14)


def test_rotations_and_motions_are_told_within_a_tolerance() -> None:
    rng = np.random.default_rng(8)
    T = random_motion(rng)
    R = T[:3, :3]
    assert is_rotation(R, 1e-12)
    assert not is_rotation(R @ np.diag([1.0, 1.0, -1.0]), 0.01)
    assert not is_rotation(np.zeros((3, 3)), 0.01)
    stretched = R @ np.diag([1.005, 1.0, 1.0])  # R^T R is 0.010025 off
    assert is_rotation(stretched, 0.0101)
    assert not is_rotation(stretched, 0.01)
    assert is_motion(T, 1e-12)
    for broken in (
        T[:3],
        np.full((4, 4), np.nan),
        T * [[1.0], [1.0], [1.0], [1.00001]],
        make_transform(2 * R, R[0]),
    ):
        assert not is_motion(broken, 0.01)


@pytest.mark.parametrize(
    ("linear", "said"),
    [
        (2.0 * np.eye(3), "it holds a scale of 2; divide"),
        (-0.001 * np.eye(3), "it holds a scale of 0.001; it also mirrors; divide"),
        (np.diag([1.0, 1.0, -1.0]), "it mirrors"),
        (np.diag([1.0, 1.0, 1.2]), "lengths are 1, 1, 1.2, and lengths and angles are off by up to 0.44"),
        (np.zeros((3, 3)), "lengths are 0, 0, 0"),
    ],
)
def test_what_is_no_rigid_transform_says_why_and_what_to_do(linear: np.ndarray, said: str) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        check_motion(make_transform(linear, np.ones(3)))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (np.eye(3), "found 3 rows of 3 numbers"),
        (np.full((4, 4), np.nan), "found NaN"),
        ("no", "no table of numbers"),
    ],
)
def test_what_is_no_matrix_is_told_in_plain_words(given: object, said: str) -> None:
    with pytest.raises(InputError, match=f"4 rows of 4 finite numbers, .*{said}"):
        check_motion(given)


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_shifting_frames_moves_the_same_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = random_motion(rng)
    source_origin, target_origin = rng.normal(size=(2, 3)) * 100
    points = rng.normal(size=(5, 3))
    before = T.copy()
    in_files = shift_frames(T, source_origin, target_origin)
    np.testing.assert_allclose(
        transform_points(in_files, points + source_origin),
        transform_points(T, points) + target_origin,
        atol=1e-11,
    )
    np.testing.assert_array_equal(T, before)
    np.testing.assert_allclose(shift_frames(in_files, -source_origin, -target_origin), T, atol=1e-11)


def test_shifting_frames_keeps_millimetres_at_utm_coordinates() -> None:
    rng = np.random.default_rng(7)
    T, origin = random_motion(rng), np.array([583394.0, 5283100.0, 498.0])
    points = rng.normal(size=(5, 3))
    moved = transform_points(shift_frames(T, origin, origin), points + origin)
    assert np.abs(moved - origin - transform_points(T, points)).max() < 1e-8
