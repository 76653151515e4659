"""From raw points to voxel points with normals: means, counts, what is dropped, scale, the voxel size."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from surface_pairs import corner

from geomoe3d.clouds.prepare import check_cloud, estimate_normals, orient_normals, prepare
from geomoe3d.clouds.voxel_grid import drop_duplicates, drop_isolated, sorted_rows, voxel_keys, voxel_means
from geomoe3d.clouds.voxel_size import (
    _size_for_count,
    bounded_voxel_size,
    choose_voxel_size,
    own_voxel_sizes,
    scale_mismatch,
    typical_spacing,
)
from geomoe3d.config import PreparationConfig
from geomoe3d.errors import EmptyCloudError, InputError
from geomoe3d.features.base import with_features
from geomoe3d.features.fpfh import FpfhDescriptor
from geomoe3d.geometry.draws import OFF_ROUND
from geomoe3d.types import PointCloud

CONFIG = PreparationConfig(viewpoint="centroid")  # a guess costs time and is tested by itself
SEEDS = st.integers(0, 2**32 - 1)


# ---- the voxel grid ---------------------------------------------------------------------------------


@given(SEEDS, st.floats(0.05, 3), st.floats(-50, 50))
@settings(max_examples=40, deadline=None)
def test_voxel_means_equal_a_slow_dictionary(seed: int, voxel_size: float, offset: float) -> None:
    points = np.random.default_rng(seed).normal(size=(200, 3)) + offset
    cells = defaultdict(list)
    for point in points:
        places = [x / voxel_size - OFF_ROUND for x in point]
        to_wall = min(min(x - np.floor(x), np.ceil(x) - x) for x in places)
        cells[tuple(int(np.floor(x)) for x in places)].append((point, min(max(to_wall / 0.05, 1e-3), 1)))
    held = {key: sum(w for _, w in cells[key]) for key in sorted(cells)}
    means = {key: sum(p * w for p, w in cells[key]) / held[key] for key in held}
    full = np.array([means[key] for key in held if held[key] >= 0.01])
    expected = [
        mean
        for key, mean in means.items()
        if held[key] >= 0.01 or np.linalg.norm(full - mean, axis=1).min() >= voxel_size
    ]
    np.testing.assert_allclose(voxel_means(points, voxel_size), expected, atol=1e-9)


@given(SEEDS)
@settings(max_examples=20, deadline=None)
def test_what_moves_to_another_voxel_hardly_moves_a_mean(seed: int) -> None:
    """Half of the points lie within a millionth of a wall; moved across it they change nothing that matters."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 5, (4000, 3)) + OFF_ROUND
    points[::2, 0] = rng.integers(1, 5, 2000) + OFF_ROUND
    one, other = (voxel_means(points + 1e-6 * rng.normal(size=points.shape), 1.0) for _ in range(2))
    away, _ = cKDTree(other).query(one)
    assert len(one) == len(other)
    assert away.max() < 0.005


def test_points_on_the_walls_of_all_voxels_are_kept() -> None:
    """A cloud that was rounded to the grid itself: nothing holds it but walls."""
    corners = np.stack(np.meshgrid(*3 * [np.arange(4.0)]), -1).reshape(-1, 3) + OFF_ROUND
    assert len(voxel_means(corners, 1.0)) == len(np.unique(voxel_keys(corners, 1.0, OFF_ROUND))) > 20


def test_voxel_means_do_not_mind_the_order_of_points() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3))
    shuffled = points[rng.permutation(500)]
    np.testing.assert_allclose(voxel_means(points, 0.3), voxel_means(shuffled, 0.3), atol=1e-14)


def test_keys_are_equal_exactly_within_a_voxel() -> None:
    points = np.random.default_rng(1).uniform(-5, 5, (300, 3))
    keys, cells = voxel_keys(points, 0.7), np.floor(points / 0.7)
    same = (cells[:, None] == cells[None]).all(2)
    np.testing.assert_array_equal(keys[:, None] == keys[None], same)


def test_keys_hold_the_widest_grid_and_refuse_a_wider_one() -> None:
    widest = np.array([[0.5, 0.5, 0.5], [2**21 - 0.5, 0.5, 0.5], [0.5, 2**21 - 0.5, 2**21 - 0.5]])
    keys = voxel_keys(widest, 1.0)
    assert len(set(keys.tolist())) == 3
    assert (keys >= 0).all()
    np.testing.assert_allclose(voxel_means(widest, 1.0)[np.argsort(np.argsort(keys))], widest, rtol=1e-15)
    with pytest.raises(InputError, match=r"voxel size 1 .*use at least 1"):
        voxel_keys(widest * [[1], [1 + 2**-20], [1]], 1.0)
    with pytest.raises(InputError, match="too small"):
        prepare(PointCloud(corner(np.random.default_rng(0))), 1e-7, CONFIG)


# ---- what is dropped and counted ----------------------------------------------------------------------


@given(SEEDS)
@settings(max_examples=40, deadline=None)
def test_duplicates_are_those_of_a_slow_set(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.integers(-2, 3, (150, 3)) * rng.choice([1.0, 0.1, 1 / 3])
    points[rng.random((150, 3)) < 0.2] *= -1  # makes some -0.0
    seen, expected = set(), []
    for point in points:
        key = tuple(point + 0.0)
        if key not in seen:
            seen.add(key)
            expected.append(point)
    kept, dropped = drop_duplicates(points)
    np.testing.assert_array_equal(kept, expected)
    assert dropped == 150 - len(expected)


@pytest.mark.parametrize("step", [1.0, 0.25, 0.001])
def test_a_regular_grid_has_no_duplicates(step: float) -> None:
    """Coordinates with few digits must not share a hash."""
    axis = np.arange(-40, 41) * step
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    assert drop_duplicates(grid)[1] == 0
    assert drop_duplicates(grid.astype(np.float32).astype(float))[1] == 0
    assert drop_duplicates(np.asfortranarray(np.vstack([grid, grid[::-1]])))[1] == len(grid)


def test_counts_add_up() -> None:
    rng = np.random.default_rng(2)
    points = corner(rng)
    far = np.array([[50.0, 0, 0], [0, 70, 0], [0, 70.05, 0]])
    cloud = PointCloud(np.vstack([points, points[:100], far, far[:1]]), name="scan", num_non_finite=7)
    made = prepare(cloud, 0.1, CONFIG)
    assert (made.num_input, made.num_non_finite) == (4000 + 100 + 4 + 7, 7)
    assert made.num_duplicates == 101
    assert made.num_isolated + len(made) == len(voxel_means(drop_duplicates(cloud.points)[0], 0.1))
    assert made.num_isolated >= 2
    assert np.abs(made.points).max() < 3
    assert made.points.shape == made.normals.shape
    assert made.name == "scan"
    without = prepare(PointCloud(points), 0.1, CONFIG)
    np.testing.assert_array_equal(made.points, without.points)
    np.testing.assert_allclose(made.normals, without.normals, atol=1e-9)


def test_duplicates_do_not_move_a_mean() -> None:
    points = corner(np.random.default_rng(3))
    doubled = np.vstack([points, np.repeat(points[:500], 3, axis=0)])
    np.testing.assert_array_equal(
        prepare(PointCloud(doubled), 0.1, CONFIG).points, prepare(PointCloud(points), 0.1, CONFIG).points
    )


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_isolated_points_have_fewer_than_two_others_near(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 3, (60, 3))
    kept = points
    while True:  # the definition: drop until every point left has two others near
        near = np.linalg.norm(kept[:, None] - kept[None], axis=2) <= 0.7
        if (near.sum(1) >= 3).all():
            break
        kept = kept[near.sum(1) >= 3]
    np.testing.assert_array_equal(drop_isolated(points, 0.7), kept)


def test_every_kept_point_has_the_neighbours_of_a_plane() -> None:
    """The middle of three points in a row has two others near, but both of them go."""
    plate = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0), [0.0], indexing="ij"), -1).reshape(-1, 3)
    row = np.array([[20.5, 0.5, 0.5], [22.4, 0.5, 0.5], [24.3, 0.5, 0.5]])
    made = prepare(PointCloud(np.vstack([plate + 0.5, row])), 1.0, CONFIG)
    near = cKDTree(made.points).query_ball_point(made.points, CONFIG.normal_radius, return_length=True)
    assert near.min() >= 3
    assert made.num_isolated == 3


def test_too_few_points_are_refused_with_the_numbers() -> None:
    points = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [10, 10, 0], [10, 10, 0]])
    with pytest.raises(EmptyCloudError, match=r"'tiny': 0 of 5 points.*1 duplicates, 4 isolated.*at least 3"):
        prepare(PointCloud(points, name="tiny"), 0.1, CONFIG)


def test_a_voxel_size_of_too_many_voxels_is_raised_just_enough() -> None:
    """A dense flat scan stays well described: the grid gets coarser, no voxel is left out."""
    cloud = PointCloud(corner(np.random.default_rng(4), 60_000, noise=0.002))
    size = bounded_voxel_size(cloud, cloud, 0.05, 1000)
    config = PreparationConfig(viewpoint="centroid")
    made = prepare(cloud, size, config)
    assert 800 < len(made) <= 1000
    assert made.num_isolated == 0
    inner = (made.points > 2.1 * size).sum(1) == 2
    assert np.abs(made.normals[inner]).max(1).min() > np.cos(np.radians(10))
    assert bounded_voxel_size(cloud, cloud, size, 1000) == size


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((0, 3)), "'empty' holds 0 points.*at least 3"),
        (np.eye(3)[:2], "holds 2 points"),
        (np.full((9, 3), 2.5), r"all 9 points are equal to \[1002.5, 2.5, 2.5\]"),
    ],
)
def test_clouds_that_fix_nothing_are_refused(points: np.ndarray, message: str) -> None:
    with pytest.raises(EmptyCloudError, match=message):
        check_cloud(PointCloud(points, origin=np.array([1000.0, 0, 0]), name="empty"))


def test_a_cloud_too_small_for_its_squares_is_refused() -> None:
    with pytest.raises(
        InputError, match=r"'tiny' is 1e-300 long at most, under the limit of 1e-15; use a smaller"
    ):
        check_cloud(PointCloud(np.eye(3) * 1e-300, name="tiny"))


def test_any_three_points_that_differ_pass_the_first_check() -> None:
    check_cloud(PointCloud(np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 1e-12]])))


# ---- normals ------------------------------------------------------------------------------------------


def test_normals_of_planes_are_exact_and_face_the_sensor() -> None:
    points = corner(np.random.default_rng(5), 8000)
    viewpoint = np.array([1.5, 1.2, 1.4])
    made = prepare(PointCloud(points), 0.1, CONFIG, viewpoint=viewpoint)
    np.testing.assert_allclose(np.linalg.norm(made.normals, axis=1), 1, atol=1e-9)
    inner = (made.points > 0.4).sum(1) == 2  # well inside a face
    assert inner.sum() > 300
    expected = (made.points[inner] < 1e-9).astype(float)  # the face's own axis, towards the viewpoint
    np.testing.assert_allclose(made.normals[inner], expected, atol=1e-9)
    assert (np.einsum("ij,ij->i", made.normals, viewpoint - made.points) >= 0).all()
    np.testing.assert_array_equal(made.viewpoint, viewpoint)


def test_normals_face_the_centroid_where_that_is_asked_for() -> None:
    made = prepare(PointCloud(corner(np.random.default_rng(6))), 0.1, CONFIG)
    assert made.viewpoint is None
    assert (np.einsum("ij,ij->i", made.normals, made.points.mean(0) - made.points) >= 0).all()


def test_without_a_viewpoint_normals_face_one_place_all_the_same() -> None:
    """A corner can be seen from inside or from outside; either way the three faces turn the same way."""
    for seed in range(3):
        made = prepare(PointCloud(corner(np.random.default_rng(seed))), 0.1, PreparationConfig())
        inner = (made.points > 0.4).sum(1) == 2
        assert abs(np.sign(made.normals[inner].sum(1)).mean()) > 0.9


def test_moving_by_whole_voxels_moves_points_and_keeps_normals() -> None:
    points = corner(np.random.default_rng(7), noise=0.005)
    shift = np.array([3, -7, 11]) * 0.125
    a = prepare(PointCloud(points), 0.125, CONFIG)
    b = prepare(PointCloud(points + shift), 0.125, CONFIG)
    np.testing.assert_allclose(b.points, a.points + shift, atol=1e-12)
    np.testing.assert_allclose(b.normals, a.normals, atol=1e-6)
    assert (a.num_isolated, a.num_duplicates) == (b.num_isolated, b.num_duplicates)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_unit_of_length_changes_nothing_but_the_lengths(scale: float) -> None:
    points = corner(np.random.default_rng(8), noise=0.005)
    a = with_features(prepare(PointCloud(points), 0.125, CONFIG), FpfhDescriptor())
    b = with_features(prepare(PointCloud(points * scale), 0.125 * scale, CONFIG), FpfhDescriptor())
    np.testing.assert_allclose(b.points, a.points * scale, rtol=1e-9, atol=1e-12 * scale)
    assert (np.abs(np.einsum("ij,ij->i", a.normals, b.normals)) > 1 - 1e-6).mean() > 0.999
    assert np.median(np.linalg.norm(a.features - b.features, axis=1)) < 1e-3


def test_orienting_flips_signs_only() -> None:
    rng = np.random.default_rng(9)
    points, normals, towards = rng.normal(size=(50, 3)), rng.normal(size=(50, 3)), rng.normal(size=3)
    turned = orient_normals(points, normals, towards)
    signs = np.sign(np.einsum("ij,ij->i", normals, towards - points))
    np.testing.assert_array_equal(turned, normals * signs[:, None])


def test_normals_are_those_of_a_slow_fit() -> None:
    points = corner(np.random.default_rng(10), 1500, noise=0.01)
    normals = estimate_normals(points, 0.3, 10_000)
    tree = cKDTree(points)
    for i in range(0, 1500, 30):
        around = points[tree.query_ball_point(points[i], 0.3)]
        values, vectors = np.linalg.eigh(np.cov(around.T))
        if values[1] > 2 * values[0]:  # a clear smallest direction
            assert abs(normals[i] @ vectors[:, 0]) > 1 - 1e-6


# ---- choosing the voxel size ----------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-3, 1e3, 7.7])
def test_voxel_size_follows_the_unit(scale: float) -> None:
    rng = np.random.default_rng(13)
    source, target = corner(rng, 30_000), 1.5 * corner(rng, 20_000)
    size = choose_voxel_size(PointCloud(source), PointCloud(target), 2000)
    scaled = choose_voxel_size(PointCloud(source * scale), PointCloud(target * scale), 2000)
    assert scaled == pytest.approx(size * scale, rel=0.16)  # the widest step of the series
    assert float(f"{scaled:.2g}") == scaled
    assert choose_voxel_size(PointCloud(target), PointCloud(source), 2000) == size


@pytest.mark.parametrize("num_points", [500, 2000, 5000])
def test_voxel_size_gives_the_number_of_voxels(num_points: int) -> None:
    dense = PointCloud(corner(np.random.default_rng(14), 200_000))
    size = choose_voxel_size(dense, dense, num_points)
    assert len(voxel_means(dense.points, size)) == pytest.approx(num_points, rel=0.15)


def test_voxel_size_is_at_least_twice_the_spacing_of_the_sparser_cloud() -> None:
    rng = np.random.default_rng(15)
    dense, sparse = corner(rng, 50_000), corner(rng, 800)
    size = choose_voxel_size(PointCloud(dense), PointCloud(sparse), 5000)
    spacing = np.median(cKDTree(sparse).query(sparse, k=2)[0][:, 1])
    assert 2 * spacing * 0.92 <= size <= 2 * spacing * 1.3
    assert size > choose_voxel_size(PointCloud(dense), PointCloud(dense), 5000)


def test_voxel_size_does_not_depend_on_where_the_cloud_lies() -> None:
    points = corner(np.random.default_rng(16), 30_000)
    near, far = PointCloud(points), PointCloud(points + 1000.0)
    assert choose_voxel_size(near, near, 3000) == pytest.approx(choose_voxel_size(far, far, 3000), rel=0.16)


@pytest.mark.parametrize("count", [3, 4, 5, 6, 20])
def test_a_voxel_size_is_found_for_the_smallest_clouds(count: int) -> None:
    """Whatever passes `check_cloud` gets a size; what is refused later can then be named clearly."""
    points = np.random.default_rng(count).uniform(0, 1, (count, 3))
    size = choose_voxel_size(PointCloud(points), PointCloud(points), 5000)
    assert 2 * np.median(cKDTree(points).query(points, k=2)[0][:, 1]) * 0.8 <= size <= 2


def test_foliage_gets_half_the_grid_of_surfaces():
    rng = np.random.default_rng(3)
    crowns = rng.uniform(0, 40, (60, 3)) * (1, 1, 0.2)
    leaves = crowns[rng.integers(60, size=60_000)] + rng.normal(0, 1.5, (60_000, 3))
    plain = _size_for_count(leaves, 3500)
    assert own_voxel_sizes(PointCloud(leaves), PointCloud(leaves), 3500)[0] == pytest.approx(plain / 2)
    ground = rng.uniform(0, 40, (60_000, 3)) * (1, 1, 0)
    walls = np.concatenate([ground, ground[:, [0, 2, 1]], ground[:, [2, 0, 1]]])
    size = own_voxel_sizes(PointCloud(walls), PointCloud(walls), 3500)[0]
    assert size == pytest.approx(_size_for_count(walls, 3500))


def test_one_point_a_million_metres_away_is_named_as_stray() -> None:
    points = np.vstack([corner(np.random.default_rng(17)), [[1e6, 0, 0]]])
    with pytest.raises(InputError, match=r"extent 1e\+06.*remove stray points"):
        prepare(PointCloud(points), choose_voxel_size(PointCloud(points), PointCloud(points), 5000), CONFIG)


def test_spacing_equals_brute_force_and_ignores_thinning() -> None:
    points = corner(np.random.default_rng(18), 3000)
    expected = np.median(cKDTree(points).query(points, k=2)[0][:, 1])
    assert typical_spacing(points) == pytest.approx(expected, rel=0.05)
    assert typical_spacing(np.repeat(points, 3, axis=0)) == pytest.approx(expected, rel=0.1)
    dense = corner(np.random.default_rng(19), 300_000)
    expected = np.median(cKDTree(dense).query(dense[::50], k=2)[0][:, 1])
    assert typical_spacing(dense) == pytest.approx(expected, rel=0.1)
    assert typical_spacing(np.ones((5, 3))) == 0


def test_millimetres_against_metres_are_noticed_from_both_sides() -> None:
    points = corner(np.random.default_rng(20), 500)
    metres, millimetres = PointCloud(points, name="a.ply"), PointCloud(points * 1000, name="b.ply")
    assert scale_mismatch(metres, metres) is None
    assert scale_mismatch(metres, PointCloud(points * 49)) is None
    assert scale_mismatch(PointCloud(points * 49), metres) is None
    for sentence in (scale_mismatch(metres, millimetres), scale_mismatch(millimetres, metres)):
        assert "a factor of 1000" in sentence
        assert "'a.ply'" in sentence
        assert "'b.ply'" in sentence
        assert "at most 50" in sentence
    assert scale_mismatch(metres, PointCloud(points + 1e6)) is None


@pytest.mark.parametrize("bits", [0, 3, 16, 17, 40, 62])
def test_rows_sorted_by_sixteen_bits_are_those_of_a_stable_sort(bits: int) -> None:
    keys = np.random.default_rng(bits).integers(0, 2**bits, 3000)
    keys = np.concatenate([keys, keys[::2]])
    np.testing.assert_array_equal(sorted_rows(keys), np.argsort(keys, kind="stable"))


@pytest.mark.parametrize("times", [2, 3, 6])
def test_rows_written_several_times_leave_the_voxel_size(times: int) -> None:
    """A goal of half the rows was beyond what so few places can fill, and the size ran to zero."""
    points = np.random.default_rng(0).uniform(0, 1, (2500, 3)) * [4, 3, 0.01]
    often = np.repeat(points, times, axis=0)
    nearly = often + np.random.default_rng(1).uniform(-1e-9, 1e-9, often.shape)
    once = PointCloud(points)
    size = choose_voxel_size(once, once, 3500)
    assert all(
        choose_voxel_size(*2 * [PointCloud(rows)], 3500) == pytest.approx(size, rel=0.15)
        for rows in (often, nearly)
    )
