"""How accurate an answer says it is: figures with known values, deviations that cover true errors, words, files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from registration_views import room_view
from scipy.spatial.transform import Rotation
from small_scans import scene
from surface_pairs import VOXEL, motion, prepared, surfaces

from geomoe3d.cli.summary import summary
from geomoe3d.clouds.io import load_points, save_points
from geomoe3d.clouds.loading import read_raw
from geomoe3d.clouds.saving import save_aligned
from geomoe3d.decision.accuracy import measure_accuracy
from geomoe3d.decision.shared_surface import SharedSurface
from geomoe3d.errors import FormatError, InputError
from geomoe3d.geometry.se3 import make_transform, transform_points
from geomoe3d.result import RegistrationResult
from geomoe3d.types import Accuracy, Correspondences, FloatArray
from geomoe3d.visual.accuracy_facts import accuracy_facts
from geomoe3d.visual.page import render_page

FOUND = Accuracy(0.03, 0.6, 0.4, 0.01, 0.008, 0.007, 0.025, 0.004, 0.012, 0.11)


def scans(noise: float = 0.0, shift: float = 0.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Two samplings of three faces of a 3 m cube with noise, the target's floor ``shift`` lower, and the motion."""
    rng, T = np.random.default_rng(0), motion(4)
    source, target = (surfaces("corner", seed, 60_000) for seed in (1, 2))
    target[target[:, 2] == 0, 2] -= shift
    source, target = (points + noise * rng.normal(size=points.shape) for points in (source, target))
    return source, transform_points(T, target), T


def measured(source: FloatArray, target: FloatArray, T: FloatArray) -> Accuracy:
    rows = Correspondences(
        np.hstack([source[:50], transform_points(T, source[:50]) + np.array([0.03, 0.04, 0])])
    )
    found = measure_accuracy(T, SharedSurface(prepared(source), prepared(target)), rows, 2 * VOXEL)
    assert found is not None
    return found


def test_the_figures_are_those_of_the_gaps() -> None:
    source, target, T = scans(shift=0.04)
    found = measured(source, target, T)
    assert found.inlier_rmse == pytest.approx(0.05, rel=1e-9)
    # A third of the surface lies 4 cm away, the rest on itself.
    assert found.distance_mean == pytest.approx(0.04 / 3, rel=0.15)
    assert found.distance_p95 == pytest.approx(0.04, abs=0.004)
    assert found.distance_median < 0.004
    assert found.distance_std == pytest.approx(0.04 * np.sqrt(2) / 3, rel=0.15)
    assert found.overlap_source > 0.98 and found.overlap_target > 0.98


def test_each_cloud_has_its_own_overlap() -> None:
    source, target, T = scans()
    half = source[source[:, 0] < 1.0]
    found = measured(half, target, T)
    seen = len(prepared(half)) / len(prepared(source))
    assert found.overlap_source > 0.98
    assert found.overlap_target == pytest.approx(seen, abs=0.06)
    back = found.exchanged()
    assert (back.overlap_source, back.overlap_target) == (found.overlap_target, found.overlap_source)


def furnished(noise: float, seed: int) -> FloatArray:
    """One of two samplings of the same boxes."""
    points, rng = scene(3, density=400), np.random.default_rng(seed)
    points = points[rng.random(len(points)) < 0.6]
    return points + noise * rng.normal(size=points.shape)


def test_deviations_grow_with_what_is_open_and_with_a_bend() -> None:
    T = motion(1)
    source, target = furnished(0.01, 0), transform_points(T, furnished(0.01, 1))
    firm = measured(source, target, T)
    assert 0 < firm.sigma_center < firm.sigma_farthest < VOXEL / 2
    away = np.vstack([source, source[:2000] + 30.0])  # a longer lever, the same turn
    far = measured(away, target, T)
    assert far.sigma_rotation_deg == pytest.approx(firm.sigma_rotation_deg, rel=0.3)
    assert far.sigma_farthest > 5 * firm.sigma_farthest
    bent = source * np.array([1.03, 0.97, 1.0])
    about = bent.mean(0) - source.mean(0)
    assert measured(bent - about, target, T).sigma_center > 4 * firm.sigma_center


def test_deviations_scale_with_the_unit_and_not_with_the_frame() -> None:
    T = motion(1)
    source, target = furnished(0.01, 0), transform_points(T, furnished(0.01, 1))
    turned = make_transform(Rotation.random(random_state=3).as_matrix(), np.array([5.0, -3.0, 2.0]))
    one = measured(source, target, T)
    rows = Correspondences(np.zeros((0, 6)))
    large = T.copy()
    large[:3, 3] *= 1000
    both = (prepared(1000 * points, 1000 * VOXEL) for points in (source, target))
    other = measure_accuracy(large, SharedSurface(*both), rows, 2000 * VOXEL)
    assert other is not None and np.isnan(other.inlier_rmse)
    assert other.sigma_center == pytest.approx(1000 * one.sigma_center, rel=0.01)
    assert other.sigma_rotation_deg == pytest.approx(one.sigma_rotation_deg, rel=0.01)
    moved = measured(source, transform_points(turned, target), turned @ T)
    assert 0.4 < moved.sigma_rotation_deg / one.sigma_rotation_deg < 2.5  # another grid, the same surfaces


def test_nothing_is_said_where_next_to_nothing_lies_on_each_other() -> None:
    source, target, T = scans()
    away = T.copy()
    away[0, 3] += 100
    nothing = measure_accuracy(
        away, SharedSurface(prepared(source), prepared(target)), Correspondences(np.zeros((0, 6))), 0.2
    )
    assert nothing is None


def test_json_and_inverse_keep_it_and_old_results_have_none() -> None:
    result = replace(room_view().result, accuracy=FOUND)
    assert RegistrationResult.from_json(result.to_json()).accuracy == FOUND
    without = replace(result, accuracy=replace(FOUND, inlier_rmse=float("nan")), overlap=float("nan"))
    again = RegistrationResult.from_json(without.to_json())
    assert np.isnan(again.overlap) and again.accuracy is not None and np.isnan(again.accuracy.inlier_rmse)
    assert ("matches", "none is an inlier") in accuracy_facts(again)
    inverse = result.inverse()
    assert inverse.accuracy == FOUND.exchanged() and inverse.inverse().accuracy == FOUND
    assert RegistrationResult.from_json(room_view().result.to_json()).accuracy is None


def test_the_words_name_each_figure() -> None:
    facts = dict(accuracy_facts(replace(room_view().result, accuracy=FOUND)))
    assert facts["overlap"] == "60 % of the source, 40 % of the target"
    assert facts["matches"] == "RMSE 0.03, not the accuracy (that is the uncertainty)"
    assert (
        facts["surfaces"] == "distance mean 0.01, median 0.008, standard deviation 0.007, 95 % within 0.025"
    )
    assert "4 and 12 mm if the unit is the metre" in facts["uncertainty"]
    assert "0.11 deg" in facts["uncertainty"]
    for factor in (1e3, 1e-9):  # not metres: no word of millimetres, above all not of a million of them
        other = replace(
            FOUND, sigma_center=factor * FOUND.sigma_center, sigma_farthest=factor * FOUND.sigma_farthest
        )
        words = dict(accuracy_facts(replace(room_view().result, accuracy=other)))["uncertainty"]
        assert "mm" not in words
    none = dict(
        accuracy_facts(replace(room_view().result, accuracy=replace(FOUND, inlier_rmse=float("nan"))))
    )
    assert none["matches"] == "none is an inlier"
    assert dict(accuracy_facts(room_view().result)) == {"overlap": "60 % of the source"}


@pytest.mark.parametrize(
    ("margin", "words"),
    [
        (np.log(20), "the second look prefers this transform to the best different one by a factor of 20"),
        (-np.log(3), "the second look prefers the best different one to this transform by a factor of 3"),
    ],
)
def test_the_margin_stands_on_the_console_and_on_the_page(margin: float, words: str) -> None:
    view = room_view()
    result = replace(view.result, evidence={**view.result.evidence, "margin": float(margin)})
    assert words in summary(result)
    assert words in render_page(replace(view, result=result))


@pytest.mark.parametrize(("agree", "words"), [(1.0, "the same transform"), (0.0, "two different transforms")])
def test_what_a_second_grid_gave_stands_on_the_console_and_on_the_page(agree: float, words: str) -> None:
    view = room_view()
    said = {"confidence_first": 0.951, "confidence_second": 0.402, "answers_agree": agree}
    result = replace(view.result, evidence={**view.result.evidence, **said})
    told = f"registered on two grids, which gave {words} (confidence 0.95 and 0.40)"
    assert told in summary(result)
    assert told in render_page(replace(view, result=result))


def test_the_paragraph_and_the_figures_name_one_overlap() -> None:
    result = replace(room_view().result, accuracy=replace(FOUND, overlap_source=0.667), overlap=0.6787)
    assert dict(accuracy_facts(result))["overlap"].startswith("67 % of the source")
    assert "67 % of the source lies on the target" in repr(result)
    assert "68 % of the source lies on the target" in repr(replace(result, accuracy=None))


def test_the_picture_tells_inliers_from_outliers_whatever_a_filter_kept() -> None:
    view = room_view(weights=np.zeros(300))  # a filter that kept nothing
    assert view.kept().sum() == (view.residuals() < view.result.inlier_threshold).sum() >= 200
    assert view.kept_words == ("inliers of the answer", "outliers")


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".xyz", ".las"])
def test_distances_are_written_beside_the_points(tmp_path: Path, suffix: str) -> None:
    if suffix == ".las":
        pytest.importorskip("laspy")
    rng, T = np.random.default_rng(0), motion(2)
    source = rng.normal(size=(300, 3))
    shift = rng.normal(size=(300, 3)) * 1e-3
    target = transform_points(T, source) + shift
    save_points(tmp_path / "target.ply", target)
    out = tmp_path / f"aligned{suffix}"
    save_aligned(out, source, T, target=tmp_path / "target.ply")
    written = read_raw(out)
    np.testing.assert_allclose(written.fields["distance"], np.linalg.norm(shift, axis=1), atol=1e-5)
    assert len(load_points(out)) == 300


def test_missing_measurements_have_no_distance_and_an_older_one_is_replaced(tmp_path: Path) -> None:
    source = np.vstack([np.zeros((3, 3)), np.eye(3)])
    save_points(tmp_path / "target.ply", np.eye(3) + np.array([0, 0, 0.5]))
    save_aligned(tmp_path / "a.ply", source, np.eye(4), target=tmp_path / "target.ply")
    lost = save_aligned(tmp_path / "b.ply", tmp_path / "a.ply", np.eye(4), target=np.eye(3))
    found = read_raw(tmp_path / "a.ply").fields["distance"]
    np.testing.assert_allclose(found, [np.nan] * 3 + [0.5] * 3)
    assert lost == ("distance",)  # said, not replaced in silence
    np.testing.assert_allclose(read_raw(tmp_path / "b.ply").fields["distance"], [np.nan] * 3 + [0.0] * 3)


def test_a_format_without_room_for_distances_says_so(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"\.npy has no place for a distance.*\.ply"):
        save_aligned(tmp_path / "a.npy", np.eye(3), np.eye(4), target=np.eye(3))
    with pytest.raises(InputError, match="no longer holds the source"):
        room_view().result.save_aligned(tmp_path / "a.ply", distances=True)
