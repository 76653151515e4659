"""``geomoe3d data check``: which layout a folder has, what it holds, what is missing, what is broken.

Counts are held against the published ones scene by scene. Opening every fragment takes about 10 ms each
for the thinned benchmark and 0.2 s at full resolution.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.data.collection import Collection, load_fragment, open_collection
from geomoe3d.data.splits import (
    PUBLISHED_PAIRS,
    TEST_FRAGMENTS,
    TEST_PAIRS,
    TEST_SCENES,
    TRAIN_SCENES,
    VALIDATION_SCENES,
    split_of,
)
from geomoe3d.errors import GeoMoE3DError
from geomoe3d.runtime.words import counted


@dataclass
class CheckReport:
    """What was found.

    Attributes:
        root: the folder.
        layout: as in `Collection`.
        num_scenes: scenes with fragments.
        num_fragments: fragment files.
        num_pairs: group -> listed pairs.
        scenes: scene -> split, fragments and pairs found, and the published counts or None.
        broken: files that cannot be read, one sentence each.
        missing: files and scenes that are referred to but absent, one sentence each.
        notes: what differs from the published counts without being an error.
    """

    root: Path
    layout: str
    num_scenes: int = 0
    num_fragments: int = 0
    num_pairs: dict[str, int] = field(default_factory=dict)
    scenes: list[dict[str, Any]] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def usable(self) -> bool:
        """Nothing is broken, nothing that a listed pair needs is missing, and there is a pair."""
        return not self.broken and not self.missing and sum(self.num_pairs.values()) > 0


def check_folder(
    root: str | Path, *, open_files: bool = True, progress: Callable[[int, int], None] | None = None
) -> CheckReport:
    """Look through a folder of training or test data.

    Args:
        root: the folder.
        open_files: False only lists; True reads every fragment.
        progress: called with (fragments looked at, fragments in all).

    Raises:
        InputError: no such folder, or none of the known layouts.
    """
    collection = open_collection(root)
    report = CheckReport(collection.root, collection.layout, broken=list(collection.problems))
    fragments = [path for paths in collection.fragments.values() for path in paths]
    report.num_scenes, report.num_fragments = len(collection.fragments), len(fragments)
    report.num_pairs = dict(Counter(pair.group for pair in collection.pairs))
    _find_missing(collection, report)
    _count_scenes(collection, report)
    for done, path in enumerate(fragments if open_files else [], start=1):
        _open(path, report)
        if progress is not None:
            progress(done, len(fragments))
    return report


def _open(path: Path, report: CheckReport) -> None:
    if not path.is_file():
        return  # named as missing already
    try:
        cloud = load_fragment(path)
    except GeoMoE3DError as error:
        report.broken.append(str(error) if str(path) in str(error) else f"'{path}': {error}")
        return
    if cloud.num_non_finite:
        report.notes.append(
            f"'{path}': dropped {counted(cloud.num_non_finite, 'point')} with NaN or infinite coordinates"
        )
    if not np.ptp(cloud.points, axis=0).any():
        report.broken.append(f"'{path}': all {len(cloud)} points are equal")


def _find_missing(collection: Collection, report: CheckReport) -> None:
    needed = Counter(path for pair in collection.pairs for path in (pair.source, pair.target))
    for path, uses in needed.items():
        if not path.is_file():
            report.missing.append(f"'{path}' does not exist; {uses} listed pairs need it")
    published = {
        "benchmark": TEST_SCENES,
        "evaluation": TEST_SCENES,
        "archive": TRAIN_SCENES + VALIDATION_SCENES,
        "predator": TRAIN_SCENES + VALIDATION_SCENES,
    }.get(collection.layout, ())
    present = {scene.split("@")[0] for scene in collection.fragments}
    present |= {scene.rsplit("_", 1)[0] for scene in present}  # Predator numbers the sequences of a scene
    absent = [scene for scene in published if scene not in present]
    if absent:
        report.notes.append(
            f"{len(absent)} of {len(published)} published scenes are absent: {', '.join(absent)}"
        )


def _count_scenes(collection: Collection, report: CheckReport) -> None:
    pairs = Counter((pair.scene, pair.group) for pair in collection.pairs)
    for scene, paths in collection.fragments.items():
        by_group = {group: pairs[scene, group] for group in report.num_pairs if pairs[scene, group]}
        official = collection.layout in ("benchmark", "evaluation")
        expected = TEST_FRAGMENTS.get(scene) if official else None
        report.scenes.append(
            {
                "scene": scene,
                "split": split_of(scene),
                "fragments": len(paths),
                "published_fragments": expected,
                "pairs": by_group,
                "published_pairs": TEST_PAIRS.get(scene) if official else None,
            }
        )
        if expected is not None and len(paths) != expected:
            report.missing.append(
                f"scene '{scene}': {counted(len(paths), 'fragment')}, published are {expected}"
            )
        if official and scene in TEST_PAIRS and by_group.get("3DMatch", 0) != TEST_PAIRS[scene]:
            found = by_group.get("3DMatch", 0)
            report.missing.append(
                f"scene '{scene}': {counted(found, 'pair')} of 3DMatch, published are {TEST_PAIRS[scene]}"
            )
    for group, count in report.num_pairs.items():
        wanted = PUBLISHED_PAIRS.get(group)
        if wanted is not None and count != wanted:
            report.notes.append(f"{group}: {count} of the {wanted} published pairs")
