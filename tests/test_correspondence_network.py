"""Baselines as filters: weights for every row, none for what is not seen, seeds and motions of PointDSC."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_networks import SMALL, settle, small, tiny

from geomoe3d.errors import CheckpointError
from geomoe3d.filters.geomoe import GeoMoEFilter
from geomoe3d.filters.network import NetworkFilter
from geomoe3d.networks.pretrained import load_pretrained, save_pretrained
from geomoe3d.networks.weight_files import WeightCard
from geomoe3d.training.synthetic import SyntheticConfig, SyntheticPairs
from geomoe3d.types import Correspondences

pytestmark = pytest.mark.usefixtures("one_thread")

PAIR = SyntheticPairs(
    SyntheticConfig(correspondences=(250, 250), inlier_ratio=(0.3, 0.3), voxel_size=(0.05, 0.05))
)[0]
ROWS = PAIR.correspondences.astype(np.float64)


@pytest.mark.parametrize("kind", SMALL)
def test_every_row_gets_a_weight_and_bad_rows_none(kind: str) -> None:
    judge = NetworkFilter(settle(small(kind)))
    plain = judge(Correspondences(ROWS), voxel_size=0.05)
    assert plain.weights.shape == (250,)
    assert ((plain.weights >= 0) & (plain.weights <= 1)).all()
    broken = np.concatenate([ROWS, np.full((1, 6), np.nan)])
    again = judge(Correspondences(broken), voxel_size=0.05)
    np.testing.assert_allclose(again.weights, [*plain.weights, 0.0], atol=1e-5)
    assert not judge(Correspondences(broken[-3:]), voxel_size=0.05).weights.any()
    other_unit = judge(Correspondences(ROWS * 1000), voxel_size=50.0)
    np.testing.assert_allclose(other_unit.weights, plain.weights, atol=1e-3)


def test_pointdsc_keeps_what_lies_under_the_best_motion_of_its_seeds() -> None:
    found = NetworkFilter(settle(small("pointdsc")))(Correspondences(ROWS), voxel_size=0.05)
    kept = found.weights > 0
    assert kept[PAIR.labels].mean() > 0.9  # lengths alone fix the motion here, whatever the features say
    assert kept[~PAIR.labels].mean() < 0.2


def test_plain_and_fast_way_of_geomoe_agree() -> None:
    model = settle(tiny())
    rows = Correspondences(ROWS)
    plain, fast = (f(model)(rows, voxel_size=0.05) for f in (NetworkFilter, GeoMoEFilter))
    np.testing.assert_allclose(plain.weights, fast.weights, atol=1e-4)


def test_weights_are_asked_for_and_must_fit(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"paper/oanet\.yaml"):
        NetworkFilter.from_pretrained("oanet", None)
    path = tmp_path / "w.safetensors"
    save_pretrained(path, settle(small("pointcn")), WeightCard(architecture={}))
    with pytest.raises(CheckpointError, match=r"of 'pointcn', not of 'oanet'"):
        NetworkFilter.from_pretrained("oanet", path)
    with pytest.raises(CheckpointError, match=r"of 'pointcn', not of 'geomoe'"):
        load_pretrained(path)
    assert NetworkFilter.from_pretrained("pointcn", path)(
        Correspondences(ROWS), voxel_size=0.05
    ).weights.any()
    with pytest.raises(CheckpointError, match=r"scores transforms"):
        NetworkFilter(tiny(motion_form="none", extra_channels=("aligned",), knn_space="source"))
    assert torch.get_num_threads() == 1
