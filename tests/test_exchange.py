"""Exchanging source and target turns the answer round and changes nothing else."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest
from small_scans import SETTINGS, UTM, cut, scene
from surface_pairs import motion, surfaces

import geomoe3d
from geomoe3d.clouds.order import in_order
from geomoe3d.config import load_config
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.geometry.se3 import inverse, transform_points
from geomoe3d.types import PointCloud


@pytest.fixture(scope="module")
def registrar():
    return geomoe3d.Registrar(load_config(None, SETTINGS))


@pytest.fixture(scope="module")
def parts():
    """Two scans of one scene and the true motion."""
    (source, A), (target, B) = (
        cut(scene(), *ends, seed=k) for k, ends in enumerate([(0.0, 3.0), (0.6, 4.0)])
    )
    return source, target, inverse(B) @ A


PAIRS = [
    "parts",
    "far away",
    "scaled",
    "other units",
    "unrelated",
    "sliding",
    "as many points",
    "sensors known",
]


def pair_of(kind, parts):
    source, target, _ = parts
    if kind == "far away":
        return source + UTM, target + 2 * UTM
    if kind == "scaled":
        return 1.1 * source, target
    if kind == "other units":
        return source, 1000 * target
    if kind == "unrelated":
        return source, cut(scene(77), 0.0, 3.0, seed=8)[0]
    if kind == "sliding":
        return surfaces("channel"), transform_points(motion(3), surfaces("channel", 1, 9000))
    if kind == "as many points":
        return source[:4000], target[:4000]
    if kind == "sensors known":
        return tuple(cloud.file_points for cloud in make_sample_pair(seed=0)[:2])
    return source, target


def check_turned_round(answer, back):
    """That one result is the other's inverse, in every field."""
    expected, found = asdict(answer.inverse()), asdict(back)
    for name in ("T_target_source", "information_center", "information_matrix"):
        scale = np.abs(np.nan_to_num(expected[name])).max() + 1
        np.testing.assert_allclose(found.pop(name) / scale, expected.pop(name) / scale, atol=1e-9)
    for fields in (expected, found):
        del fields["seconds"]
    one, other = expected.pop("alternative"), found.pop("alternative")
    assert (one is None) == (other is None)
    if one is not None:
        np.testing.assert_allclose(other["T_target_source"], one["T_target_source"], atol=1e-9)
        assert other["relative_score"] == pytest.approx(one["relative_score"], rel=1e-9)
    # An array has its name from its role.
    for fields in (expected, found):
        for side in ("source", "target"):
            del fields[side]["name"]
    one, other = expected.pop("accuracy"), found.pop("accuracy")
    assert (one is None) == (other is None)
    assert one is None or other == pytest.approx(one, rel=1e-6)
    evidence, measured = expected.pop("evidence"), found.pop("evidence")
    assert measured == pytest.approx(evidence, rel=1e-12)
    assert (
        str(found.pop("reasons")).replace("'target'", "'source'")
        == str(expected.pop("reasons")).replace("'target'", "'source'")
        or answer.status != "ok"
    )
    assert str(found) == str(expected)


@pytest.mark.parametrize("kind", PAIRS)
def test_the_answer_is_the_inverse_in_every_field(kind, parts, registrar):
    source, target = pair_of(kind, parts)
    used = geomoe3d.Registrar() if kind == "sensors known" else registrar
    answer, back = used.register(source, target), used.register(target, source)
    check_turned_round(answer, back)
    np.testing.assert_array_equal(answer.correspondences, np.roll(back.correspondences, 3, axis=1))
    if kind in ("parts", "far away", "sensors known"):
        assert answer.ok
        moved = answer.apply(source)
        np.testing.assert_allclose(back.apply(moved), source, atol=1e-6)


def test_overlaps_are_those_of_the_callers_clouds(parts, registrar):
    source, target, _ = parts
    small = target[target[:, 0] < np.median(target[:, 0])]
    for one, other in ((source, small), (small, source)):
        result = registrar.register(one, other)
        assert result.ok
        assert (result.overlap > result.evidence["overlap_target"]) == (one is small)


def test_scale_is_told_of_the_callers_source(parts, registrar):
    source, target, _ = parts
    answer, back = registrar.register(1.1 * source, target), registrar.register(target, 1.1 * source)
    for result, ratio in ((answer, 1.1), (back, 1 / 1.1)):
        assert result.evidence["scale_ratio"] == pytest.approx(ratio, rel=0.02)
        said = f"lengths in 'source' are {ratio:.2f}"[:-1]
        assert any(said in reason and "those in 'target'" in reason for reason in result.reasons)
        turned = (
            result.inverse()
        )  # the number turns over; the sentence goes by names, which stay with their clouds
        assert turned.evidence["scale_ratio"] == pytest.approx(1 / ratio, rel=0.02)
        assert turned.reasons == result.reasons and turned.target.name == "source"


def test_a_first_guess_and_given_correspondences_are_turned_round_too(parts, registrar):
    source, target, T = parts
    rng = np.random.default_rng(3)
    rows = source[rng.permutation(len(source))[:200]]
    rows = np.hstack([rows, transform_points(T, rows)])
    for given, turned in (
        ({"initial": T}, {"initial": inverse(T)}),
        ({"correspondences": rows}, {"correspondences": np.roll(rows, 3, axis=1)}),
    ):
        answer, back = (
            registrar.register(source, target, **given),
            registrar.register(target, source, **turned),
        )
        check_turned_round(answer, back)
        np.testing.assert_allclose(answer.T_target_source, T, atol=0.02)


def test_what_led_to_an_answer_is_told_in_the_callers_order(parts, registrar):
    source, target, _ = parts
    told, back = registrar.explain(source, target), registrar.explain(target, source)
    np.testing.assert_array_equal(told.source.points, source)
    np.testing.assert_array_equal(back.source.points, target)
    assert len(told.hypotheses) == len(back.hypotheses) > 1
    for one, other in zip(told.hypotheses, back.hypotheses, strict=True):
        np.testing.assert_allclose(inverse(one.T_target_source), other.T_target_source, atol=1e-12)
        assert one.score == other.score
    for found in (told, back):
        gaps = transform_points(found.result.T_target_source, found.correspondences.source)
        gaps = np.linalg.norm(gaps - found.correspondences.target, axis=1)
        np.testing.assert_array_equal(found.inliers, gaps < found.result.inlier_threshold)


def test_the_cloud_at_fault_is_named_whatever_the_order(parts, registrar):
    source, _, _ = parts
    for pair, name in (((source, source[:2]), "target"), ((source[:2], source), "source")):
        with pytest.raises(geomoe3d.InputError, match=f"'{name}' holds 2 points"):
            registrar.register(*pair)


def test_the_order_is_that_of_points_spreads_and_bytes():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3))
    few, many = PointCloud(points[:49]), PointCloud(points)
    wide, other = PointCloud(2 * points), PointCloud(points[::-1].copy())
    for first, second in ((many, few), (many, wide)):
        assert in_order(first, second)
        assert not in_order(second, first)
    assert in_order(many, many)
    assert in_order(many, other) != in_order(other, many)
