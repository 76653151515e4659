"""Readers of photographs with known cameras, each of a published layout, told apart by their files.

transforms.json (instant-ngp, nerfstudio), LLFF's poses_bounds.npy, KITTI odometry (calib.txt, poses.txt), COLMAP's
text and binary models, Middlebury's NAME_par.txt, and what OANet and those who followed publish of YFCC100M and SUN3D
(images.txt, calibration.txt, visibility.txt). All give OpenCV's camera frame: x right, y down, z forward.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geomoe3d.errors import FormatError, InputError, MissingFileError, plain_reason
from geomoe3d.geometry.se3 import check_motion, inverse, make_transform
from geomoe3d.images.cameras import Camera, ImageScene, View
from geomoe3d.images.features import read_grey
from geomoe3d.runtime.optional import optional_module
from geomoe3d.runtime.plain import parse_json
from geomoe3d.runtime.words import counted, natural_key, shape_in_words

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
            f"'{folder}' holds no photographs with cameras: none of transforms.json, poses_bounds.npy, poses.txt with "
            "calib.txt, images.txt or .bin with cameras.txt or .bin, *_par.txt, images.txt with calibration.txt and "
            "visibility.txt is there"
        )
    layout, file = found
    try:
        views = list(_LAYOUTS[layout][0](folder, file))
        there = [k for k, view in enumerate(views) if view.path.is_file()]
        pairs = _visible_together(file, there) if layout == "yfcc" else None
    except (FormatError, MissingFileError):
        raise
    except (InputError, ValueError, KeyError, IndexError, TypeError, struct.error, OSError) as error:
        raise FormatError(
            f"'{file}' is damaged, or no file of the layout {layout}: {plain_reason(error)}"
        ) from None
    lost = len(views) - len(there)
    notes = (f"{lost} of {len(views)} views have no image",) if lost else ()
    if len(there) < 2:
        raise InputError(f"'{folder}' ({layout}) has {len(there)} views with an image; at least 2 are needed")
    return ImageScene(folder.name, layout, tuple(views[k] for k in there), notes, pairs)


def layout_of(folder: Path) -> tuple[str, Path] | None:
    """Name of the layout and its main file, or None."""
    for layout, (_, names, beside) in _LAYOUTS.items():
        for file in (file for name in names for file in sorted(folder.glob(name))):
            if all((file.parent / other.format(file.suffix)).is_file() for other in beside):
                return layout, file
    return None


def images_in(folder: Path) -> list[Path]:
    """Image files of a folder by name; numbers in names count as numbers."""
    if not folder.is_dir():
        raise MissingFileError(f"no folder '{folder}' of images")
    images = (path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    return sorted(images, key=lambda path: natural_key(path.name))


def _transforms(folder: Path, file: Path) -> Iterator[View]:
    data = parse_json(file.read_text(encoding="utf-8"))
    for frame in data["frames"]:
        given: dict[str, Any] = {**data, **frame}
        path = folder / given["file_path"]
        path = path if path.suffix else path.with_suffix(".png")
        if "w" not in given:  # a lost image is left out later
            given["h"], given["w"] = read_grey(path).shape if path.is_file() else (1, 1)
        width, height = given["w"], given["h"]
        fx = given["fl_x"] if "fl_x" in given else 0.5 * width / np.tan(0.5 * float(given["camera_angle_x"]))
        camera = Camera(
            float(fx), float(given.get("fl_y", fx)),
            float(given.get("cx", width / 2)) - 0.5, float(given.get("cy", height / 2)) - 0.5,
            tuple(float(given.get(k, 0.0)) for k in ("k1", "k2", "p1", "p2")),  # type: ignore[arg-type]
            (int(width), int(height)),
        )  # fmt: skip
        flip = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera (y up, z backwards) to OpenCV's
        yield View(path, camera, inverse(check_motion(given["transform_matrix"]) @ flip))


def _llff(folder: Path, file: Path) -> Iterator[View]:
    rows = np.load(file, allow_pickle=False)
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise FormatError(
            f"'{file}' must hold 17 numbers for each photograph, found {shape_in_words(rows.shape)}"
        )
    images = sorted(images_in(folder / "images"))  # 10 before 2, as LLFF counts
    if len(images) != len(rows):
        found = f"but '{folder / 'images'}' has {counted(len(images), 'image')}"
        raise FormatError(f"'{file}' has {counted(len(rows), 'pose')}, {found}")
    for path, given in zip(images, rows[:, :15].reshape(-1, 3, 5), strict=True):
        # Columns: down, right, backwards, place, and (height, width, focal length).
        R = np.stack([given[:, 1], given[:, 0], -given[:, 2]], axis=1)
        height, width, f = given[:, 4]
        camera = Camera(f, f, (width - 1) / 2, (height - 1) / 2, size=(int(width), int(height)))
        yield View(path, camera, inverse(make_transform(R, given[:, 3])))


def _kitti(folder: Path, file: Path) -> Iterator[View]:
    first = (folder / "calib.txt").read_text().splitlines()[0].split(":")[-1]
    camera = Camera.of(np.array(first.split(), dtype=np.float64).reshape(3, 4))
    places = [folder / name for name in ("image_0", "image_2", "image_l", "images")]
    place = next((place for place in places if place.is_dir()), folder)
    poses = np.loadtxt(file, ndmin=2)
    if poses.shape[1] != 12:
        raise FormatError(f"'{file}' must have 12 numbers per line, found {poses.shape[1]}")
    for path, row in zip(images_in(place), poses.reshape(-1, 3, 4), strict=False):
        yield View(path, camera, inverse(make_transform(row[:, :3], row[:, 3])))


_MODELS = {
    "SIMPLE_PINHOLE": "fxy", "PINHOLE": "fgxy", "SIMPLE_RADIAL": "fxyk", "RADIAL": "fxykm", "OPENCV": "fgxykmpq",
}  # fmt: skip
"""COLMAP's first camera models in the order of their numbers, and what their parameters are: focal lengths f and g,
centre x and y, radial distortion k and m, tangential p and q."""


def _colmap(folder: Path, file: Path) -> Iterator[View]:
    read = _colmap_binary if file.suffix == ".bin" else _colmap_text
    cameras, images = read(file.with_name(f"cameras{file.suffix}"), file)
    root = folder / "images" if (folder / "images").is_dir() else folder
    made = {}
    for number, (model, width, height, *values) in cameras.items():
        v = dict(zip(_MODELS[model], values, strict=True))
        k, m, p, q = (v.get(name, 0.0) for name in "kmpq")
        size = (int(width), int(height))
        # COLMAP counts from the corner of the first pixel.
        made[number] = Camera(v["f"], v.get("g", v["f"]), v["x"] - 0.5, v["y"] - 0.5, (k, m, p, q), size)
    for name, camera, numbers in sorted(images):
        R = Rotation.from_quat(np.roll(numbers[:4], -1)).as_matrix()  # stored with the real part first
        yield View(root / name, made[camera], make_transform(R, np.array(numbers[4:])))


def _known(model: str, file: Path) -> str:
    if model not in _MODELS:
        known = ", ".join(_MODELS)
        raise FormatError(f"'{file}': camera model {model} is not read; undistort the images, or use {known}")
    return model


def _colmap_text(cameras: Path, images: Path) -> tuple[dict[int, Any], list[Any]]:
    found = {}
    for line in _lines(cameras):
        number, model, *values = line.split()
        found[int(number)] = (_known(model, cameras), *map(float, values))
    lines = [line for line in images.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    views = [line.split(maxsplit=9) for line in lines[::2] if line.strip()]  # the others list points
    return found, [(w[9].strip(), int(w[8]), [float(word) for word in w[1:8]]) for w in views]


def _colmap_binary(cameras: Path, images: Path) -> tuple[dict[int, Any], list[Any]]:
    data, at, found, names = cameras.read_bytes(), 8, {}, dict(enumerate(_MODELS))
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, kind, width, height = struct.unpack_from("<iiQQ", data, at)
        model = _known(names.get(kind, str(kind)), cameras)
        found[number] = (model, width, height, *struct.unpack_from(f"<{len(_MODELS[model])}d", data, at + 24))
        at += 24 + 8 * len(_MODELS[model])
    data, at, views = images.read_bytes(), 8, []
    for _ in range(struct.unpack_from("<Q", data)[0]):
        _, *numbers, camera = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        views.append((data[at + 64 : end].decode(), camera, numbers))
        at = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]  # behind the image's points
    return found, views


def _middlebury(folder: Path, file: Path) -> Iterator[View]:
    for line in _lines(file)[1:]:
        name, *words = line.split()
        K, R, t = np.split(np.array(words, dtype=np.float64)[:21], (9, 18))
        yield View(folder / name, Camera.of(K.reshape(3, 3)), make_transform(R.reshape(3, 3), t))


def _yfcc(folder: Path, file: Path) -> Iterator[View]:
    h5py = optional_module("h5py", "cameras of YFCC100M and SUN3D need h5py", "'geomoe3d[images]'")
    for image, name in zip(_lines(file), _lines(folder / "calibration.txt"), strict=True):
        with h5py.File(folder / name) as stored:
            K, R, t, size = (np.array(stored[key], dtype=np.float64) for key in ("K", "R", "T", "imsize"))
        K = K.reshape(3, 3)
        K[:2, 2] += (size.ravel() - 1) / 2  # published from the middle of the image
        yield View(folder / image, Camera.of(K), make_transform(R.reshape(3, 3), t.ravel()))


def _visible_together(file: Path, there: list[int]) -> tuple[tuple[int, int], ...]:
    """Pairs in the published order of those who drew them: both ways round, by what both images see."""
    rows = [np.loadtxt(file.parent / name).ravel() for name in _lines(file.with_name("visibility.txt"))]
    seen = np.stack(rows)
    least = 50 if seen.max() > 1 else 0.35  # points of a reconstruction; shares of the depth image in SUN3D
    np.fill_diagonal(seen, 0)
    pairs = np.random.RandomState(1234).permutation(np.argwhere(seen > least))
    place = {k: number for number, k in enumerate(there)}
    return tuple((place[i], place[j]) for i, j in pairs.tolist() if i in place and j in place)


def _lines(file: Path) -> list[str]:
    lines = (line.strip() for line in file.read_text(encoding="utf-8").splitlines())
    return [line for line in lines if line and not line.startswith("#")]


_COLMAP = [f"{place}images{suffix}" for place in ("", "sparse/", "sparse/0/") for suffix in (".bin", ".txt")]
_LAYOUTS: dict[str, tuple[Callable[[Path, Path], Iterator[View]], list[str], tuple[str, ...]]] = {
    "transforms": (_transforms, ["transforms.json"], ()),
    "llff": (_llff, ["poses_bounds.npy"], ()),
    "kitti": (_kitti, ["poses.txt"], ("calib.txt",)),
    "colmap": (_colmap, _COLMAP, ("cameras{}",)),
    "middlebury": (_middlebury, ["*_par.txt"], ()),
    "yfcc": (_yfcc, ["images.txt"], ("calibration.txt", "visibility.txt")),
}
"""Reader of each layout, its main file, and what must lie beside it, {} being the suffix of that."""
