"""Readers of photographs with known cameras, each of a published layout, told apart by their files.

transforms.json (instant-ngp, nerfstudio), LLFF's poses_bounds.npy, KITTI odometry (calib.txt, poses.txt), COLMAP's
text and binary models, Middlebury's NAME_par.txt, and what OANet and those who followed publish of YFCC100M and SUN3D
(images.txt, calibration.txt, visibility.txt). All give OpenCV's camera frame: x right, y down, z forward.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geomoe3d.errors import FormatError, InputError, MissingFileError
from geomoe3d.geometry.se3 import inverse, make_transform
from geomoe3d.images.cameras import Camera, ImageScene, View
from geomoe3d.runtime.optional import optional_module
from geomoe3d.runtime.words import counted, natural_key
from geomoe3d.types import FloatArray

SUFFIXES = (".jpg", ".jpeg", ".png", ".ppm", ".bmp", ".tif", ".tiff")


def read_scene(folder: str | Path) -> ImageScene:
    """The photographs of a folder with their cameras.

    Raises:
        MissingFileError: no such folder.
        InputError: it has none of the known layouts, or fewer than two views with an image.
        FormatError: a file of the layout is damaged.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise MissingFileError(f"no folder '{folder}' of photographs")
    found = layout_of(folder)
    if found is None:
        raise InputError(
            f"'{folder}' holds no photographs with cameras: none of transforms.json, poses_bounds.npy, "
            "poses.txt with calib.txt, cameras.txt or .bin with images.txt or .bin, *_par.txt, images.txt with "
            "calibration.txt and visibility.txt is there"
        )
    layout, file = found
    try:
        views = list(_READERS[layout](folder, file))
        there = [k for k, view in enumerate(views) if view.path.is_file()]
        pairs = _visible_together(file, there) if layout == "yfcc" else None
    except InputError:
        raise
    except (ValueError, KeyError, IndexError, TypeError, struct.error, OSError) as error:
        raise FormatError(f"'{file}' is damaged, or no file of the layout {layout}: {error}") from None
    lost = len(views) - len(there)
    notes = (f"{lost} of {len(views)} views have no image",) if lost else ()
    if len(there) < 2:
        raise InputError(f"'{folder}' ({layout}) has {len(there)} views with an image; at least 2 are needed")
    return ImageScene(folder.name, layout, tuple(views[k] for k in there), notes, pairs)


def layout_of(folder: Path) -> tuple[str, Path] | None:
    """Name of the layout and its main file, or None."""
    for layout, (names, beside) in _FILES.items():
        places = ("", "sparse/", "sparse/0/") if layout == "colmap" else ("",)
        for file in (
            file for place in places for name in names for file in sorted(folder.glob(place + name))
        ):
            if all((file.parent / other.format(file.suffix)).is_file() for other in beside):
                return layout, file
    return None


def images_in(folder: Path) -> list[Path]:
    """Image files of a folder by name; numbers in names count as numbers."""
    if not folder.is_dir():
        raise MissingFileError(f"no folder '{folder}' of images")
    return sorted(
        (p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES), key=lambda p: natural_key(p.name)
    )


def _transforms(folder: Path, file: Path) -> Iterator[View]:
    data = json.loads(file.read_text(encoding="utf-8"))
    for frame in data["frames"]:
        given = {**data, **frame}
        path = folder / given["file_path"]
        path = path if path.suffix else path.with_suffix(".png")
        width, height = (given["w"], given["h"]) if "w" in given else _size(path)
        fx = given["fl_x"] if "fl_x" in given else 0.5 * width / np.tan(0.5 * float(given["camera_angle_x"]))
        camera = Camera(
            float(fx), float(given.get("fl_y", fx)),
            float(given.get("cx", width / 2)) - 0.5, float(given.get("cy", height / 2)) - 0.5,
            tuple(float(given.get(k, 0.0)) for k in ("k1", "k2", "p1", "p2")),  # type: ignore[arg-type]
            (int(width), int(height)),
        )  # fmt: skip
        flip = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera (y up, z backwards) to OpenCV's
        yield View(path, camera, inverse(_matrix(given["transform_matrix"]) @ flip))


def _llff(folder: Path, file: Path) -> Iterator[View]:
    rows = np.load(file, allow_pickle=False)
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise FormatError(f"'{file}' must have shape (N, 17), found {rows.shape}")
    images = sorted(images_in(folder / "images"))  # 10 before 2, as LLFF counts
    if len(images) != len(rows):
        raise InputError(
            f"'{file}' has {counted(len(rows), 'pose')}, but '{folder / 'images'}' has {counted(len(images), 'image')}"
        )
    for path, row in zip(images, rows, strict=True):
        given = row[:15].reshape(3, 5)
        # Columns: down, right, backwards, place, and (height, width, focal length).
        R = np.stack([given[:, 1], given[:, 0], -given[:, 2]], axis=1)
        height, width, f = given[:, 4]
        camera = Camera(f, f, (width - 1) / 2, (height - 1) / 2, size=(int(width), int(height)))
        yield View(path, camera, inverse(make_transform(R, given[:, 3])))


def _kitti(folder: Path, file: Path) -> Iterator[View]:
    first = (folder / "calib.txt").read_text().splitlines()[0].split(":")[-1]
    camera = Camera.of(np.array(first.split(), dtype=np.float64).reshape(3, 4))
    place = next(
        (p for n in ("image_0", "image_2", "image_l", "images") if (p := folder / n).is_dir()), folder
    )
    poses = np.loadtxt(file, ndmin=2)
    if poses.shape[1] != 12:
        raise FormatError(f"'{file}' must have 12 numbers per line, found {poses.shape[1]}")
    for path, row in zip(images_in(place), poses.reshape(-1, 3, 4), strict=False):
        yield View(path, camera, inverse(make_transform(row[:, :3], row[:, 3])))


_MODELS: dict[str, tuple[int, Callable[..., Camera]]] = {
    "SIMPLE_PINHOLE": (3, lambda f, x, y: Camera(f, f, x, y)),
    "PINHOLE": (4, lambda f, g, x, y: Camera(f, g, x, y)),
    "SIMPLE_RADIAL": (4, lambda f, x, y, k: Camera(f, f, x, y, (k, 0.0, 0.0, 0.0))),
    "RADIAL": (5, lambda f, x, y, k, m: Camera(f, f, x, y, (k, m, 0.0, 0.0))),
    "OPENCV": (8, lambda f, g, x, y, k, m, p, q: Camera(f, g, x, y, (k, m, p, q))),
}
"""Number of parameters of COLMAP's first camera models, in the order of their numbers, and the camera of them."""


def _colmap(folder: Path, file: Path) -> Iterator[View]:
    read = _colmap_binary if file.suffix == ".bin" else _colmap_text
    cameras, images = read(file.with_name(f"cameras{file.suffix}"), file)
    root = folder / "images" if (folder / "images").is_dir() else folder
    made = {}
    for number, (model, width, height, values) in cameras.items():
        if model not in _MODELS:
            known = ", ".join(_MODELS)
            raise FormatError(
                f"'{file}': camera model {model} is not read; undistort the images, or use {known}"
            )
        ideal = _MODELS[model][1](*values)
        made[number] = Camera(
            ideal.fx, ideal.fy, ideal.cx - 0.5, ideal.cy - 0.5, ideal.distortion, (width, height)
        )  # COLMAP counts from the corner of the first pixel
    for name, camera, q, t in sorted(images, key=lambda one: one[0]):
        R = Rotation.from_quat([q[1], q[2], q[3], q[0]]).as_matrix()
        yield View(root / name, made[camera], make_transform(R, t))


def _colmap_text(cameras: Path, images: Path) -> tuple[dict[int, Any], list[Any]]:
    found = {}
    for line in cameras.read_text(encoding="utf-8").splitlines():
        if line.strip() and not line.startswith("#"):
            number, model, width, height, *values = line.split()
            found[int(number)] = (model, int(width), int(height), [float(v) for v in values])
    lines = [line for line in images.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    views = []
    for line in lines[::2]:  # every other line lists the image's points
        if line.strip():
            words = line.split(maxsplit=9)
            numbers = [float(word) for word in words[1:8]]
            views.append((words[9].strip(), int(words[8]), numbers[:4], np.array(numbers[4:])))
    return found, views


def _colmap_binary(cameras: Path, images: Path) -> tuple[dict[int, Any], list[Any]]:
    data, at = cameras.read_bytes(), 8
    found = {}
    names = list(_MODELS)
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        if not 0 <= model < len(names):
            raise FormatError(f"'{cameras}': camera model {model} is not read; undistort the images first")
        count = _MODELS[names[model]][0]
        found[number] = (names[model], width, height, struct.unpack_from(f"<{count}d", data, at + 24))
        at += 24 + 8 * count
    data, at = images.read_bytes(), 8
    views = []
    for _ in range(struct.unpack_from("<Q", data)[0]):
        _, *numbers, camera = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        views.append((data[at + 64 : end].decode(), camera, numbers[:4], np.array(numbers[4:])))
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * points
    return found, views


def _middlebury(folder: Path, file: Path) -> Iterator[View]:
    for line in file.read_text(encoding="utf-8").splitlines()[1:]:
        if line.strip():
            name, *words = line.split()
            K, R, t = np.split(np.array(words, dtype=np.float64)[:21], (9, 18))
            yield View(folder / name, Camera.of(K.reshape(3, 3)), make_transform(R.reshape(3, 3), t))


def _yfcc(folder: Path, file: Path) -> Iterator[View]:
    h5py = optional_module("h5py", "cameras of YFCC100M and SUN3D need h5py", "'geomoe3d[images]'")
    for image, name in zip(*(_lines(f) for f in (file, folder / "calibration.txt")), strict=True):
        with h5py.File(folder / name) as stored:
            K, R, t, size = (np.array(stored[key], dtype=np.float64) for key in ("K", "R", "T", "imsize"))
        K = K.reshape(3, 3)
        K[:2, 2] += (size.ravel() - 1) / 2  # published from the middle of the image
        yield View(folder / image, Camera.of(K), make_transform(R.reshape(3, 3), t.ravel()))


def _visible_together(file: Path, there: list[int]) -> tuple[tuple[int, int], ...]:
    """Pairs in the published order of those who drew them: both ways round, by what both images see."""
    seen = np.stack(
        [np.loadtxt(file.parent / name).ravel() for name in _lines(file.with_name("visibility.txt"))]
    )
    least = 50 if seen.max() > 1 else 0.35  # points of a reconstruction; shares of the depth image in SUN3D
    np.fill_diagonal(seen, 0)
    pairs = np.random.RandomState(1234).permutation(np.argwhere(seen > least))
    place = {k: number for number, k in enumerate(there)}
    return tuple((place[i], place[j]) for i, j in pairs.tolist() if i in place and j in place)


def _lines(file: Path) -> list[str]:
    return [line.strip() for line in file.read_text(encoding="utf-8").splitlines() if line.strip()]


_READERS: dict[str, Callable[[Path, Path], Iterator[View]]] = {
    "transforms": _transforms, "llff": _llff, "kitti": _kitti, "colmap": _colmap, "middlebury": _middlebury,
    "yfcc": _yfcc,
}  # fmt: skip
_FILES = {
    "transforms": (("transforms.json",), ()), "llff": (("poses_bounds.npy",), ()),
    "kitti": (("poses.txt",), ("calib.txt",)), "colmap": (("images.bin", "images.txt"), ("cameras{}",)),
    "middlebury": (("*_par.txt",), ()), "yfcc": (("images.txt",), ("calibration.txt", "visibility.txt")),
}  # fmt: skip
"""Main file of each layout, and what must lie beside it, {} being its suffix."""


def _matrix(rows: Any) -> FloatArray:
    T = np.array(rows, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise ValueError(f"a transform_matrix must hold 4 x 4 finite numbers, found shape {T.shape}")
    return T


def _size(path: Path) -> tuple[int, int]:
    from geomoe3d.images.features import read_grey

    height, width = read_grey(path).shape if path.is_file() else (1, 1)  # a lost image is left out later
    return width, height
