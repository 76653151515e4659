"""Motions drawn closer by keypoints: towards the truth, whatever is matched, in any unit and frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from corner_scenes import AT_ZERO, VOXEL, scene
from scipy.spatial.transform import Rotation

from geomoe3d.clouds.pair import Pair
from geomoe3d.config import EstimatorConfig
from geomoe3d.estimators.consensus import ConsensusEstimator
from geomoe3d.estimators.keypoint_alignment import KeypointAligner
from geomoe3d.estimators.proposals import propose
from geomoe3d.geometry.se3 import (
    make_transform,
    residuals,
    rotation_error_deg,
    shift_frames,
    transform_points,
    translation_error,
)
from geomoe3d.types import Correspondences, FloatArray, Hypothesis

THRESHOLD = 2 * VOXEL


def nudged(T: FloatArray, points: FloatArray, seed: int) -> FloatArray:
    """T turned by 3 degrees about where the points go, and shifted by 6 cm."""
    rng = np.random.default_rng(seed)
    turn, shift = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    centre = transform_points(T, points.mean(0)[None])[0]
    R = Rotation.from_rotvec(np.radians(3) * turn).as_matrix()
    return make_transform(R, centre - R @ centre + 0.06 * shift) @ T


@pytest.mark.parametrize("seed", range(4))
def test_a_motion_nearby_is_drawn_to_the_truth(seed: int) -> None:
    rows, T = scene(seed, count=1000, share=0.1)
    start = nudged(T, rows[:, :3], seed)
    found = KeypointAligner(rows, THRESHOLD)(start)
    centre = rows[:, :3].mean(0)[None]
    gap = [np.linalg.norm(transform_points(M, centre) - transform_points(T, centre)) for M in (start, found)]
    assert gap[1] < 0.3 * gap[0]
    assert rotation_error_deg(found, T) < 1 < rotation_error_deg(start, T)
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(found[3], [0, 0, 0, 1])


def test_where_a_fifth_of_the_correspondences_agree_their_fit_stands() -> None:
    rows, T = scene(1, count=600, share=0.3)
    assert KeypointAligner(rows, THRESHOLD)(T) is T
    fewer = np.vstack([rows[:90], rows[180:]])  # 90 of 510
    assert KeypointAligner(fewer, THRESHOLD)(T) is not T


def test_which_point_belongs_to_which_does_not_matter_and_nothing_is_changed() -> None:
    rows, T = scene(1, count=600, share=0.1)
    start = nudged(T, rows[:, :3], 1)
    kept = rows.copy(), start.copy()
    order = np.random.default_rng(0).permutation(len(rows))
    shuffled = np.hstack([rows[:, :3], rows[order, 3:]])
    one, other = (KeypointAligner(given, THRESHOLD)(start) for given in (rows, shuffled))
    assert one.tobytes() == other.tobytes() != start.tobytes()
    np.testing.assert_array_equal(rows, kept[0])
    np.testing.assert_array_equal(start, kept[1])


@pytest.mark.parametrize(("scale", "origin"), [(1e-3, 0.0), (1e3, 0.0), (1.0, 5e5)])
def test_unit_and_frame_do_not_matter(scale: float, origin: float) -> None:
    rows, T = scene(2, count=600, share=0.1)
    start = nudged(T, rows[:, :3], 2)
    plain = KeypointAligner(rows, THRESHOLD)(start)
    moved = start.copy()
    moved[:3, 3] = scale * start[:3, 3] + origin - start[:3, :3] @ np.full(3, origin)
    found = KeypointAligner(scale * rows + origin, scale * THRESHOLD)(moved)
    found[:3, 3] = (found[:3, 3] - origin + found[:3, :3] @ np.full(3, origin)) / scale
    assert rotation_error_deg(found, plain) < 1e-3
    assert translation_error(found, plain) < 1e-4


def test_where_nothing_is_near_the_motion_stays_as_it_was() -> None:
    rows, T = scene(3, share=0.1)
    far = T.copy()
    far[:3, 3] += 100
    assert KeypointAligner(rows, THRESHOLD)(far) is far


@pytest.mark.parametrize("count", [0, 1, 3, 9])
def test_few_points_are_no_surface(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rows, T = scene(3, share=0.0)
    monkeypatch.setattr("geomoe3d.estimators.keypoint_alignment.align", None)  # is not even called
    assert KeypointAligner(rows[:count], THRESHOLD)(T) is T


def test_points_that_coincide_do_not_bring_it_down() -> None:
    rows, T = scene(3, share=0.1)
    same = np.hstack([rows[:, :3], np.repeat(rows[:1, 3:], len(rows), axis=0)])
    assert KeypointAligner(same, THRESHOLD)(T) is T


def test_a_motion_that_would_lose_half_of_its_correspondences_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    rows, T = scene(1, count=600, share=0.1)
    slid = T.copy()
    slid[:3, 3] += 0.1 * THRESHOLD
    far = T.copy()
    far[:3, 3] += 2 * THRESHOLD
    for given, kept in ((slid, False), (far, True)):
        in_units = KeypointAligner(rows, THRESHOLD)
        monkeypatch.setattr(
            "geomoe3d.estimators.keypoint_alignment.align",
            lambda *_, T=given, a=in_units, **__: (scaled(T, a), None),
        )
        found = in_units(T)
        assert (found is T) is kept


def scaled(T: FloatArray, aligner: KeypointAligner) -> FloatArray:
    """T as the alignment would give it: about the keypoints' means, in its units."""
    source, target = aligner._centres
    made = shift_frames(T, -source, -target)
    made[:3, 3] /= aligner._unit
    return made


def test_hypotheses_count_the_inliers_of_the_motion_drawn_closer() -> None:
    rows, T = scene(2, count=1000, share=0.1)
    start = nudged(T, rows[:, :3], 2)
    before = Hypothesis(start, 7.0, 1)
    (found,) = KeypointAligner(rows, THRESHOLD).hypotheses([before])
    gaps = residuals(found.T_target_source, rows[:, :3], rows[:, 3:])
    assert found.num_inliers == (gaps < THRESHOLD).sum() > 90
    assert found.proposal_score == 7.0


@pytest.mark.parametrize("normals", [False, True])
def test_proposals_of_clouds_are_left_to_the_clouds(normals: bool) -> None:
    rows, _ = scene(5, count=500, share=0.05)
    zero = np.zeros((len(rows), 3))
    given = Correspondences(rows, viewpoints=AT_ZERO, normals=(zero, zero) if normals else None)

    def motions(count: int) -> list[bytes]:
        found = propose(
            ConsensusEstimator(num_hypotheses=8),
            Pair(given, THRESHOLD / 2, THRESHOLD),
            np.ones(len(rows)),
            EstimatorConfig(num_aligned=count),
        )
        return [h.T_target_source.tobytes() for h in found]

    assert (motions(3) == motions(0)) is normals


def test_so_many_proposals_are_drawn_closer_as_the_configuration_says() -> None:
    rows, T = scene(5, count=500, share=0.05)

    def run(count: int) -> list[Any]:
        return propose(
            ConsensusEstimator(num_hypotheses=8),
            Pair(Correspondences(rows, viewpoints=AT_ZERO), THRESHOLD / 2, THRESHOLD),
            np.ones(len(rows)),
            EstimatorConfig(num_aligned=count),
        )

    none, some = run(0), run(3)
    differs = [
        a.T_target_source.tobytes() != b.T_target_source.tobytes() for a, b in zip(none, some, strict=True)
    ]
    assert any(differs[:3])
    assert not any(differs[3:])
    assert [h.proposal_score for h in none] == [h.proposal_score for h in some]
    assert translation_error(some[0].T_target_source, T) < translation_error(none[0].T_target_source, T)
