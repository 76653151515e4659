"""Local maps: a scan with those of its group that overlap it most, for groups that no pair of scans joins.

Place: after grouping, between groups that are still apart. Four scans show more than one, and what they share
with a scan of another group is larger. A map is written as a file and registered like a scan; its anchor is
the scan in whose frame it lies, so that an edge between maps is one between their anchors.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from geomoe3d.config import expert
from geomoe3d.geometry.se3 import inverse, transform_points
from geomoe3d.multiway.alignment import Surface
from geomoe3d.multiway.edges import Edge
from geomoe3d.multiway.overlaps import Overlaps
from geomoe3d.multiway.rules import Group, Poses
from geomoe3d.types import FloatArray

MAPS_FOLDER = "maps"


@dataclass(frozen=True)
class MapPair:
    """Two maps of two groups that may show the same place.

    Attributes:
        source, target: numbers of their anchors.
        members: the scans of both maps, the anchor first.
    """

    source: int
    target: int
    members: tuple[tuple[int, ...], tuple[int, ...]]


def members_of(anchor: int, poses: Poses, overlaps: Overlaps, count: int | None = None) -> tuple[int, ...]:
    """The scans of the map about a scan, ``count`` or so many as a map has: itself, and those that overlap it most."""
    shared = {k: overlaps.of(k, anchor, inverse(poses[anchor]) @ T) for k, T in poses.items() if k != anchor}
    nearest = sorted((k for k in shared if shared[k] > 0), key=lambda k: (-shared[k], k))
    return anchor, *nearest[: (count or expert().many_pairs.map_scans) - 1]


def map_pairs(
    groups: Sequence[Group],
    edges: Sequence[Edge],
    similarity: FloatArray,
    overlaps: Overlaps,
    *,
    sequence: bool = False,
) -> list[MapPair]:
    """Pairs of maps of different groups: about the surest edges between them, and where scans look alike.

    Args:
        groups: the largest first; of two single scans no map is made.
        edges: of all registered pairs, with what cycles say of them.
        similarity: (K, K) of the scans.
        overlaps: of all scans.
        sequence: whether scans with neighbouring numbers were taken one after the other.
    """
    found: list[MapPair] = []
    known: dict[int, tuple[int, ...]] = {}
    for a, b in combinations(groups, 2):
        if len(a.poses) + len(b.poses) < 3 or len(found) >= expert().many_pairs.most_maps:
            continue
        poses = {**a.poses, **b.poses}
        crossing = [e for e in edges if (e.source in a.poses) != (e.target in a.poses)]
        crossing = [e for e in crossing if e.source in poses and e.target in poses]
        crossing.sort(key=lambda e: (-e.worth, e.source, e.target))
        alike = sorted(
            ((i, j) for i in a.poses for j in b.poses if np.isfinite(similarity[i, j])),
            key=lambda pair: (-similarity[pair], pair),
        )
        following = [(i, i + 1) for i in poses if i + 1 in poses and (i in a.poses) != (i + 1 in a.poses)]
        likely = [(e.source, e.target) for e in crossing]
        limits = expert().many_pairs
        each, few = limits.maps_per_groups, limits.map_edges
        lots = (following if sequence else [], each), (likely, few), (alike, each)
        chosen: list[MapPair] = []
        for lot, limit in lots:
            for source, target in lot:
                if len(chosen) >= limit:
                    break
                if any({source, target} <= set(sum(pair.members, ())) for pair in chosen):
                    continue  # a map of these was chosen already
                for scan in (source, target):
                    if scan not in known:
                        known[scan] = members_of(scan, a.poses if scan in a.poses else b.poses, overlaps)
                chosen.append(MapPair(source, target, (known[source], known[target])))
        chosen = [pair for pair in chosen if max(map(len, pair.members)) > 1]
        for pair in chosen:  # both ways: on so little a second try often finds what the first did not
            found += [pair, MapPair(pair.target, pair.source, pair.members[::-1])]
    return found[: expert().many_pairs.most_maps]


def whole_pairs(groups: Sequence[Group]) -> list[MapPair]:
    """Pairs of whole groups, and of the largest with single scans, as maps about their middle scans.

    Args:
        groups: the largest first; those of more than 60 scans are left out, since local maps show as much of them.
    """
    known = expert().many_pairs
    made = [group for group in groups if 1 < len(group.poses) <= known.whole_scans]
    alone = [group for group in groups if len(group.poses) == 1]
    pairs = [*combinations(made, 2), *((made[0], one) for one in alone if made)]
    pairs = [(a, b) for a, b in pairs if len(a.poses) + len(b.poses) > known.map_scans]
    members = {id(group): _middle_first(group.poses) for group in groups}
    found = [(members[id(a)], members[id(b)]) for a, b in pairs[: known.most_maps]]
    return [MapPair(b[0], a[0], (b, a)) for a, b in found]


def _middle_first(poses: Poses) -> tuple[int, ...]:
    """All scans of a group, the one that stands nearest to their mean first."""
    middle = np.mean([T[:3, 3] for T in poses.values()], axis=0)
    first = min(sorted(poses), key=lambda k: float(np.linalg.norm(poses[k][:3, 3] - middle)))
    return first, *(k for k in sorted(poses) if k != first)


def write_map(
    folder: Path, members: Sequence[int], poses: Poses, surfaces: Mapping[int, Surface], sensor: FloatArray
) -> Path:
    """A map as a file of points about its anchor's sensor, named by what it holds; one that is there stays.

    Args:
        folder: made if missing.
        members: its scans, the anchor first.
        poses: T_group_scan of them.
        surfaces: their voxel points.
        sensor: (3,) of the anchor, local coordinates.
    """
    to_anchor = inverse(poses[members[0]])
    points = (
        np.concatenate([transform_points(to_anchor @ poses[k], surfaces[k].points) for k in members]) - sensor
    )
    path = folder / f"{hashlib.sha256(points.tobytes()).hexdigest()[:24]}.npy"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        np.save(path, points)
    return path
