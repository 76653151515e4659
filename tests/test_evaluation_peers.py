"""Other people's methods: each lands where it can, says when it cannot, and is never called when absent."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from method_pairs import MOTION, correspondences
from scipy.spatial.transform import Rotation

from geomoe3d.data.sample import make_sample_pair
from geomoe3d.errors import InputError
from geomoe3d.evaluation import peer as base
from geomoe3d.evaluation.peers import PEERS
from geomoe3d.evaluation.records import MethodInput
from geomoe3d.geometry.se3 import (
    make_transform,
    rotation_error_deg,
    transform_points,
    translation_error,
)

UTM = np.array([583394.0, 5283100.0, 498.0])
ON_CORRESPONDENCES = [name for name, peer in PEERS.items() if "correspondences" in peer.inputs]
ON_CLOUDS = [name for name, peer in PEERS.items() if "clouds" in peer.inputs]
RANSAC = PEERS["open3d-ransac-50k"]
LOCAL = ["icp-identity", "small-gicp"]
UNSEEDED = ["kiss-matcher", "gc-ransac"]


def with_settings(peer, **changes):
    return replace(peer, settings={**peer.settings, **changes})


def present(name: str):
    peer = PEERS[name]
    reason = peer.absent()
    if reason is not None:
        pytest.skip(reason)
    return peer


@pytest.fixture(scope="module")
def room():
    """Two views thinned to 2 cm: KISS-Matcher looks at every point."""
    source, target, T = make_sample_pair(seed=0)
    rng = np.random.default_rng(0)
    points = [cloud.file_points for cloud in (source, target)]
    return *(p[rng.permutation(len(p))[:40_000]] for p in points), T


def clouds(source: np.ndarray, target: np.ndarray) -> MethodInput:
    return MethodInput("room/0-1", source=source, target=target)


@pytest.mark.parametrize("name", ON_CORRESPONDENCES)
def test_lands_on_correspondences(name):
    peer = present(name)
    rows = correspondences(0.6, count=400)
    answer = peer(MethodInput("room/0-1", correspondences=rows))
    assert answer.T_target_source is not None
    assert rotation_error_deg(answer.T_target_source, MOTION) < 1.5
    assert translation_error(answer.T_target_source, MOTION) < 0.08
    assert np.abs(answer.T_target_source[:3, :3].T @ answer.T_target_source[:3, :3] - np.eye(3)).max() < 1e-12


@pytest.mark.parametrize("name", ON_CORRESPONDENCES)
def test_map_coordinates_do_not_matter(name):
    peer = present(name)
    rows = correspondences(0.6, count=400)
    answer = peer(MethodInput("room/0-1", correspondences=rows + np.tile(UTM, 2)))
    moved = transform_points(answer.T_target_source, rows[:, :3] + UTM) - UTM
    assert np.abs(moved - transform_points(MOTION, rows[:, :3])).max() < 0.15


def test_ransac_that_found_nothing_says_so_though_points_lie_close():
    """The two sets of points coincide, so that the library's own fitness is high at the identity."""
    rng = np.random.default_rng(2)
    points = rng.uniform(-1, 1, (60, 3))
    rows = np.hstack([points, points[rng.permutation(60)]])
    T = with_settings(RANSAC, iterations=50)(MethodInput("a/0-1", correspondences=rows)).T_target_source
    if T is not None:  # a motion by chance: then rows must agree with it
        residuals = np.linalg.norm(transform_points(T, rows[:, :3]) - rows[:, 3:], axis=1)
        assert (residuals < 0.1).sum() >= 3
    scaled = np.hstack([points, 9 * points])
    assert RANSAC(MethodInput("a/0-1", correspondences=scaled)).T_target_source is None


@pytest.mark.parametrize("name", ["open3d-feature-ransac", "kiss-matcher"])
def test_lands_on_clouds(name, room):
    peer = present(name)
    if name == "open3d-feature-ransac":
        peer = with_settings(peer, iterations=20_000)  # enough for this pair
    source, target, T = room
    answer = peer(clouds(source, target))
    assert answer.T_target_source is not None
    assert rotation_error_deg(answer.T_target_source, T) < 15  # the benchmark's rule: no refinement follows
    assert translation_error(answer.T_target_source, T) < 0.30
    assert all(seconds >= 0 for seconds in answer.stages.values())
    assert answer.stages["features"] > 0


@pytest.mark.parametrize("name", LOCAL)
def test_local_methods_land_from_close_by_only(name, room):
    peer = present(name)
    source, _, _ = room
    nudge = make_transform(
        Rotation.from_rotvec([0.03, 0.02, -0.04]).as_matrix(), np.array([0.05, -0.03, 0.04])
    )
    halves = source[::2] + UTM, transform_points(nudge, source[1::2]) + UTM
    found = peer(clouds(*halves)).T_target_source
    moved = transform_points(found, source + UTM) - UTM
    assert np.linalg.norm(moved - transform_points(nudge, source), axis=1).max() < 0.03
    wide = make_transform(Rotation.from_rotvec([0, 0, 2.5]).as_matrix(), np.array([0.5, 0, 0]))
    lost = peer(clouds(source[::2], transform_points(wide, source[1::2]))).T_target_source
    assert lost is None or rotation_error_deg(lost, wide) > 15


@pytest.mark.parametrize("name", ON_CORRESPONDENCES)
def test_hopeless_correspondences_never_give_the_identity(name):
    peer = present(name)
    rng = np.random.default_rng(1)
    hopeless = [
        np.hstack([rng.uniform(-1, 1, (3, 3)), 100 * rng.uniform(-1, 1, (3, 3))]),
        rng.uniform(-1, 1, (2, 6)),
        np.zeros((0, 6)),
    ]
    if name.startswith("open3d-ransac"):
        hopeless.append(np.hstack([rng.uniform(-1, 1, (50, 3)), 100 * rng.uniform(-1, 1, (50, 3))]))
    for rows in hopeless:
        T = peer(MethodInput("a/0-1", correspondences=rows)).T_target_source
        assert T is None or not np.allclose(T, np.eye(4))


@pytest.mark.parametrize("name", ON_CLOUDS)
def test_hopeless_clouds_never_give_the_identity(name):
    """KISS-Matcher would crash on some of these, others answer with the identity."""
    peer = present(name)
    rng = np.random.default_rng(1)
    for source, target in (
        (rng.uniform(size=(50, 3)), 1000 + 20 * rng.uniform(size=(60, 3))),
        (rng.uniform(size=(3, 3)), rng.uniform(size=(3, 3)) + 30),
        (np.zeros((0, 3)), np.zeros((5, 3))),
    ):
        assert peer(clouds(source, target)).T_target_source is None


@pytest.mark.parametrize("name", sorted(set(ON_CORRESPONDENCES) - set(UNSEEDED)))
def test_same_seed_same_answer(name):
    peer, rows = present(name), correspondences(0.3, count=400)
    one, two = (
        peer(MethodInput("a/0-1", correspondences=rows, seed=4)).T_target_source.tobytes() for _ in range(2)
    )
    assert one == two


def test_feature_ransac_is_seeded(room):
    source, target, _ = room
    given = MethodInput("room/0-1", source=source, target=target, voxel_size=0.1, seed=2)
    quick = with_settings(PEERS["open3d-feature-ransac"], iterations=5000)
    one, two = (quick(given).T_target_source.tobytes() for _ in range(2))
    assert one == two


@pytest.mark.parametrize("name", list(PEERS))
def test_absent_library_is_reported_not_called(name, monkeypatch):
    peer = PEERS[name]
    find = base.importlib.util.find_spec
    monkeypatch.setattr(
        base.importlib.util,
        "find_spec",
        lambda wanted, *rest: None if wanted == peer.module else find(wanted),
    )
    monkeypatch.setitem(sys.modules, peer.module, None)  # an import would raise
    reason = peer.absent()
    assert reason is not None
    assert f"pip install {peer.distributions[0]}" in reason
    assert name in reason
    assert peer.identity()["settings"] == PEERS[name].identity()["settings"]


def test_a_library_that_cannot_be_loaded_is_absent(tmp_path, monkeypatch):
    (tmp_path / "kiss_matcher.py").write_text(
        "raise ImportError('libGL.so.1: cannot open shared object file')"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "kiss_matcher", raising=False)
    reason = PEERS["kiss-matcher"].absent()
    assert reason is not None
    assert "installed but cannot be loaded (libGL.so.1" in reason


@pytest.mark.parametrize("name", list(PEERS))
def test_wrong_track_is_an_error(name):
    peer = PEERS[name]
    rows, points = np.zeros((10, 6)), np.zeros((10, 3))
    given = {
        "correspondences": MethodInput("a/0-1", source=points, target=points),
        "clouds": MethodInput("a/0-1", correspondences=rows),
    }
    for kind in ("correspondences", "clouds"):
        if peer.inputs == {kind}:
            with pytest.raises(InputError, match=f"a/0-1: '{name}' takes {kind}"):
                peer(given[kind])


def test_a_librarys_complaint_is_an_error_of_the_pair():
    def complain(*_, **__):
        raise RuntimeError("[Open3D Error] no")

    with pytest.raises(InputError, match=r"a/0-1: 'open3d-ransac-50k': RuntimeError: \[Open3D Error\] no"):
        replace(RANSAC, register=complain)(
            MethodInput("a/0-1", correspondences=correspondences(1.0, count=400))
        )


def test_identity_follows_the_settings():
    assert with_settings(RANSAC, iterations=7).identity() != RANSAC.identity()
    settings = [PEERS[f"open3d-ransac-{size}"].identity()["settings"]["iterations"] for size in ("50k", "1m")]
    assert settings == [50_000, 1_000_000]
