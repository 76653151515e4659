"""What every method is given of a pair, the same for all of them: fixed correspondences, all, or the clouds.

- ``1k``: 1,000 nearest neighbours in feature space. Where the benchmark folder holds ``correspondences-1k``
  these are taken as published with it; elsewhere they are drawn from ``all`` with a seed that is the pair's.
- ``all``: the nearest target of every source point on the 5 cm grid, no mutual check (benchmark rule).
- ``clouds``: the points of both files.

Making the input is not on any method's clock. Clouds and features are kept for as long as a scene lasts.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.config import PreparationConfig
from geomoe3d.data.collection import load_fragment
from geomoe3d.data.describe import describe_fragment
from geomoe3d.data.threedmatch import BENCHMARKS, find_benchmark_root, load_fixed_scene
from geomoe3d.errors import InputError
from geomoe3d.evaluation.peer import versions
from geomoe3d.evaluation.records import VOXEL_SIZE, EvaluationPair, MethodInput
from geomoe3d.matching.nearest import nearest_features
from geomoe3d.runtime.sources import source_hash
from geomoe3d.types import Float32Array, FloatArray

TRACKS = ("1k", "all", "clouds")


def needs(track: str) -> str:
    """Which kind of input the track gives: ``clouds`` or ``correspondences``. Raises InputError: no such track."""
    if track not in TRACKS:
        raise InputError(f"there is no track '{track}'; there are: {', '.join(TRACKS)}")
    return "clouds" if track == "clouds" else "correspondences"


class InputMaker:
    """Makes the inputs of one track; keep one per process.

    Args:
        track: one of `TRACKS`.
        benchmark: where the pairs come from.
        root: folder of the published benchmarks, or None.
        seed: given on to the methods.
    """

    def __init__(self, track: str, benchmark: str, root: str | Path | None = None, *, seed: int = 0) -> None:
        needs(track)
        self.track, self.seed = track, seed
        self._points = lru_cache(8)(lambda path: load_fragment(path).file_points)
        # A benchmark scene has at most 66 fragments, 0.7 MB each.
        self._describe = lru_cache(80)(_describe)
        self._fixed: dict[str, FloatArray] = {}
        self._fixed_scene = ""
        self._published = _published_folder(track, benchmark, root)

    def identity(self, pairs: Sequence[EvaluationPair]) -> dict[str, Any]:
        """Where the input of these pairs comes from, for the identity of a run, as plain JSON.

        Files enter with their size and their beginning, 64 KiB each: enough to notice other data under the
        same names. Matched correspondences depend on the code that makes them, too.
        """
        files = {path for pair in pairs for path in (pair.source, pair.target)}
        if self.track == "clouds":
            return {"from": "points of the files", "files_sha256": _hash_files(files)}
        if self._published is not None:
            files = {self._published / f"{pair.scene}.npz" for pair in pairs}
            return {"from": "published 1k correspondences", "files_sha256": _hash_files(files)}
        return {
            "from": "matched on a 5 cm grid",
            "files_sha256": _hash_files(files),
            "source_sha256": [source_hash(made.__module__) for made in (describe_fragment, nearest_features)],
            "preparation": PreparationConfig().model_dump(mode="json"),
            "versions": versions("numpy", "scipy", "open3d-cpu", "open3d"),
        }

    def __call__(self, pair: EvaluationPair) -> MethodInput:
        """The input of one pair. Raises InputError: a cloud or the correspondences cannot be read."""
        if self.track == "clouds":
            source, target = self._points(pair.source), self._points(pair.target)
            return MethodInput(pair.id, source=source, target=target, seed=self.seed)
        rows = self._take_published(pair) if self._published else self._match(pair)
        return MethodInput(pair.id, correspondences=rows, seed=self.seed)

    def _match(self, pair: EvaluationPair) -> FloatArray:
        (points, features), (others, other_features) = (
            self._describe(pair.source),
            self._describe(pair.target),
        )
        nearest = nearest_features(features, other_features, 1, with_ratio=False)[0][:, 0]
        rows = np.hstack([points, others[nearest]]).astype(np.float64)
        if self.track == "all":
            return rows
        digest = hashlib.sha256(pair.id.encode()).digest()
        rng = np.random.default_rng(int.from_bytes(digest[:8], "big"))
        return rows[np.sort(rng.permutation(len(rows))[:1000])]  # as in the published 1k

    def _take_published(self, pair: EvaluationPair) -> FloatArray:
        assert self._published is not None
        if pair.scene != self._fixed_scene:
            found = load_fixed_scene(self._published / f"{pair.scene}.npz")
            self._fixed = {f"{pair.scene}/{c.source_index}-{c.target_index}": c.points for c in found}
            self._fixed_scene = pair.scene
        if pair.id not in self._fixed:
            raise InputError(f"'{self._published / pair.scene}.npz' lacks the pair {pair.id}")
        return self._fixed[pair.id]


def _describe(path: Path) -> tuple[Float32Array, Float32Array]:
    return describe_fragment(load_fragment(path), VOXEL_SIZE)


def _hash_files(files: Collection[Path]) -> str:
    """Over names, sizes and beginnings; one that is missing counts as empty, reading it will say so."""
    total = hashlib.sha256()
    for path in sorted(files):
        start, size = b"", 0
        with suppress(OSError), path.open("rb") as stream:
            start, size = stream.read(65536), path.stat().st_size
        total.update(f"{path.parent.name}/{path.name} {size} ".encode() + hashlib.sha256(start).digest())
    return total.hexdigest()


def _published_folder(track: str, benchmark: str, root: str | Path | None) -> Path | None:
    """The folder of fixed correspondences, where the track wants them and the benchmark has them."""
    if track != "1k" or benchmark not in BENCHMARKS:
        return None
    folder = find_benchmark_root(root) / "correspondences-1k" / benchmark
    return folder if folder.is_dir() else None
