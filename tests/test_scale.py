"""Clouds of two sizes: the ratio is measured, named by its units where it is one, and never called ok."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_scans import cut, scene
from surface_pairs import motion

import geomoe3d
from geomoe3d.clouds.prepare import prepare
from geomoe3d.config import PreparationConfig, load_config
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.decision.answer import Decision
from geomoe3d.decision.confidence import Judgement
from geomoe3d.decision.scale import Scale, likely_unit_ratio, measure_scale, seeming_units, units_differ
from geomoe3d.decision.shared_surface import SharedSurface
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.types import FloatArray, Hypothesis, PointCloud, PreparedCloud

VOXEL = 0.08
NAMES = ("a", "b")


def prepared(points: FloatArray) -> PreparedCloud:
    return prepare(PointCloud(points), VOXEL, PreparationConfig(viewpoint="centroid"))


def two_scans(factor: float) -> tuple[PreparedCloud, PreparedCloud, FloatArray]:
    """Two samplings of boxes, the source ``factor`` times too large about its mean, and the motion."""
    points, T = scene(3, density=400), motion(1)
    rng = np.random.default_rng(0)
    first = points[rng.random(len(points)) < 0.6]
    second = transform_points(T, points[rng.random(len(points)) < 0.6])
    middle = first.mean(0)
    return prepared(middle + factor * (first - middle)), prepared(second), T


@pytest.mark.parametrize("factor", [0.9, 0.98, 1.02, 1.05, 1.1])
def test_the_ratio_is_measured(factor: float) -> None:
    source, target, T = two_scans(factor)
    found = measure_scale(T, SharedSurface(source, target))
    assert found is not None and found.differs
    assert found.ratio == pytest.approx(factor, abs=0.004)
    assert found.sigma < 0.006


def test_one_size_is_one_size_and_exchange_inverts_the_ratio() -> None:
    source, target, T = two_scans(1.0)
    found, back = (
        measure_scale(T, SharedSurface(source, target)),
        measure_scale(np.linalg.inv(T), SharedSurface(target, source)),
    )
    assert found is not None and back is not None
    assert not found.differs and not back.differs
    assert found.ratio == pytest.approx(1, abs=0.004)
    assert found.ratio * back.ratio == pytest.approx(1, abs=0.004)


def test_a_bent_body_is_no_other_size() -> None:
    """Stretched by 4 per cent along one axis and shrunk along another: no scale explains it."""
    source, target, T = two_scans(1.0)
    stretch = Rotation.random(random_state=2).as_matrix() * np.array([1.04, 0.96, 1.0])
    bent = prepared(target.points @ (stretch @ np.linalg.inv(stretch / [1.04, 0.96, 1.0])).T)
    found = measure_scale(T, SharedSurface(source, bent))
    assert found is not None and not found.differs
    assert found.sigma > 0.015


def test_next_to_nothing_shared_has_no_scale() -> None:
    source, target, T = two_scans(1.0)
    away = T.copy()
    away[0, 3] += 100
    assert measure_scale(away, SharedSurface(source, target)) is None


def test_units_are_named_by_their_ratio() -> None:
    assert seeming_units(1000.4, ("'a'", "'b'")).endswith("'a' seems to be in millimetres, 'b' in metres")
    assert seeming_units(1 / 3.28, ("'a'", "'b'")).endswith("'a' seems to be in metres, 'b' in feet")
    assert "inches" in seeming_units(39.37, ("'a'", "'b'")) and "centimetres" in seeming_units(
        0.01, ("'a'", "'b'")
    )
    assert seeming_units(1.1, ("'a'", "'b'")) == "" and seeming_units(1.0, ("'a'", "'b'")) == ""
    assert likely_unit_ratio((36.0, 10.0)) == pytest.approx(1 / 0.3048)
    assert likely_unit_ratio((14.0, 10.0)) is None and likely_unit_ratio((10.0, 0.0)) is None
    assert Scale(3.28, 0.01).sentence("a", "b").endswith("'a' seems to be in feet, 'b' in metres")


def test_the_larger_cloud_is_named_as_such_whichever_comes_first_and_whatever_the_names() -> None:
    large = Scale(1.1, 0.01)
    assert "lengths in 'a' are 1.1 times those in 'b' (+- 1.0 %)" in large.sentence("a", "b")
    assert "lengths in 'b' are 0.9091 times those in 'a'" in large.exchanged().sentence("b", "a")
    said = "lengths in 'scan' (the larger one) are 1.1 times those in 'scan' (the smaller one)"
    assert said in large.sentence("scan", "scan")
    assert units_differ(1 / 1000, "scan", "scan").endswith(
        "'scan' (the larger one) seems to be in millimetres, 'scan' (the smaller one) in metres; bring both to one "
        "unit, a rigid transform cannot change scale"
    )
    assert "lengths in 'a' are 3.28084 times those in 'b'" in units_differ(3.28084, "a", "b")
    assert units_differ(0.3048, "b", "a") == units_differ(1 / 0.3048, "a", "b")


def test_what_differs_is_never_ok_and_what_is_not_believed_has_no_scale() -> None:
    sure = replace(
        Decision.failed(""), answer=Hypothesis(np.eye(4)), judgement=Judgement("ok", ("so",), 0.99)
    )
    told = sure.with_scale(Scale(1.1, 0.01), NAMES).judgement
    assert told.status == "low_confidence" and told.confidence < 0.8
    assert "1.1 times" in told.reasons[0] and told.reasons[1:] == ("so",)
    unsure = Judgement(
        "low_confidence", ("so", "confidence 0.92 is below 0.98"), 0.92, "confidence 0.92 is below 0.98"
    )
    told = replace(sure, judgement=unsure).with_scale(Scale(1.1, 0.01), NAMES).judgement
    assert (
        told.reasons[1:] == ("so",) and "1.1 times" in told.reasons[0]
    )  # not two confidences in one verdict
    for off in (Scale(1.025, 0.007), Scale(1.05, 0.018), Scale(1.08, 0.04)):
        assert sure.with_scale(off, NAMES).judgement.status == "low_confidence"
    for fine in (Scale(1.1, 0.08), Scale(1.05, 0.02), Scale(1.025, 0.008), Scale(1.005, 0.0001), None):
        assert sure.with_scale(fine, NAMES).judgement == sure.judgement
    doubtful = replace(sure, judgement=Judgement("ambiguous", ("no",), 0.1))
    assert doubtful.with_scale(Scale(1.1, 0.01), NAMES).judgement == doubtful.judgement


@pytest.mark.parametrize("factor", [0.95, 1.1])
def test_a_scan_of_another_size_is_not_ok_and_says_the_ratio(factor: float) -> None:
    source, target, _ = make_sample_pair(seed=0)
    result = geomoe3d.register(factor * source.file_points, target)
    assert not result.ok
    assert result.evidence["scale_ratio"] == pytest.approx(factor, abs=0.01)
    assert "the scale differs" in result.reasons[0]


@pytest.mark.parametrize(("factor", "unit"), [(3.28084, "feet"), (1000.0, "millimetres")])
def test_two_units_are_named_where_the_clouds_fit_in_one(factor: float, unit: str) -> None:
    points = scene(3, density=400)
    source, target = cut(points, 0.0, 3.6, seed=0)[0], cut(points, 0.4, 4.6, seed=1)[0]
    result = geomoe3d.register(factor * source, target)
    assert not result.ok
    assert f"'source' seems to be in {unit}, 'target' in metres" in result.reasons[0]


def test_units_are_named_also_where_the_larger_cloud_is_taken_for_a_map() -> None:
    source, target, _ = make_sample_pair(seed=0)
    config = load_config(None, ["expert.maps.larger_grid=1.5"])
    result = geomoe3d.register(source.file_points / 0.3048, target, config=config)
    assert not result.ok
    assert result.reasons[0].startswith("units differ: ") and "in feet" in result.reasons[0]
