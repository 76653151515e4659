"""3DMatch and 3DLoMatch as published: ground truth files, pairs to be registered, fixed correspondences.

A benchmark folder holds, per scene, ``gt.log`` (one 4x4 per pair), ``gt.info`` (one 6x6 per pair) and
``gt_overlap.log``; the fragments lie beside it as ``<scene>/cloud_bin_N.ply``. An entry ``i j`` of gt.log
maps fragment j into fragment i; here, as in PointDSC's protocol, the source is i and the target is j, so
that the true motion is the inverse of the entry. Cost: 843 pairs in 0.1 s, their correspondences in 1 s.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geomoe3d.errors import FormatError, InputError, cannot_read, plain_reason
from geomoe3d.geometry.se3 import inverse, is_motion, make_transform, project_to_so3
from geomoe3d.runtime.files import write_text
from geomoe3d.runtime.words import shape_in_words
from geomoe3d.types import FloatArray

BENCHMARKS = ("3DMatch", "3DLoMatch")
DATA_VARIABLE = "GEOMOE3D_DATA"


PairTable = list[tuple[int, int, FloatArray]]


@dataclass(frozen=True)
class BenchmarkPair:
    """Two fragments of one scene and the true motion between them.

    Attributes:
        benchmark: 3DMatch or 3DLoMatch.
        scene: name of the scene's folder.
        source_index: i of the gt.log entry.
        target_index: j of the gt.log entry.
        source: path of fragment i; it need not exist where only the ground truth is at hand.
        target: path of fragment j.
        T_target_source: (4, 4), p_target = R p_source + t, metres.
        overlap: share of the source's points with a target neighbour, as published, or None if not listed.
        information: (6, 6) matrix of gt.info that weighs the benchmark's RMSE, or None where not listed.
    """

    benchmark: str
    scene: str
    source_index: int
    target_index: int
    source: Path
    target: Path
    T_target_source: FloatArray
    overlap: float | None = None
    information: FloatArray | None = None


@dataclass(frozen=True)
class FixedCorrespondences:
    """The same 1,000 putative correspondences for every method.

    Attributes:
        scene: name of the scene's folder.
        source_index: fragment i.
        target_index: fragment j.
        points: (N, 6) float64 rows [source xyz, target xyz], metres, each in its fragment's frame.
        T_target_source: (4, 4) true motion, rotation on SO(3).
    """

    scene: str
    source_index: int
    target_index: int
    points: FloatArray
    T_target_source: FloatArray


def find_data_root() -> Path:
    """The folder of real scans: ``GEOMOE3D_DATA``, else ``../shared/data`` beside the checkout. Raises
    InputError: neither is a folder."""
    given = os.environ.get(DATA_VARIABLE)
    if given:
        if Path(given).is_dir():
            return Path(given)
        raise InputError(f"{DATA_VARIABLE}='{given}' is not a folder; point it at the folder of real scans")
    beside = Path(__file__).resolve().parents[3] / "shared" / "data"
    if beside.is_dir():
        return beside
    raise InputError(
        f"no folder of real scans: '{beside}' does not exist; set {DATA_VARIABLE} to the folder that holds "
        "3dmatch-dev"
    )


def find_benchmark_root(root: str | Path | None = None) -> Path:
    """The folder that holds ``benchmarks`` and ``fragments``: ``root`` itself or its ``3dmatch-dev``.

    Args:
        root: None takes `find_data_root`.

    Raises:
        InputError: neither holds ``benchmarks``.
    """
    base = find_data_root() if root is None else Path(root)
    for candidate in (base, base / "3dmatch-dev"):
        if (candidate / "benchmarks").is_dir():
            return candidate
    raise InputError(f"'{base}' holds no folder 'benchmarks' (nor does its '3dmatch-dev')")


def read_gt_log(path: str | Path) -> PairTable:
    """Entries (i, j, T) of a gt.log in file order; T (4, 4) maps fragment j into fragment i, as written.

    An empty file gives an empty list.

    Raises:
        InputError: the file cannot be read.
        FormatError: an entry is cut short, holds no finite numbers or is no rigid transform; names the line.
    """
    return _read_blocks(Path(path), 4)


def read_gt_info(path: str | Path) -> PairTable:
    """Entries (i, j, I) of a gt.info in file order; I (6, 6) weighs the benchmark's RMSE. Raises InputError:
    the file cannot be read; FormatError: an entry is cut short or holds no numbers; names the line."""
    return _read_blocks(Path(path), 6)


def read_gt_overlap(path: str | Path) -> dict[tuple[int, int], float]:
    """Overlap in [0, 1] of every listed pair (i, j), i < j as in the file. Raises InputError: the file cannot
    be read; FormatError: a line is not ``i,j,overlap``; names the line."""
    overlaps: dict[tuple[int, int], float] = {}
    for number, line in enumerate(_lines(Path(path)), start=1):
        if not line.strip():
            continue
        try:
            i, j, value = line.replace(",", " ").split()
            overlaps[int(i), int(j)] = float(value)
            if not math.isfinite(overlaps[int(i), int(j)]):
                raise ValueError(value)
        except ValueError:
            raise FormatError(
                f"'{path}' line {number}: expected 'i,j,overlap', found '{line.strip()}'"
            ) from None
    return overlaps


def write_gt_log(path: str | Path, entries: PairTable, num_fragments: int) -> None:
    """Write entries (i, j, T), T mapping j into i, with all digits of a double. Raises OutputError: the file
    exists, or the disk refuses."""
    lines = []
    for i, j, T in entries:
        lines.append(f"{i}\t{j}\t{num_fragments}")
        lines += ["\t".join(f"{value:.17g}" for value in row) for row in T]
    text = "".join(line + "\n" for line in lines)
    write_text(path, text, force=False)


def write_gt_overlap(path: str | Path, overlaps: dict[tuple[int, int], float]) -> None:
    """Write ``i,j,overlap`` lines, four digits. Raises OutputError: the file exists, or the disk refuses."""
    text = "".join(f"{i},{j},{value:.4f}\n" for (i, j), value in sorted(overlaps.items()))
    write_text(path, text, force=False)


def true_motion(entry: FloatArray, *, raw: bool = False) -> FloatArray:
    """T_target_source (4, 4) of a gt.log entry: its inverse, with source i and target j.

    Args:
        entry: (4, 4) maps j into i.
        raw: False projects the rotation onto SO(3) first (redkitchen's are up to 5e-4 off, which puts a floor
            of up to 1.5 degrees under the error); True inverts the matrix as it is, as PointDSC does.
    """
    if raw:
        return np.asarray(np.linalg.inv(entry), dtype=np.float64)
    return inverse(make_transform(project_to_so3(entry[:3, :3]), entry[:3, 3]))


def load_benchmark(
    root: str | Path | None = None, benchmark: str = "3DMatch", *, raw: bool = False
) -> list[BenchmarkPair]:
    """Every pair of a benchmark, scenes by name, entries in file order.

    Args:
        root: folder with ``benchmarks`` and ``fragments`` (or one that holds it as ``3dmatch-dev``); None:
            `find_data_root`.
        benchmark: 3DMatch or 3DLoMatch.
        raw: as in `true_motion`.

    Raises:
        InputError: unknown benchmark, or a folder or gt.log is missing. Missing fragments do not matter here.
        FormatError: a ground truth file is broken.
    """
    base = find_benchmark_root(root)
    folder = _benchmark_folder(base / "benchmarks", benchmark)
    pairs = []
    for scene in sorted(p for p in folder.iterdir() if p.is_dir()):
        fragments = base / "fragments" / scene.name
        info_file, overlap_file = scene / "gt.info", scene / "gt_overlap.log"
        info = {(i, j): matrix for i, j, matrix in (read_gt_info(info_file) if info_file.is_file() else [])}
        overlaps = read_gt_overlap(overlap_file) if overlap_file.is_file() else {}
        for i, j, entry in read_gt_log(scene / "gt.log"):
            pairs.append(
                BenchmarkPair(
                    benchmark,
                    scene.name,
                    i,
                    j,
                    fragments / f"cloud_bin_{i}.ply",
                    fragments / f"cloud_bin_{j}.ply",
                    true_motion(entry, raw=raw),
                    overlaps.get((i, j)),
                    info.get((i, j)),
                )
            )
    if not pairs:
        raise InputError(f"'{folder}' holds no pairs")
    return pairs


def iterate_fixed_correspondences(
    root: str | Path | None = None, benchmark: str = "3DMatch"
) -> Iterator[FixedCorrespondences]:
    """The fixed 1k correspondences of every pair, scenes by name, pairs in gt.log order, one scene in memory.

    Args:
        root: as in `load_benchmark`.
        benchmark: 3DMatch or 3DLoMatch.

    Raises:
        InputError: unknown benchmark, or the folder or its files are missing.
        FormatError: a file lacks an array or cannot be decoded.
    """
    folder = _benchmark_folder(find_benchmark_root(root) / "correspondences-1k", benchmark)
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise InputError(f"'{folder}' holds no .npz file")
    for file in files:
        yield from load_fixed_scene(file)


def load_fixed_scene(file: str | Path) -> list[FixedCorrespondences]:
    """The fixed correspondences of one scene, ``<scene>.npz``, pairs in gt.log order. Raises FormatError: the
    file is missing, lacks an array or cannot be decoded."""
    file = Path(file)
    try:
        with np.load(file, allow_pickle=False) as archive:
            pair, start, T = archive["pair"], archive["start"], archive["T_target_source"]
            rows = np.hstack([archive["source_mm"], archive["target_mm"]]) / 1000.0
    except (OSError, ValueError, EOFError, KeyError) as error:
        raise FormatError(f"'{file}' is no file of fixed correspondences: {error}") from None
    return [
        FixedCorrespondences(file.stem, int(i), int(j), rows[start[k] : start[k + 1]], T[k])
        for k, (i, j) in enumerate(pair)
    ]


def _benchmark_folder(parent: Path, benchmark: str) -> Path:
    if benchmark not in BENCHMARKS:
        raise InputError(f"there is no benchmark '{benchmark}'; there are: {', '.join(BENCHMARKS)}")
    folder = parent / benchmark
    if not folder.is_dir():
        raise InputError(f"'{folder}' is not a folder; give the folder that holds '{parent.name}'")
    return folder


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="ascii").splitlines()
    except UnicodeDecodeError:
        raise FormatError(f"'{path}' is no text file") from None
    except OSError as error:
        raise cannot_read(error, f"cannot read '{path}': {error.strerror}") from None


def _read_blocks(path: Path, size: int) -> PairTable:
    lines = [(number, line) for number, line in enumerate(_lines(path), start=1) if line.strip()]
    entries: PairTable = []
    for first in range(0, len(lines), size + 1):
        number, head = lines[first]
        body = lines[first + 1 : first + 1 + size]
        try:
            i, j = (int(word) for word in head.split()[:2])
            matrix = np.array([[float(word) for word in line.split()] for _, line in body])
        except ValueError as error:
            raise FormatError(
                f"'{path}' line {number}: no entry 'i j count' and {size} rows: {plain_reason(error)}"
            ) from None
        if matrix.shape != (size, size):
            raise FormatError(
                f"'{path}' line {number}: the entry holds {shape_in_words(matrix.shape)}, expected {size} of {size}; "
                "is the file cut short?"
            )
        if not np.isfinite(matrix).all():
            raise FormatError(f"'{path}' line {number}: the entry {i} {j} is not finite")
        # Published rotations are up to 5e-4 off.
        if size == 4 and not is_motion(matrix, 0.02):
            raise FormatError(f"'{path}' line {number}: the entry {i} {j} is no rigid transform")
        entries.append((i, j, matrix))
    return entries
