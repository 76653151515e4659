"""Channels of a network that scores transforms: what the true one looks like, and what must not matter."""

from __future__ import annotations

import numpy as np
import pytest
from corner_scenes import VOXEL, random_motion, scene
from judged_motions import SMALL, aligned, column, network
from scipy.spatial.transform import Rotation

from geomoe3d.config import build_config
from geomoe3d.errors import ConfigError, InputError
from geomoe3d.geometry.draws import drawn_rows
from geomoe3d.geometry.se3 import make_transform, transform_points
from geomoe3d.networks.aligned import CHANNELS, PRIOR_KERNEL
from geomoe3d.networks.architecture import CHANNEL_WIDTHS, NetworkConfig
from geomoe3d.networks.folded import FoldedGeoMoE
from geomoe3d.networks.inputs import pair_input
from geomoe3d.networks.motion_judge import MotionJudge
from geomoe3d.types import Correspondences

pytestmark = pytest.mark.usefixtures("one_thread")


def test_the_true_motion_looks_better_than_a_wrong_one_in_every_respect() -> None:
    rows, T = scene()
    wrong = T @ make_transform(Rotation.from_rotvec([0.0, 0.9, 0.0]).as_matrix(), np.array([0.4, 0.3, -0.8]))
    channels = aligned(rows, np.stack([T, wrong]))
    assert channels.shape == (2, 300, CHANNEL_WIDTHS["aligned"])
    assert np.isfinite(channels).all()
    assert np.abs(channels).max() <= 5
    good, bad = channels
    for name in ("residual", "source_near", "source_in_plane", "target_in_plane", "matched_normals"):
        assert column(good, name).mean() > column(bad, name).mean(), name
    in_front = [sum(column(c, f"{side}_in_front").mean() for side in ("source", "target")) for c in channels]
    assert in_front[0] < in_front[1]


def test_channels_do_not_change_when_either_scan_is_moved() -> None:
    rows, T = scene()
    rng = np.random.default_rng(3)
    A, B = random_motion(rng), random_motion(rng)
    moved = np.hstack([transform_points(A, rows[:, :3]), transform_points(B, rows[:, 3:])])
    before = aligned(rows, T[None])
    after = aligned(moved, (B @ T @ np.linalg.inv(A))[None], (A[:3, 3], B[:3, 3]))
    # Pixels of the range images may fall otherwise; everything else is the same.
    free = [CHANNELS.index(n) for n in CHANNELS if n.endswith(("seen", "in_front", "on_view"))]
    rest = [k for k in range(len(CHANNELS)) if k not in free]
    np.testing.assert_allclose(after[..., rest], before[..., rest], atol=1e-4)
    assert np.abs(after[..., free].mean(1) - before[..., free].mean(1)).max() < 0.05


def test_without_the_sensors_places_free_space_says_nothing() -> None:
    rows, T = scene()
    channels = aligned(rows, T[None], (None, None))
    for name in ("source_seen", "source_in_front", "target_on_view", "source_range"):
        assert not column(channels, name).any()
    assert column(channels, "matched_normals").min() >= 0  # lines, not directions


def test_channels_need_their_own_form_of_network() -> None:
    for change in ({"motion_form": "difference"}, {"knn_space": "compatibility"},
                   {"extra_channels": ("aligned", "ratio")}):  # fmt: skip
        with pytest.raises(ConfigError, match="aligned"):
            build_config(NetworkConfig, {**SMALL, **change})
    with pytest.raises(InputError, match="scores transforms"):
        pair_input(scene()[0], VOXEL, build_config(NetworkConfig, SMALL))


def test_the_first_prior_keeps_what_the_motion_brings_together() -> None:
    rows, T = scene()
    channels = aligned(rows, T[None])[0]
    gap = np.linalg.norm(transform_points(T, rows[:, :3]) - rows[:, 3:], axis=1)
    np.testing.assert_array_equal(column(channels, "residual") > PRIOR_KERNEL, gap < 2 * VOXEL)


def test_no_motions_are_no_channels() -> None:
    rows, _ = scene()
    assert aligned(rows, np.zeros((0, 4, 4))).shape == (0, 300, len(CHANNELS))
    assert (
        MotionJudge(FoldedGeoMoE.of(network())).about(Correspondences(rows), voxel_size=VOXEL)(
            np.zeros((0, 4, 4))
        )
        == []
    )


@pytest.mark.parametrize("count", [300, 1700])
def test_the_share_that_preserves_length_counts_others_alone(count: int) -> None:
    rows, T = scene(count=count)
    found = column(aligned(rows, T[None])[0], "degree")
    unit = (rows - rows.mean(0)) / VOXEL
    anchors = drawn_rows(rows / (2 * VOXEL), 1.0, 1000)  # beyond a thousand some stand for all
    gap = np.abs(
        np.linalg.norm(unit[:, None, :3] - unit[None, anchors, :3], axis=2)
        - np.linalg.norm(unit[:, None, 3:] - unit[None, anchors, 3:], axis=2)
    )
    agrees = (gap < 2.0) & (np.arange(count)[:, None] != anchors)
    np.testing.assert_allclose(found, 5 * agrees.sum(1) / len(anchors), atol=0.02)
    assert found.min() >= 0
