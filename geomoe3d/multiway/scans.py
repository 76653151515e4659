"""The scans of a model: which files, under which names, in which order, on which common voxel grid."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geomoe3d.batch.table import kind_of
from geomoe3d.clouds.io import READABLE_SUFFIXES, load_points
from geomoe3d.clouds.prepare import check_cloud
from geomoe3d.clouds.transform_files import load_transform
from geomoe3d.clouds.voxel_size import bounded_voxel_size, choose_voxel_size
from geomoe3d.config import PreparationConfig, expert
from geomoe3d.errors import GeoMoE3DError, InputError, MissingFileError
from geomoe3d.runtime.words import natural_key, once_more


@dataclass(frozen=True)
class Scan:
    """One file of the model.

    Attributes:
        name: unique in the model; the file's stem, with as much of its folder as makes it unique.
        path: absolute.
    """

    name: str
    path: str


def as_paths(
    scans: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
) -> list[str | os.PathLike[str]]:
    """What a caller gave as paths; a single one need not stand in a list.

    Raises:
        InputError: something else than paths: a model reads its scans from files, again and again.
    """
    if isinstance(scans, (str, os.PathLike)):
        return [scans]
    if isinstance(scans, (bytes, Mapping)) or not isinstance(scans, Iterable):
        raise InputError(f"scans must be paths of files or of folders, found {kind_of(scans)}")
    paths = list(scans)
    if not paths:
        raise InputError(
            "no scans are given; a model needs the paths of at least two, or of a folder with them"
        )
    for number, path in enumerate(paths, start=1):
        if not isinstance(path, (str, os.PathLike)):
            raise InputError(
                f"scan {number} must be the path of a file or of a folder, found {kind_of(path)}; save "
                "clouds in memory first: geomoe3d.save_points"
            )
    return paths


def find_scans(inputs: Iterable[str | os.PathLike[str]]) -> list[Scan]:
    """The scans of a model, see `find_clouds`.

    Raises:
        InputError: as `find_clouds`, or fewer than two.
    """
    scans = find_clouds(inputs)
    if len(scans) < 2:
        raise InputError(f"a model needs at least 2 scans, found {len(scans)}")
    return scans


def find_clouds(inputs: Iterable[str | os.PathLike[str]]) -> list[Scan]:
    """The clouds of given files and folders, in natural order (scan 2 before scan 10) within each folder.

    A folder stands for all files in it that can be read as clouds, not for its sub-folders nor for transforms that
    lie beside them.

    Raises:
        InputError: a path that is not there, a folder without clouds, or a file given twice.
    """
    paths: list[Path] = []
    for given in inputs:
        path = Path(given)
        if path.is_dir():
            inside = [p for p in path.iterdir() if p.suffix.lower() in READABLE_SUFFIXES and p.is_file()]
            inside = [p for p in inside if not _is_transform(p)]
            if not inside:
                raise InputError(f"'{path}' holds no clouds; readable are {', '.join(READABLE_SUFFIXES)}")
            paths += sorted(inside, key=lambda p: natural_key(p.name))
        elif path.is_file():
            paths.append(path)
        else:
            raise MissingFileError(f"there is no file or folder '{path}' (folder now: {Path.cwd()})")
    resolved = [path.resolve() for path in paths]
    twice = {path for path in resolved if resolved.count(path) > 1}
    if twice:
        raise InputError(f"'{sorted(twice)[0]}' is given more than once; name every scan once")
    return [Scan(name, str(path)) for name, path in zip(_unique_names(resolved), resolved, strict=True)]


def find_copies(scans: Iterable[Scan], content: Callable[[str], str | None]) -> dict[str, str]:
    """Name of a scan -> name of the first one whose file has the same content, by its hash (None: not known)."""
    first: dict[str, str] = {}
    copies = {}
    for scan in scans:
        if (found := content(scan.path)) is not None and (
            earlier := first.setdefault(found, scan.name)
        ) != scan.name:
            copies[scan.name] = earlier
    return copies


def copies_in_words(copies: Mapping[str, str]) -> list[str]:
    """A sentence for each copy."""
    return [
        f"{once_more(name, first)}, and each is taken for a scan of its own; leave one out if that was not meant"
        for name, first in copies.items()
    ]


def _is_transform(path: Path) -> bool:
    # A transform is some hundred bytes.
    if path.stat().st_size > 4096:
        return False
    try:
        load_transform(path)
    except GeoMoE3DError:
        return False
    return True


def choose_common_voxel_size(
    scans: Iterable[Scan], config: PreparationConfig
) -> tuple[float, dict[str, str]]:
    """One voxel size for all scans, and the scans that cannot be used, with the reason.

    It is the median of what each scan would get by itself, rounded to two digits, and raised where a scan
    would occupy more than ``config.max_points`` voxels, unless it is so large that it must be in another unit.

    Raises:
        InputError: fewer than two scans can be used.
    """
    sizes: dict[str, float] = {}
    unusable: dict[str, str] = {}
    for scan in scans:
        try:
            cloud = load_points(scan.path)
            check_cloud(cloud)
            sizes[scan.path] = choose_voxel_size(cloud, cloud, config.voxel_points)
        except GeoMoE3DError as error:
            unusable[scan.name] = str(error)
    if len(sizes) < 2:
        listed = "; ".join(f"{name}: {reason}" for name, reason in unusable.items())
        raise InputError(f"fewer than 2 scans can be used: {listed}")
    wanted = common = float(f"{np.median(list(sizes.values())):.2g}")
    for path, size in sizes.items():
        # Only such a scan can occupy too many voxels. One so large that no pair of it is registered is in another unit.
        if 2 * wanted < size < expert().preparation.most_extent_ratio * wanted:
            cloud = load_points(path)
            common = bounded_voxel_size(cloud, cloud, common, config.max_points)
    return (common if common == wanted else _rounded_up(common)), unusable


def _rounded_up(size: float) -> float:
    """To two digits, never down: a size raised to a limit of voxels must not fall below it again."""
    digits = float(f"{size:.2g}")
    if digits < size:
        last = math.floor(math.log10(size)) - 1  # place of the second digit
        digits = float(f"{digits + 10.0**last:.2g}")
    return digits


def _unique_names(paths: list[Path]) -> list[str]:
    alike = Counter(path.with_suffix("") for path in paths)  # some differ by their suffix alone
    last = [path.stem if alike[path.with_suffix("")] == 1 else path.name for path in paths]
    for depth in range(1, max(len(path.parts) for path in paths) + 1):
        names = [
            "/".join((*path.parent.parts[len(path.parent.parts) - depth + 1 :], name))
            for path, name in zip(paths, last, strict=True)
        ]
        if len(set(names)) == len(names):
            return names
    return [str(path) for path in paths]  # such as a.ply, a.xyz and a.ply.xyz
