"""What a result was made of, so that pictures can be asked for afterwards.

Paths, or references to the caller's own objects, and the correspondences, some 100 kB: no copy of a cloud, so
thousands of results fit into a list. Pictures load the clouds again, and refuse clouds that have changed since.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from geomoe3d.clouds.loading import load_points
from geomoe3d.errors import InputError
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray, IntArray, PointCloud

Mark = tuple[int, bytes]

NOT_KEPT = (
    "this result no longer holds {what}: it was read from JSON, changed, or sent between processes; pictures can be "
    "given the clouds, picture(path, source=..., target=...), and register gives a result that holds everything"
)


@dataclass(frozen=True, eq=False)
class Inputs:
    """What a result was made of; not part of its JSON.

    Attributes:
        source, target: as the caller gave them: paths, or the objects themselves; None where they did not
            travel with the result, as after pickling objects in memory.
        marks: number and mean of the finite points of each, by which a changed cloud is told; None unknown.
        correspondences: (K, 6) rows [source xyz, target xyz] in the files' coordinates.
        weights: (K,) in [0, 1] of a filter or network, or None.
        groups: (K,) as a filter gave them, or None.
        group_names: of the groups.
    """

    source: Any
    target: Any
    marks: tuple[Mark | None, Mark | None] = (None, None)
    correspondences: FloatArray = field(default_factory=lambda: np.zeros((0, 6)))
    weights: FloatArray | None = None
    groups: IntArray | None = None
    group_names: tuple[str, ...] = ()

    def __getstate__(self) -> dict[str, Any]:
        """Clouds in memory stay where they are: a result that travels between processes stays small."""
        paths = {side: getattr(self, side) for side in ("source", "target")}
        return {
            **vars(self),
            **{s: d if isinstance(d, (str, os.PathLike)) else None for s, d in paths.items()},
        }

    def exchanged(self) -> Inputs:
        """With the roles of source and target exchanged."""
        rows = np.concatenate([self.correspondences[:, 3:], self.correspondences[:, :3]], axis=1)
        both = {"source": self.target, "target": self.source, "marks": self.marks[::-1]}
        return replace(self, correspondences=rows, **both)

    def clouds(self, source: Any, target: Any, seed: int) -> tuple[PointCloud, PointCloud]:
        """Both clouds loaded again; a given one takes the place of the one remembered. Raises InputError: a
        cloud that is neither remembered nor given, or that has changed since."""
        loaded = []
        for role, given, kept, mark in zip(
            ("source", "target"), (source, target), (self.source, self.target), self.marks, strict=True
        ):
            data = kept if given is None else given
            if data is None:
                raise InputError(NOT_KEPT.format(what=f"the {role}"))
            cloud = load_points(data, seed=seed)
            if mark is not None and mark_of(cloud) != mark:
                change = (
                    f"has {counted(len(cloud), 'point')} instead of {mark[0]:,}"
                    if len(cloud) != mark[0]
                    else "moved"
                )
                raise InputError(
                    f"the {role} is no longer what was registered: it {change}; give it as it was: "
                    f"picture(path, {role}=...)"
                )
            loaded.append(cloud)
        return loaded[0], loaded[1]


def mark_of(cloud: PointCloud) -> Mark:
    """Number and mean of a cloud's points, bit for bit."""
    return len(cloud), (cloud.points.mean(axis=0) + cloud.origin).tobytes()
