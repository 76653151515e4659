"""Canonical frames and motions from seeds: nothing of how clouds lay is left, and right motions are found."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tiny_networks import TINY

from geomoe3d.config import build_config
from geomoe3d.errors import ConfigError
from geomoe3d.geometry.se3 import rotation_error_deg
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.frames import canonical_rotations, principal_axes
from geomoe3d.networks.inputs import pair_input
from geomoe3d.networks.seeded_motions import length_affinity, seeded_motion, spread_seeds
from geomoe3d.training.augment import AugmentationConfig, augment
from geomoe3d.training.batches import make_sample
from geomoe3d.training.pairs import TrainingPair
from geomoe3d.training.synthetic import SyntheticConfig, SyntheticPairs

pytestmark = pytest.mark.usefixtures("one_thread")

PAIRS = SyntheticPairs(
    SyntheticConfig(correspondences=(300, 300), inlier_ratio=(0.3, 0.3), voxel_size=(0.05, 0.05))
)
TURN = AugmentationConfig(swap=0, jitter=0)


def turned(pair: TrainingPair, seed: int) -> TrainingPair:
    return augment(pair, TURN, None, np.random.default_rng(seed))


@pytest.mark.parametrize("frame", ["principal", "principal_hypothesis"])
def test_a_canonical_frame_leaves_nothing_of_how_the_clouds_lay(frame: str) -> None:
    config = build_config(NetworkConfig, {**TINY.model_dump(), "frame": frame})
    for index in range(4):
        seen = [
            pair_input(turned(PAIRS[index], seed).correspondences, 0.05, config).coordinates
            for seed in range(2)
        ]
        given = pair_input(PAIRS[index].correspondences, 0.05, TINY).coordinates
        torch.testing.assert_close(*seen, atol=2e-3, rtol=0)
        assert float((seen[0] - given).abs().max()) > 0.1


def test_principal_axes_turn_with_the_points() -> None:
    points = torch.from_numpy(np.random.default_rng(0).gamma(2.0, [3, 2, 1], (200, 3)))
    axes = principal_axes(points)
    torch.testing.assert_close(axes @ axes.T, torch.eye(3, dtype=torch.float64))
    R = torch.from_numpy(Rotation.random(random_state=3).as_matrix())
    torch.testing.assert_close(principal_axes(points @ R.T), axes @ R.T)


def test_the_hypothesis_turns_the_target_onto_the_source() -> None:
    for index in range(3):
        pair = turned(PAIRS[index], index)
        points = torch.from_numpy(pair.correspondences).double()
        A, B = canonical_rotations(points, 0.05, "hypothesis")
        left = B.numpy() @ pair.T_target_source[:3, :3] @ A.numpy().T
        assert np.degrees(np.arccos(np.clip((np.trace(left) - 1) / 2, -1, 1))) < 3


def test_the_true_motion_is_known_in_the_frame_that_the_network_sees() -> None:
    config = build_config(NetworkConfig, {**TINY.model_dump(), "frame": "principal_hypothesis"})
    pair = turned(PAIRS[1], 5)
    sample = make_sample(pair, config)
    x = sample.inputs[0].coordinates[sample.labels].double()
    T = sample.truth.double()
    residual = (x[:, :3] @ T[:3, :3].T + T[:3, 3] - x[:, 3:]).norm(dim=1) * config.unit_voxels
    assert float(residual.max()) < 2.01


def test_seeds_find_the_motion_and_stand_apart() -> None:
    pair = turned(PAIRS[2], 8)
    points = torch.from_numpy(pair.correspondences).double()
    affinity = length_affinity(points, 0.1)
    assert float(affinity.diagonal().abs().max()) == 0
    seeds = spread_seeds(affinity.sum(1), points[:, :3], 0.1)
    assert 0 < len(seeds) <= 30
    apart = torch.cdist(points[seeds, :3], points[seeds, :3]) + 10 * torch.eye(len(seeds))
    assert float(apart.min()) >= 0.1
    T = seeded_motion(points, affinity, seeds, 0.1).numpy()
    assert rotation_error_deg(T, pair.T_target_source) < 3


def test_frames_are_for_networks_that_see_coordinates() -> None:
    with pytest.raises(ConfigError, match=r"frame principal turns coordinates"):
        build_config(
            NetworkConfig,
            {"frame": "principal", "motion_form": "none", "extra_channels": ["ratio"]},
        )
