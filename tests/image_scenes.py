"""Small scenes for the tests of images: points before two cameras, textured photographs, and warps of them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from geomoe3d.geometry.se3 import make_transform
from geomoe3d.images.cameras import Camera

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
