"""Posed fragments from whatever folder holds them: one list of pairs with the true motion of each.

Place: between files on disk and everything that trains or evaluates. `open_collection` looks which of the
known layouts a folder has and lists its fragments and pairs; clouds are read later, one at a time, by
`load_fragment`. Listing costs reading the ground truth files.

Layouts:

- ``benchmark``: ``benchmarks/<3DMatch|3DLoMatch>/<scene>/gt.log`` with ``fragments/<scene>/cloud_bin_N.ply``;
- ``evaluation``: the official test set, ``<scene>/cloud_bin_N.ply`` with ``<scene>-evaluation/gt.log``;
- ``archive``: the training archive of FCGF and PointDSC, ``<scene>@seq-NN_MMM.npz`` with ``*-0.30.txt``;
- ``predator``: ``train_info.pkl``, ``val_info.pkl``, ``3DMatch.pkl``, ``3DLoMatch.pkl`` with ``.pth`` clouds;
- ``posed``: folders of clouds with gt.log (what ``data fragments`` and ``data synthesize`` write), or with
  ``poses.txt``: one T_world_fragment of 16 numbers per cloud, in the order of their numbers or names.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path

import numpy as np

from geomoe3d.data.safe_pickle import load_pickle
from geomoe3d.data.threedmatch import (
    BENCHMARKS,
    find_benchmark_root,
    load_benchmark,
    read_gt_log,
    read_gt_overlap,
    true_motion,
)
from geomoe3d.errors import FormatError, GeoMoE3DError, InputError, MissingFileError, plain_reason
from geomoe3d.geometry.se3 import inverse, make_transform, project_to_so3
from geomoe3d.runtime.words import counted, shape_in_words
from geomoe3d.types import FloatArray, PointCloud

_CLOUD_PATTERN = "cloud_bin_*.ply"
_CLOUD_SUFFIXES = (".ply", ".pcd", ".npy", ".npz", ".xyz", ".las", ".laz", ".e57", ".pth")


@dataclass(frozen=True)
class PosedPair:
    """Two fragments on disk and the true motion between them.

    Attributes:
        scene: scene as the layout names it.
        source: file of the source fragment.
        target: file of the target fragment.
        T_target_source: (4, 4), metres.
        overlap: as listed, or None.
        group: benchmark or list that the pair belongs to.
    """

    scene: str
    source: Path
    target: Path
    T_target_source: FloatArray
    overlap: float | None = None
    group: str = "pairs"


@dataclass
class Collection:
    """What a folder holds.

    Attributes:
        root: the folder.
        layout: the name that `open_collection` has for what it found.
        fragments: scene -> fragment files, in order of their number.
        pairs: all listed pairs, group by group.
        problems: one sentence per thing that is missing or broken, with the file's name.
    """

    root: Path
    layout: str
    fragments: dict[str, list[Path]] = field(default_factory=dict)
    pairs: list[PosedPair] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def open_collection(root: str | Path) -> Collection:
    """List the fragments and pairs of a folder, whichever known layout it has. Raises InputError: no such
    folder, or no layout fits; the message says what was looked for."""
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"'{root}' is not a folder")
    openers = {
        "benchmark": (_has_benchmark, _open_benchmark),
        "predator": (lambda folder: bool(_info_files(folder)), _open_predator),
        "archive": (lambda folder: _archive_folder(folder) is not None, _open_archive),
        "evaluation": (lambda folder: any(folder.glob("*-evaluation/gt.log")), _open_evaluation),
        "posed": (lambda folder: bool(_posed_folders(folder)), _open_posed),
    }
    for layout, (fits, read) in openers.items():
        if fits(root):
            collection = Collection(root, layout)
            read(collection)
            return collection
    raise InputError(
        f"'{root}' has none of the known layouts: benchmarks/<name>/<scene>/gt.log; "
        "<scene>-evaluation/gt.log; <scene>@seq-NN_MMM.npz with *-0.30.txt; train_info.pkl; "
        "<scene>/gt.log beside <scene>/cloud_bin_N.ply; <scene>/poses.txt beside clouds"
    )


def load_fragment(path: str | Path) -> PointCloud:
    """The points of a fragment of any layout, metres, in the fragment's own frame. Raises InputError:
    missing, unreadable or empty; every reader's own errors are of this kind."""
    from geomoe3d.clouds.io import load_points

    path = Path(path)
    if path.suffix == ".pth":
        return load_points(_as_points(load_pickle(path), path), name=path.name)
    if path.suffix == ".npz":
        try:
            with np.load(path, allow_pickle=False) as archive:
                points = archive["pcd"] if "pcd" in archive.files else None
        except FileNotFoundError:
            raise MissingFileError(f"'{path}' does not exist") from None
        except Exception as error:  # zip, zlib, header: a damaged archive raises nearly anything
            raise FormatError(f"'{path}' cannot be read: {error}") from None
        if points is not None:
            return load_points(_as_points(points, path), name=path.name)
    return load_points(path)


def fragment_number(path: Path) -> int:
    """The last number in a file's name, for sorting; -1 where there is none."""
    digits = ""
    for character in reversed(path.stem):
        if character.isdigit():
            digits = character + digits
        elif digits:
            break
    return int(digits) if digits else -1


def _as_points(value: object, path: Path) -> FloatArray:
    points = np.asarray(value)
    if points.dtype.kind not in "fiu" or points.ndim != 2 or points.shape[1] < 3:
        raise FormatError(f"'{path}' holds no x, y, z for each point but {shape_in_words(points.shape)}")
    return np.asarray(points[:, :3], dtype=np.float64)


def _sorted_clouds(folder: Path, pattern: str = _CLOUD_PATTERN) -> list[Path]:
    return sorted(folder.glob(pattern), key=lambda p: (fragment_number(p), p.name))


def _has_benchmark(root: Path) -> bool:
    try:
        find_benchmark_root(root)
    except InputError:
        return False
    return True


def _open_benchmark(collection: Collection) -> None:
    base = find_benchmark_root(collection.root)
    for folder in sorted(p for p in (base / "fragments").glob("*") if p.is_dir()):
        collection.fragments[folder.name] = _sorted_clouds(folder)
    for benchmark in BENCHMARKS:
        try:
            pairs = load_benchmark(base, benchmark)
        except GeoMoE3DError as error:
            collection.problems.append(f"{benchmark}: {error}")
            continue
        collection.pairs += [
            PosedPair(p.scene, p.source, p.target, p.T_target_source, p.overlap, benchmark) for p in pairs
        ]


def _open_evaluation(collection: Collection) -> None:
    for truth in sorted(collection.root.glob("*-evaluation")):
        scene = truth.name.removesuffix("-evaluation")
        _add_scene(collection, collection.root / scene, truth, "3DMatch")


def _open_posed(collection: Collection) -> None:
    for folder in _posed_folders(collection.root):
        if (folder / "gt.log").is_file():
            _add_scene(collection, folder, folder, "pairs")
        else:
            _add_by_poses(collection, folder)


def _posed_folders(root: Path) -> list[Path]:
    candidates = [root, *sorted(p for p in root.iterdir() if p.is_dir() and not p.name.startswith("."))]
    return [
        p
        for p in candidates
        if ((p / "gt.log").is_file() and any(p.glob(_CLOUD_PATTERN)))
        or ((p / "poses.txt").is_file() and len(_any_clouds(p)) > 1)
    ]


def _any_clouds(folder: Path) -> list[Path]:
    found = [p for p in folder.iterdir() if p.suffix.lower() in _CLOUD_SUFFIXES and p.is_file()]
    return sorted(found, key=lambda p: (fragment_number(p), p.name))


def _add_by_poses(collection: Collection, folder: Path) -> None:
    """Every pair of clouds with the motion that their poses give; overlaps are measured later."""
    clouds = _any_clouds(folder)
    collection.fragments[folder.name] = clouds
    path = folder / "poses.txt"
    try:
        poses = np.loadtxt(path).reshape(-1, 4, 4)
    except (OSError, ValueError) as error:
        collection.problems.append(f"'{path}' holds no poses of 16 numbers: {plain_reason(error)}")
        return
    if len(poses) != len(clouds) or not np.isfinite(poses).all():
        collection.problems.append(
            f"'{path}' holds {counted(len(poses), 'finite pose')} for {len(clouds)} clouds"
        )
        return
    motions = [make_transform(project_to_so3(pose[:3, :3]), pose[:3, 3]) for pose in poses]
    for i, j in combinations(range(len(clouds)), 2):
        T = inverse(motions[j]) @ motions[i]
        collection.pairs.append(PosedPair(folder.name, clouds[i], clouds[j], T))


def _add_scene(collection: Collection, clouds: Path, truth: Path, group: str) -> None:
    collection.fragments[clouds.name] = _sorted_clouds(clouds)
    if not collection.fragments[clouds.name]:
        collection.problems.append(f"'{clouds}' holds no {_CLOUD_PATTERN}")
    try:
        entries = read_gt_log(truth / "gt.log")
        listed = truth / "gt_overlap.log"
        overlaps = read_gt_overlap(listed) if listed.is_file() else {}
    except GeoMoE3DError as error:
        collection.problems.append(str(error))
        return
    for i, j, entry in entries:
        source, target = (clouds / f"cloud_bin_{number}.ply" for number in (i, j))
        pair = PosedPair(clouds.name, source, target, true_motion(entry), overlaps.get((i, j)), group)
        collection.pairs.append(pair)


def _archive_folder(root: Path) -> Path | None:
    for folder in (root, root / "threedmatch"):
        if folder.is_dir() and (any(folder.glob("*@seq-*.npz")) or any(folder.glob("*@seq-*-0.30.txt"))):
            return folder
    return None


def _open_archive(collection: Collection) -> None:
    """Clouds of one sequence share a world frame, so every true motion is the identity."""
    folder = _archive_folder(collection.root)
    assert folder is not None
    for path in _sorted_clouds(folder, "*@seq-*.npz"):
        collection.fragments.setdefault(path.name.rsplit("_", 1)[0], []).append(path)
    lists = sorted(folder.glob("*-0.30.txt"))
    if not lists:
        collection.problems.append(f"'{folder}' holds no list of pairs *-0.30.txt")
    for file in lists:
        scene = file.name.removesuffix("-0.30.txt")
        for number, line in enumerate(file.read_text(errors="replace").splitlines(), start=1):
            words = line.split()
            if not words:
                continue
            try:
                source, target, overlap = folder / words[0], folder / words[1], float(words[2])
                if not np.isfinite(overlap):
                    raise ValueError(words[2])
            except (IndexError, ValueError):
                collection.problems.append(f"'{file}' line {number}: no 'cloud cloud overlap': '{line}'")
                continue
            collection.pairs.append(PosedPair(scene, source, target, np.eye(4), overlap, "archive"))


_INFO_NAMES = ("train_info", "val_info", "3DMatch", "3DLoMatch")


def _info_files(root: Path) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for name in _INFO_NAMES:
        for folder in ("", "configs/indoor", "indoor", "metadata"):
            path = root / folder / f"{name}.pkl"
            if path.is_file():
                found.setdefault(name, path)
    return found


def _cloud_base(root: Path, example: str) -> Path:
    bases = [root / part for part in ("", "data", "indoor", "data/indoor")]
    return next((base for base in bases if (base / Path(example).parts[0]).is_dir()), root)


def _open_predator(collection: Collection) -> None:
    for group, file in _info_files(collection.root).items():
        try:
            info = load_pickle(file)
            names = list(zip(info["src"], info["tgt"], strict=True))
            R = np.asarray(info["rot"], dtype=np.float64).reshape(-1, 3, 3)
            t = np.asarray(info["trans"], dtype=np.float64).reshape(-1, 3)
            overlaps = np.asarray(info["overlap"], dtype=np.float64).reshape(-1)
            if not len(names) == len(R) == len(t) == len(overlaps):
                raise FormatError(
                    f"lists of unequal length: {len(names)}, {len(R)}, {len(t)}, {len(overlaps)}"
                )
            if not all(np.isfinite(values).all() for values in (R, t, overlaps)):
                raise FormatError("a transform or an overlap is not finite")
        except (GeoMoE3DError, KeyError, TypeError, ValueError) as error:
            collection.problems.append(f"'{file}' is no list of pairs: {plain_reason(error)}")
            continue
        base = _cloud_base(collection.root, str(names[0][0])) if names else collection.root
        for k, (source, target) in enumerate(names):
            T = make_transform(project_to_so3(R[k]), t[k])
            scene, paths = Path(source).parent.name, (base / source, base / target)
            collection.pairs.append(PosedPair(scene, *paths, T, float(overlaps[k]), group))
            known = collection.fragments.setdefault(scene, [])
            known += [path for path in paths if path not in known]
