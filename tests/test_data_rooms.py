"""Generated rooms: what stands in them, what the sensor does, and sets that are exact and reproducible."""

from __future__ import annotations

import errno
import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from geomoe3d.cli.errors import run
from geomoe3d.cli.main import geomoe3d
from geomoe3d.data import record as record_module
from geomoe3d.data import synthesize as module
from geomoe3d.data.check import check_folder
from geomoe3d.data.collection import load_fragment, open_collection
from geomoe3d.data.rooms.arrange import MAKERS, PROGRAMS
from geomoe3d.data.rooms.models import open_library
from geomoe3d.data.rooms.relief import Relief, ReliefSettings
from geomoe3d.data.rooms.scenes import Scene, generate_scene, load_mesh_scene
from geomoe3d.data.rooms.sensor import Camera, DepthSensor, SensorSettings, cast
from geomoe3d.data.rooms.shell import Room, join, overlaps, plan_flat
from geomoe3d.data.rooms.solids import Solids
from geomoe3d.data.rooms.walk import WalkSettings, camera_pose, drifted, frame_poses, walk
from geomoe3d.data.settings import SynthesisSettings
from geomoe3d.data.synthesize import Job, make_scene, scene_name, synthesize
from geomoe3d.errors import ConfigError, FormatError, InputError, OutputError
from geomoe3d.geometry.se3 import inverse, rotation_angle_deg, transform_points

TINY = SynthesisSettings(fragments_per_scene=2, frames_per_fragment=2, fusion_voxel=0.03, min_points=500)
CLEAN = SensorSettings(
    disparity_noise=0,
    disparity_step=1e-3,
    edge_shift=0,
    hole_share=0,
    bias=0,
    min_slope=0.02,
    full_slope=0.03,
)
SMALL = Camera(160, 120, 146.0)


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


# ---- solids, furniture, flats --------------------------------------------------------------------


def test_solids_are_where_they_should_be() -> None:
    s = Solids()
    s.box((1, 2, 3), (0.5, 1.0, 2.0))
    assert np.allclose(s.bounds, [(1, 2, 3), (1.5, 3, 5)])
    s.rod((0, 0, 0), (0, 0, 4), 0.1)
    assert np.allclose(s.bounds[0], (-0.1, -0.1, 0), atol=1e-2)
    scene = Solids()
    scene.place(s, np.array([[0, -1.0, 0, 10], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
    assert scene.bounds[0][0] == pytest.approx(10 - 3)


@pytest.mark.parametrize("name", sorted(MAKERS))
def test_every_piece_stands_on_its_floor_space(name: str) -> None:
    for seed in range(12):
        piece = MAKERS[name](np.random.default_rng(seed))
        low, high = piece.solids.bounds
        assert np.isfinite([low, high]).all()
        assert low[2] > -0.15
        assert 0.02 < high[2] < 2.6
        # Cushions, jackets and castors may stand out a little.
        slack = 0.3
        assert -piece.width / 2 - slack < low[0] < high[0] < piece.width / 2 + slack
        assert -slack < low[1] < high[1] < piece.depth + slack
        for shelf in piece.shelves:
            assert shelf.x[0] < shelf.x[1]
            assert shelf.y[0] < shelf.y[1]
            assert 0 < shelf.z <= high[2] + 0.1


def test_programs_name_known_pieces() -> None:
    assert {name for program in PROGRAMS.values() for name, _, _ in program} <= set(MAKERS)


def test_rooms_of_a_flat_are_apart_and_joined() -> None:
    for seed in range(8):
        rooms = plan_flat(np.random.default_rng(seed), 3)
        assert len(rooms) == 3
        for k, room in enumerate(rooms):
            assert not any(overlaps(room.rect, other.rect) for other in rooms[k + 1 :])
        passages = sum(
            o.kind in ("passage", "door ajar")
            for room in rooms
            for side in room.openings.values()
            for o in side
        )
        assert passages >= 2


def test_a_doorway_may_take_all_the_wall_that_two_rooms_share() -> None:
    for seed in range(300):
        rng = np.random.default_rng(seed)
        start, length = rng.uniform(0.0, 5.0), rng.uniform(1.3, 1.6)
        west = Room((0.0, 0.0, 3.0, 12.0), 2.5)
        east = Room((3.12, start, 6.0, start + length), 2.5)
        join(rng, [west, east])
        ((door,), (same,)) = west.openings["east"], east.openings["west"]
        assert (door.start, door.end) == (same.start, same.end)
        assert start + 0.1 - 1e-9 <= door.start < door.end <= start + length - 0.1 + 1e-9


def test_scene_depends_on_its_generator_alone() -> None:
    one, two = (generate_scene(np.random.default_rng(5)) for _ in range(2))
    other = generate_scene(np.random.default_rng(6))
    assert np.array_equal(np.concatenate(one.solids.vertices), np.concatenate(two.solids.vertices))
    assert one.solids.num_vertices != other.solids.num_vertices


# ---- sensor and walk -----------------------------------------------------------------------------


def wall_scene() -> Scene:
    s = Solids()
    s.box((3.0, -5, -5), (0.1, 10, 10))
    return Scene("primitives", "wall", s, [(-1, -1, 1, 1)])


def test_cast_depth_is_exact() -> None:
    hits = cast(wall_scene().rays, SMALL, camera_pose(np.zeros(3), 0, 0, 0))
    assert np.allclose(hits.depth, 3.0, atol=1e-5)
    assert hits.slope.max() == pytest.approx(1.0, abs=1e-4)


def bent(scene: Scene, settings: ReliefSettings, pose: np.ndarray, seed: int = 3) -> tuple[np.ndarray, ...]:
    """World points (n, 3) of an image before and after bending."""
    hits = cast(scene.rays, SMALL, pose)
    relief = Relief(np.random.default_rng(seed), scene.solids, settings)
    moved = relief.bend(hits, SMALL.rays(), pose)
    return tuple(transform_points(pose, SMALL.rays() * h.depth.reshape(-1, 1)) for h in (hits, moved))


def test_relief_is_fixed_in_the_world_and_as_steep_as_asked() -> None:
    settings = ReliefSettings(bend=0.2, spread=0.0, structure=1.0)
    poses = [camera_pose(np.array([0, y, 0.0]), yaw, 0, 0) for y, yaw in ((-0.5, 9.0), (0.5, -9.0))]
    slopes = []
    for seed in range(12):
        seen: list[dict[tuple[int, int], float]] = []
        for pose in poses:
            flat, uneven = bent(wall_scene(), settings, pose, seed)
            assert np.allclose(flat[:, 0], 3.0, atol=1e-4)
            # How far the surface stands out in the cells of a grid on the wall, in metres.
            cells = np.floor(uneven[:, 1:] / 0.05).astype(int).tolist()
            heights = dict(zip(map(tuple, cells), (uneven[:, 0] - 3.0).tolist(), strict=True))
            for step in ((1, 0), (0, 1)):
                next_cell = {(y, z): (y + step[0], z + step[1]) for y, z in heights}
                rise = [heights[b] - heights[a] for a, b in next_cell.items() if b in heights]
                slopes.append(np.mean(np.square(rise)) / 0.05**2)
            seen.append(heights)
        both = sorted(set(seen[0]) & set(seen[1]))
        one, two = (np.array([heights[cell] for cell in both]) for heights in seen)
        assert len(both) > 300
        assert np.corrcoef(one, two)[0, 1] > 0.9
    assert np.sqrt(2 * np.mean(slopes)) == pytest.approx(0.2, rel=0.25)  # along both axes of the wall


def test_relief_spares_structure_and_can_be_none() -> None:
    pose = camera_pose(np.zeros(3), 20, 0, 0)
    flat, still = bent(wall_scene(), ReliefSettings(bend=0.0), pose)
    assert np.array_equal(flat, still)
    flat, weak = bent(wall_scene(), ReliefSettings(spread=0.0, structure=0.25), pose)
    _, full = bent(wall_scene(), ReliefSettings(spread=0.0, structure=1.0), pose)
    ratio = (full - flat).std() / (weak - flat).std()
    assert ratio == pytest.approx(4.0, rel=0.01)


def test_sensor_rounds_the_disparity() -> None:
    sensor = DepthSensor(SMALL, SensorSettings(bias=0), np.random.default_rng(0))
    depth = sensor.measure(cast(wall_scene().rays, SMALL, camera_pose(np.zeros(3), 0, 0, 0)))
    seen = depth[depth > 0]
    assert np.mean(depth > 0) > 0.9
    assert np.median(seen) == pytest.approx(3.0, abs=0.03)
    values = np.unique(seen)
    assert len(values) < 20
    # z^2 / (f b) / 8: 2.6 cm at 3 m for f = 585 and b = 7.5 cm.
    assert np.median(np.diff(values)) == pytest.approx(9 / (584 * 0.075) / 8, rel=0.1)


def test_clean_sensor_gives_true_depth_within_its_range() -> None:
    scene = generate_scene(np.random.default_rng(2))
    stand = walk(np.random.default_rng(0), scene, 1, WalkSettings())[0]
    hits = cast(scene.rays, SMALL, stand.pose)
    depth = DepthSensor(SMALL, CLEAN, np.random.default_rng(0)).measure(hits)
    seen = depth > 0
    assert seen.mean() > 0.3
    assert np.abs(depth - hits.depth)[seen].max() < 0.002
    assert depth[seen].min() > CLEAN.near
    assert depth.max() < CLEAN.far


def test_nearer_things_cast_a_shadow_and_grazing_surfaces_vanish() -> None:
    s = Solids()
    s.box((3.0, -5, -5), (0.1, 10, 10))
    s.box((1.0, -0.2, -0.2), (0.05, 0.4, 0.4))
    pose = camera_pose(np.zeros(3), 0, 0, 0)
    hits = cast(s.scene(), SMALL, pose)
    depth = DepthSensor(SMALL, CLEAN, np.random.default_rng(0)).measure(hits)
    middle = depth[SMALL.height // 2]
    lost = np.flatnonzero((middle == 0) & (hits.depth[SMALL.height // 2] > 2.9))
    # The wall is hidden from the projector over b f (1/1 - 1/3) pixels on one side of the box.
    assert len(lost) == pytest.approx(0.075 * 146 * (1 - 1 / 3), abs=2)
    assert len({bool(column > SMALL.width / 2) for column in lost}) == 1
    floor = Solids()
    floor.box((-1, -5, -0.3), (20, 10, 0.1))
    hits = cast(floor.scene(), SMALL, pose)
    settings = SensorSettings(min_slope=0.08, full_slope=0.25, far=10.0)
    depth = DepthSensor(SMALL, settings, np.random.default_rng(0)).measure(hits)
    assert not (depth[hits.slope < 0.07] > 0).any()
    steep = (hits.slope > 0.3) & (hits.depth < 9)
    assert (depth[steep] > 0).mean() > 0.75


def test_camera_keeps_its_distance_and_sees_something() -> None:
    import open3d as o3d

    scene = generate_scene(np.random.default_rng(11))
    settings = WalkSettings()
    stands = walk(np.random.default_rng(1), scene, 8, settings)
    assert len(stands) >= 6
    eyes = np.array([stand.eye for stand in stands], dtype=np.float32)
    assert scene.rays.compute_distance(o3d.core.Tensor(eyes)).numpy().min() > settings.clearance
    again = walk(np.random.default_rng(1), scene, 8, settings)
    assert all(np.array_equal(a.pose, b.pose) for a, b in zip(stands, again, strict=True))


def test_frames_begin_at_the_stand_and_drift_is_none_at_the_first() -> None:
    scene = generate_scene(np.random.default_rng(11))
    stand = walk(np.random.default_rng(1), scene, 1, WalkSettings())[0]
    rng = np.random.default_rng(3)
    poses = frame_poses(rng, stand, 9, WalkSettings())
    believed = drifted(rng, poses, 0.02, 0.5)
    assert np.array_equal(poses[0], stand.pose)
    assert np.array_equal(believed[0], poses[0])
    errors = [inverse(a) @ b for a, b in zip(poses, believed, strict=True)]
    assert 0 < np.linalg.norm(errors[-1][:3, 3]) < 0.1
    assert 0 < rotation_angle_deg(errors[-1][:3, :3]) < 3
    assert all(np.array_equal(x, y) for x, y in zip(poses, drifted(rng, poses, 0, 0), strict=True))


# ---- recorded sets -------------------------------------------------------------------------------


def test_fragments_lie_on_the_surfaces_of_their_scene() -> None:
    """Ground truth is exact: with nothing disturbed, fused points moved by their pose meet the scene."""
    import open3d as o3d

    ideal = {"sensor": CLEAN, "relief": ReliefSettings(bend=0.0), "drift_metres": 0.0, "drift_deg": 0.0}
    settings = TINY.model_copy(update=ideal)
    scene = generate_scene(np.random.default_rng(21))
    recorded = record_module.record(np.random.default_rng(4), scene, settings)
    assert len(recorded.clouds) >= 2
    for cloud, pose in zip(recorded.clouds, recorded.poses, strict=True):
        world = transform_points(pose, cloud.astype(np.float64)).astype(np.float32)
        away = scene.rays.compute_distance(o3d.core.Tensor(world)).numpy()
        assert np.median(away) < 0.005
        assert np.percentile(away, 95) < settings.fusion_voxel
        # Cut off to 3DMatch's cube in front of the first camera.
        assert cloud[:, 2].min() >= 0.5
        assert np.abs(cloud[:, :2]).max() <= 1.5


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("set") / "one"
    synthesize(folder, 2, seed=3, settings=TINY)
    return folder


def test_set_is_read_by_everything_that_reads_posed_fragments(made: Path) -> None:
    collection = open_collection(made)
    assert collection.layout == "posed"
    assert check_folder(made).usable
    for pair in collection.pairs[:3]:
        poses = np.loadtxt(pair.source.parent / "poses.txt").reshape(-1, 4, 4)
        i, j = (int(path.stem.rsplit("_", 1)[1]) for path in (pair.source, pair.target))
        assert np.allclose(pair.T_target_source, inverse(poses[j]) @ poses[i], atol=1e-12)
        # And the truth fits the clouds: most source points that overlap are close to the target.
        source, target = (load_fragment(path).file_points for path in (pair.source, pair.target))
        from scipy.spatial import cKDTree

        distance = cKDTree(target).query(transform_points(pair.T_target_source, source))[0]
        assert np.mean(distance < 0.0375) == pytest.approx(pair.overlap, abs=0.01)


@pytest.mark.slow
def test_same_seed_same_bytes_on_any_number_of_workers(made: Path, tmp_path: Path) -> None:
    synthesize(tmp_path / "two", 2, seed=3, workers=2, settings=TINY)
    assert files_of(tmp_path / "two") == files_of(made)
    synthesize(tmp_path / "other", 1, seed=4, settings=TINY)
    first = Path(scene_name(0)) / "cloud_bin_0.ply"
    assert (tmp_path / "other" / first).read_bytes() != (made / first).read_bytes()


def test_larger_set_contains_the_smaller_one(made: Path, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    assert synthesize(folder, 1, seed=3, settings=TINY).made == 1
    report = synthesize(folder, 2, seed=3, settings=TINY)
    assert (report.made, report.kept) == (1, 1)
    assert files_of(folder) == files_of(made)
    assert synthesize(folder, 2, seed=3, settings=TINY).made == 0


_KILLED = """
import os, signal, sys
from geomoe3d.data import synthesize as module
from geomoe3d.data.settings import SynthesisSettings
real = module.write_gt_log
def deadly(path, *arguments, **named):
    if "00001" in str(path):
        os.kill(os.getpid(), signal.SIGKILL)
    real(path, *arguments, **named)
module.write_gt_log = deadly
module.synthesize(sys.argv[1], 2, seed=3, settings=SynthesisSettings.model_validate_json(sys.argv[2]))
"""


@pytest.mark.slow
def test_resume_after_sigkill_in_the_middle_of_a_scene(made: Path, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    command = [sys.executable, "-c", _KILLED, str(folder), TINY.model_dump_json()]
    root = str(Path(__file__).parents[1])
    ended = subprocess.run(command, capture_output=True, timeout=120, check=False, cwd=root)
    assert ended.returncode == -signal.SIGKILL, ended.stderr.decode()
    left = sorted(p.name for p in folder.iterdir())
    assert left == [f".writing-{scene_name(1)}", "manifest.json", scene_name(0)]
    report = synthesize(folder, 2, seed=3, settings=TINY)
    assert (report.made, report.kept) == (1, 1)
    assert files_of(folder) == files_of(made)


def test_other_settings_or_material_are_refused_by_name(made: Path) -> None:
    with pytest.raises(InputError, match="seed was 3, now 5"):
        synthesize(made, 2, seed=5, settings=TINY)
    changed = TINY.model_copy(update={"sensor": SensorSettings(far=3.0)})
    with pytest.raises(InputError, match=r"settings\.sensor\.far was 4\.5, now 3\.0"):
        synthesize(made, 2, seed=3, settings=changed)


def test_full_disk_leaves_nothing_half_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import geomoe3d.clouds.io as io

    real, calls = io.save_points, []

    def full(path: Path, *arguments: object, **named: object) -> None:
        calls.append(path)
        if len(calls) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(path, *arguments, **named)

    monkeypatch.setattr(io, "save_points", full)
    with pytest.raises(OutputError, match="No space left"):
        synthesize(tmp_path / "set", 1, seed=3, settings=TINY)
    assert [p.name for p in (tmp_path / "set").iterdir()] == ["manifest.json"]
    monkeypatch.undo()
    assert synthesize(tmp_path / "set", 1, seed=3, settings=TINY).made == 1


def test_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(OutputError, match=r"manifest\.json"):
        synthesize(tmp_path, 1, settings=TINY)
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "manifest.json").write_text("{broken")
    with pytest.raises(InputError, match="damaged"):
        synthesize(tmp_path / "set", 1, settings=TINY)


# ---- models and meshes ---------------------------------------------------------------------------


def write_models(folder: Path) -> None:
    import trimesh

    folder.mkdir()
    for name, extents in (("chair", (0.45, 0.9, 0.5)), ("desk", (1.4, 0.75, 0.7)), ("sofa", (1.8, 0.8, 0.9))):
        trimesh.creation.box(extents=extents).export(folder / f"{name}.obj")
    (folder / "table.obj").write_bytes(b"\x00\x01 this is no model")
    (folder / "wardrobe.glb").write_bytes(b"")
    (folder / "readme.txt").write_text("no model")


def test_models_are_scaled_and_turned(tmp_path: Path) -> None:
    write_models(tmp_path / "models")
    library = open_library([tmp_path / "models"])
    assert {kind: len(models) for kind, models in library.models.items()} == {
        "chair": 1,
        "desk": 1,
        "sofa": 1,
        "table": 1,
        "wardrobe": 1,
    }
    piece = library.draw("desk", np.random.default_rng(0))
    assert piece is not None
    assert (piece.width, piece.depth, piece.height) == pytest.approx((1.4, 0.7, 0.75))
    assert np.allclose(piece.solids.bounds, [(-0.7, 0, 0), (0.7, 0.7, 0.75)])


@pytest.mark.slow
def test_unreadable_models_are_named_and_passed_over(tmp_path: Path) -> None:
    write_models(tmp_path / "models")
    settings = TINY.model_copy(update={"shares": TINY.shares.model_copy(update={"models": 1.0})})
    report = synthesize(
        tmp_path / "set", 3, seed=1, settings=settings, model_folders=[str(tmp_path / "models")]
    )
    assert report.made == 3
    assert {scene.kind for scene in report.scenes} == {"models"}
    text = " ".join(report.unreadable)
    assert "table.obj" in text or "wardrobe.glb" in text
    stored = json.loads((tmp_path / "set" / scene_name(0) / "scene.json").read_text())
    assert stored["kind"] == "models"


def test_catalogue_gives_the_real_size(tmp_path: Path) -> None:
    import trimesh

    folder = tmp_path / "library"
    folder.mkdir()
    trimesh.creation.box(extents=(100, 50, 70)).export(folder / "m.obj")  # any unit, y up
    (folder / "PluginFurnitureCatalog.properties").write_text(
        "name#1=Big table\ncategory#1=Kitchen\nmodel#1=/m.obj\nwidth#1=160\ndepth#1=80\nheight#1=74\n"
        "name#2=Car\ncategory#2=Vehicles\nmodel#2=/m.obj\nwidth#2=160\ndepth#2=80\nheight#2=74\n"
        "name#3=Chair\ncategory#3=Kitchen\nmodel#3=/none.obj\nwidth#3=wide\n"
    )
    library = open_library([folder])
    assert len(library) == 1
    assert "entry 3" in library.unreadable[0]
    piece = library.draw("table", np.random.default_rng(0))
    assert piece is not None
    assert (piece.width, piece.depth, piece.height) == pytest.approx((1.6, 0.8, 0.74))


def test_missing_material(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a folder"):
        synthesize(tmp_path / "set", 1, settings=TINY, model_folders=[str(tmp_path / "absent")])
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no usable model"):
        open_library([tmp_path / "empty"])
    with pytest.raises(InputError, match="does not exist"):
        synthesize(tmp_path / "set", 1, settings=TINY, meshes=[str(tmp_path / "absent.ply")])
    (tmp_path / "broken.ply").write_text("ply\nbroken")
    with pytest.raises(FormatError, match=r"broken\.ply' cannot be read"):
        synthesize(tmp_path / "set", 1, settings=TINY, meshes=[str(tmp_path / "broken.ply")])
    assert not (tmp_path / "set").exists()  # not bound to a file that has to change


def test_whole_scene_mesh(tmp_path: Path) -> None:
    import trimesh

    source = generate_scene(np.random.default_rng(11))
    mesh = trimesh.Trimesh(
        np.concatenate(source.solids.vertices), np.concatenate(source.solids.faces), process=False
    )
    mesh.export(tmp_path / "flat.ply")
    scene = load_mesh_scene(tmp_path / "flat.ply")
    assert scene.kind == "mesh"
    stands = walk(np.random.default_rng(0), scene, 4, WalkSettings())
    assert len(stands) == 4
    assert all(0.9 < stand.eye[2] < 1.9 for stand in stands)
    (tmp_path / "broken.ply").write_bytes(b"ply\n")
    with pytest.raises(InputError, match=r"broken\.ply"):
        load_mesh_scene(tmp_path / "broken.ply")


# ---- command -------------------------------------------------------------------------------------


def test_command_writes_report_and_contact_sheet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from PIL import Image

    out = tmp_path / "set"
    settings = ["fragments_per_scene=2", "frames_per_fragment=2", "fusion_voxel=0.03", "min_points=500"]
    arguments = ["data", "synthesize", str(out), "--scenes", "1", "--seed", "2", *settings]
    assert run(geomoe3d, "geomoe3d", arguments) == 0
    text = capsys.readouterr().out
    assert "scenes: 1" in text
    assert (out / "report.md").read_text() == text
    with Image.open(out / "contact.png") as picture:
        assert picture.width > 500
    assert run(geomoe3d, "geomoe3d", arguments) == 0
    assert run(geomoe3d, "geomoe3d", [*arguments, "sensor.farr=3"]) == 2
    assert "sensor.far" in capsys.readouterr().err


def test_settings_are_checked() -> None:
    with pytest.raises((ConfigError, ValueError), match="clutter"):
        SynthesisSettings(clutter=(5.0, 1.0))


def test_job_can_be_sent_to_a_worker(tmp_path: Path) -> None:
    import pickle

    job = Job(str(tmp_path), 0, TINY)
    assert pickle.loads(pickle.dumps(job)) == job
    assert make_scene.__module__ == module.__name__
