"""The pairs of a benchmark: of a folder, thinned out, unrelated, and as published."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from posed_scans import motion, real_root

from geomoe3d.data.threedmatch import load_benchmark
from geomoe3d.errors import InputError
from geomoe3d.evaluation.benchmarks import load_pairs, thin_out
from geomoe3d.geometry.se3 import inverse


def test_a_folder_gives_its_pairs(posed_folder: Path) -> None:
    pairs = load_pairs(str(posed_folder))
    assert [p.id.split("/")[1] for p in pairs] == [
        "cloud_bin_0--cloud_bin_1",
        "cloud_bin_0--cloud_bin_2",
        "cloud_bin_0--cloud_bin_3",
        "cloud_bin_1--cloud_bin_2",
        "cloud_bin_1--cloud_bin_3",
        "cloud_bin_2--cloud_bin_3",
    ]
    assert [p.consecutive for p in pairs] == [True, False, False, True, False, True]
    assert np.allclose(pairs[1].T_target_source, inverse(motion(2)))
    assert pairs[0].overlap == 0.9
    assert thin_out(pairs, 4) == [pairs[0], pairs[4]]


@pytest.mark.parametrize("name", ["3DMatsch", "/no/such/folder"])
def test_unknown_benchmarks_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="no benchmark"):
        load_pairs(name)


def test_every_must_be_positive(posed_folder: Path) -> None:
    with pytest.raises(InputError, match="at least 1"):
        thin_out(load_pairs(str(posed_folder)), 0)


# ---- the published benchmark ------------------------------------------------------------------------


def test_unrelated_pairs_come_from_different_scenes() -> None:
    real_root()
    pairs = load_pairs("unrelated", num_unrelated=50)
    assert len({pair.id for pair in pairs}) == 50
    assert load_pairs("unrelated", num_unrelated=20) == pairs[:20]
    scene_of = {path: pair.scene for pair in load_benchmark() for path in (pair.source, pair.target)}
    for pair in pairs:
        assert pair.T_target_source is None
        assert scene_of[pair.source] != scene_of[pair.target]


def test_raw_truth_differs_only_where_rotations_are_not_orthonormal() -> None:
    real_root()
    gaps: dict[str, float] = {}
    for pair in load_pairs("3DMatch"):
        gap = float(np.abs(pair.raw_T_target_source - pair.T_target_source)[:3, :3].max())
        gaps[pair.scene] = max(gaps.get(pair.scene, 0.0), gap)
    red = next(name for name in gaps if "redkitchen" in name)
    assert gaps[red] > 1e-4
    assert all(gap < gaps[red] for name, gap in gaps.items() if name != red)
