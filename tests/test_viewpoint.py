"""Where the sensors stood: believed near the origin only, guessed from what can be seen."""

from __future__ import annotations

import numpy as np
import pytest
from corner_scenes import scene
from surface_pairs import corner

from geomoe3d.clouds.prepare import orient_normals, prepare
from geomoe3d.clouds.viewpoint import (
    believed_viewpoints,
    find_viewpoints,
    guess_viewpoint,
    sign_breaks,
)
from geomoe3d.config import PreparationConfig, expert, load_config
from geomoe3d.geometry.se3 import make_transform, rotation_error_deg, transform_points
from geomoe3d.registration import Registrar
from geomoe3d.types import PointCloud


def test_viewpoints_are_believed_near_the_origin_only_and_for_both_or_none() -> None:
    points = corner(np.random.default_rng(21), 500)
    near = PointCloud(points + 1.0, origin=np.array([0.0, 0, 0]))
    shifted = PointCloud(points + 1.0 - 2.0, origin=np.array([2.0, 2, 2]))  # the same cloud in another frame
    far = PointCloud(points, origin=np.array([583394.0, 5283100, 498]))
    for rule in ("auto", "origin"):
        a, b = find_viewpoints(near, shifted, rule)
        np.testing.assert_array_equal(a, [0, 0, 0])
        np.testing.assert_array_equal(b, [-2, -2, -2])  # the file's origin in local coordinates
    assert find_viewpoints(near, far, "auto") == (None, None)
    assert find_viewpoints(far, near, "auto") == (None, None)
    for rule in ("centroid", "guess"):
        assert find_viewpoints(near, near, rule) == (None, None)
    np.testing.assert_array_equal(find_viewpoints(near, far, "origin")[1], -far.origin)


@pytest.mark.parametrize(("distance", "believed"), [(0.0, True), (3.4, True), (3.5, False)])
def test_one_extent_is_the_limit(distance: float, believed: bool) -> None:
    """The extent of the unit faces is their diagonal, 2 sqrt(3) = 3.46."""
    corners = np.array([[x, y, z] for x in (0.0, 2) for y in (0, 2) for z in (0, 2)])
    for sign in (1, -1):
        cloud = PointCloud((corners + np.array([distance, -0.7, -0.6])) * sign)
        assert (find_viewpoints(cloud, cloud, "auto")[0] is not None) == believed


@pytest.mark.parametrize("shift", ["mean", "middle", "corner", "mean, then thinned"])
def test_no_sensor_is_believed_where_a_cloud_was_plainly_moved(shift: str) -> None:
    rng = np.random.default_rng(3)
    seen, _ = seen_from(np.array([0.5, 0.5, 1.6]), rng)
    points = seen - [0.5, 0.5, 1.6]
    low, high = points.min(0), points.max(0)
    moved = points - {"middle": (low + high) / 2, "corner": low}.get(shift, points.mean(0))
    if "thinned" in shift:
        moved = moved[np.unique(np.floor(moved / 0.05).astype(int), axis=0, return_index=True)[1]]
    good, bad, far = PointCloud(points), PointCloud(moved), PointCloud(moved - 2.0, origin=np.full(3, 2.0))
    assert find_viewpoints(good, good, "auto")[0] is not None
    for cloud in (bad, far):  # whatever was taken off at loading
        assert find_viewpoints(good, cloud, "auto") == (None, None)
        assert find_viewpoints(cloud, good, "auto") == (None, None)
    assert find_viewpoints(bad, bad, "origin")[0] is not None


def test_a_place_that_the_file_gives_is_believed_away_from_the_origin() -> None:
    points = corner(np.random.default_rng(21), 500)
    shift = np.array([583394.0, 5283100, 498])
    near, place = PointCloud(points + 1.0), np.array([1.0, 2.0, 1.5])
    far = PointCloud(points, origin=shift, sensor=shift + place)
    for pair, expected in (((far, far), (place, place)), ((near, far), (np.zeros(3), place))):
        np.testing.assert_array_equal(find_viewpoints(*pair, "auto"), expected)
    elsewhere = PointCloud(points, origin=shift, sensor=np.array([0.1, 0.0, 0.0]))  # of another frame
    assert find_viewpoints(far, elsewhere, "auto") == (None, None)
    at_origin = PointCloud(points + 1.0, sensor=place)
    np.testing.assert_array_equal(find_viewpoints(at_origin, at_origin, "auto"), np.zeros((2, 3)))
    for rule in ("guess", "centroid"):
        assert find_viewpoints(far, far, rule) == (None, None)


def test_bare_correspondences_have_their_sensors_at_the_origins_that_are_near() -> None:
    rows, _ = scene()
    zero = np.zeros(3)
    found = believed_viewpoints(rows, (zero, zero))
    assert found is not None
    np.testing.assert_array_equal(found, np.zeros((2, 3)))
    assert believed_viewpoints(rows, (zero, np.array([3e5, 0, 0]))) is None


def seen_from(viewpoint: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """What a sensor sees of a room with a box in it: points and exact normals turned to the sensor."""
    points, normals = [], []
    for low, high in (((0, 0, 0), (5, 4, 2.5)), ((2, 1, 0), (3, 2, 1.2))):
        low, high = np.array(low, float), np.array(high, float)
        for axis in range(3):
            for side in (low, high):
                count = round(60 * np.prod(np.delete(high - low, axis)))  # even over all surfaces
                face = rng.uniform(low, high, (count, 3))
                face[:, axis] = side[axis]
                points.append(face)
                normals.append(np.tile(np.eye(3)[axis], (count, 1)))
    points, normals = np.vstack(points), np.vstack(normals)
    rays = points - viewpoint
    with np.errstate(divide="ignore"):
        entry, leave = (np.array([c]) - viewpoint for c in ([2.0, 1, 0], [3.0, 2, 1.2]))
        a, b = entry / rays, leave / rays
    first, last = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
    hidden = (first < last) & (first < 1 - 1e-6) & (last > 0)
    forward = rays @ np.array([1.0, 0.6, -0.3]) > 0.5 * np.linalg.norm(rays, axis=1)  # a field of view
    seen = ~hidden & forward
    return points[seen], orient_normals(points, normals, viewpoint)[seen]


@pytest.mark.parametrize("seed", range(3))
def test_a_guessed_viewpoint_turns_nearly_all_normals_right(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, normals = seen_from(np.array([0.5, 0.5, 1.6]), rng)
    signs = rng.choice([-1.0, 1.0], (len(normals), 1))
    place = guess_viewpoint(points, normals * signs, 0.2)
    turned = orient_normals(points, normals * signs, place)
    assert (np.einsum("ij,ij->i", turned, normals) > 0).mean() > 0.9


def test_a_guess_is_seeded_and_follows_the_cloud() -> None:
    points, normals = seen_from(np.array([0.5, 0.5, 1.6]), np.random.default_rng(9))
    place = guess_viewpoint(points, normals, 0.25)
    np.testing.assert_array_equal(guess_viewpoint(points, normals, 0.25), place)
    np.testing.assert_array_equal(guess_viewpoint(points, -normals, 0.25), place)
    np.testing.assert_array_equal(guess_viewpoint(points * 1024, normals, 256), place * 1024)
    assert (guess_viewpoint(points, normals, 0.25, seed=1) != place).any()


def test_a_guess_for_points_on_a_line_or_in_a_plane_is_finite() -> None:
    rng = np.random.default_rng(10)
    for directions in (1, 2):
        points = rng.normal(size=(50, directions)) @ np.eye(3)[:directions]
        assert np.isfinite(guess_viewpoint(points, np.tile([0.0, 0, 1], (50, 1)), 0.1)).all()


def bumpy_body(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and outward normals of nine balls that overlap, about 2 m across."""
    rng = np.random.default_rng(seed)
    centers, radii = rng.uniform(-1, 1, (9, 3)) * [1, 0.7, 0.5], rng.uniform(0.25, 0.5, 9)
    ball = rng.integers(0, 9, count)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    points = centers[ball] + radii[ball, None] * normals
    away = np.linalg.norm(points[:, None] - centers, axis=2) - radii
    away[np.arange(count), ball] = 0
    return points[(away > -1e-9).all(1)], normals[(away > -1e-9).all(1)]


def test_normals_contradict_a_sensor_that_saw_around_a_body_but_not_the_one_that_was_there() -> None:
    points, normals = bumpy_body(1, 40_000)
    sensor = np.array([3.0, 1.0, 2.0])
    front = points[np.einsum("ij,ij->i", sensor - points, normals) > 0]
    config, elsewhere = PreparationConfig(), np.array([0.0, -0.5, -1.0])
    seen = prepare(PointCloud(front), 0.06, config, viewpoint=sensor)
    assert sign_breaks(seen) < 0.2 * expert().viewpoint.most_sign_breaks
    for cloud in (front, points):
        doubted = prepare(PointCloud(cloud), 0.06, config, viewpoint=elsewhere)
        assert sign_breaks(doubted) > expert().viewpoint.most_sign_breaks


@pytest.mark.parametrize("seed", [1, 2])
def test_a_scan_of_an_object_whose_origin_is_no_sensor_is_found_on_the_whole_object(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, normals = bumpy_body(seed, 60_000)
    shift, turn = np.array([0, 0.5, 1]), np.linalg.qr(rng.normal(size=(3, 3)))[0]
    front = points[np.einsum("ij,ij->i", np.array([3.0, 1, 2]) - points, normals) > 0] + shift
    T = make_transform(turn * np.linalg.det(turn), np.zeros(3))
    T[:3, 3] = [0.6, -1.0, 0.3] - transform_points(T, points + shift).mean(0)
    whole = transform_points(T, points[::2] + shift)
    source, target = (p + rng.normal(0, 0.003, p.shape) for p in (front, whole))
    result = Registrar().register(source, target)
    assert result.ok, result.reasons
    assert rotation_error_deg(result.T_target_source, T) < 1
    moved = transform_points(result.T_target_source, front) - transform_points(T, front)
    assert np.linalg.norm(moved, axis=1).max() < 0.03
    once = ["preparation.viewpoint=origin", "second_look.repeat_below=0"]
    believing = Registrar(load_config(None, once)).register(source, target)
    assert not believing.ok  # what the sides of the normals do to it
