"""Readers of photographs with cameras: each layout gives the same views of one made-up scene."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from image_scenes import write_published
from scipy.spatial.transform import Rotation

from geomoe3d.errors import FormatError, InputError, MissingFileError
from geomoe3d.geometry.se3 import inverse, make_transform, rotation_angle_deg
from geomoe3d.images.cameras import relative_pose
from geomoe3d.images.pairs import choose_pairs, pose_pairs
from geomoe3d.images.scenes import read_scene

cv2 = pytest.importorskip("cv2")
pytest.importorskip("h5py")
NAMES = ["img_1.png", "img_2.png", "img_10.png"]
WIDTH, HEIGHT, FOCAL = 64, 48, 50.0
SEEN = [[90, 60, 50], [70, 90, 10], [20, 51, 90]]  # more than 50 points: 0-1, 1-0, 2-1


def poses():
    """Camera to world, OpenCV's frame."""
    turns = Rotation.from_euler("yx", [[0, 0], [15, 5], [30, 10]], degrees=True).as_matrix()
    return [make_transform(R, np.array([k, 0.2 * k, 0.1])) for k, R in enumerate(turns)]


def images(folder):
    folder.mkdir(parents=True, exist_ok=True)
    for name in NAMES:
        cv2.imwrite(str(folder / name), np.zeros((HEIGHT, WIDTH), np.uint8))


def transforms(folder):
    images(folder / "images")
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": (T @ np.diag([1.0, -1, -1, 1])).tolist()}
        for name, T in zip(NAMES, poses(), strict=True)
    ]
    frames.append({"file_path": "images/lost.png", "transform_matrix": np.eye(4).tolist()})
    whole = {"camera_angle_x": 2 * np.arctan(WIDTH / 2 / FOCAL), "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(whole))


def llff(folder):
    images(folder / "images")
    rows = []
    for k in np.argsort(NAMES):  # by name, 10 before 2
        R, c = poses()[k][:3, :3], poses()[k][:3, 3]
        block = np.column_stack([R[:, 1], R[:, 0], -R[:, 2], c, [HEIGHT, WIDTH, FOCAL]])
        rows.append(np.concatenate([block.ravel(), [1.0, 9.0]]))
    np.save(folder / "poses_bounds.npy", np.array(rows))


def kitti(folder):
    images(folder / "image_0")
    P = np.array([[FOCAL, 0, WIDTH / 2 - 0.5, 0], [0, FOCAL, HEIGHT / 2 - 0.5, 0], [0, 0, 1, 0]])
    (folder / "calib.txt").write_text("P0: " + " ".join(map(str, P.ravel())) + "\n")
    np.savetxt(folder / "poses.txt", [T[:3].ravel() for T in poses()])


def colmap_text(folder):
    images(folder / "images")
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "sparse" / "0" / "cameras.txt").write_text(
        f"# cameras\n7 SIMPLE_RADIAL {WIDTH} {HEIGHT} {FOCAL} {WIDTH / 2} {HEIGHT / 2} 0\n"
    )
    lines = ["# images"]
    for k, (name, T) in enumerate(zip(NAMES, poses(), strict=True)):
        W = inverse(T)
        x, y, z, w = Rotation.from_matrix(W[:3, :3]).as_quat()
        lines += [" ".join(map(str, [k + 1, w, x, y, z, *W[:3, 3], 7, name])), "1.0 2.0 -1"]
    (folder / "sparse" / "0" / "images.txt").write_text("\n".join(lines) + "\n")


def colmap_binary(folder):
    images(folder / "images")
    cameras = struct.pack("<QiiQQ4d", 1, 7, 1, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    (folder / "cameras.bin").write_bytes(cameras)
    data = struct.pack("<Q", 3)
    for k, (name, T) in enumerate(zip(NAMES, poses(), strict=True)):
        W = inverse(T)
        x, y, z, w = Rotation.from_matrix(W[:3, :3]).as_quat()
        data += struct.pack("<i7di", k + 1, w, x, y, z, *W[:3, 3], 7) + name.encode() + b"\0"
        data += struct.pack("<Q2dq", 1, 3.0, 4.0, -1)
    (folder / "images.bin").write_bytes(data)


def middlebury(folder):
    images(folder)
    lines = ["3"]
    for name, T in zip(NAMES, poses(), strict=True):
        W = inverse(T)
        K = [FOCAL, 0, WIDTH / 2 - 0.5, 0, FOCAL, HEIGHT / 2 - 0.5, 0, 0, 1]
        lines.append(" ".join([name, *map(str, [*K, *W[:3, :3].ravel(), *W[:3, 3]])]))
    (folder / "toy_par.txt").write_text("\n".join(lines))


def yfcc(folder):
    images(folder / "images")
    K = np.diag([FOCAL, FOCAL, 1.0])
    write_published(folder, [f"images/{name}" for name in NAMES], K, [inverse(T) for T in poses()], SEEN)


LAYOUTS = [transforms, llff, kitti, colmap_text, colmap_binary, middlebury, yfcc]
MAIN_FILES = ("transforms.json", "poses_bounds.npy", "poses.txt", "images.txt", "images.bin", "toy_par.txt")
each_layout = pytest.mark.parametrize("layout", LAYOUTS, ids=lambda f: f.__name__)


@each_layout
def test_every_layout_gives_the_same_views(layout, tmp_path):
    layout(tmp_path)
    scene = read_scene(tmp_path)
    assert scene.layout == layout.__name__.split("_")[0]
    by_name = {view.path.name: view for view in scene.views}
    assert sorted(by_name) == sorted(NAMES)
    for name, T in zip(NAMES, poses(), strict=True):
        np.testing.assert_allclose(by_name[name].T_camera_world, inverse(T), atol=1e-5)
        camera = by_name[name].camera
        expected = [FOCAL, FOCAL, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5]
        np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], expected, rtol=1e-9)
    assert bool(scene.notes) == (layout is transforms)  # the lost image is told


@each_layout
def test_damaged_files_are_named(layout, tmp_path):
    layout(tmp_path)
    (main,) = (path for path in tmp_path.rglob("*") if path.name in MAIN_FILES)
    data = main.read_bytes()
    main.write_bytes(data[: len(data) // 2 - 3])
    with pytest.raises(InputError, match=main.name) as caught:
        read_scene(tmp_path)
    assert isinstance(caught.value, FormatError | InputError)


def test_pairs_of_a_published_scene_are_those_that_see_enough_in_the_published_order(tmp_path):
    yfcc(tmp_path)
    drawn = [[(0, 1), (1, 0), (2, 1)][k] for k in np.random.RandomState(1234).permutation(3)]
    assert list(read_scene(tmp_path).pairs) == drawn
    first, second = pose_pairs(read_scene(tmp_path), 2)[0]
    assert [first.path.name, second.path.name] == [NAMES[k] for k in drawn[0]]
    (tmp_path / "images" / NAMES[0]).unlink()
    assert list(read_scene(tmp_path).pairs) == [(1, 0)]  # numbers are those of the views that are there


def test_shares_of_the_depth_image_say_who_sees_whom_in_sun3d(tmp_path):
    images(tmp_path / "images")
    shares = [[1, 0.5, 0.2], [0.3, 1, 0.2], [0.2, 0.4, 1]]
    names = [f"images/{name}" for name in NAMES]
    write_published(tmp_path, names, np.eye(3), [inverse(T) for T in poses()], shares)
    assert sorted(read_scene(tmp_path).pairs) == [(0, 1), (2, 1)]


def test_folders_without_cameras_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"transforms\.json"):
        read_scene(tmp_path)
    with pytest.raises(MissingFileError, match="nowhere"):
        read_scene(tmp_path / "nowhere")
    transforms(tmp_path)
    (tmp_path / "images" / NAMES[0]).unlink()
    (tmp_path / "images" / NAMES[1]).unlink()
    with pytest.raises(InputError, match="1 views with an image"):
        read_scene(tmp_path)


def test_pairs_are_chosen_by_their_rotation(tmp_path):
    kitti(tmp_path)
    scene = read_scene(tmp_path)
    a, b, c = scene.views
    assert choose_pairs(scene, (20, 60), 9) == [(a, c)]
    assert choose_pairs(scene, (3, 20), 9) == [(a, b), (b, c)]
    assert len(choose_pairs(scene, (3, 60), 2)) == 2
    T = relative_pose(scene.views[0], scene.views[2])
    np.testing.assert_allclose(T, inverse(poses()[2]) @ poses()[0], atol=1e-5)
    assert 20 < rotation_angle_deg(T[:3, :3]) < 60
