"""One cloud sought in a much larger one, which becomes a map for it: what `geomoe3d.line` does with such a pair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomoe3d.config import expert
from geomoe3d.maps.found import Found
from geomoe3d.maps.map import Map
from geomoe3d.maps.voxels import VoxelSums
from geomoe3d.pipeline import Pipeline
from geomoe3d.runtime.timing import StageClock
from geomoe3d.types import FloatArray, PointCloud


def search_larger(
    scan: PointCloud, world: PointCloud, line: Pipeline, guess: FloatArray | None, clock: StageClock
) -> Found | None:
    """One cloud sought in a much larger one: what `geomoe3d.line` does with such a pair.

    Args:
        scan: the smaller cloud, as loaded.
        world: the larger one, as loaded; its sensor is not asked for.
        line: parts of the configuration.
        guess: (4, 4) of T_world_scan, file coordinates, or None.
        clock: told of the stages.

    Returns:
        The scan and the part of the larger cloud around the answer, in the clouds' local coordinates, and what was
        decided; None where there was no candidate.
    """
    clock("index")
    nothing = VoxelSums.empty(1.0, np.zeros(3))
    made = Map(nothing, config=line.config, line=line).with_cloud(replace(world, sensor=None))
    guesses = [] if guess is None else [guess]
    found = made._finder(scan, scan, guesses, None, expert().maps.candidates, clock)[0]
    return None if found is None else replace(found, decision=made._told(found, scan, clock))
