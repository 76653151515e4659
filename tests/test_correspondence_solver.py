"""Bare correspondences: a motion in the given frames, what agrees with it, and input that is refused."""

from __future__ import annotations

import numpy as np
import pytest
from corner_scenes import VOXEL, scene

import geomoe3d
from geomoe3d.config import load_config
from geomoe3d.errors import InputError
from geomoe3d.geometry.se3 import rotation_error_deg, transform_points, translation_error
from geomoe3d.types import Correspondences

UTM = np.array([583394.0, 5283100.0, 498.0])


@pytest.mark.parametrize("scorers", ["auto", "[surfaces]"])
@pytest.mark.parametrize("shift", [np.zeros(3), UTM])
def test_the_motion_is_found_in_the_frames_given(scorers, shift):
    rows, T = scene()
    moved = rows + np.concatenate([shift, 2 * shift])
    config = load_config(None, [f"scoring.scorers={scorers}"])
    result = geomoe3d.register_correspondences(moved, voxel_size=VOXEL, config=config)
    assert result.found
    assert rotation_error_deg(result.T_target_source, T) < 2.0
    images = transform_points(result.T_target_source, rows[:, :3] + shift) - 2 * shift
    assert np.abs(images - transform_points(T, rows[:, :3])).max() < 0.1
    assert result.inlier_threshold == pytest.approx(2 * VOXEL)
    gaps = np.linalg.norm(transform_points(result.T_target_source, moved[:, :3]) - moved[:, 3:], axis=1)
    np.testing.assert_array_equal(result.inliers, gaps < 2 * VOXEL)
    assert result.num_inliers >= 100
    assert result.weights.shape == (300,)
    assert set(result.seconds) == {"propose", "total"} | ({"score"} if scorers == "auto" else set())


def test_it_is_the_method_that_is_measured():
    from geomoe3d.evaluation.methods import make_method
    from geomoe3d.evaluation.records import MethodInput

    rows, _ = scene(seed=2)
    config = load_config(None, ["scoring.scorers=[surfaces, network]"])
    alone = geomoe3d.register_correspondences(rows, voxel_size=0.05, config=config)
    given = MethodInput("pair", correspondences=rows, voxel_size=0.05, inlier_threshold=0.1)
    measured = make_method("geomoe")(given)
    assert measured.T_target_source.tobytes() == alone.T_target_source.tobytes()


def test_centred_halves_are_not_taken_for_sensors_at_zero():
    rows, T = scene()
    centred = rows - rows.mean(0)
    result = geomoe3d.register_correspondences(centred, voxel_size=VOXEL)
    assert rotation_error_deg(result.T_target_source, T) < 2.0


@pytest.mark.parametrize("rows", [np.zeros((0, 6)), np.zeros((2, 6)), np.zeros((40, 6))])
def test_nothing_found_is_no_identity(rows):
    result = geomoe3d.register_correspondences(rows, voxel_size=0.05)
    assert not result.found
    assert np.isnan(result.T_target_source).all()
    assert result.num_inliers == 0
    assert len(result.weights) == len(rows)


def test_correspondences_of_the_pipeline_are_taken_too():
    rows, T = scene()
    result = geomoe3d.register_correspondences(Correspondences(rows), voxel_size=VOXEL)
    assert translation_error(result.T_target_source, T) < 0.1


@pytest.mark.parametrize(
    ("rows", "size", "message"),
    [
        (np.zeros((5, 3)), 0.05, r"shape \(N, 6\), found \(5, 3\)"),
        ("rows.npy", 0.05, "found a str"),
        (np.vstack([np.zeros((3, 6)), np.full((2, 6), np.nan)]), 0.05, "2 of 5 .* first in row 3"),
        (np.zeros((5, 6)), 0.0, "voxel_size must be a positive length, found 0.0"),
        (np.zeros((5, 6)), float("nan"), "voxel_size must be a positive length, found nan"),
        (np.zeros((5, 6)), "a", "voxel_size must be a positive length, found 'a'"),
    ],
)
def test_unusable_input_is_refused(rows, size, message):
    with pytest.raises(InputError, match=message):
        geomoe3d.register_correspondences(rows, voxel_size=size)
    with pytest.raises(InputError, match=message):
        geomoe3d.Registrar(load_config(None, ["scoring.scorers=[surfaces]"])).filter(rows, voxel_size=size)
