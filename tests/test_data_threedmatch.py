"""Ground truth files of 3DMatch: hand-made ones, and the real ones where they are at hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomoe3d.data.threedmatch import (
    DATA_VARIABLE,
    find_data_root,
    iterate_fixed_correspondences,
    load_benchmark,
    read_gt_info,
    read_gt_log,
    read_gt_overlap,
    true_motion,
    write_gt_log,
    write_gt_overlap,
)
from geomoe3d.errors import FormatError, InputError, OutputError
from geomoe3d.geometry.se3 import make_transform, rotation_angle_deg


def real_data() -> Path:
    try:
        return find_data_root()
    except InputError as error:
        pytest.skip(str(error))


def motion(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return make_transform(Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3))


def test_gt_log_round_trip_keeps_every_bit(tmp_path: Path) -> None:
    entries = [(0, 1, motion(1)), (0, 7, motion(2)), (3, 12, motion(3))]
    write_gt_log(tmp_path / "gt.log", entries, 13)
    found = read_gt_log(tmp_path / "gt.log")
    assert [(i, j) for i, j, _ in found] == [(0, 1), (0, 7), (3, 12)]
    for (_, _, given), (_, _, read) in zip(entries, found, strict=True):
        assert np.array_equal(given, read)
    with pytest.raises(OutputError, match="exists"):
        write_gt_log(tmp_path / "gt.log", entries, 13)


def test_overlap_round_trip(tmp_path: Path) -> None:
    write_gt_overlap(tmp_path / "o.log", {(0, 1): 0.51234, (0, 2): 0.0})
    assert read_gt_overlap(tmp_path / "o.log") == {(0, 1): 0.5123, (0, 2): 0.0}


def test_empty_file_has_no_entries(tmp_path: Path) -> None:
    (tmp_path / "gt.log").write_text("\n \n")
    assert read_gt_log(tmp_path / "gt.log") == []


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("0 1 60\n1 0 0 0\n0 1 0 0\n", "line 1"),
        ("0 1 60\n1 0 0 0\n0 1 0 0\n0 0 1 x\n0 0 0 1\n", "line 1"),
        ("0 1 60\n1 0 0\n0 1 0\n0 0 1\n0 0 0\n", "line 1"),
        ("0 1 60\n1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "line 1: the entry 0 1 is not finite"),
        ("0 1 60\n2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "line 1: the entry 0 1 is no rigid transform"),
        ("0 1 60\n1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1\n", "line 1: the entry 0 1 is no rigid transform"),
        ("zero 1 60\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "line 1"),
    ],
)
def test_broken_gt_log_names_the_line(tmp_path: Path, text: str, line: str) -> None:
    (tmp_path / "gt.log").write_text(text)
    with pytest.raises(FormatError, match=line):
        read_gt_log(tmp_path / "gt.log")


def test_broken_overlap_and_missing_file(tmp_path: Path) -> None:
    (tmp_path / "o.log").write_text("0,1,0.5\n0,2\n")
    with pytest.raises(FormatError, match="line 2"):
        read_gt_overlap(tmp_path / "o.log")
    (tmp_path / "o.log").write_text("0,1,nan\n")
    with pytest.raises(FormatError, match="line 1"):
        read_gt_overlap(tmp_path / "o.log")
    (tmp_path / "binary").write_bytes(bytes(range(256)))
    with pytest.raises(FormatError, match="no text"):
        read_gt_log(tmp_path / "binary")
    with pytest.raises(InputError, match="absent"):
        read_gt_info(tmp_path / "absent")


def test_true_motion_inverts_and_projects() -> None:
    entry = motion(5)
    assert np.allclose(true_motion(entry) @ entry, np.eye(4), atol=1e-12)
    skewed = entry.copy()
    skewed[:3, :3] *= 1.0005
    R = true_motion(skewed)[:3, :3]
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
    raw = true_motion(skewed, raw=True)[:3, :3]
    assert not np.allclose(raw @ raw.T, np.eye(3), atol=1e-5)


def test_data_root_by_variable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(DATA_VARIABLE, str(tmp_path))
    assert find_data_root() == tmp_path
    with pytest.raises(InputError, match="benchmarks"):
        load_benchmark()
    monkeypatch.setenv(DATA_VARIABLE, str(tmp_path / "absent"))
    with pytest.raises(InputError, match=DATA_VARIABLE):
        find_data_root()


def test_benchmark_of_a_made_up_folder(tmp_path: Path) -> None:
    scene = tmp_path / "benchmarks" / "3DMatch" / "room"
    scene.mkdir(parents=True)
    entry = motion(9)
    write_gt_log(scene / "gt.log", [(2, 5, entry)], 6)
    (pair,) = load_benchmark(tmp_path)
    assert (pair.scene, pair.source_index, pair.target_index) == ("room", 2, 5)
    assert pair.source == tmp_path / "fragments" / "room" / "cloud_bin_2.ply"
    assert pair.overlap is None
    assert pair.information is None
    # A point of fragment j goes to i by the entry, and back by T_target_source.
    point = np.array([0.3, -1.0, 2.0, 1.0])
    assert np.allclose(pair.T_target_source @ (entry @ point), point)
    with pytest.raises(InputError, match="no benchmark"):
        load_benchmark(tmp_path, "4DMatch")
    with pytest.raises(InputError, match="3DLoMatch"):
        load_benchmark(tmp_path, "3DLoMatch")


@pytest.mark.parametrize(("benchmark", "count"), [("3DMatch", 843), ("3DLoMatch", 1044)])
def test_real_benchmark_counts(benchmark: str, count: int) -> None:
    root = real_data()
    pairs = load_benchmark(root, benchmark)
    assert len(pairs) == count
    assert all(p.source.is_file() and p.target.is_file() for p in pairs)
    assert all(p.overlap is not None and 0 < p.overlap <= 1 for p in pairs)
    assert all(p.information is not None for p in pairs)
    raw = load_benchmark(root, benchmark, raw=True)
    turned = [
        rotation_angle_deg(a.T_target_source[:3, :3].T @ b.T_target_source[:3, :3])
        for a, b in zip(pairs, raw, strict=True)
    ]
    assert max(turned) < 0.1


def test_real_fixed_correspondences_agree_with_the_ground_truth() -> None:
    root = real_data()
    fixed = list(iterate_fixed_correspondences(root, "3DMatch"))
    truth = {(p.scene, p.source_index, p.target_index): p for p in load_benchmark(root, "3DMatch")}
    assert len(fixed) == len(truth) == 843
    ratios = []
    for pair in fixed:
        T = truth[pair.scene, pair.source_index, pair.target_index].T_target_source
        assert np.allclose(T, pair.T_target_source, atol=1e-6)
        moved = pair.points[:, :3] @ T[:3, :3].T + T[:3, 3]
        ratios.append(np.mean(np.linalg.norm(moved - pair.points[:, 3:], axis=1) < 0.10))
    # A wrong direction of the motion would leave about 1 %.
    assert 0.06 < float(np.mean(ratios)) < 0.12
