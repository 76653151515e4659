"""What training reads: correspondences with labels and the true motion, one pair at a time.

A pair dataset is anything with ``len()``, ``[index]``, ``identity()`` and ``voxel_sizes()``. `ShardFolder`
reads pairs that were written to disk, mapped into memory so that a data set larger than memory costs only
what is touched. `geomoe3d.training.synthetic` makes them up.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from geomoe3d.errors import FormatError, InputError
from geomoe3d.runtime.files import new_folder
from geomoe3d.runtime.words import counted
from geomoe3d.types import BoolArray, Float32Array, FloatArray

OPTIONAL_CHANNELS = ("feature_distance", "ratio", "mutual")
_OF_MOTIONS = ("motions", "motion_start", "viewpoints")
_REQUIRED = ("start", "correspondences", "labels", "T_target_source", "voxel_size")


@dataclass(frozen=True)
class TrainingPair:
    """One pair of clouds, or of images, as far as training sees it.

    Attributes:
        correspondences: (N, 6) float32 rows [source xyz, target xyz], cloud units; of images (N, 4) rows
            [x0, y0, x1, y1], normalised by the intrinsics, with the pose X1 = R X0 + t, |t| = 1, for the
            motion, labels by `geomoe3d.geometry.essential.label_threshold`, and a voxel size of 1.
        labels: (N,) True where the residual under the true motion is below the inlier threshold.
        T_target_source: (4, 4) float64 true motion, p_target = R p_source + t.
        voxel_size: cloud units.
        feature_distance: (N,) float32 or None.
        ratio: (N,) float32 or None.
        mutual: (N,) bool or None.
        motions: (K, 4, 4) float64 motions proposed for the pair, best first, or None; for networks that
            score transforms.
        viewpoints: (2, 3) places of the source's and the target's sensor, or None where not known.
    """

    correspondences: Float32Array
    labels: BoolArray
    T_target_source: FloatArray
    voxel_size: float
    feature_distance: Float32Array | None = None
    ratio: Float32Array | None = None
    mutual: BoolArray | None = None
    motions: FloatArray | None = None
    viewpoints: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.correspondences)

    def take(self, rows: NDArray[Any]) -> TrainingPair:
        """The given rows (index or mask), channels included."""
        extra: dict[str, Any] = {
            name: None if (values := getattr(self, name)) is None else values[rows]
            for name in OPTIONAL_CHANNELS
        }
        return replace(self, correspondences=self.correspondences[rows], labels=self.labels[rows], **extra)


class PairDataset(Protocol):
    """A source of training pairs; the same index always gives the same pair."""

    def __len__(self) -> int:
        """Number of pairs."""

    def __getitem__(self, index: int) -> TrainingPair:
        """Pair ``index``, 0 <= index < len."""

    def identity(self) -> str:
        """Short text that changes when the data change; stored in checkpoints and weight cards."""

    def voxel_sizes(self) -> tuple[float, float]:
        """Least and largest voxel size of its pairs; stored in weight cards."""


def _visible(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if not p.name.startswith("."))


def _is_shard(path: Path) -> bool:
    return (path.is_dir() and (path / "start.npy").is_file()) or path.suffix == ".npz"


class ShardFolder:
    """Pairs of a folder of shards, or of its subfolders, in the order of the shards' names.

    A shard is a folder of ``.npy`` files (mapped, recommended for large data) or one ``.npz`` file (loaded
    whole at first use) with ``correspondences`` (sum N, 6 or 4) float32, ``start`` (P+1,) row offsets,
    ``labels`` (sum N,) bool, ``T_target_source`` (P, 4, 4) float64, ``voxel_size`` (P,) and optionally
    ``feature_distance``, ``ratio`` and ``mutual`` (sum N,), ``motions`` (sum K, 4, 4) with ``motion_start``
    (P+1,), and ``viewpoints`` (P, 2, 3).

    Raises:
        InputError: the folder is missing, holds no shard, or holds shards beside folders of shards.
        FormatError: a shard lacks an array, or its arrays do not fit together.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise InputError(f"training data '{self.folder}' is not a folder; give a folder of shards")
        entries = _visible(self.folder)
        flat = [entry for entry in entries if _is_shard(entry)]
        parts = [entry for entry in entries if entry.is_dir() and not _is_shard(entry)]
        nested = [shard for part in parts for shard in _visible(part) if _is_shard(shard)]
        if flat and nested:
            raise InputError(
                f"'{self.folder}' holds shards ('{flat[0].name}') and a folder of shards "
                f"('{nested[0].parent.name}'); keep them apart, lest data of two origins mix"
            )
        self._paths = flat or nested
        if not self._paths:
            raise InputError(
                f"'{self.folder}' and its subfolders hold no shard (a folder with start.npy, or a .npz file)"
            )
        self._open: dict[int, dict[str, NDArray[Any]]] = {}
        counts = [len(_read(path, ("start",))["start"]) - 1 for path in self._paths]
        self._first = np.concatenate([[0], np.cumsum(counts)])

    def __len__(self) -> int:
        return int(self._first[-1])

    def __getitem__(self, index: int) -> TrainingPair:
        if not 0 <= index < len(self):
            raise IndexError(f"pair {index} of {len(self)}")
        shard = int(np.searchsorted(self._first, index, side="right")) - 1
        arrays = self._arrays(shard)
        i = index - int(self._first[shard])
        rows = slice(int(arrays["start"][i]), int(arrays["start"][i + 1]))
        extra = {name: np.array(arrays[name][rows]) for name in OPTIONAL_CHANNELS if name in arrays}
        if "motions" in arrays:
            few = slice(int(arrays["motion_start"][i]), int(arrays["motion_start"][i + 1]))
            extra["motions"] = np.array(arrays["motions"][few])
        if "viewpoints" in arrays:
            extra["viewpoints"] = np.array(arrays["viewpoints"][i])
        return TrainingPair(
            np.array(arrays["correspondences"][rows], dtype=np.float32),
            np.array(arrays["labels"][rows], dtype=bool),
            np.array(arrays["T_target_source"][i], dtype=np.float64),
            float(arrays["voxel_size"][i]),
            **extra,
        )

    def identity(self) -> str:
        """Hash of the shards' names, sizes and offsets."""
        digest = hashlib.sha256()
        for path in self._paths:
            digest.update(path.relative_to(self.folder).as_posix().encode())
            digest.update(_read(path, ("start",))["start"].astype(np.int64).tobytes())
            files = sorted(path.iterdir()) if path.is_dir() else [path]
            digest.update(json.dumps([[f.name, f.stat().st_size] for f in files]).encode())
        return f"shards:{self.folder.name}:{len(self)}:{digest.hexdigest()[:12]}"

    def voxel_sizes(self) -> tuple[float, float]:
        """Least and largest of all pairs."""
        found = [_read(path, ("voxel_size",)).get("voxel_size", np.zeros(0)) for path in self._paths]
        sizes = np.concatenate(found)
        return float(sizes.min()), float(sizes.max())

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": {}}  # workers open the files themselves

    def _arrays(self, shard: int) -> dict[str, NDArray[Any]]:
        if shard not in self._open:
            path = self._paths[shard]
            arrays = _read(path, (*_REQUIRED, *OPTIONAL_CHANNELS, *_OF_MOTIONS))
            _check_shard(path, arrays)
            self._open[shard] = arrays
        return self._open[shard]


def write_shard(path: str | Path, pairs: Sequence[TrainingPair]) -> None:
    """Write one shard folder, completely or not at all.

    Args:
        path: folder to create; its parent must exist.
        pairs: all with, or all without, each optional channel.

    Raises:
        OutputError: the folder exists or cannot be created.
        InputError: no pairs, or some have a channel that others lack.
    """
    path = Path(path)
    if not pairs:
        raise InputError("a shard needs at least one pair")
    arrays: dict[str, NDArray[Any]] = {
        "start": np.cumsum([0, *map(len, pairs)]).astype(np.int64),
        "correspondences": np.concatenate([p.correspondences for p in pairs]).astype(np.float32),
        "labels": np.concatenate([p.labels for p in pairs]).astype(bool),
        "T_target_source": np.stack([p.T_target_source for p in pairs]).astype(np.float64),
        "voxel_size": np.array([p.voxel_size for p in pairs], dtype=np.float64),
    }
    for name in (*OPTIONAL_CHANNELS, "motions", "viewpoints"):
        given = [values for p in pairs if (values := getattr(p, name)) is not None]
        if given and len(given) < len(pairs):
            raise InputError(f"{len(given)} of {counted(len(pairs), 'pair')} have '{name}'; all or none must")
        if given:
            arrays[name] = np.stack(given) if name == "viewpoints" else np.concatenate(given)
        if given and name == "motions":
            arrays["motion_start"] = np.cumsum([0, *map(len, given)]).astype(np.int64)
    with new_folder(path, "shard") as temporary:
        for name, array in arrays.items():
            np.save(temporary / f"{name}.npy", array)


def _read(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    try:
        if path.is_dir():
            files = {name: path / f"{name}.npy" for name in names}
            return {
                name: np.load(file, mmap_mode="r", allow_pickle=False)
                for name, file in files.items()
                if file.is_file()
            }
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in names if name in archive.files}
    except (OSError, ValueError, EOFError) as error:
        raise FormatError(f"shard '{path}' cannot be read: {error}") from None


def _check_shard(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    missing = [name for name in _REQUIRED if name not in arrays]
    if missing:
        raise FormatError(f"shard '{path}' lacks {', '.join(missing)}")
    start = arrays["start"]
    num_rows, num_pairs = int(start[-1]), len(start) - 1
    expected: dict[str, tuple[int, ...]] = {
        "correspondences": (num_rows, 4 if arrays["correspondences"].shape[1:] == (4,) else 6),
        "T_target_source": (num_pairs, 4, 4),
    }
    expected |= {"labels": (num_rows,), "voxel_size": (num_pairs,)}
    expected |= {name: (num_rows,) for name in OPTIONAL_CHANNELS if name in arrays}
    if "motions" in arrays:
        if "motion_start" not in arrays:
            raise FormatError(f"shard '{path}' has transforms but lacks motion_start")
        num_motions = int(arrays["motion_start"][-1])
        expected |= {"motion_start": (num_pairs + 1,), "motions": (num_motions, 4, 4)}
    if "viewpoints" in arrays:
        expected["viewpoints"] = (num_pairs, 2, 3)
    for name, shape in expected.items():
        if arrays[name].shape != shape:
            raise FormatError(f"shard '{path}': {name} has shape {arrays[name].shape}, expected {shape}")
    if bool((np.diff(start) < 0).any()) or start[0] != 0:
        raise FormatError(f"shard '{path}': start must rise from 0")
