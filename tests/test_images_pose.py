"""Pose and homography of two images: right on clean and on wrong matches, and not called sure where they cannot be."""

from __future__ import annotations

import json

import click
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from image_scenes import CAMERA, matches_of, texture
from scipy.optimize import least_squares

from geomoe3d.cli.main import geomoe3d
from geomoe3d.errors import CheckpointError, GeoMoE3DError, InputError, MissingFileError
from geomoe3d.geometry.homography import weighted_dlt
from geomoe3d.geometry.se3 import rotation_angle_deg, rotation_error_deg
from geomoe3d.images.cameras import Camera
from geomoe3d.images.features import detect, match, read_grey
from geomoe3d.images.homography import corner_error, deviations, find_homography, map_points
from geomoe3d.images.network import ImageNetwork
from geomoe3d.images.pose import find_pose
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.build import build_network
from geomoe3d.networks.pretrained import save_pretrained
from geomoe3d.networks.weight_files import WeightCard

pytest.importorskip("cv2")
pytestmark = pytest.mark.usefixtures("one_thread")
H = np.array([[0.9, -0.1, 40], [0.15, 1.0, -30], [1e-4, -5e-5, 1]])


def angle_between(a, b):
    return np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_damaged_image_is_refused(tmp_path, suffix):
    """OpenCV takes it, with grey in place of what is lost."""
    import cv2

    path = tmp_path / f"photo{suffix}"
    cv2.imwrite(str(path), texture())
    whole = path.read_bytes()
    assert read_grey(path).shape == texture().shape[:2]
    middle = len(whole) // 2
    for damaged in (whole[:middle], whole[:middle] + bytes(200) + whole[middle + 200 :]):
        path.write_bytes(damaged)
        with pytest.raises(
            InputError, match=r"photo\..* (is damaged: .*copy it anew|cannot be read as an image)"
        ):
            read_grey(path)


@pytest.mark.parametrize("estimator", ["magsac", "ransac", "eight_point"])
def test_the_pose_of_matches_with_wrong_ones_among_them(estimator):
    pixels, true, T = matches_of(wrong=0 if estimator == "eight_point" else 200)
    found = find_pose(pixels, (CAMERA, CAMERA), estimator=estimator, threshold=1.5)
    assert found.status == "ok", found.reasons
    assert rotation_error_deg(found.T, T) < 0.5
    assert angle_between(found.t, T[:3, 3]) < 1.5
    assert (found.inliers == true).mean() > (0.85 if estimator == "eight_point" else 0.97)
    assert found.residuals[true].max() < 3 < np.median(found.residuals[~true]) if (~true).any() else True


def test_eight_point_on_clean_matches_is_exact_and_weights_decide():
    pixels, true, T = matches_of(noise=0, wrong=50)
    found = find_pose(pixels, (CAMERA, CAMERA), weights=true * 0.7, estimator="eight_point")
    assert np.abs(found.T - T).max() < 1e-6
    spoilt = find_pose(pixels, (CAMERA, CAMERA), estimator="eight_point")
    assert spoilt.status != "ok"


def test_eight_points_through_wrong_matches_are_not_sure_though_chance_finds_some():
    """It rejects none: a pose that few of the matches agree with is a compromise that halves of them share."""
    pixels, *_ = matches_of(1200, wrong=400, noise=0.05)
    for wrong, told in ((0, False), (400, True)):
        found = find_pose(pixels[: 1200 + wrong], (CAMERA, CAMERA), estimator="eight_point")
        assert any("rejects none" in reason for reason in found.reasons) is told
        assert (found.status == "ok") is not told


def test_a_camera_that_only_turned_or_hardly_moved_is_ambiguous_and_its_rotation_right():
    for step in ((0.0, 0, 0), (1e-3, 0, 0)):
        pixels, _, T = matches_of(step=step, turn=10)
        found = find_pose(pixels, (CAMERA, CAMERA))
        assert found.status == "ambiguous"
        assert "only turned" in found.reasons[0]
        assert rotation_angle_deg(found.R @ T[:3, :3].T) < 1


def test_a_planar_scene_is_ambiguous_and_the_other_pose_is_given():
    pixels, _, T = matches_of(planar=True, noise=0.1)
    found = find_pose(pixels, (CAMERA, CAMERA))
    assert found.status == "ambiguous"
    assert "plane" in found.reasons[0]
    poses = [found.T, *found.alternatives]
    assert min(rotation_error_deg(pose, T) for pose in poses) < 1


def test_unrelated_images_are_never_ok_and_few_matches_fail():
    for seed in range(5):
        pixels = matches_of(8, wrong=500, seed=seed)[0]
        assert find_pose(pixels, (CAMERA, CAMERA)).status in ("low_confidence", "failed")
    for few in (np.zeros((0, 4)), pixels[:7], np.full((50, 4), np.nan), np.zeros((50, 4))):
        found = find_pose(few, (CAMERA, CAMERA))
        assert found.status == "failed"
        assert found.T is None
        assert not found.inliers.any()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"weights": np.ones(3)}, "weights"),
        ({"threshold": 0.0}, "threshold"),
        ({"estimator": "magic"}, "magic"),
        ({"threshold": "wide"}, "wide"),
        ({"weights": ["heavy"] * 50}, "weights"),
        ({"seed": 2**31}, "2147483647"),
        ({"seed": 1.5}, "whole number"),
    ],
)
def test_bad_arguments_are_named(changes, words):
    pixels, *_ = matches_of(50)
    with pytest.raises(InputError, match=words):
        find_pose(pixels, (CAMERA, CAMERA), **changes)
    with pytest.raises(InputError, match=words):
        find_homography(pixels, **changes)


@pytest.mark.parametrize(
    ("pixels", "words"),
    [
        ([["a", "b", "c", "d"]] * 20, "real numbers"),
        (None, "NoneType"),
        (np.zeros((20, 4), complex), "complex"),
        ([[1, 2, 3, 4], [5, 6]], "real numbers"),
        (np.full((20, 4), 1e300), "1e[+]300"),
        (np.zeros(4), r"\(4,\)"),
    ],
)
def test_what_are_no_matches_is_refused(pixels, words):
    with pytest.raises(InputError, match=words):
        find_pose(pixels, (CAMERA, CAMERA))
    for estimator in ("magsac", "dlt"):
        with pytest.raises(InputError, match=words):
            find_homography(pixels, estimator=estimator)


@pytest.mark.parametrize("cameras", [CAMERA, (CAMERA,), (CAMERA,) * 3])
def test_a_pose_needs_two_cameras(cameras):
    with pytest.raises(InputError, match="two cameras"):
        find_pose(matches_of(50)[0], cameras)


def test_distortion_is_undone():
    camera = Camera(700, 690, 390, 310, (0.1, -0.05, 1e-3, 2e-3), (800, 600))
    rays = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2))
    r2 = (rays**2).sum(axis=1, keepdims=True)
    xy = (rays[:, :1] * rays[:, 1:]) * [2e-3, 4e-3]
    xy[:, 0] = 2e-3 * rays.prod(axis=1) + 2e-3 * (r2[:, 0] + 2 * rays[:, 0] ** 2)
    xy[:, 1] = 1e-3 * (r2[:, 0] + 2 * rays[:, 1] ** 2) + 4e-3 * rays.prod(axis=1)
    distorted = rays * (1 + 0.1 * r2 - 0.05 * r2**2) + xy
    np.testing.assert_allclose(camera.normalise(distorted * [700, 690] + [390, 310]), rays, atol=1e-5)


@pytest.mark.parametrize("estimator", ["dlt", "ransac", "magsac"])
def test_the_homography_of_clean_matches(estimator):
    first = np.random.default_rng(0).uniform([0, 0], [800, 600], (60, 2))
    found = find_homography(np.hstack([first, map_points(H, first)]), estimator=estimator)
    assert found.status == "ok"
    np.testing.assert_allclose(found.H, H, atol=1e-6, rtol=1e-5)
    assert corner_error(found.H, H, (800, 600)) < 1e-4
    assert found.inliers.all()


def noisy_fit(seed, corner, width, height, num=40, noise=0.7):
    """H of matches with noise in one part of an image of 800 x 600, by least squares of what they are off."""
    rng = np.random.default_rng(seed)
    first = np.array(corner) + rng.uniform(0, 1, (num, 2)) * [width, height]
    second = map_points(H, first) + rng.normal(0, noise, first.shape)
    flat = least_squares(
        lambda h: (map_points(np.append(h, 1.0).reshape(3, 3), first) - second).ravel(),
        H.ravel()[:8],
        x_scale="jac",
    ).x
    return np.append(flat, 1.0).reshape(3, 3), np.hstack([first, second])


@pytest.mark.parametrize("part", [((0, 0), 800, 600), ((500, 100), 200, 300), ((50, 50), 700, 40)])
def test_the_deviation_of_a_corner_is_that_of_many_repeated_fits(part):
    corners = np.array([[0, 0], [799, 0], [799, 599], [0, 599.0]])
    fits = [noisy_fit(seed, *part) for seed in range(200)]
    off = np.array([map_points(found, corners) - map_points(H, corners) for found, _ in fits])
    measured = np.sqrt((off**2).sum(axis=2).mean(axis=0))
    told = np.sqrt(np.mean([deviations(found, x, corners) ** 2 for found, x in fits], axis=0))
    np.testing.assert_allclose(told, measured, rtol=0.35)


@pytest.mark.parametrize("estimator", ["ransac", "magsac", "dlt"])
def test_inliers_in_a_small_part_of_the_image_are_not_called_sure_of_the_rest(estimator):
    """All matches that agree are right, and what they say of the far corner is off by decimetres of the image."""
    rng = np.random.default_rng(3)
    everywhere = rng.uniform([0, 0], [800, 600], (80, 2))
    small = rng.uniform([20, 20], [150, 110], (80, 2))
    for first, status in ((everywhere, "ok"), (small, "low_confidence")):
        pixels = np.hstack([first, map_points(H, first) + rng.normal(0, 0.7, first.shape)])
        wrong = rng.uniform(0, [800, 600, 800, 600], (400, 4))
        weights = np.concatenate([np.ones(80), np.zeros(400) if estimator == "dlt" else np.full(400, 0.5)])
        found = find_homography(np.vstack([pixels, wrong]), weights=weights, estimator=estimator)
        assert found.status == status
        assert found.inliers[:80].mean() > 0.9
        if status == "ok":
            assert corner_error(found.H, H, (800, 600)) < 5.0
        else:
            assert any("or lie in a small part of the image" in reason for reason in found.reasons)


def test_matches_that_fix_no_homography_have_no_deviation():
    line = np.column_stack([np.arange(30.0), 2 * np.arange(30.0)] * 2)
    assert np.isinf(deviations(np.eye(3), line, line[:2, :2])).all()
    assert np.isinf(deviations(np.eye(3), line[:3], line[:2, :2])).all()


def test_dlt_is_differentiable_and_degenerate_matches_fail():
    line = np.column_stack([np.arange(30.0), 2 * np.arange(30.0)] * 2)
    for pixels in (line, np.zeros((30, 4)), line[:3]):
        assert find_homography(pixels, estimator="dlt").status == "failed"
        weights = torch.ones(len(pixels), requires_grad=True)
        weighted_dlt(torch.from_numpy(pixels), weights)[0].sum().backward()
        assert bool(weights.grad.isfinite().all())
    assert corner_error(None, H, (8, 8)) == np.inf
    shift = np.array([[1.0, 0, 3], [0, 1, 4], [0, 0, 1]])
    assert corner_error(shift, np.eye(3), (8, 8)) == pytest.approx(5.0)


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    import cv2

    folder = tmp_path_factory.mktemp("pair")
    image = texture()
    cv2.imwrite(str(folder / "a.png"), image)
    cv2.imwrite(str(folder / "b.png"), cv2.warpPerspective(image, H, (480, 360), borderValue=128))
    return folder


@pytest.mark.parametrize("detector", ["rootsift", "sift", "orb"])
def test_keypoints_match_where_the_warp_puts_them(pair, detector):
    found = match(*(detect(pair / name, detector, 500) for name in ("a.png", "b.png")))
    best = found.pixels[found.distinct()]
    assert len(best) > 40
    off = np.linalg.norm(map_points(H, best[:, :2]) - best[:, 2:], axis=1)
    assert np.median(off) < 1.0
    assert (found.ratio <= 1 + 1e-6).all()


def test_reduced_images_give_keypoints_of_the_whole(pair):
    import cv2

    large = cv2.resize(texture(), None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
    whole, reduced = detect(texture(), most=200), detect(large, most=200, longer_side=480)
    assert reduced.size == (1440, 1080)
    found = match(whole, reduced)
    both = found.pixels[found.distinct()]
    assert np.median(np.linalg.norm((both[:, :2] + 0.5) * 3 - 0.5 - both[:, 2:], axis=1)) < 1.0


def test_an_image_without_structure_has_no_matches():
    flat = detect(np.full((50, 60), 7, np.uint8))
    assert len(match(flat, flat)) == 0
    with pytest.raises(MissingFileError, match="nowhere"):
        detect("nowhere.png")


def run(*words):
    return CliRunner().invoke(geomoe3d, [str(word) for word in words], standalone_mode=False)


def test_homography_on_the_command_line(pair, tmp_path):
    done = run("homography", pair / "a.png", pair / "b.png", "--output", tmp_path / "h.json", "--picture",
               tmp_path / "h.png")  # fmt: skip
    assert "status: ok" in done.output
    answer = json.loads((tmp_path / "h.json").read_text())
    assert corner_error(np.array(answer["H"]), H, (480, 360)) < 3
    assert (tmp_path / "h.png").stat().st_size > 10_000


def test_a_pose_with_guessed_intrinsics_is_not_ok_and_a_network_weighs(pair, tmp_path):
    config = NetworkConfig(correspondence_dim=4, num_layers=1, width=16, num_sub_fields=4, num_heads=2)
    weights = tmp_path / "w.safetensors"
    save_pretrained(weights, build_network(config), WeightCard(architecture={}))
    done = run("pose", pair / "a.png", pair / "b.png", "--weights", weights, "--output", tmp_path / "p.json",
               "--picture", tmp_path / "p.png")  # fmt: skip
    answer = json.loads((tmp_path / "p.json").read_text())
    assert answer["status"] != "ok"
    assert "guess" in answer["reasons"][-1] or answer["status"] == "failed"
    assert done.return_value == 3
    verdict = ImageNetwork(weights)(np.random.default_rng(0).normal(size=(40, 4)))
    assert verdict.logits.shape == verdict.expert.shape == (40,)
    assert len(set(verdict.sub_field)) > 1  # though one of them may take most of every match
    assert "inlier_pixels" in answer
    save_pretrained(tmp_path / "c.safetensors", build_network(NetworkConfig(num_layers=1)), WeightCard({}))
    with pytest.raises(CheckpointError, match="clouds"):
        ImageNetwork(tmp_path / "c.safetensors")


def test_intrinsics_that_are_none_are_named(pair):
    done = run("pose", pair / "a.png", pair / "b.png", "--intrinsics", "700,700")
    assert isinstance(done.exception, InputError)
    assert "fx,fy,cx,cy" in str(done.exception)


def test_images_are_never_written_over_and_outputs_are_refused_before_the_work(pair, tmp_path):
    images = [tmp_path / "a.png", tmp_path / "b.png"]
    for image in images:
        image.write_bytes((pair / image.name).read_bytes())
    before = [image.read_bytes() for image in images]
    for verb in ("pose", "homography"):
        for words, said in (
            (["--picture", images[0], "--force"], "also an input"),
            (["--picture", images[1], "--force"], "also an input"),
            (["--output", tmp_path / "h.txt"], ".json"),
            (["--picture", tmp_path / "m.foo"], ".svg"),
            (["--output", tmp_path / "none" / "h.json"], "does not exist"),
        ):
            done = run(verb, *images, *words)
            assert isinstance(done.exception, GeoMoE3DError), (verb, words)
            assert said in str(done.exception)
            assert "status" not in done.output  # refused before the answer, not after
    assert [image.read_bytes() for image in images] == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "b.png"]


def test_a_copy_of_an_image_and_one_without_keypoints_are_said(pair, tmp_path):
    (tmp_path / "copy.png").write_bytes((pair / "a.png").read_bytes())
    done = run("homography", pair / "a.png", tmp_path / "copy.png")
    assert "both images are the same file" in done.output
    import cv2

    cv2.imwrite(str(tmp_path / "flat.png"), np.full((50, 60), 7, np.uint8))
    done = run("homography", pair / "a.png", tmp_path / "flat.png")
    assert done.return_value == 3
    assert "no keypoints were found in" in done.output + done.stderr
    done = run("pose", pair / "a.png", tmp_path)
    assert isinstance(done.exception, InputError)
    assert "is a folder" in str(done.exception)


def test_intrinsics_of_the_second_image_alone_are_refused(pair):
    done = run("pose", pair / "a.png", pair / "b.png", "--intrinsics1", "700,700,240,180")
    assert isinstance(done.exception, click.UsageError)
    assert "--intrinsics for IMAGE0" in str(done.exception)
