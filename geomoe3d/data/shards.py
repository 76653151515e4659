"""Described fragments on disk: voxel points, features and the pairs of one scene, mapped into memory.

FPFH is what preparing a pair costs, so it is computed once per fragment; correspondences are drawn from it
anew in every epoch. A shard says which settings and which files it came from and carries the hashes of its
arrays; one that is stale, from another version or damaged is refused with the reason. About 0.6 MB per
fragment of 5,000 points; opening costs the header alone.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomoe3d.errors import FormatError, InputError
from geomoe3d.runtime.files import file_hash, new_folder
from geomoe3d.runtime.plain import parse_json
from geomoe3d.runtime.provenance import differences, in_words
from geomoe3d.types import Float32Array, FloatArray

SHARD_VERSION = 1
_META = "shard.json"
# name -> (type, trailing shape)
_ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {
    "points": ("<f4", (3,)),
    "features": ("<f2", (33,)),
    "start": ("<i8", ()),
    "pair": ("<i8", (2,)),
    "T_target_source": ("<f8", (4, 4)),
    "overlap": ("<f4", ()),
}


@dataclass(frozen=True)
class DescribedScene:
    """Fragments of one scene, described, with the pairs between them.

    Attributes:
        name: of the scene.
        points: (sum n, 3) float32 voxel points of all fragments, each in its own frame, metres.
        features: (sum n, 33) float16 unit FPFH.
        start: (F + 1,) row offsets of the fragments.
        pair: (P, 2) source and target fragment.
        T_target_source: (P, 4, 4) true motions.
        overlap: (P,) share of the source.
        voxel_size: metres.
    """

    name: str
    points: Float32Array
    features: NDArray[np.float16]
    start: NDArray[np.int64]
    pair: NDArray[np.int64]
    T_target_source: FloatArray
    overlap: Float32Array
    voxel_size: float

    def fragment(self, index: int) -> tuple[Float32Array, NDArray[np.float16]]:
        """Points and features of one fragment, as views."""
        rows = slice(int(self.start[index]), int(self.start[index + 1]))
        return self.points[rows], self.features[rows]


def write_shard(folder: str | Path, scene: DescribedScene, settings: dict[str, Any], source: str) -> None:
    """Write one shard, completely or not at all.

    Args:
        folder: of the shard; its parent must exist.
        scene: what it holds.
        settings: that made it; JSON values.
        source: fingerprint of the files it came from.

    Raises:
        OutputError: the folder exists, or the disk refuses; then nothing is left.
    """
    with new_folder(Path(folder), "shard") as temporary:
        hashes = {}
        for name, (kind, _) in _ARRAYS.items():
            path = temporary / f"{name}.npy"
            np.save(path, np.asarray(getattr(scene, name), dtype=kind))
            hashes[name] = file_hash(path)
        meta = {
            "version": SHARD_VERSION,
            "name": scene.name,
            "voxel_size": scene.voxel_size,
            "settings": settings,
            "source": source,
            "sha256": hashes,
        }
        (temporary / _META).write_text(json.dumps(meta, indent=1) + "\n")


def is_shard(folder: Path) -> bool:
    """Whether a folder is a shard of fragments with features."""
    return (folder / _META).is_file()


def read_meta(folder: str | Path) -> dict[str, Any]:
    """What a shard says about itself. Raises FormatError: shard.json is missing or damaged."""
    path = Path(folder) / _META
    try:
        meta = parse_json(path.read_text())
    except (OSError, ValueError) as error:
        raise FormatError(f"shard '{folder}' has no readable {_META}: {error}") from None
    if not isinstance(meta, dict) or "version" not in meta:
        raise FormatError(f"shard '{folder}': {_META} holds no version")
    return meta


def why_stale(folder: str | Path, settings: dict[str, Any], source: str | None = None) -> str | None:
    """The reason why a shard does not fit settings or source files any more, or None if it does. Raises
    FormatError: as `read_meta`."""
    meta = read_meta(folder)
    if meta["version"] != SHARD_VERSION:
        return f"version {meta['version']}, this is version {SHARD_VERSION}"
    found = meta.get("settings", {})
    differing = differences(found, settings)
    if differing:
        return f"other settings: {in_words(differing)}"
    if source is not None and meta.get("source") != source:
        return f"other fragments now than those it came from ({meta.get('source')}, now {source})"
    return None


def open_shard(folder: str | Path, *, verify: bool = False) -> DescribedScene:
    """Map a shard into memory.

    Args:
        folder: of the shard.
        verify: True compares the hashes of all arrays, which reads them whole.

    Raises:
        FormatError: another version, an array is missing, cut, of another type, or its hash differs.
    """
    folder = Path(folder)
    meta = read_meta(folder)
    if meta["version"] != SHARD_VERSION:
        raise FormatError(
            f"shard '{folder}' has version {meta['version']}, this reads version {SHARD_VERSION}; "
            "remove it and run 'geomoe3d data features' again"
        )
    arrays: dict[str, Any] = {}
    for name, (kind, trailing) in _ARRAYS.items():
        path = folder / f"{name}.npy"
        try:
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise FormatError(f"shard '{folder}': {name}.npy cannot be read: {error}") from None
        if array.dtype != np.dtype(kind) or array.shape[1:] != trailing:
            raise FormatError(f"shard '{folder}': {name} is {array.dtype} {array.shape}")
        if verify and file_hash(path) != meta.get("sha256", {}).get(name):
            raise FormatError(f"shard '{folder}': {name}.npy is damaged, its hash differs; make it anew")
        arrays[name] = array
    _check(folder, arrays)
    return DescribedScene(str(meta["name"]), **arrays, voxel_size=float(meta["voxel_size"]))


def _check(folder: Path, arrays: dict[str, Any]) -> None:
    start, pair = arrays["start"], arrays["pair"]
    num_fragments = len(start) - 1
    sound = num_fragments >= 0 and start[0] == 0 and bool((np.diff(start) >= 0).all())
    sound = sound and int(start[-1]) == len(arrays["points"]) == len(arrays["features"])
    sound = sound and len(pair) == len(arrays["T_target_source"]) == len(arrays["overlap"])
    if not sound or (len(pair) and not (pair.min() >= 0 and pair.max() < num_fragments)):
        raise FormatError(f"shard '{folder}': its arrays do not fit together; remove it and make it anew")


def shard_folders(folder: str | Path) -> list[Path]:
    """Shards of a folder by name. Raises InputError: no such folder, or it holds none."""
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"'{folder}' is not a folder")
    found = sorted(p for p in folder.iterdir() if not p.name.startswith(".") and is_shard(p))
    if not found:
        raise InputError(
            f"'{folder}' holds no shard of fragments with features; 'geomoe3d data features' makes them"
        )
    return found
