"""Where the sensors stood, said by the user: believed as it is, checked, and none means none."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import geomoe3d
from geomoe3d.cli.register import command
from geomoe3d.clouds.viewpoint import check_both_known, find_viewpoints, seen_by_none, with_sensors
from geomoe3d.config import PreparationConfig
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.decision.confidence import Judgement
from geomoe3d.decision.remarks import remarks
from geomoe3d.errors import ConfigError, InputError
from geomoe3d.line import _on_each_other
from geomoe3d.types import PointCloud, PreparedCloud

FAR = np.array([500.0, -20.0, 3.0])


def clouds() -> tuple[PointCloud, PointCloud]:
    rng = np.random.default_rng(0)
    first, second = (PointCloud(rng.uniform(-1, 1, (50, 3)), 100.0 * np.ones(3)) for _ in range(2))
    return first, second


def test_a_place_that_is_given_is_believed_wherever_it_lies() -> None:
    assert find_viewpoints(*clouds(), "auto") == (None, None)
    given = with_sensors(clouds(), (FAR, (0, 0, 0)), "auto")
    source, target = find_viewpoints(*given, "auto")
    assert np.array_equal(source, FAR - 100) and np.array_equal(target, np.full(3, -100.0))
    assert not seen_by_none(given)


def test_none_is_no_sensor_even_where_one_could_stand_at_the_origin() -> None:
    rng = np.random.default_rng(1)
    ahead = PointCloud(rng.uniform([2, -1, -1], [4, 1, 1], (200, 3)))
    assert find_viewpoints(ahead, ahead, "auto")[0] is not None
    given = with_sensors((ahead, ahead), (None, "none"), "auto")
    assert find_viewpoints(*given, "auto") == (None, None) and seen_by_none(given)
    assert with_sensors((ahead, ahead), (None, None), "guess") == (ahead, ahead)


@pytest.mark.parametrize("sensor", ["origin", (1.0, 2.0), (1.0, 2.0, np.nan)])
def test_what_is_no_place_is_refused(sensor: object) -> None:
    with pytest.raises(
        InputError, match=r"sensor of the source is at \[1e\+300, 0.0, 0.0\], beyond the limit of 1e\+12"
    ):
        with_sensors(clouds(), ((1e300, 0, 0), None), "auto")
    with pytest.raises(InputError, match="sensor of the target"):
        with_sensors(clouds(), (None, sensor), "auto")  # type: ignore[arg-type]


@pytest.mark.parametrize("sensors", [(FAR, None), (None, FAR), (FAR, "none")])
def test_one_place_alone_is_refused_where_the_other_is_not_known(sensors: tuple) -> None:
    with pytest.raises(InputError, match="one alone is of no use"):
        check_both_known(with_sensors(clouds(), sensors, "auto"))
    with pytest.raises(InputError, match="one alone is of no use"):
        geomoe3d.register(*clouds(), sensors=sensors)


def spun(height: float = 1.0) -> np.ndarray:
    """A room of 10 x 8 x 3, as a sensor at the origin sees it that spins: rays at equal angles, all around."""
    azimuth, elevation = np.radians(np.meshgrid(np.arange(0.5, 360, 1.0), np.arange(-39, 40, 2.0))).reshape(
        2, -1
    )
    rays = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], 1
    )
    low, high = np.array([-4.9, -4.2, -height]), np.array([5.1, 3.8, 3 - height])
    with np.errstate(divide="ignore"):
        return rays * np.where(rays > 0, high / rays, low / rays).min(axis=1)[:, None]


def test_a_spinning_sensor_is_believed_at_the_origin_though_the_mean_lies_near_it() -> None:
    points = spun()
    extent = np.linalg.norm(np.ptp(points, axis=0))
    assert np.linalg.norm(points.mean(axis=0)) < 0.025 * extent
    scan = geomoe3d.load_points(points)
    place, _ = find_viewpoints(scan, scan, "auto")
    assert np.allclose(place, -scan.origin)
    # Where its mean was subtracted the origin is no sensor's place, nor near the mean of a cloud thinned to a grid.
    thinned = points[np.unique(np.floor(points / 0.4), axis=0, return_index=True)[1]]
    for moved in (points - points.mean(axis=0), thinned - thinned.mean(axis=0) + [0.01 * extent, 0, 0]):
        cloud = geomoe3d.load_points(moved)
        assert find_viewpoints(cloud, cloud, "auto") == (None, None)


def test_a_place_and_another_rule_exclude_each_other() -> None:
    with pytest.raises(ConfigError, match="leave one of the two out"):
        with_sensors(clouds(), ("none", None), "guess")


def test_the_command_line_takes_places(tmp_path: Path) -> None:
    source, target, _ = make_sample_pair(3)
    paths = [str(tmp_path / f"{name}.npy") for name in ("source", "target")]
    for path, cloud in zip(paths, (source, target), strict=True):
        np.save(path, cloud.file_points + FAR)
    place = ",".join(map(str, FAR))
    told = ["--sensor-source", place, "--sensor-target", place]
    done = CliRunner().invoke(command, [*paths, *told, "--quiet"])
    assert done.exit_code == 0, done.output
    for wrong in ("1,2", "here", "1,2,x"):
        refused = CliRunner().invoke(command, [*paths, "--sensor-source", wrong])
        assert refused.exit_code == 2 and "X,Y,Z" in refused.output


def test_what_is_advised_where_sensors_are_guessed_names_the_verb_that_has_the_option() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (300, 3))
    cloud = PreparedCloud(points, points, None, 0.1, None, np.zeros(3))
    doubtful = Judgement("low_confidence", (), 0.5)
    (said,) = remarks((points, points[::-1]), (cloud, cloud), 0.1, False, PreparationConfig(), doubtful)
    assert said.index("`geomoe3d register`: --sensor-source") < said.index("`locate`: --sensor X,Y,Z")
    assert "preparation.viewpoint=origin" in said


def test_a_look_without_sensors_that_lays_the_believed_ones_on_each_other_is_seen() -> None:
    T = np.eye(4)
    T[:3, 3] = [2.0, 0.0, 0.0]
    look: Any = SimpleNamespace(
        decision=SimpleNamespace(T_target_source=T), pair=SimpleNamespace(voxel_size=0.1)
    )
    here = np.zeros(3)
    assert _on_each_other((here, np.array([2.3, 0.0, 0.0])), look)
    assert not _on_each_other((here, np.array([2.6, 0.0, 0.0])), look)
    assert not _on_each_other(None, look)
