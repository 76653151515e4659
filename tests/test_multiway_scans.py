"""Scans to be aligned: found in natural order with names of their own, and one voxel size for all."""

from __future__ import annotations

from geomoe3d.config import PreparationConfig
from geomoe3d.multiway.scans import choose_common_voxel_size, find_scans


def test_scans_are_found_in_natural_order_with_unique_names(tmp_path):
    for name in ("a/s10.npy", "a/s9.npy", "b/s9.npy", "a/notes.md"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    assert [scan.name for scan in find_scans([tmp_path / "a"])] == ["s9", "s10"]
    assert [s.name for s in find_scans([tmp_path / "a", tmp_path / "b"])] == ["a/s9", "a/s10", "b/s9"]


def test_the_common_voxel_size_serves_the_median_scan(scanned_room):
    folder, _ = scanned_room
    scans = find_scans([folder])
    size, unusable = choose_common_voxel_size(scans, PreparationConfig(voxel_points=500))
    assert list(unusable) == ["scan_9"]
    assert 0.1 < size < 0.6
    assert float(f"{size:.2g}") == size
