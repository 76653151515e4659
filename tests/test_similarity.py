"""An unknown scale: found, held in the 4x4 everywhere, named; refused where it has no place."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import call, install_registrar, write_scans
from headless_browser import browse
from registration_views import make_result, room_view
from scipy.spatial.transform import Rotation

import geomoe3d
from geomoe3d.batch.folder import write_transforms
from geomoe3d.clouds.formats.objects import points_array
from geomoe3d.clouds.loading import read_raw
from geomoe3d.clouds.moved import moved
from geomoe3d.clouds.saving import save_aligned
from geomoe3d.clouds.transform_files import load_transform
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.decision.explanation import Explanation
from geomoe3d.decision.similarity import find_similarity, likely_ratios, scaled_cloud
from geomoe3d.errors import ConfigError, FormatError, InputError
from geomoe3d.geometry.se3 import inverse, make_transform, scale_of, transform_points
from geomoe3d.result import RegistrationResult
from geomoe3d.types import Accuracy, FloatArray, PointCloud
from geomoe3d.visual.page import render_page

FEET = 0.3048
R = Rotation.from_rotvec([0.3, -0.2, 1.1]).as_matrix()
SIMILAR = make_transform(FEET * R, np.array([1.0, -2.0, 0.5]))


@pytest.fixture(scope="module")
def pair() -> tuple[FloatArray, FloatArray, FloatArray]:
    """The sample pair with the source in feet far from its origin, and the true similarity."""
    source, target, T = make_sample_pair(seed=0)
    away = np.array([5000.0, -3000.0, 200.0])
    true = T.copy()
    true[:3, :3] *= FEET
    true[:3, 3] -= true[:3, :3] @ away
    return source.file_points[::3] / FEET + away, target.file_points[::3], true


@pytest.fixture(scope="module")
def answer(pair: tuple[FloatArray, FloatArray, FloatArray]) -> RegistrationResult:
    return geomoe3d.register(pair[0], pair[1], scale="estimate")


def similar_result() -> RegistrationResult:
    return make_result(SIMILAR, scale=FEET, accuracy=Accuracy(0.3, 0.6, 0.4, *[0.3] * 6, 0.11))


def test_feet_against_metres_is_found_and_named(
    pair: tuple[FloatArray, FloatArray, FloatArray], answer: RegistrationResult
) -> None:
    source, _, true = pair
    assert answer.ok
    assert answer.scale == pytest.approx(FEET, rel=0.01)
    assert scale_of(answer.T_target_source) == pytest.approx(answer.scale, rel=1e-12)
    off = np.linalg.norm(answer.apply(source) - transform_points(true, source), axis=1)
    assert np.median(off) < 0.03
    assert "'source' seems to be in feet, 'target' in metres" in answer.reasons
    assert answer.evidence["scale_ratio"] == pytest.approx(1 / FEET, rel=0.01)
    assert answer.accuracy is not None and answer.accuracy.sigma_center < 0.1  # metres, the target's
    assert np.linalg.norm(answer.source.origin) > 1000  # that of the source as it is
    assert answer.inliers.sum() == answer.num_inliers  # correspondences are those of the file too
    assert answer.config["scale"] == "estimate"


def test_everything_that_is_written_holds_the_scale(
    tmp_path: Path, pair: tuple[FloatArray, FloatArray, FloatArray], answer: RegistrationResult
) -> None:
    source = pair[0]
    again = RegistrationResult.from_json(answer.to_json())
    assert again.scale == answer.scale
    np.testing.assert_array_equal(again.T_target_source, answer.T_target_source)
    for name in ("T.txt", "T.npy", "pdal:T.json"):
        answer.save(f"{name.split(':')[0]}:{tmp_path / 'T.json'}" if ":" in name else tmp_path / name)
    for name in ("T.txt", "T.npy", "T.json"):
        np.testing.assert_array_equal(load_transform(tmp_path / name), answer.T_target_source)
    answer.save_aligned(tmp_path / "aligned.ply", distances=True)
    np.testing.assert_allclose(read_raw(tmp_path / "aligned.ply").points, answer.apply(source), atol=1e-5)
    for name in ("T.tum", "T.kitti", "T.yaml"):
        with pytest.raises(FormatError, match=r"holds a rotation and a translation, not a scale of 0\.30"):
            answer.save(tmp_path / name)
    back = answer.inverse()
    assert back.scale == pytest.approx(1 / answer.scale)
    np.testing.assert_allclose(back.apply(answer.apply(source)), source, rtol=1e-12, atol=1e-8)
    assert "scaled by" in repr(answer)


def test_the_inverse_carries_lengths_and_information_over() -> None:
    result = similar_result()
    back = result.inverse()
    assert back.voxel_size == pytest.approx(result.voxel_size / FEET)
    assert back.accuracy is not None and back.accuracy.sigma_farthest == pytest.approx(0.3 / FEET)
    assert back.accuracy.sigma_rotation_deg == 0.11 and back.accuracy.overlap_source == 0.4
    np.testing.assert_allclose(inverse(SIMILAR, FEET) @ SIMILAR, np.eye(4), atol=1e-12)
    # A shift of the target by u is one of the old source by R^T u / s: certain to s times as little.
    np.testing.assert_allclose(back.information_matrix[3:, 3:], FEET**2 * np.eye(3), atol=1e-12)
    np.testing.assert_allclose(back.information_matrix[:3, :3], np.eye(3), atol=1e-12)
    twice = back.inverse()
    np.testing.assert_allclose(twice.T_target_source, SIMILAR, atol=1e-12)
    assert twice.voxel_size == pytest.approx(result.voxel_size)


def test_normals_keep_their_length(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points, normals = rng.normal(size=(20, 3)), rng.normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    there = moved(PointCloud(points, normals=normals), SIMILAR)
    np.testing.assert_allclose(there.file_points, FEET * points @ R.T + SIMILAR[:3, 3], atol=1e-12)
    np.testing.assert_allclose(there.normals, normals @ R.T, atol=1e-12)
    geomoe3d.save_points(tmp_path / "in.ply", points, normals=normals)
    save_aligned(tmp_path / "out.ply", tmp_path / "in.ply", SIMILAR, scale=FEET)
    np.testing.assert_allclose(read_raw(tmp_path / "out.ply").normals, normals @ R.T, atol=1e-6)
    with pytest.raises(InputError, match="no rigid transform"):
        save_aligned(tmp_path / "no.ply", points, SIMILAR)
    with pytest.raises(InputError, match=r"no similarity of scale 2"):
        save_aligned(tmp_path / "no.ply", points, SIMILAR, scale=2.0)
    open3d = pytest.importorskip("open3d")
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    for given in (cloud, open3d.t.geometry.PointCloud.from_legacy(cloud)):
        turned = moved(given, SIMILAR)
        turned = turned.to_legacy() if hasattr(turned, "to_legacy") else turned
        np.testing.assert_allclose(points_array(turned.points), there.file_points, atol=1e-5)
        np.testing.assert_allclose(points_array(turned.normals), normals @ R.T, atol=1e-5)


def test_the_page_names_the_scale_and_moves_by_it(tmp_path: Path) -> None:
    view = room_view()
    T = view.result.T_target_source.copy()
    T[:3, :3] *= FEET
    correspondences = view.correspondences / np.array([FEET] * 3 + [1.0] * 3)
    shown = replace(
        view,
        source_points=view.source_points / FEET,
        correspondences=correspondences,
        result=replace(view.result, T_target_source=T, scale=FEET),
    )
    assert shown.kept().sum() == view.kept().sum()
    text = render_page(shown)
    assert "= 0.3048 R p" in text and "lengths of the source times this are those of the target" in text
    half_way = browse(tmp_path, text, script="", wish="#at=0.5&renderer=canvas2d")["model"]
    model = np.array([float(v) for v in half_way.split()]).reshape(4, 4).T  # a similarity on the way too
    assert scale_of(model) == pytest.approx(np.sqrt(FEET), rel=1e-9)
    np.testing.assert_allclose(model[:3, :3] @ model[:3, :3].T, FEET * np.eye(3), atol=1e-9)


def test_a_batch_says_the_scale_in_its_transforms_and_knows_them_again(tmp_path: Path) -> None:
    write_transforms(tmp_path, [("pair", similar_result())])
    path = tmp_path / "pair.txt"
    assert "p_target = 0.3048 R p_source + t" in path.read_text()
    np.testing.assert_array_equal(load_transform(path), SIMILAR)
    write_transforms(tmp_path, [("other", similar_result())])  # its own of before are taken away
    assert not path.exists()


def test_the_ladder_begins_at_the_extents_and_stays_within_a_thousand() -> None:
    rng = np.random.default_rng(0)
    cloud = PointCloud(rng.normal(size=(500, 3)), sensor=np.ones(3))
    large = scaled_cloud(cloud, 7.0)
    assert large.sensor is not None and large.sensor[0] == 7.0
    ratios = likely_ratios(large, cloud)
    assert ratios[0] == pytest.approx(7.0) and len(ratios) == 15
    assert max(ratios) / 7 == pytest.approx(1.2**7) and min(ratios) / 7 == pytest.approx(1.2**-7)
    assert max(likely_ratios(scaled_cloud(cloud, 900.0), cloud)) < 1200
    assert likely_ratios(scaled_cloud(cloud, 1e5), cloud) == []


def test_a_place_that_fits_at_a_wrong_scale_gives_way_to_a_better_one() -> None:
    """The first rung is ok at 1.2, a neighbour scores more at 1: not the first that is ok is the answer."""
    cloud = PointCloud(np.random.default_rng(0).normal(size=(500, 3)))
    asked: list[float] = []

    def attempt(ratio: float, thorough: bool) -> Explanation:
        asked.append(ratio)
        place = 1.0 if ratio < 1.1 else 1.2
        evidence = {"score": 25.0 if place == 1.0 else 1.4, "scale_ratio": place / ratio, "scale_sigma": 0.01}
        settled = abs(np.log(place / ratio)) < 0.01
        found = make_result(np.eye(4), evidence=evidence, status="ok" if settled else "low_confidence")
        return Explanation(replace(found, confidence=0.99 if settled else 0.5), cloud, cloud)

    best = find_similarity(scaled_cloud(cloud, 1.18), cloud, attempt)
    assert best is not None and best[0].result.ok
    assert best[1] == pytest.approx(1.0)
    assert len(asked) < 10


def test_the_more_scales_were_tried_the_less_one_that_fits_is_worth() -> None:
    """0.96 at the fifteenth rung is no ok; 0.96 at the first one leaves odds of 24 to 2."""
    cloud = PointCloud(np.random.default_rng(0).normal(size=(500, 3)))

    def attempt_with(place: float, confidence: float) -> Callable[[float, bool], Explanation]:
        def attempt(ratio: float, thorough: bool) -> Explanation:
            near = abs(np.log(place / ratio)) < 0.05
            evidence = {"score": 9.0 if near else 0.1, "scale_ratio": 1.0, "scale_sigma": 0.01}
            found = make_result(np.eye(4), evidence=evidence, status="ok" if near else "low_confidence")
            return Explanation(replace(found, confidence=confidence if near else 0.01), cloud, cloud)

        return attempt

    first = find_similarity(cloud, cloud, attempt_with(1.0, 0.999))
    last = find_similarity(cloud, cloud, attempt_with(1.2**7, 0.96))
    assert first is not None and last is not None
    assert first[0].result.ok and first[0].result.confidence == pytest.approx(999 / 1001)
    assert last[0].result.status == "low_confidence" and last[1] == pytest.approx(1.2**7)
    assert last[0].result.confidence == pytest.approx((24 / 16) / (1 + 24 / 16), rel=1e-3)
    assert "15 scales were tried" in last[0].result.reasons[0]


def test_what_is_too_far_apart_or_of_no_scale_is_refused() -> None:
    rng = np.random.default_rng(0)
    cloud = rng.normal(size=(500, 3))
    far = geomoe3d.register(cloud * 1e5, cloud, scale="estimate")
    assert far.status == "failed" and "between 1/1000 and 1000" in far.reasons[0]
    with pytest.raises(ConfigError, match="first guess"):
        geomoe3d.register(cloud, cloud, scale="estimate", initial=np.eye(4))
    config = geomoe3d.RegistrationConfig(scale="estimate")
    with pytest.raises(ConfigError, match="needs the clouds"):
        geomoe3d.register_correspondences(np.zeros((5, 6)), voxel_size=0.1, config=config)
    with pytest.raises(ConfigError, match="is for pairs"):
        geomoe3d.register_scans(["a.ply", "b.ply"], "out", config=config)


def test_the_command_line_refuses_formats_before_the_work_and_prints_the_scale(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    registrar = install_registrar(monkeypatch)
    registrar.answer = replace(similar_result(), evidence={"scale_sigma": 0.004})
    both = write_scans(tmp_path)
    assert call("register", *both, "--estimate-scale", "--output", tmp_path / "T.tum") == 2
    assert "not an estimated scale" in capfd.readouterr().err and not registrar.asked
    out = tmp_path / "a.xyz"
    assert call("register", *both, "--estimate-scale", "--output", tmp_path / "T.txt", "--aligned", out) == 0
    said = capfd.readouterr().out
    assert "scale       0.3048 +- 0.4 %: lengths of the source times this are those of the target" in said
    assert "p_target = 0.3048 R p_source + t" in said
    assert registrar.asked[0][2].scale == "estimate"
    np.testing.assert_array_equal(load_transform(tmp_path / "T.txt"), SIMILAR)
    np.testing.assert_allclose(np.loadtxt(out), transform_points(SIMILAR, np.loadtxt(both[0])), atol=1e-9)
    assert call("register", *both, "--json", "--inverse", "--estimate-scale") == 0
    assert json.loads(capfd.readouterr().out)["scale"] == pytest.approx(1 / FEET)
