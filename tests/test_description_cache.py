"""The cache of clouds with features: the same answers, computed once, whatever happens to its folder."""

from __future__ import annotations

import os
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields

import numpy as np
import pytest

import geomoe3d.features.cache as module
from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.prepare import prepare
from geomoe3d.config import PreparationConfig, load_config
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.errors import EmptyCloudError, InputError, OutputError
from geomoe3d.features.base import with_features
from geomoe3d.features.cache import FeatureCache, feature_identity
from geomoe3d.features.fpfh import FpfhDescriptor
from geomoe3d.registration import Registrar

CONFIG = PreparationConfig()
FPFH = FpfhDescriptor()


@pytest.fixture(scope="module")
def clouds():
    """A generated pair, thinned."""
    source, target, _ = make_sample_pair(seed=0)
    return tuple(load_points(cloud.points[::8], name=cloud.name) for cloud in (source, target))


def fetch(cache, cloud, voxel_size=0.2, viewpoint=None, config=CONFIG, seed=0, descriptor=FPFH):
    """Through the cache; returns the described cloud and how often it was computed."""
    calls = []

    def make():
        calls.append(1)
        prepared = prepare(cloud, voxel_size, config, viewpoint=viewpoint, seed=seed)
        return with_features(prepared, descriptor)

    identity = feature_identity(voxel_size, viewpoint, config, descriptor, seed)
    return cache.fetch(cloud, identity, make), len(calls)


def same(a, b):
    for item in fields(a):
        one, other = getattr(a, item.name), getattr(b, item.name)
        if isinstance(one, np.ndarray):
            assert one.dtype == other.dtype, item.name
            assert one.tobytes() == other.tobytes(), item.name
        else:
            assert one == other, item.name


def test_the_second_time_nothing_is_computed_and_every_byte_is_the_same(tmp_path, clouds):
    cache = FeatureCache(tmp_path)
    first, computed = fetch(cache, clouds[0])
    assert computed == 1
    again, computed = fetch(FeatureCache(tmp_path), clouds[0])
    assert computed == 0
    same(first, again)


def test_a_registration_has_the_same_bytes_with_and_without_it(tmp_path, clouds):
    plain = Registrar().register(*clouds)
    cache = FeatureCache(tmp_path)
    for _ in range(2):
        cached = Registrar(cache=cache).register(*clouds)
        for item in fields(plain):
            one, other = getattr(plain, item.name), getattr(cached, item.name)
            if isinstance(one, np.ndarray):
                assert one.tobytes() == other.tobytes(), item.name
            elif item.name == "alternative":
                assert one.T_target_source.tobytes() == other.T_target_source.tobytes()
            elif item.name != "seconds":
                assert one == other, item.name
    assert len(list(tmp_path.iterdir())) == 2


def test_two_names_and_places_of_the_same_points_share_an_entry(tmp_path, clouds):
    cache = FeatureCache(tmp_path)
    fetch(cache, clouds[0])
    far = load_points(clouds[0].points, name="other")
    shifted = module.replace(far, origin=np.array([5e5, 5e6, 0.0]))
    found, computed = fetch(cache, shifted)
    assert computed == 0
    assert found.name == "other"
    assert found.origin.tolist() == [5e5, 5e6, 0.0]


@pytest.mark.parametrize(
    "change",
    [
        {"voxel_size": 0.21},
        {"viewpoint": np.zeros(3)},
        {"config": PreparationConfig(normal_neighbors=20)},
        {"seed": 1},
        {"descriptor": FpfhDescriptor(neighbors=70)},
    ],
)
def test_whatever_decides_a_description_makes_another_entry(tmp_path, clouds, change):
    cache = FeatureCache(tmp_path)
    fetch(cache, clouds[0])
    _, computed = fetch(cache, clouds[0], **change)
    assert computed == 1


def test_one_moved_point_or_other_code_makes_another_entry(tmp_path, clouds, monkeypatch):
    cache = FeatureCache(tmp_path)
    fetch(cache, clouds[0])
    points = clouds[0].points.copy()
    points[17, 1] = np.nextafter(points[17, 1], 9)
    assert fetch(cache, module.replace(clouds[0], points=points))[1] == 1
    monkeypatch.setattr(module, "source_hash", lambda name: "another version")
    assert fetch(cache, clouds[0])[1] == 1


@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "other"])
def test_a_damaged_entry_is_made_again_with_a_warning(tmp_path, clouds, damage):
    cache = FeatureCache(tmp_path)
    first, _ = fetch(cache, clouds[0])
    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    middle = len(whole) // 2
    path.write_bytes(
        {
            "cut": whole[:middle],
            "flip": whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :],
            "empty": b"",
            "other": b"PK not a zip",
        }[damage]
    )
    with pytest.warns(RuntimeWarning, match="damaged.*made again"):
        again, computed = fetch(cache, clouds[0])
    assert computed == 1
    same(first, again)
    assert path.read_bytes() == whole
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert fetch(cache, clouds[0])[1] == 0


def test_what_was_used_longest_ago_goes_first(tmp_path, clouds):
    cache = FeatureCache(tmp_path)
    sizes = (0.2, 0.21, 0.22)
    for age, size in enumerate(sizes):
        before = set(tmp_path.iterdir())
        fetch(cache, clouds[0], size)
        (path,) = set(tmp_path.iterdir()) - before
        os.utime(path, (1000 + age, 1000 + age))
    fetch(cache, clouds[0], 0.2)  # used now: 0.21 is the oldest
    kept = sum(path.stat().st_size for path in tmp_path.iterdir())
    small = FeatureCache(tmp_path, max_bytes=kept + 1)
    fetch(small, clouds[0], 0.23)
    assert [fetch(cache, clouds[0], size)[1] for size in (0.2, 0.22, 0.23)] == [0, 0, 0]
    assert fetch(cache, clouds[0], 0.21)[1] == 1


def test_a_single_entry_may_exceed_the_limit_but_nothing_stays_beside_it(tmp_path, clouds):
    cache = FeatureCache(tmp_path, max_bytes=1)
    fetch(cache, clouds[0], 0.2)
    fetch(cache, clouds[0], 0.3)
    assert len(list(tmp_path.iterdir())) == 1


def test_what_killed_writers_left_is_removed_after_an_hour(tmp_path, clouds):
    cache = FeatureCache(tmp_path)
    old, young = tmp_path / ".writing-1.npz", tmp_path / ".writing-2.npz"
    for path, age in ((old, 7200), (young, 10)):
        path.write_bytes(b"half")
        os.utime(path, (time.time() - age,) * 2)
    fetch(cache, clouds[0])
    assert not old.exists()
    assert young.exists()


def test_many_writers_of_few_entries_never_meet_half_a_file(tmp_path, clouds):
    expected = {size: fetch(FeatureCache(tmp_path / "alone"), clouds[0], size)[0] for size in (0.3, 0.4)}
    cache = FeatureCache(tmp_path / "shared", max_bytes=200_000)  # they evict each other all the time

    def work(number):
        size = (0.3, 0.4)[number % 2]
        same(fetch(cache, clouds[0], size)[0], expected[size])

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with ThreadPoolExecutor(4) as pool:
            list(pool.map(work, range(24)))


def test_a_folder_that_cannot_be_written_costs_time_only(tmp_path, clouds, monkeypatch):
    cache = FeatureCache(tmp_path)

    def refuse(*arguments, **named):
        raise OutputError("cannot write: the disk is full")

    monkeypatch.setattr(module, "write_atomically", refuse)
    with pytest.warns(RuntimeWarning, match="not kept.*disk is full"):
        found, computed = fetch(cache, clouds[0])
    assert computed == 1
    assert found.features is not None


def test_errors_pass_through_and_store_nothing(tmp_path, clouds):
    cache = FeatureCache(tmp_path)
    with pytest.raises(EmptyCloudError):
        fetch(cache, load_points(np.diag([9.0, 99.0, 999.0])))
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError, match="positive"):
        FeatureCache(tmp_path, max_bytes=0)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot make the folder"):
        FeatureCache(tmp_path / "file")


# ---- a first guess, verified and not trusted -----------------------------------------------------------


def test_a_wrong_guess_changes_nothing(clouds):
    plain = Registrar().register(*clouds)
    wrong = np.eye(4)
    wrong[:3, 3] = [40.0, 0.0, 0.0]
    guessed = Registrar().register(*clouds, initial=wrong)
    assert guessed.T_target_source.tobytes() == plain.T_target_source.tobytes()
    assert guessed.status == "ok"


def test_a_rough_guess_alone_is_refined_and_chosen():
    source, target, T = make_sample_pair(seed=0)
    rough = T.copy()
    rough[:3, 3] += [0.04, -0.03, 0.02]
    few = ["matching.max_correspondences=3", "second_look.max_correspondences=0"]
    starved = load_config(None, [*few, "estimator.name=svd"])
    assert not Registrar(starved).register(source.file_points, target.file_points).ok
    found = Registrar(starved).register(source.file_points, target.file_points, initial=rough)
    assert np.abs(found.T_target_source - T).max() < 0.01


@pytest.mark.parametrize(
    ("guess", "message"),
    [
        (np.eye(3), "4 rows of 4 finite numbers, found 3 rows of 3"),
        (np.full((4, 4), np.nan), "finite"),
        (2 * np.eye(4), "no rigid transform"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "mirrors"),
        (np.eye(4) + np.eye(4)[[3, 0, 1, 2]] * [0.5, 0, 0, 0], "last row|no rigid"),
        ([["a"] * 4] * 4, "numbers"),
    ],
)
def test_a_guess_that_is_no_motion_is_refused(clouds, guess, message):
    with pytest.raises(InputError, match=message):
        Registrar().register(*clouds, initial=guess)
