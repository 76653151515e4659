"""The whole line through the API: generated pairs with a known motion, and everything that must not be ok."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import geomoe3d
from geomoe3d.config import load_config
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.errors import ConfigError, EmptyCloudError, InputError, NonFiniteError
from geomoe3d.geometry.se3 import (
    inverse,
    make_transform,
    rotation_error_deg,
    shift_frames,
    transform_points,
    translation_error,
)
from geomoe3d.registration import Registrar
from geomoe3d.types import Correspondences

MOTION = make_transform(Rotation.random(random_state=5).as_matrix(), np.array([1.0, -2.0, 0.5]))
UTM = np.array([583394.0, 5283100.0, 498.0])


@pytest.fixture(scope="module")
def pair():
    source, target, T = make_sample_pair(seed=0)
    return source.file_points, target.file_points, T


@pytest.fixture(scope="module")
def answer(pair):
    return geomoe3d.register(pair[0], pair[1])


def box(size, count, seed):
    """Points on the surface of a box, evenly per face."""
    rng = np.random.default_rng(seed)
    face = rng.integers(0, 6, count)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[np.arange(count), face % 3] = np.where(face < 3, -0.5, 0.5)
    return points * np.array(size)


def images_apart(T_a, T_b, points):
    """Largest distance between the images of the points under two motions."""
    return np.abs(transform_points(T_a, points) - transform_points(T_b, points)).max()


def test_sample_pair_lands_on_the_truth_and_knows_it(pair, answer):
    assert answer.status == "ok"
    assert answer.confidence > 0.95
    assert rotation_error_deg(answer.T_target_source, pair[2]) < 0.5
    assert translation_error(answer.T_target_source, pair[2]) < 0.01
    assert 0.4 < answer.overlap < 0.8
    assert 0 < answer.num_inliers < answer.num_correspondences <= 2000
    stages = ("load", "preprocess", "features", "match", "propose", "score", "refine", "decide", "total")
    assert tuple(answer.seconds) == stages
    assert np.linalg.det(answer.T_target_source[:3, :3]) == pytest.approx(1, abs=1e-12)


def test_same_seed_same_bytes(pair, answer):
    again = geomoe3d.register(pair[0], pair[1])
    assert again.T_target_source.tobytes() == answer.T_target_source.tobytes()
    assert again.confidence == answer.confidence


def test_threads_do_not_change_the_answer(tmp_path, pair):
    np.save(tmp_path / "a.npy", pair[0])
    np.save(tmp_path / "b.npy", pair[1])
    code = (
        "import sys, geomoe3d; r = geomoe3d.register(sys.argv[1], sys.argv[2]);"
        "print(r.T_target_source.tobytes().hex())"
    )
    printed = [
        subprocess.run(
            [sys.executable, "-c", code, str(tmp_path / "a.npy"), str(tmp_path / "b.npy")],
            env={**os.environ, "OMP_NUM_THREADS": n, "OPENBLAS_NUM_THREADS": n},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for n in ("1", "2")
    ]
    assert len(printed[0].strip()) == 2 * 16 * 8
    assert printed[0] == printed[1]


def test_swapped_roles_give_the_inverse(pair, answer):
    back = geomoe3d.register(pair[1], pair[0])
    assert back.status == "ok"
    assert images_apart(inverse(back.T_target_source), answer.T_target_source, pair[0]) < 0.02


def test_national_grid_coordinates_register_as_well_as_the_origin(pair, answer):
    far = geomoe3d.register(pair[0] + UTM, pair[1] + 2 * UTM)
    assert far.status == "ok"
    moved = far.apply(pair[0] + UTM) - 2 * UTM
    assert np.abs(moved - transform_points(pair[2], pair[0])).max() < 0.03
    assert np.allclose(far.source.origin, UTM, atol=10)


def test_a_billion_units_away(pair):
    far = geomoe3d.register(pair[0] + 1e9, pair[1] + 1e9)
    assert far.status == "ok"
    assert np.abs(far.apply(pair[0] + 1e9) - 1e9 - transform_points(pair[2], pair[0])).max() < 0.03


def test_millimetres_on_both_sides(pair, answer):
    big = geomoe3d.register(1000 * pair[0], 1000 * pair[1])
    assert big.status == "ok"
    assert big.voxel_size == pytest.approx(1000 * answer.voxel_size)
    assert np.abs(big.T_target_source[:3, 3] / 1000 - answer.T_target_source[:3, 3]).max() < 1e-3


def test_millimetres_against_metres_is_said_and_not_guessed(pair):
    result = geomoe3d.register(1000 * pair[0], pair[1])
    assert result.status == "failed"
    assert "millimetres" in result.reasons[0]
    assert np.isnan(result.T_target_source).all()
    with pytest.raises(InputError, match="no transform"):
        result.apply(pair[0])


def test_the_same_scan_twice_is_the_identity_found_not_assumed(pair):
    same = geomoe3d.register(pair[0], pair[0])
    assert same.status == "ok"
    assert np.abs(same.T_target_source - np.eye(4)).max() < 1e-6
    moved = geomoe3d.register(pair[0], transform_points(MOTION, pair[0]))
    assert moved.status == "ok"
    assert images_apart(moved.T_target_source, MOTION, pair[0]) < 0.01


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_unrelated_scans_are_never_ok(pair, seed):
    rng = np.random.default_rng(seed)
    other = np.vstack([box(rng.uniform(0.3, 3, 3), 4000, k) + rng.uniform(-2, 2, 3) for k in range(8)])
    result = geomoe3d.register(pair[0], other)
    assert result.status in {"failed", "low_confidence"}
    assert result.reasons
    assert result.confidence < 0.9


@pytest.mark.parametrize("size", [(1, 1, 1), (1, 2, 3)])
@pytest.mark.parametrize(("name", "least"), [("surfaces", 0.8), ("surfaces, network", 0.05)])
def test_symmetric_boxes_are_ambiguous_and_show_the_other_motion(size, name, least):
    """The clouds like both motions alike; the network may prefer one a little."""
    target = transform_points(MOTION, box(size, 20_000, 1))
    result = geomoe3d.register(box(size, 20_000, 0), target, scoring={"scorers": name.split(", ")})
    assert result.status == "ambiguous"
    assert result.alternative is not None
    assert result.alternative.relative_score > least
    assert result.alternative.rotation_difference_deg > 80


def test_surfaces_that_slide_are_never_ok():
    rng = np.random.default_rng(0)
    plane = np.c_[rng.uniform(0, 4, (20_000, 2)), rng.normal(0, 0.003, 20_000)]
    angle = rng.uniform(0, 2 * np.pi, 20_000)
    cylinder = np.c_[np.cos(angle), np.sin(angle), rng.uniform(0, 3, 20_000)]
    for points in (plane, cylinder):
        result = geomoe3d.register(points, transform_points(MOTION, points[::2]))
        assert result.status != "ok"
        assert result.confidence <= 0.3
        assert result.reasons


def test_too_few_or_degenerate_points(pair):
    for count in (0, 1, 2):
        with pytest.raises(EmptyCloudError):
            geomoe3d.register(pair[0][:count], pair[1])
    with pytest.raises(EmptyCloudError, match="all 50 points are equal"):
        geomoe3d.register(np.ones((50, 3)), pair[1])
    with pytest.raises(NonFiniteError):
        geomoe3d.register(np.full((50, 3), np.nan), pair[1])
    line = np.outer(np.linspace(0, 3, 2000), [1.0, 2.0, 3.0])
    for source, target in ((line, pair[1]), (pair[0], line), (line, line)):
        result = geomoe3d.register(source, target)
        assert result.status == "failed"
        assert not np.isfinite(result.T_target_source).any()
    with pytest.raises(EmptyCloudError, match="of 3 points remain"):
        geomoe3d.register(np.eye(3), np.eye(3) + 1)


def test_dirt_is_dropped_and_counted(pair, answer):
    rng = np.random.default_rng(0)
    dirty = pair[0].copy()
    dirty[0] = np.nan
    dirty[7, 1] = np.inf
    dirty = np.vstack([dirty, dirty[100:150], pair[0].max(0) + rng.uniform(1.0, 1.5, (1, 3))])
    result = geomoe3d.register(dirty, pair[1], voxel_size=answer.voxel_size)
    assert result.status == "ok"
    assert result.source.num_input == len(dirty)
    assert result.source.num_non_finite == 2
    assert result.source.num_duplicates == 50
    assert result.source.num_isolated >= 1
    assert images_apart(result.T_target_source, pair[2], pair[0]) < 0.03


def test_voxel_size_is_used_reported_and_bounded(pair):
    assert geomoe3d.register(*pair[:2], voxel_size=0.07).voxel_size == 0.07
    with pytest.raises(InputError, match="too small"):
        geomoe3d.register(*pair[:2], voxel_size=1e-8)
    with pytest.raises(ConfigError, match="voxel_size"):
        geomoe3d.register(*pair[:2], voxel_size=-1)
    with pytest.raises(ConfigError, match="voxel_size"):
        geomoe3d.register(*pair[:2], voxl_size=0.05)


def test_a_voxel_size_too_fine_for_the_limit_is_raised_and_said(pair):
    config = load_config(None, ["voxel_size=0.01", "preparation.max_points=6000"])
    result = Registrar(config).register(*pair[:2])
    assert result.status == "ok"
    assert 0.01 < result.voxel_size < 0.1
    assert max(result.source.num_points, result.target.num_points) <= 6000
    assert any("0.01 gives more than 6000 voxels" in reason for reason in result.reasons)


def test_stray_points_far_away_do_not_matter(pair):
    stray = np.vstack([pair[0], [[1e4, 0.0, 0.0]]])
    result = geomoe3d.register(stray, pair[1])
    assert result.status == "ok"
    assert images_apart(result.T_target_source, pair[2], pair[0]) < 0.03


@pytest.mark.parametrize(
    "assignment",
    ["estimator.name=ransac", "filter.name=spectral", "refinement.name=icp", "matching.name=mutual"],
)
def test_other_parts_land_too(pair, assignment):
    result = Registrar(load_config(None, [assignment])).register(*pair[:2])
    assert rotation_error_deg(result.T_target_source, pair[2]) < 1
    assert translation_error(result.T_target_source, pair[2]) < 0.03


def test_verification_and_refinement_can_be_switched_off(pair):
    plain = Registrar(load_config(None, ["scoring.scorers=[]", "refinement.name=none"]))
    result = plain.register(*pair[:2])
    assert rotation_error_deg(result.T_target_source, pair[2]) < 5


def test_explanation_shows_what_led_to_the_answer(pair):
    explained = Registrar().explain(*pair[:2])
    matched = explained.correspondences
    assert len(matched) == explained.result.num_correspondences == len(explained.weights)
    assert explained.inliers.sum() == explained.result.num_inliers
    assert np.array_equal(matched.source + explained.source.origin, matched.source)
    assert len(explained.source) == len(pair[0])


def test_many_pairs_with_one_registrar(pair, answer):
    results = list(Registrar().register_many([pair[:2], (pair[1], pair[0])]))
    assert results[0].T_target_source.tobytes() == answer.T_target_source.tobytes()
    assert results[1].status == "ok"


def test_filter_weighs_anybodys_correspondences(pair):
    matched = Registrar().explain(*pair[:2]).correspondences
    weights = Registrar(load_config(None, ["filter.name=spectral", "scoring.scorers=[surfaces]"])).filter(
        matched.points, voxel_size=0.05
    )
    true = np.linalg.norm(transform_points(pair[2], matched.source) - matched.target, axis=1) < 0.1
    assert weights.shape == (len(matched),)
    assert weights.min() >= 0
    assert weights.max() == 1
    assert weights[true].mean() > 3 * weights[~true].mean()
    with pytest.raises(InputError, match="shape"):
        Registrar().filter(np.zeros((4, 5)), voxel_size=0.05)


def test_progress_names_every_stage_in_order(pair):
    stages: list[str] = []
    geomoe3d.register(*pair[:2], progress=stages.append)
    assert list(dict.fromkeys(stages)) == [
        "load",
        "preprocess",
        "features",
        "match",
        "propose",
        "score",
        "refine",
        "decide",
    ]


def test_no_warnings_reach_the_user(pair):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        geomoe3d.register(*pair[:2])
        geomoe3d.register(np.outer(np.linspace(0, 3, 500), [1.0, 2.0, 3.0]), pair[1])


def test_correspondences_are_bounded_however_many_points(pair):
    explained = Registrar(load_config(None, ["matching.max_correspondences=300"])).explain(*pair[:2])
    assert isinstance(explained.correspondences, Correspondences)
    assert len(explained.correspondences) == 300
    everything = Registrar(load_config(None, ["matching.max_correspondences=100000"])).explain(*pair[:2])
    mutual = int(everything.correspondences.mutual.sum())
    assert 300 < mutual < len(everything.correspondences)
    assert explained.correspondences.mutual.all()  # of which there are enough


def test_a_first_guess_without_verification_is_refused_before_work(pair):
    config = load_config(None, ["scoring.scorers=[]"])
    with pytest.raises(ConfigError, match=r"--initial .*scoring\.scorers is empty; leave --initial out"):
        geomoe3d.register(pair[0], pair[1], config=config, initial=np.eye(4))


def test_centred_clouds_register_without_their_sensors(pair):
    source, target = (points - points.mean(0) for points in pair[:2])
    result = geomoe3d.register(source, target)
    truth = shift_frames(pair[2], -pair[0].mean(0), -pair[1].mean(0))
    assert result.status == "ok"
    assert images_apart(result.T_target_source, truth, source) < 0.03


def test_a_first_guess_that_is_overruled_is_mentioned(pair, answer):
    wrong = answer.T_target_source @ make_transform(np.eye(3), np.array([0.0, 1.5, 0.0]))
    told = geomoe3d.register(pair[0], pair[1], initial=wrong)
    assert told.status == "ok"
    assert images_apart(told.T_target_source, answer.T_target_source, pair[0]) < 0.01
    assert any("first guess is not the answer" in reason for reason in told.reasons)
    near = geomoe3d.register(pair[0], pair[1], initial=answer.T_target_source)
    assert near.reasons == ()


def test_one_file_given_twice_is_mentioned(pair, tmp_path):
    np.save(tmp_path / "a.npy", pair[0])
    same = geomoe3d.register(tmp_path / "a.npy", str(tmp_path / "a.npy"))
    assert "source and target are the same file" in same.reasons
    np.save(tmp_path / "b.npy", pair[0])
    again = geomoe3d.register(tmp_path / "a.npy", tmp_path / "b.npy")
    told = (
        f"'{tmp_path / 'a.npy'}' is '{tmp_path / 'b.npy'}' once more: the files are the same, byte for byte"
    )
    assert again.status == "ok" and again.reasons == (told,)
    np.save(tmp_path / "b.npy", np.nextafter(pair[0], np.inf))  # as long, and another one
    assert geomoe3d.register(tmp_path / "a.npy", tmp_path / "b.npy").reasons == ()


def test_a_grid_that_leaves_next_to_nothing_is_named(pair):
    result = geomoe3d.register(pair[0], pair[1], voxel_size=2.0)
    assert result.status != "ok"
    assert any("voxels of edge 2; a smaller voxel size" in reason for reason in result.reasons)


@pytest.mark.parametrize("config", [{"seed": 1}, "register.yaml", []])
def test_a_configuration_of_another_kind_is_refused(pair, config):
    with pytest.raises(ConfigError, match=r"expected a RegistrationConfig; load_config\(path"):
        geomoe3d.register(pair[0], pair[1], config=config)


def test_a_section_given_as_a_word_is_explained(pair):
    with pytest.raises(ConfigError, match=r"'estimator' is a section, found 'ransac'.*estimator\.name"):
        geomoe3d.register(pair[0], pair[1], estimator="ransac")


def test_results_can_be_compared_and_kept_in_sets(answer):
    assert answer == answer
    assert len({answer, answer.inverse()}) == 2
    with pytest.raises(InputError, match=r"found the path 'a.ply'.*geomoe3d\.load_points"):
        answer.apply("a.ply")
