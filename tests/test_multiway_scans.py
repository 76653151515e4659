"""Scans to be aligned: found in natural order with names of their own, and one voxel size for all."""

from __future__ import annotations

import numpy as np
import pytest

from geomoe3d.clouds.io import load_points
from geomoe3d.clouds.voxel_grid import voxel_keys
from geomoe3d.config import PreparationConfig
from geomoe3d.data.sample import write_sample_pair
from geomoe3d.errors import FormatError
from geomoe3d.multiway.scans import choose_common_voxel_size, find_scans


def test_scans_are_found_in_natural_order_with_unique_names(tmp_path):
    for name in ("a/s10.npy", "a/s9.npy", "b/s9.npy", "a/notes.md"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    assert [scan.name for scan in find_scans([tmp_path / "a"])] == ["s9", "s10"]
    assert [s.name for s in find_scans([tmp_path / "a", tmp_path / "b"])] == ["a/s9", "a/s10", "b/s9"]


def test_files_that_differ_by_their_suffix_keep_it_and_the_others_their_names(tmp_path):
    for name in ("s 1.ply", "s 1.xyz", "s 2.ply", "t.ply", "t.xyz", "t.ply.xyz"):
        (tmp_path / name).write_text("")
    assert [s.name for s in find_scans([tmp_path / f"s {k}" for k in ("1.ply", "1.xyz", "2.ply")])] == [
        "s 1.ply", "s 1.xyz", "s 2",
    ]  # fmt: skip
    found = find_scans([tmp_path / f"t{suffix}" for suffix in (".ply", ".xyz", ".ply.xyz")])
    assert len({s.name for s in found}) == 3


def test_transforms_beside_the_scans_are_no_scans(tmp_path):
    write_sample_pair(tmp_path)
    assert (tmp_path / "T_target_source.txt").is_file()
    np.save(tmp_path / "T.npy", np.eye(4))
    assert [scan.name for scan in find_scans([tmp_path])] == ["source", "target"]
    for name in ("T_target_source.txt", "T.npy"):
        with pytest.raises(FormatError, match="holds a transform"):
            load_points(tmp_path / name)


def test_the_common_voxel_size_serves_the_median_scan(scanned_room):
    folder, _ = scanned_room
    scans = find_scans([folder])
    size, unusable = choose_common_voxel_size(scans, PreparationConfig(voxel_points=500))
    assert list(unusable) == ["scan_9"]
    assert 0.1 < size < 0.6
    assert float(f"{size:.2g}") == size


def test_no_scan_exceeds_the_limit_of_voxels_on_the_common_grid(tmp_path):
    rng = np.random.default_rng(0)
    for number, side in enumerate((2.0, 2.0, 2.0, 40.0)):  # three small plates and a huge one
        plate = np.column_stack([rng.uniform(0, side, (60_000, 2)), np.zeros(60_000)])
        np.save(tmp_path / f"{number}.npy", plate)
    for limit in range(1000, 1400, 25):
        config = PreparationConfig(voxel_points=1000, max_points=limit)
        size, _ = choose_common_voxel_size(find_scans([tmp_path]), config)
        largest = load_points(tmp_path / "3.npy").points
        assert len(np.unique(voxel_keys(largest, size))) <= limit
