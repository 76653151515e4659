"""RGB-D frames to fragments: walls that are known, frames that must be skipped, the real oracle."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from geomoe3d.cli.errors import run
from geomoe3d.cli.main import geomoe3d
from geomoe3d.clouds.io import load_points
from geomoe3d.data.fragments import make_fragments, split_runs
from geomoe3d.data.fusion import FusionSettings, fuse, measure_overlap, thin
from geomoe3d.data.rgbd import Frame, open_recording
from geomoe3d.data.threedmatch import find_data_root, read_gt_log, read_gt_overlap
from geomoe3d.errors import FormatError, InputError, OutputError
from geomoe3d.geometry.se3 import inverse, make_transform, transform_points

K = np.array([[140.0, 0, 79.5], [0, 140.0, 59.5], [0, 0, 1]])
COARSE = FusionSettings(voxel_size=0.02, truncation=0.06)


def camera(k: int) -> np.ndarray:
    R = Rotation.from_euler("yx", [2.0 * k, -1.0 * k], degrees=True).as_matrix()
    return make_transform(R, np.array([0.05 * k, -0.02 * k, 0.01 * k]))


def wall_depth(T_world_camera: np.ndarray, height: int = 120, width: int = 160) -> np.ndarray:
    """Depth of two perpendicular walls, z = 2.0 and x = 0.6, seen from a pose; metres."""
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u, dtype=float)], -1)
    directions = rays @ T_world_camera[:3, :3].T
    t = T_world_camera[:3, 3]
    with np.errstate(divide="ignore"):
        far = (2.0 - t[2]) / directions[..., 2]
        side = (0.6 - t[0]) / directions[..., 0]
    return np.minimum(far, np.where(side > 0, side, np.inf))


def write_frame(folder: Path, k: int, T: np.ndarray, depth: np.ndarray, per_metre: float = 1000.0) -> None:
    values = np.round(depth * per_metre).astype(np.uint16)
    Image.fromarray(values).save(folder / f"frame-{k:06d}.depth.png")
    np.savetxt(folder / f"frame-{k:06d}.pose.txt", T)


def write_recording(folder: Path, count: int = 6) -> None:
    folder.mkdir()
    np.savetxt(folder / "camera-intrinsics.txt", K)
    for k in range(count):
        write_frame(folder, k, camera(k), wall_depth(camera(k)))


def test_fused_points_lie_on_the_walls_and_are_repeatable() -> None:
    frames = [(wall_depth(camera(k)).astype(np.float32), camera(k)) for k in range(4)]
    points = fuse(frames, K, COARSE)
    assert len(points) > 2000
    distance = np.minimum(np.abs(points[:, 2] - 2.0), np.abs(points[:, 0] - 0.6))
    assert np.percentile(distance, 95) < COARSE.voxel_size / 2  # steep views of a wall are biased by less
    assert np.median(distance) < 0.002
    assert np.array_equal(points, fuse(frames, K, COARSE))


def test_fusion_keeps_to_its_volume_and_needs_frames() -> None:
    frames = [(wall_depth(camera(k)).astype(np.float32), camera(k)) for k in (2, 3)]
    cut = FusionSettings(0.02, 0.06, volume=((-0.2, -0.2, 0.5), (0.3, 0.3, 3.5)))
    points = fuse(frames, K, cut)
    assert len(points) > 100
    assert points.min(0)[0] >= -0.2
    assert points.max(0)[1] < 0.3
    assert fuse(frames[:1], K, cut).shape == (0, 3)  # seen once, twice is asked for
    nothing = FusionSettings(0.02, 0.06, volume=((5.0, 5.0, 5.0), (6.0, 6.0, 6.0)))
    assert fuse(frames, K, nothing).shape == (0, 3)
    assert fuse([(np.zeros((120, 160), np.float32), camera(0))], K, COARSE).shape == (0, 3)
    with pytest.raises(InputError, match="no frames"):
        fuse([], K, COARSE)


def test_thin_keeps_the_first_point_of_each_cell() -> None:
    points = np.array([[0.01, 0, 0], [0.02, 0, 0], [0.03, 0, 0], [-0.01, 0, 0]])
    assert thin(points, 0.025).tolist() == [[0.01, 0, 0], [0.03, 0, 0], [-0.01, 0, 0]]
    assert thin(np.zeros((0, 3)), 0.1).shape == (0, 3)


def test_overlap_counts_the_source_points_that_meet_the_target() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 1, (4000, 2)), np.zeros(4000)])
    T = camera(7)
    moved = transform_points(T, points)
    assert measure_overlap(points, moved, T) == 1.0
    assert measure_overlap(points, moved[points[:, 0] < 0.5], T) == pytest.approx(0.5375, abs=0.02)
    assert measure_overlap(points, moved + 100, T) == 0.0
    assert measure_overlap(points, np.zeros((0, 3)), T) == 0.0


def test_recording_to_fragments_with_exact_truth(tmp_path: Path) -> None:
    write_recording(tmp_path / "frames")
    report = make_fragments(
        open_recording(tmp_path / "frames"), tmp_path / "out", frames_per_fragment=3, settings=COARSE
    )
    assert len(report.num_points) == 2
    assert report.skipped == []
    ((i, j, T),) = read_gt_log(tmp_path / "out" / "gt.log")
    assert (i, j) == (0, 1)
    assert np.allclose(T, inverse(camera(0)) @ camera(3), atol=1e-9)
    clouds = [load_points(tmp_path / "out" / f"cloud_bin_{k}.ply").file_points for k in range(2)]
    # Both fragments lie on the walls of the world, by the poses of their first cameras.
    for points, first in zip(clouds, (camera(0), camera(3)), strict=True):
        world = transform_points(first, points)
        assert np.percentile(np.minimum(abs(world[:, 2] - 2.0), abs(world[:, 0] - 0.6)), 95) < 0.01
    overlap = read_gt_overlap(tmp_path / "out" / "gt_overlap.log")[0, 1]
    assert 0.3 < overlap <= 1
    with pytest.raises(OutputError, match="holds files"):
        make_fragments(open_recording(tmp_path / "frames"), tmp_path / "out")


def test_unusable_frames_are_named_and_skipped(tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    write_recording(folder, 9)
    (folder / "frame-000001.pose.txt").unlink()
    np.savetxt(folder / "frame-000002.pose.txt", np.full((4, 4), np.nan))
    write_frame(folder, 3, camera(3), wall_depth(camera(3), 60, 80))
    write_frame(folder, 4, camera(4), np.zeros((120, 160)))
    (folder / "frame-000005.depth.png").write_bytes(b"no image")
    np.savetxt(folder / "frame-000006.pose.txt", 2 * camera(6))
    report = make_fragments(open_recording(folder), tmp_path / "out", frames_per_fragment=9, settings=COARSE)
    text = "\n".join(report.skipped)
    for number, reason in (
        (1, "pose.txt"),
        (2, "not finite"),
        (3, "pixels"),
        (4, "0.0%"),
        (5, "image"),
        (6, "no rot"),
    ):
        (line,) = [line for line in report.skipped if f"frame-00000{number}" in line]
        assert reason in line, text
    assert len(report.skipped) == 6
    assert len(report.num_points) == 1


def test_all_frames_unusable(tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    write_recording(folder, 3)
    for k in range(3):
        write_frame(folder, k, camera(k), np.full((120, 160), 65.535))
    with pytest.raises(InputError, match="no fragment"):
        make_fragments(open_recording(folder), tmp_path / "out", frames_per_fragment=3)
    for k in range(3):
        (folder / f"frame-00000{k}.pose.txt").unlink()
    with pytest.raises(InputError, match="usable pose"):
        open_recording(folder)


def test_conventions_agree(tmp_path: Path) -> None:
    write_recording(tmp_path / "seven", 3)
    (tmp_path / "plain" / "depth").mkdir(parents=True)
    (tmp_path / "tum" / "depth").mkdir(parents=True)
    for name in ("plain", "tum"):
        np.savetxt(tmp_path / name / "K.txt", K)
    rows, listed, poses = [], ["# depth"], ["# time tx ty tz qx qy qz qw"]
    for k in range(3):
        T, depth = camera(k), wall_depth(camera(k))
        Image.fromarray(np.round(depth * 1000).astype(np.uint16)).save(
            tmp_path / "plain" / "depth" / f"{k}.png"
        )
        Image.fromarray(np.round(depth * 5000).astype(np.uint16)).save(
            tmp_path / "tum" / "depth" / f"{k}.png"
        )
        rows.append(T.ravel())
        listed.append(f"{k}.005 depth/{k}.png")
        numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
        poses.append(" ".join([f"{k}.0", *(f"{x:.12f}" for x in numbers)]))
    listed.append("99.0 depth/2.png")
    np.savetxt(tmp_path / "plain" / "poses.txt", rows)
    (tmp_path / "tum" / "depth.txt").write_text("\n".join(listed))
    (tmp_path / "tum" / "groundtruth.txt").write_text("\n".join(poses))
    clouds = {}
    for name in ("seven", "plain", "tum"):
        recording = open_recording(tmp_path / name)
        report = make_fragments(recording, tmp_path / f"out-{name}", frames_per_fragment=3, settings=COARSE)
        clouds[name] = load_points(tmp_path / f"out-{name}" / "cloud_bin_0.ply").file_points
        assert len(report.skipped) == (1 if name == "tum" else 0)
    assert np.array_equal(clouds["seven"], clouds["plain"])
    assert np.percentile(cKDTree(clouds["tum"]).query(clouds["plain"])[0], 99) < 0.01
    with (tmp_path / "plain" / "poses.txt").open("a") as stream:
        np.savetxt(stream, [rows[0]])
    with pytest.raises(FormatError, match="4 poses"):
        open_recording(tmp_path / "plain")


@pytest.mark.filterwarnings("error")
def test_broken_lists_and_poses_are_named(tmp_path: Path) -> None:
    write_recording(tmp_path / "seven", 3)
    (tmp_path / "seven" / "frame-000001.pose.txt").write_text("")
    recording = open_recording(tmp_path / "seven")
    assert len(recording.frames) == 2
    assert "holds no numbers" in recording.skipped[0]
    tum = tmp_path / "tum"
    tum.mkdir()
    np.savetxt(tum / "K.txt", K)
    (tum / "groundtruth.txt").write_text("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match=r"depth\.txt"):
        open_recording(tum, convention="tum")
    (tum / "depth.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FormatError, match="no text file"):
        open_recording(tum)
    (tum / "depth.txt").write_text("1.0 depth/0.png\nabc depth/1.png\n2.0\n")
    recording = open_recording(tum)
    assert len(recording.frames) == 1
    assert [line[:16] for line in recording.skipped] == ["depth.txt line 2", "depth.txt line 3"]
    (tum / "groundtruth.txt").write_text("1.0 0 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 0\n3.0 0 nan 0 0 0 0 1\n")
    (tum / "depth.txt").write_text("".join(f"{k}.0 depth/{k}.png\n" for k in (1, 2, 3)))
    recording = open_recording(tum)
    assert len(recording.frames) == 1
    assert recording.skipped == [
        "2.png: the pose holds no rotation (its quaternion is zero)",
        "3.png: the pose is not finite",
    ]


def test_lengths_must_be_positive(tmp_path: Path) -> None:
    write_recording(tmp_path / "frames", 3)
    recording = open_recording(tmp_path / "frames")
    for settings in (FusionSettings(voxel_size=0), FusionSettings(max_depth=-1)):
        with pytest.raises(InputError, match="must be positive"):
            make_fragments(recording, tmp_path / "out", frames_per_fragment=3, settings=settings)
    with pytest.raises(InputError, match="the grid must be positive"):
        make_fragments(recording, tmp_path / "out", frames_per_fragment=3, grid=0.0)
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="focal lengths"):
        open_recording(tmp_path / "frames", intrinsics=np.zeros((3, 3)))


def test_runs() -> None:
    frames = [Frame(Path(str(k)), np.eye(4)) for k in range(12)]
    assert [len(run) for run in split_runs(frames, 5)] == [5, 5]
    assert [len(run) for run in split_runs(frames[:8], 5)] == [5, 3]
    assert [len(run) for run in split_runs(frames[:2], 5)] == [2]


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_recording(tmp_path / "frames")
    (tmp_path / "frames" / "camera-intrinsics.txt").unlink()
    arguments = ["data", "fragments", str(tmp_path / "frames"), str(tmp_path / "out"), "--count", "3"]
    assert run(geomoe3d, "geomoe3d", arguments) == 2
    assert "--intrinsics" in capsys.readouterr().err
    assert run(geomoe3d, "geomoe3d", [*arguments, "--voxel", "0.02"]) == 2
    assert "--voxel is now --voxel-size" in capsys.readouterr().err
    arguments += ["--intrinsics", "140,140,79.5,59.5", "--voxel-size", "0.02", "--whole"]
    assert run(geomoe3d, "geomoe3d", arguments) == 0
    assert "2 fragments" in capsys.readouterr().out
    assert run(geomoe3d, "geomoe3d", ["data", "check", str(tmp_path / "out")]) == 0


def real(part: str) -> Path:
    try:
        folder = find_data_root() / part
    except InputError as error:
        pytest.skip(str(error))
    if not folder.is_dir():
        pytest.skip(f"'{folder}' is not at hand")
    return folder


def surface_distance(points: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Distance to the surface that a cloud thinned to 2.5 cm samples: to the plane of its nearest points."""
    tree = cKDTree(reference)
    distance, index = tree.query(points, k=6)
    patches = reference[index] - reference[index].mean(1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", patches, patches))[1][:, :, 0]
    planar = np.abs(np.einsum("ni,ni->n", points - reference[index].mean(1), normals))
    return np.where(distance[:, 0] < 0.035, planar, distance[:, 0])


@pytest.mark.slow
def test_oracle_redkitchen(tmp_path: Path) -> None:
    """Frames 0-49 and 50-99 are what cloud_bin_0 and cloud_bin_1 of the benchmark were fused from."""
    recording = open_recording(real("rgbd/redkitchen-seq01"))
    make_fragments(recording, tmp_path / "out")
    benchmark = real("3dmatch-dev")
    for number in (0, 1):
        ours = load_points(tmp_path / "out" / f"cloud_bin_{number}.ply").file_points
        published = load_points(
            benchmark / "fragments" / "7-scenes-redkitchen" / f"cloud_bin_{number}.ply"
        ).file_points
        there = cKDTree(ours).query(published)[0]
        back = surface_distance(ours[::5], published)
        for distance in (there, back):
            assert np.median(distance) < 0.01
            assert np.percentile(distance, 95) < 0.03
    ((_, _, T),) = read_gt_log(tmp_path / "out" / "gt.log")
    published_T = read_gt_log(benchmark / "benchmarks" / "3DMatch" / "7-scenes-redkitchen" / "gt.log")[0][2]
    assert np.linalg.norm(T[:3, 3] - published_T[:3, 3]) < 0.05


@pytest.mark.slow
def test_oracle_full_resolution(tmp_path: Path) -> None:
    recording = open_recording(real("rgbd/redkitchen-seq01"))
    published = load_points(real("fullres") / "redkitchen_cloud_bin_0.ply").file_points
    del recording.frames[50:]
    make_fragments(recording, tmp_path / "out")
    ours = load_points(tmp_path / "out" / "cloud_bin_0.ply").file_points
    for a, b in ((ours, published), (published, ours)):
        distance = cKDTree(a).query(b)[0]
        assert np.median(distance) < 0.01
        assert np.percentile(distance, 95) < 0.03


@pytest.mark.slow
def test_lounge(tmp_path: Path) -> None:
    settings = FusionSettings(voxel_size=0.012, truncation=0.05, volume=None)
    report = make_fragments(open_recording(real("rgbd/hololens-lounge")), tmp_path / "out", settings=settings)
    assert len(report.num_points) >= 7
    assert report.num_pairs >= 12
