"""The cause is named: no measurements among the numbers, a mirrored cloud, a voxel size that does not fit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from small_scans import scene
from surface_pairs import motion

import geomoe3d
from geomoe3d.clouds.loading import load_points, without_missing
from geomoe3d.clouds.viewpoint import with_sensor
from geomoe3d.config import PreparationConfig
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.decision.answer import Decision
from geomoe3d.decision.causes import mirrored_axes
from geomoe3d.decision.confidence import Judgement
from geomoe3d.decision.remarks import data_remarks, far_sensors
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.runtime.timing import StageClock
from geomoe3d.scoring.surfaces import SURFACES, Evidence
from geomoe3d.types import Hypothesis, PointCloud


def test_zeros_in_many_rows_are_missing_measurements_and_one_is_a_point() -> None:
    points = np.vstack([np.zeros((5, 3)), np.random.default_rng(0).normal(size=(50, 3))])
    loaded = load_points(points, name="scan")
    assert len(loaded) == 55  # whoever loads them gets all
    cloud = without_missing(loaded)
    assert len(cloud) == 50 and cloud.num_non_finite == 5
    assert cloud.notes == (
        "'scan': 5 points at exactly (0, 0, 0) stand for missing measurements and were left out",
    )
    one = without_missing(load_points(points[4:], name="scan"))
    assert len(one) == 51 and one.notes == ()
    assert len(without_missing(load_points(np.zeros((4, 3))))) == 4  # nothing else is left
    far = PointCloud(points - [1000.0, 0, 0], origin=np.array([1000.0, 0, 0]))
    assert len(without_missing(far)) == 50


@pytest.mark.parametrize(("number", "axis"), [(-9999.0, 2), (-32768.0, 0)])
def test_numbers_that_stand_for_no_measurement_are_named(number: float, axis: int) -> None:
    points = np.random.default_rng(0).normal(size=(500, 3))
    bad = points.copy()
    bad[:7, axis] = number
    clouds = load_points(bad, name="bad.ply"), load_points(points, name="good.ply")
    said, *_ = data_remarks(clouds, 0.25, PreparationConfig())
    assert said.startswith(f"'bad.ply': 7 points have the {'xyz'[axis]} {number:.0f}, which stands for no")
    assert not any("measurement" in s for s in data_remarks(clouds[1:] * 2, 0.25, PreparationConfig()))


def test_a_sensor_said_to_stand_far_away_is_named() -> None:
    points = np.random.default_rng(0).normal((1000.0, 0, 0), size=(500, 3))
    far, near = (
        with_sensor(load_points(points, name="scan"), place, "auto")
        for place in ((0.0, 0, 0), (1003.0, 0, 0))
    )
    (said,) = far_sensors((far, near))
    assert said.startswith("the sensor of 'scan' is said to have stood 999.9 from it")
    assert not list(far_sensors((near, near)))


def test_a_voxel_size_far_from_the_usual_one_is_named() -> None:
    cloud = PointCloud(scene(3, density=400))
    clouds = cloud, cloud
    (large,) = data_remarks(clouds, 3.0, PreparationConfig())
    assert "the voxel size 3 is large for these clouds: without one given 0." in large
    (small,) = data_remarks(clouds, 0.001, PreparationConfig())
    assert "the voxel size 0.001 is small" in small


def test_a_mirrored_cloud_is_named_and_never_ok() -> None:
    source, target, _ = make_sample_pair(seed=0)
    turned = transform_points(motion(3), source.file_points[::3] * [-1, 1, 1])
    result = geomoe3d.register(turned, target.file_points[::3])
    assert not result.ok
    assert result.reasons[0].startswith("mirrored: with x of 'source' the other way round the clouds fit")


def test_matches_of_ones_own_that_fix_nothing_do_not_make_a_cloud_mirrored() -> None:
    """The same pair that is ok without them was called mirrored: what was compared was nothing with features."""
    source, target, _ = make_sample_pair(seed=0)
    rows = np.array([[1.0, 2, 3, 4, 5, 6]])
    result = geomoe3d.register(source.file_points[::3], target.file_points[::3], correspondences=rows)
    assert result.status == "failed"
    assert not [reason for reason in result.reasons if "mirrored" in reason]


@dataclass(frozen=True)
class Liked:
    factor: float


@pytest.mark.parametrize(("surfaces", "told"), [(0.7, False), (1.2, True)])
def test_furniture_that_repeats_fits_mirrored_too_so_the_clouds_must_be_surer(
    surfaces: float, told: bool
) -> None:
    def decided(distinctiveness: float, liked: float) -> Decision:
        scores = {SURFACES: Evidence(0.5, 0.5, distinctiveness, 0.0), "network": Liked(liked)}
        answer = Hypothesis(np.eye(4), scores=scores)
        return replace(Decision.failed(""), answer=answer, judgement=Judgement("ok", (), 0.98))

    as_is, other = decided(0.5, 1.0), decided(surfaces, 30.0)
    said = mirrored_axes(as_is, "a.ply", lambda: 0.1, lambda: other, StageClock())
    assert (said is not None) == told
