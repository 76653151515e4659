"""The sample pair: reproducible, plausible as a sensor's view, and with the truth it claims."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.spatial import cKDTree

from geomoe3d.data import sample
from geomoe3d.data.rooms.solids import Solids as Room
from geomoe3d.data.sample import make_sample_pair, write_sample_pair
from geomoe3d.data.sample_room import furnished_room
from geomoe3d.errors import InputError, OutputError
from geomoe3d.geometry.se3 import rotation_angle_deg, transform_points


@pytest.fixture(scope="module")
def pair():
    return make_sample_pair(0)


def overlap(points, others, T, distance):
    moved = transform_points(T, points[::10])
    return float((cKDTree(others).query(moved, distance_upper_bound=distance)[0] < distance).mean())


def test_same_seed_gives_the_same_arrays_and_another_seed_another_pair(pair):
    again, other = make_sample_pair(0), make_sample_pair(1)
    for one, two in zip(pair[:2], again[:2], strict=True):
        np.testing.assert_array_equal(one.points, two.points)
        np.testing.assert_array_equal(one.colors, two.colors)
    np.testing.assert_array_equal(pair[2], again[2])
    assert not np.array_equal(pair[2], other[2])


def test_views_are_those_of_a_depth_camera_at_the_origin(pair):
    for cloud in pair[:2]:
        assert 50_000 < len(cloud) < 300_000
        assert np.isfinite(cloud.points).all()
        assert not cloud.origin.any()
        assert cloud.colors.shape == cloud.points.shape
        assert cloud.colors.min() >= 0 and cloud.colors.max() <= 1
        # Plain colours per object: many objects, far fewer colours than points.
        assert 20 < len(np.unique(np.round(cloud.colors * 255), axis=0)) < 200
        distance = np.linalg.norm(cloud.points, axis=1)
        assert distance.min() > 0.35 and distance.max() < 6.0  # 4.5 m of depth, at the image's corner
        # y points down: the camera is held about 1.4 m over the floor and pitched down.
        assert cloud.points[:, 1].max() > 0.8


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_the_given_motion_lays_the_views_on_each_other_and_the_overlap_is_partial(pair, seed):
    source, target, T = pair if seed == 0 else make_sample_pair(seed)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    for share in (
        overlap(source.points, target.points, T, 0.0375),
        overlap(target.points, source.points, np.linalg.inv(T), 0.0375),
    ):
        assert 0.4 < share < 0.7
    # The motion is no trifle, and without it the clouds lie elsewhere.
    assert 30 < rotation_angle_deg(T[:3, :3]) < 90
    assert np.linalg.norm(T[:3, 3]) > 1
    assert overlap(source.points, target.points, np.eye(4), 0.0375) < 0.25


def test_a_small_error_of_the_motion_shows_so_the_truth_is_sharp(pair):
    """The median distance of overlapping points grows when the given motion is disturbed in any direction."""
    source, target, T = pair
    tree = cKDTree(target.points)
    points = source.points[::20]

    def misfit(motion):
        distance = tree.query(transform_points(motion, points))[0]
        return float(np.minimum(distance, 0.05).mean())

    best = misfit(T)
    for axis, sign in itertools.product(range(3), (-1, 1)):
        moved = T.copy()
        moved[axis, 3] += sign * 0.02
        assert misfit(moved) > best


def test_noise_grows_with_depth_and_is_a_few_millimetres():
    """Of a bare wall straight ahead the residual from its plane is the sensor's noise alone."""
    room = furnished_room(np.random.default_rng(0))
    scene, colors = room.scene(), np.concatenate(room.colors)
    spread = {}
    for distance in (1.0, 3.0):
        pose = sample._camera_pose((4.4 - distance, 2.8, 2.0), 0.0, 0.0, 0.0)  # faces the wall x = 4.4
        points, _ = sample._depth_frame(scene, colors, pose, np.random.default_rng(1))
        middle = points[(np.abs(points[:, 0]) < 0.15) & (np.abs(points[:, 1]) < 0.15)]
        assert len(middle) > 200
        assert middle[:, 2].mean() == pytest.approx(distance, abs=2e-3)
        spread[distance] = middle[:, 2].std()
    assert spread[1.0] == pytest.approx(0.003, rel=0.15)
    assert spread[3.0] == pytest.approx(0.0015 * 9, rel=0.15)


def test_nothing_is_seen_beyond_the_range_nor_at_a_grazing_angle():
    corridor = Room()
    corridor.box((-1.0, 1.0, -2.0), (20.0, 0.1, 4.0), (1.0, 0.0, 0.0))  # a wall along the line of sight
    colors = np.concatenate(corridor.colors)
    for beside, farthest in ((0.15, 3.0), (0.5, 4.5)):
        pose = sample._camera_pose((0.0, 1.0 - beside, 0.0), 0.0, 0.0, 0.0)
        points, _ = sample._depth_frame(corridor.scene(), colors, pose, np.random.default_rng(1))
        assert len(points) > 1000
        assert points[:, 2].min() > 0.35
        # The nearer one stands beside the wall, the sooner its slope falls under 0.05: 0.15 / 3.0.
        assert 0.8 * farthest < points[:, 2].max() < farthest + 0.1


def test_written_files_have_the_same_bytes_and_read_back(tmp_path, pair):
    from geomoe3d.clouds.io import load_points

    first = write_sample_pair(tmp_path / "a" / "deep", seed=0)
    second = write_sample_pair(tmp_path / "b", seed=0)
    for one, two in zip(first, second, strict=True):
        assert one.read_bytes() == two.read_bytes()
    assert [path.name for path in first] == ["source.ply", "target.ply", "T_target_source.txt"]
    np.testing.assert_array_equal(np.loadtxt(first.truth), pair[2])
    assert "maps source.ply into target.ply: p_target = R p_source + t" in first.truth.read_text()
    for path, cloud in ((first.source, pair[0]), (first.target, pair[1])):
        loaded = load_points(path)
        np.testing.assert_allclose(loaded.file_points, cloud.points, atol=1e-6)
        np.testing.assert_allclose(loaded.colors, cloud.colors, atol=1 / 255)


def test_nothing_is_replaced_without_force(tmp_path):
    (tmp_path / "target.ply").write_text("mine")
    with pytest.raises(OutputError, match=r"target\.ply"):
        write_sample_pair(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["target.ply"]  # not half a pair either
    assert (tmp_path / "target.ply").read_text() == "mine"
    write_sample_pair(tmp_path, force=True)
    assert (tmp_path / "target.ply").read_bytes() != b"mine"


def test_a_negative_seed_and_a_folder_that_is_a_file_are_refused(tmp_path):
    with pytest.raises(InputError, match="-1"):
        make_sample_pair(-1)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="folder"):
        write_sample_pair(tmp_path / "file")


def test_the_same_pair_written_again_is_left_as_it_is_and_another_one_refused(tmp_path):
    paths = write_sample_pair(tmp_path)
    times = [path.stat().st_mtime_ns for path in paths]
    assert write_sample_pair(tmp_path) == paths
    assert [path.stat().st_mtime_ns for path in paths] == times
    with pytest.raises(OutputError, match="exists; pass --force"):
        write_sample_pair(tmp_path, seed=1)
    paths.truth.write_text("mine")
    with pytest.raises(OutputError, match="exists; pass --force"):
        write_sample_pair(tmp_path)
