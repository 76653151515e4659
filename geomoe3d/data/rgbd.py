"""Recorded depth frames with poses, in the conventions that people publish them in.

Known folders: 7-Scenes and 3DMatch (``frame-000000.depth.png`` with ``frame-000000.pose.txt``), TUM
(``depth.txt`` and ``groundtruth.txt``), and plain ones (``depth/*.png`` with one pose per row of
``poses.txt``). Poses are camera to world, depth is 16-bit. Frames without a usable pose or depth are named
and left out. Listing reads poses only; images are decoded one at a time, about 10 ms each.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geomoe3d.errors import FormatError, InputError, MissingFileError, cannot_read, plain_reason
from geomoe3d.geometry.se3 import is_rotation, make_transform, project_to_so3
from geomoe3d.runtime.words import counted, shape_in_words
from geomoe3d.types import Float32Array, FloatArray

CONVENTIONS = ("7scenes", "tum", "plain")
_INTRINSICS = ("camera-intrinsics.txt", "K.txt", "intrinsics.txt", "intrinsic_depth.txt")


@dataclass(frozen=True)
class Frame:
    """One depth image on disk with T_world_camera (4, 4)."""

    path: Path
    T_world_camera: FloatArray


@dataclass
class Recording:
    """Frames in the order they were taken.

    Attributes:
        folder: where they came from.
        convention: one of `CONVENTIONS`.
        frames: those with a usable pose.
        intrinsics: (3, 3) pixels.
        per_metre: depth values per metre.
        invalid: depth values that mean nothing was measured.
        skipped: one sentence per frame that is left out.
    """

    folder: Path
    convention: str
    frames: list[Frame]
    intrinsics: FloatArray
    per_metre: float
    invalid: tuple[int, ...] = (0, 65535)
    skipped: list[str] = field(default_factory=list)


def open_recording(
    folder: str | Path,
    *,
    convention: str | None = None,
    intrinsics: FloatArray | None = None,
    per_metre: float | None = None,
    invalid: tuple[int, ...] = (0, 65535),
) -> Recording:
    """List the frames of a folder.

    Args:
        folder: as described in this module; 7-Scenes intrinsics may also lie one folder up.
        convention: one of `CONVENTIONS`; None looks at the folder.
        intrinsics: (3, 3) pixels; None reads the folder's file.
        per_metre: depth values per metre; None takes 5000 for TUM and 1000 otherwise.
        invalid: depth values that mean nothing was measured.

    Raises:
        InputError: no such folder, no known convention, no frames, no intrinsics.
        FormatError: a pose or intrinsics file cannot be understood as a whole.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"'{folder}' is not a folder")
    if convention is None:
        convention = _find_convention(folder)
    readers = {"7scenes": _seven_scenes, "tum": _tum, "plain": _plain}
    if convention not in readers:
        raise InputError(f"there is no convention '{convention}'; there are: {', '.join(CONVENTIONS)}")
    skipped: list[str] = []
    frames = readers[convention](folder, skipped)
    if not frames:
        reasons = "; ".join(skipped[:3])
        raise InputError(
            f"'{folder}' holds no frame with a usable pose" + (f" ({reasons})" if reasons else "")
        )
    K = _read_intrinsics(folder) if intrinsics is None else np.asarray(intrinsics, dtype=np.float64)
    if not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0):
        raise InputError(f"focal lengths must be positive and finite, found intrinsics {K.tolist()}")
    usual = 5000.0 if convention == "tum" else 1000.0
    scale = usual if per_metre is None else per_metre
    if not scale > 0:
        raise InputError(f"depth values per metre must be positive, found {scale}")
    return Recording(folder, convention, frames, K, scale, invalid, skipped)


def read_depth(recording: Recording, frame: Frame) -> Float32Array:
    """Depth (H, W) float32 in metres, 0 where nothing was measured. Raises FormatError: the file is no
    single-channel 16-bit image, or is damaged; InputError: it does not exist."""
    from PIL import Image

    try:
        with Image.open(frame.path) as image:
            values = np.array(image)
    except FileNotFoundError:
        raise MissingFileError(f"'{frame.path}' does not exist") from None
    except Exception as error:  # Pillow raises OSError, SyntaxError, ValueError and zlib's own
        raise FormatError(f"'{frame.path}' is no readable image: {error}") from None
    if values.ndim != 2 or values.dtype.kind not in "iu" or values.dtype.itemsize < 2:
        raise FormatError(
            f"'{frame.path}' is no depth image: expected one channel of 16-bit whole numbers, found "
            f"{' x '.join(map(str, values.shape))} values of {8 * values.dtype.itemsize} bits"
        )
    depth: Float32Array = (values / recording.per_metre).astype(np.float32)
    depth[np.isin(values, recording.invalid)] = 0
    return depth


def image_size(recording: Recording) -> tuple[int, int]:
    """The most common (height, width) of the frames, from their headers."""
    from PIL import Image

    sizes: Counter[tuple[int, int]] = Counter()
    for frame in recording.frames:
        try:
            with Image.open(frame.path) as image:
                sizes[image.height, image.width] += 1
        except Exception:  # named when the frame is read
            continue
    if not sizes:
        raise InputError(f"'{recording.folder}': none of {len(recording.frames)} depth images can be opened")
    return sizes.most_common(1)[0][0]


def _find_convention(folder: Path) -> str:
    if any(folder.glob("*.depth.png")):
        return "7scenes"
    if (folder / "groundtruth.txt").is_file() and (folder / "depth.txt").is_file():
        return "tum"
    if (folder / "poses.txt").is_file():
        return "plain"
    raise InputError(
        f"'{folder}' holds neither frame-*.depth.png with *.pose.txt, nor depth.txt with groundtruth.txt, "
        "nor poses.txt with depth/*.png"
    )


def _numbers(path: Path) -> NDArray[np.float64]:
    lines = [line.split("#")[0] for line in _text(path).splitlines()]
    lines = [line for line in lines if line.strip()]
    if not lines:
        raise FormatError(f"'{path}' holds no numbers")
    try:
        return np.atleast_2d(np.loadtxt(lines, delimiter="," if "," in lines[0] else None))
    except ValueError as error:
        raise FormatError(f"'{path}' holds no table of numbers: {plain_reason(error)}") from None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise cannot_read(error, f"cannot read '{path}': {error.strerror or error}") from None
    except UnicodeDecodeError:
        raise FormatError(f"'{path}' is no text file") from None


def _read_intrinsics(folder: Path) -> FloatArray:
    for path in (place / name for place in (folder, folder.parent) for name in _INTRINSICS):
        if path.is_file():
            values = _numbers(path)
            if values.shape in ((3, 3), (4, 4)):
                return np.array(values[:3, :3])
            if values.size in (4, 9):
                return _matrix(values.ravel())
            raise FormatError(
                f"'{path}': expected 3 x 3 or 'fx fy cx cy', found {shape_in_words(values.shape)}"
            )
    raise InputError(
        f"'{folder}' holds no intrinsics ({', '.join(_INTRINSICS)}); give --intrinsics fx,fy,cx,cy"
    )


def _matrix(values: FloatArray) -> FloatArray:
    if len(values) == 9:
        return values.reshape(3, 3)
    fx, fy, cx, cy = values
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def _check_pose(values: FloatArray, name: str, skipped: list[str]) -> FloatArray | None:
    """The pose with its rotation on SO(3), or None and a sentence why not."""
    if values.shape not in ((4, 4), (3, 4)):
        skipped.append(f"{name}: the pose holds {shape_in_words(values.shape)}, expected 4 rows of 4")
        return None
    if not np.isfinite(values).all():
        skipped.append(f"{name}: the pose is not finite")
        return None
    R = values[:3, :3]
    if not is_rotation(R, 0.02):
        skipped.append(f"{name}: the pose holds no rotation (det {np.linalg.det(R):.3f})")
        return None
    return make_transform(project_to_so3(R), np.array(values[:3, 3]))


def _seven_scenes(folder: Path, skipped: list[str]) -> list[Frame]:
    frames = []
    for path in sorted(folder.glob("*.depth.png")):
        pose_file = path.with_name(path.name.removesuffix(".depth.png") + ".pose.txt")
        if not pose_file.is_file():
            skipped.append(f"{path.name}: no {pose_file.name}")
            continue
        try:
            values = _numbers(pose_file)
        except FormatError as error:
            skipped.append(f"{path.name}: {error}")
            continue
        pose = _check_pose(values, path.name, skipped)
        if pose is not None:
            frames.append(Frame(path, pose))
    return frames


def _plain(folder: Path, skipped: list[str]) -> list[Frame]:
    rows = _numbers(folder / "poses.txt")
    if rows.shape[1] not in (12, 16):
        if rows.shape[1] == 4 and len(rows) % 4 == 0:
            rows = rows.reshape(-1, 16)
        else:
            raise FormatError(
                f"'{folder / 'poses.txt'}' has {counted(rows.shape[1], 'column')}, expected 16 or 12 per pose"
            )
    place = folder / "depth" if (folder / "depth").is_dir() else folder
    images = sorted(place.glob("*.png"))
    if len(images) != len(rows):
        raise FormatError(
            f"'{folder}': {counted(len(images), 'depth image')} but {counted(len(rows), 'pose')}; each needs a row"
        )
    frames = []
    for path, row in zip(images, rows, strict=True):
        pose = _check_pose(row.reshape(-1, 4), path.name, skipped)
        if pose is not None:
            frames.append(Frame(path, pose))
    return frames


def _tum(folder: Path, skipped: list[str]) -> list[Frame]:
    """TUM: the pose nearest in time, at most 20 ms away, as its tools associate them."""
    from scipy.spatial.transform import Rotation

    poses = _numbers(folder / "groundtruth.txt")
    if poses.shape[1] != 8:
        raise FormatError(
            f"'{folder / 'groundtruth.txt'}' has {counted(poses.shape[1], 'column')}, expected 8"
        )
    poses = poses[np.argsort(poses[:, 0])]
    frames = []
    for number, line in enumerate(_text(folder / "depth.txt").splitlines(), start=1):
        words = line.split()
        if not words or line.startswith("#"):
            continue
        try:
            time, path = float(words[0]), folder / words[1]
        except (IndexError, ValueError):
            skipped.append(f"depth.txt line {number}: no 'time file': '{line}'")
            continue
        right = int(np.clip(np.searchsorted(poses[:, 0], time), 1, len(poses) - 1)) if len(poses) > 1 else 0
        near = min((max(right - 1, 0), right), key=lambda k: abs(poses[k, 0] - time))
        gap = abs(poses[near, 0] - time)
        most = 0.02
        if gap > most:
            skipped.append(f"{path.name}: the nearest pose is {gap:.3f} s away, at most {most} s is used")
            continue
        row = poses[near]
        if not np.isfinite(row).all():
            skipped.append(f"{path.name}: the pose is not finite")
            continue
        if not row[4:].any():
            skipped.append(f"{path.name}: the pose holds no rotation (its quaternion is zero)")
            continue
        frames.append(Frame(path, make_transform(Rotation.from_quat(row[4:]).as_matrix(), row[1:4])))
    return frames
