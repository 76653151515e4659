"""The clouds as witnesses: range images, evidence of motions right and wrong, distinct alternatives."""

from __future__ import annotations

from dataclasses import astuple, replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geomoe3d.clouds.pair import Pair
from geomoe3d.clouds.prepare import prepare
from geomoe3d.clouds.range_image import RangeImage
from geomoe3d.clouds.viewpoint import find_viewpoints
from geomoe3d.config import PreparationConfig, RegistrationConfig
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.decision.distinct import are_different, distinct
from geomoe3d.decision.selection import Selection
from geomoe3d.errors import InputError
from geomoe3d.features.base import with_features
from geomoe3d.features.fpfh import FpfhDescriptor
from geomoe3d.geometry.se3 import inverse, make_transform, transform_points
from geomoe3d.refinement.base import NoRefiner
from geomoe3d.runtime.timing import StageClock
from geomoe3d.scoring.surfaces import SurfaceScorer, Verifier, evidence_of
from geomoe3d.types import Correspondences, Hypothesis, PreparedCloud

CONFIG = PreparationConfig()
THRESHOLD = 0.1


@pytest.fixture(scope="module")
def pair() -> tuple[PreparedCloud, PreparedCloud, np.ndarray]:
    source, target, T = make_sample_pair(0)
    views = find_viewpoints(source, target, "auto")
    assert views[0] is not None
    made = [
        with_features(prepare(cloud, 0.05, CONFIG, viewpoint=view), FpfhDescriptor())
        for cloud, view in zip((source, target), views, strict=True)
    ]
    return made[0], made[1], T


@pytest.fixture(scope="module")
def verifier(pair) -> Verifier:
    return Verifier(pair[0], pair[1], THRESHOLD)


def turned(degrees: float, axis: int, shift: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    R = Rotation.from_rotvec(np.radians(degrees) * np.eye(3)[axis]).as_matrix()
    return make_transform(R, np.array(shift, dtype=float))


# ---- range images ---------------------------------------------------------------------------------------


def wall(distance: float = 3.0) -> np.ndarray:
    """A plane x = distance, 4 m wide and high, points 3 cm apart."""
    axis = np.arange(-2, 2, 0.03)
    y, z = (a.ravel() for a in np.meshgrid(axis, axis))
    return np.column_stack([np.full(len(y), distance), y, z])


def look_at(image: RangeImage, points: np.ndarray, margin: float) -> tuple[int, int]:
    """How many points fall where the sensor saw something, and how many of them in front by more."""
    margins, distances = image.margins(points)
    np.testing.assert_allclose(distances, np.linalg.norm(points - image.viewpoint, axis=1))
    return int(np.isfinite(margins).sum()), int((margins < -margin).sum())


@pytest.mark.parametrize("seed", [None, 0, 1])
def test_points_before_behind_and_beside_a_wall(seed: int | None) -> None:
    """The answer is the same wherever the sensor stands and however it is turned."""
    T = np.eye(4)
    if seed is not None:
        rng = np.random.default_rng(seed)
        T = make_transform(Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3) * 10)
    image = RangeImage.of(transform_points(T, wall()), T[:3, 3])
    before = np.array([[1.5, 0, 0], [1.0, 0.4, -0.3], [2.5, -1, 1], [0.3, 0.05, 0.05]])
    near = np.array([[2.85, 0, 0], [3.05, 0.2, 0.2]])
    behind = np.array([[4.0, 0, 0], [9.0, 1, 2]])
    beside = np.array([[-3.0, 0, 0], [0, 3, 0], [0, 0, -3], [1, 3, 0]])
    for points, expected in (
        (before, (4, 4)),
        (near, (2, 0)),
        (behind, (2, 0)),
        (beside, (0, 0)),
        (np.vstack([before, near, behind, beside]), (8, 4)),
        (np.zeros((0, 3)), (0, 0)),
    ):
        assert look_at(image, transform_points(T, points), 0.2) == expected
    assert look_at(image, transform_points(T, near), 0.01)[1] <= 1
    assert look_at(image, transform_points(T, before), 5.0) == (4, 0)


def test_a_surface_never_violates_its_own_free_space() -> None:
    rng = np.random.default_rng(2)
    for _ in range(5):
        points = rng.normal(size=(500, 3)) + rng.normal(size=3)
        image = RangeImage.of(points, rng.normal(size=3))
        assert look_at(image, points, 1e-9) == (500, 0)


def test_axes_are_a_rotation_and_the_image_counts_every_point() -> None:
    points = wall()
    image = RangeImage.of(points, np.zeros(3))
    np.testing.assert_allclose(image.axes @ image.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(image.axes) == pytest.approx(1)
    assert image.axes[0] @ [1, 0, 0] > 0.999
    assert image.nearest.shape == (72, 144)
    seen = np.isfinite(image.nearest)
    assert image.nearest[seen].min() == pytest.approx(3, abs=0.01)
    assert image.nearest[seen].max() < np.sqrt(17) + 0.01
    assert (image.nearest[~seen] == -np.inf).all() and 0.05 < seen.mean() < 0.2


def test_points_on_the_sensor_itself_do_no_harm() -> None:
    points = np.vstack([wall(), np.zeros((1, 3))])
    image = RangeImage.of(points, np.zeros(3))
    assert np.isfinite(image.axes).all()
    assert look_at(image, np.zeros((3, 3)), 0.1)[0] in (0, 3)
    lonely = RangeImage.of(np.zeros((1, 3)), np.zeros(3))
    assert np.isfinite(lonely.axes).all()


# ---- evidence -------------------------------------------------------------------------------------------


def test_the_true_motion_beats_random_and_neighbouring_ones(pair, verifier: Verifier) -> None:
    source, _, T = pair
    truth = verifier.evidence(T)
    assert truth.overlap > 0.3
    assert truth.free_space_violation < 0.05
    centre = source.points.mean(0)
    rng = np.random.default_rng(0)
    wrong = []
    for k in range(60):
        R = Rotation.random(random_state=k).as_matrix()
        place = transform_points(T, centre[None])[0] + rng.normal(size=3) * 0.5
        wrong.append(make_transform(R, place - R @ centre))
    for axis in range(3):
        for step in (-1, 1):
            wrong += [turned(15 * step, axis) @ T, turned(0, 0, tuple(0.5 * step * np.eye(3)[axis])) @ T]
    scores = [verifier.evidence(W).surface_score for W in wrong]
    assert truth.surface_score > 2 * max(scores)


def test_the_score_falls_as_the_motion_leaves_the_truth(pair, verifier: Verifier) -> None:
    T = pair[2]
    for axis in range(3):
        scores = [verifier.evidence(turned(angle, axis) @ T).surface_score for angle in (0, 2, 6, 20)]
        assert scores == sorted(scores, reverse=True)


def test_far_away_there_is_no_evidence(verifier: Verifier) -> None:
    far = verifier.evidence(turned(0, 0, (1000.0, 0, 0)))
    assert (far.overlap, far.agreement, far.distinctiveness, far.surface_score) == (0, 0, 0, 0)
    assert far.free_space_violation >= 0


def test_shares_are_shares_and_the_score_is_what_the_class_says(pair, verifier: Verifier) -> None:
    for T in (pair[2], np.eye(4), turned(40, 1) @ pair[2], turned(180, 1) @ pair[2]):
        e = verifier.evidence(T)
        assert 0 <= e.agreement <= e.overlap <= 1
        assert -e.agreement <= e.distinctiveness <= e.agreement * (np.log(257) - 1)
        assert 0 <= e.free_space_violation <= 2
        assert e.surface_score == pytest.approx(
            max(e.distinctiveness, 0) * np.exp(-10 * e.free_space_violation)
        )


def test_evidence_equals_its_definition_written_plainly(pair) -> None:
    """All points asked, all targets as the random sample: loops over the documented formula."""
    source, target, T = pair
    rng = np.random.default_rng(1)
    keep = np.sort(rng.choice(len(source), 200, replace=False))
    source = replace(
        source, points=source.points[keep], normals=source.normals[keep], features=source.features[keep]
    )
    keep = np.sort(rng.choice(len(target), 250, replace=False))
    target = replace(
        target, points=target.points[keep], normals=target.normals[keep], features=target.features[keep]
    )
    threshold = 0.3
    e = Verifier(source, target, threshold).evidence(T)
    overlap = agreement = surprise = 0.0
    for p, n, f in zip(transform_points(T, source.points), source.normals, source.features, strict=True):
        distances = np.linalg.norm(target.points - p, axis=1)
        j = distances.argmin()
        if distances[j] >= threshold:
            continue
        overlap += 1
        if target.normals[j] @ T[:3, :3] @ n <= 0.7:
            continue
        agreement += 1
        own = np.linalg.norm(target.features[j] - f)
        rank = (np.linalg.norm(target.features - f, axis=1) < own - 1e-6).sum()
        surprise += (-np.log((1 + rank) / 251) - 1) * (1 - (distances[j] / threshold) ** 2)
    assert e.overlap == pytest.approx(overlap / 200, abs=1e-12)
    assert e.agreement == pytest.approx(agreement / 200, abs=0.011)  # a cosine at the limit may round
    assert e.distinctiveness == pytest.approx(surprise / 200, abs=0.02)


def test_overlap_agrees_with_all_points(pair, verifier: Verifier) -> None:
    source, target, T = pair
    distance, _ = cKDTree(target.points).query(transform_points(T, source.points))
    assert verifier.evidence(T).overlap == pytest.approx((distance < THRESHOLD).mean(), abs=0.05)


def test_free_space_tells_a_view_through_a_wall(pair, verifier: Verifier) -> None:
    """Half a metre towards the sensor the walls hang in the air that it looked through."""
    T = pair[2]
    pushed = turned(0, 0, (0, 0, -0.7)) @ T
    assert verifier.evidence(pushed).free_space_violation > 0.3
    assert verifier.evidence(T).free_space_violation < 0.05


def test_without_viewpoints_signs_of_normals_and_free_space_are_not_asked(pair) -> None:
    source, target, T = pair
    blind = [replace(cloud, viewpoint=None) for cloud in (source, target)]
    flipped = replace(blind[0], normals=-blind[0].normals)
    plain, other = Verifier(*blind, THRESHOLD).evidence(T), Verifier(flipped, blind[1], THRESHOLD).evidence(T)
    assert plain == other
    assert plain.free_space_violation == 0
    assert plain.distinctiveness > 0.2
    # One viewpoint alone is none.
    assert Verifier(source, blind[1], THRESHOLD).evidence(T) == plain
    # With viewpoints the sign matters.
    facing_away = replace(source, normals=-source.normals)
    assert Verifier(facing_away, target, THRESHOLD).evidence(T).agreement < 0.05


def test_exchanged_roles_see_the_same_violations(pair, verifier: Verifier) -> None:
    source, target, T = pair
    back = Verifier(target, source, THRESHOLD, num_queries=10**6)
    forth = Verifier(source, target, THRESHOLD, num_queries=10**6)
    for W in (T, turned(0, 0, (0, 0, -0.7)) @ T, turned(30, 1) @ T):
        a, b = forth.evidence(W).free_space_violation, back.evidence(inverse(W)).free_space_violation
        assert a == pytest.approx(b, abs=1e-3)


def test_the_frame_of_either_cloud_does_not_matter(pair) -> None:
    source, target, T = pair
    A = make_transform(Rotation.random(random_state=3).as_matrix(), np.array([5.0, -3, 2]))
    moved = replace(
        source,
        points=transform_points(A, source.points),
        normals=source.normals @ A[:3, :3].T,
        viewpoint=transform_points(A, source.viewpoint[None])[0],
    )
    # All are asked: a draw goes by places, and so by the frame.
    a, b = (Verifier(s, target, THRESHOLD, num_queries=10**6) for s in (source, moved))
    a, b = a.evidence(T), b.evidence(T @ inverse(A))
    assert b.overlap == pytest.approx(a.overlap, abs=1e-3)
    assert b.distinctiveness == pytest.approx(a.distinctiveness, abs=1e-3)
    assert b.free_space_violation == pytest.approx(a.free_space_violation, abs=1e-2)


def test_the_seed_decides_the_choice_and_matters_little(pair) -> None:
    source, target, T = pair
    a, b, c = (Verifier(source, target, THRESHOLD, seed=seed).evidence(T) for seed in (0, 0, 1))
    assert a == b
    assert a != c
    assert a.surface_score == pytest.approx(c.surface_score, rel=0.15)


def test_clouds_without_features_are_refused(pair) -> None:
    source, target, _ = pair
    for a, b in ((replace(source, features=None), target), (source, replace(target, features=None))):
        with pytest.raises(InputError, match="with_features"):
            Verifier(a, b, THRESHOLD)


# ---- ranking --------------------------------------------------------------------------------------------


def selection(pair) -> Selection:
    source, target = pair[:2]
    seen = Pair(Correspondences(np.zeros((0, 6))), source.voxel_size, THRESHOLD, 0, source, target)
    scorers = {"surfaces": SurfaceScorer()}
    return Selection(seen, scorers, NoRefiner().about(seen), RegistrationConfig(), StageClock())


def test_ranking_puts_the_truth_first_and_keeps_every_hypothesis(pair, verifier: Verifier) -> None:
    T = pair[2]
    motions = [
        turned(8, 1) @ T,
        turned(0, 0, (500.0, 0, 0)),
        T,
        turned(0, 0, (0, 700.0, 0)),
        turned(5, 0) @ T,
    ]
    hypotheses = [Hypothesis(motion, float(k), k) for k, motion in enumerate(motions)]
    chosen = selection(pair)
    chosen.add(hypotheses)
    ranked = chosen.hypotheses
    assert ranked[0] is hypotheses[2]
    assert {id(h) for h in ranked} == {id(h) for h in hypotheses}
    scores = [h.score for h in ranked]
    assert scores == sorted(scores, reverse=True)
    for h in ranked:
        assert evidence_of(h) == verifier.evidence(h.T_target_source)
        assert h.score == evidence_of(h).surface_score
    nowhere = [h for h in ranked if evidence_of(h).distinctiveness == 0 and evidence_of(h).overlap == 0]
    # Equal evidence keeps the given order.
    assert [h.num_inliers for h in nowhere] == [1, 3]
    assert verifier(np.zeros((0, 4, 4))) == []


def test_another_motion_is_one_that_shifts_or_turns_clearly(pair) -> None:
    source, _, T = pair
    centre = transform_points(T, source.points.mean(0)[None])[0]

    def around_centre(degrees: float, shift: float = 0.0) -> Hypothesis:
        R = turned(degrees, 2)
        R[:3, 3] = centre - R[:3, :3] @ centre + [shift, 0, 0]
        return Hypothesis(R @ T, 0.0, 0)

    same = [around_centre(0), around_centre(14.9), around_centre(0, 0.29), around_centre(14, 0.28)]
    assert not any(are_different(T, h.T_target_source, source, 0.3) for h in same)
    for other in (around_centre(15.1), around_centre(0, 0.31), around_centre(180)):
        assert are_different(T, other.T_target_source, source, 0.3)
        assert distinct([Hypothesis(T), *same, other], source, 0.3, 5)[1] is other


def test_hypotheses_asked_together_get_what_each_gets_alone(pair, verifier: Verifier) -> None:
    T = pair[2]
    motions = [T, *(turned(30 * k, k % 3, (0.1 * k, 0, 0)) @ T for k in range(1, 13))]
    motions.insert(7, turned(0, 0, (100, 0, 0)) @ T)  # where nothing meets
    found = verifier(np.array(motions))
    assert len(found) == len(motions)
    for transform, evidence in zip(motions, found, strict=True):
        alone = verifier.evidence(transform)
        assert astuple(evidence)[:4] == pytest.approx(astuple(alone)[:4], rel=1e-12, abs=1e-12)
    assert max(found, key=lambda evidence: evidence.surface_score) is found[0]
