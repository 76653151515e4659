"""Small scenes for the tests of images: points before two cameras, textured photographs, and warps of them."""

from __future__ import annotations

import json

import numpy as np
from scipy.spatial.transform import Rotation

from geomoe3d.geometry.se3 import make_transform
from geomoe3d.images.cameras import Camera

SIZE, FOCAL = (480, 360), 400.0
CAMERA = Camera(700.0, 700.0, 399.5, 299.5, size=(800, 600))


def matches_of(num=300, *, seed=0, turn=20.0, step=(-1.5, 0.1, 0.3), planar=False, wrong=0, noise=0.3):
    """Pixels (N + wrong, 4) of points about four units away, which of them are true, and the pose (4, 4)."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1.5, -1, 3], [1.5, 1, 6], (num, 3))
    if planar:
        points[:, 2] = 4 + 0.5 * points[:, 0] - 0.3 * points[:, 1]
    T = make_transform(Rotation.from_euler("y", turn, degrees=True).as_matrix(), np.array(step))
    moved = points @ T[:3, :3].T + T[:3, 3]
    pixels = np.hstack([x[:, :2] / x[:, 2:] * 700 + [399.5, 299.5] for x in (points, moved)])
    pixels = pixels + rng.normal(0, noise, pixels.shape) * (noise > 0)
    other = rng.uniform([0, 0, 0, 0], [800, 600, 800, 600], (wrong, 4))
    T[:3, 3] /= max(np.linalg.norm(T[:3, 3]), 1e-12)
    return np.vstack([pixels, other]), np.arange(num + wrong) < num, T


def texture(width=480, height=360, seed=0):
    """A grey image (height, width) with blobs of all sizes."""
    import cv2

    rng = np.random.default_rng(seed)
    image = np.zeros((height, width))
    for scale in (3, 8, 20):
        small = rng.random((height // scale + 2, width // scale + 2))
        image += cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC) * scale**0.3
    image = (image - image.min()) / np.ptp(image)
    return (255 * image).astype(np.uint8)


def corner_room(folder):
    """Photographs of two textured walls in a corner, with their cameras (transforms.json)."""
    import cv2

    folder.mkdir(exist_ok=True)
    K = np.array([[FOCAL, 0, 239.5], [0, FOCAL, 179.5], [0, 0, 1]])
    walls = [
        (texture(seed=1), np.array([[-4, -2.5, 5], [4, 0, 1.5], [0, 5, 0]])),
        (texture(seed=2), np.array([[0, -2.5, 6.5], [4, 0, -1.5], [0, 5, 0]])),
    ]
    frames = []
    for k in range(4):
        turned = Rotation.from_euler("y", -9 * k, degrees=True).as_matrix()
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = turned, [0.9 * k, 0.05 * k, 0.1 * k]  # camera to world
        W = np.linalg.inv(T)
        image = np.full((360, 480), 90, np.uint8)
        for picture, (corner, right, down) in walls:
            points = np.array(
                [corner, corner + right, corner + right + down, corner + down], dtype=np.float64
            )
            seen = (points @ W[:3, :3].T + W[:3, 3]) @ K.T
            pixels = (seen[:, :2] / seen[:, 2:]).astype(np.float32)
            square = np.array([[0, 0], [479, 0], [479, 359], [0, 359]], dtype=np.float32)
            H = cv2.getPerspectiveTransform(square, pixels)
            drawn = cv2.warpPerspective(picture, H, SIZE, flags=cv2.INTER_AREA)
            mask = cv2.warpPerspective(np.full_like(picture, 255), H, SIZE)
            image = np.where(mask > 200, drawn, image)
        cv2.imwrite(str(folder / f"{k}.png"), image)
        frames.append({"file_path": f"{k}.png", "transform_matrix": (T @ np.diag([1.0, -1, -1, 1])).tolist()})
    whole = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": 240, "cy": 180, "w": 480, "h": 360, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(whole))
    return folder


def write_published(folder, names, K, poses, visible, size=(64, 48)):
    """What OANet publishes of YFCC100M and SUN3D, for images that lie in ``folder``: K from the image's middle."""
    import h5py

    for part in ("calibration", "visibility"):
        (folder / part).mkdir(exist_ok=True)
        files = [f"{part}/{k}.{'h5' if part == 'calibration' else 'txt'}" for k in range(len(names))]
        (folder / f"{part}.txt").write_text("".join(f"{file}\n" for file in files))
    (folder / "images.txt").write_text("".join(f"{name}\n" for name in names))
    for k, (T, row) in enumerate(zip(poses, visible, strict=True)):
        with h5py.File(folder / "calibration" / f"{k}.h5", "w") as stored:
            stored["K"], stored["R"], stored["T"] = K, T[:3, :3], T[None, :3, 3]
            stored["imsize"] = np.array([size])
        np.savetxt(folder / "visibility" / f"{k}.txt", np.array(row)[None])
