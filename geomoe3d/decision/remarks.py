"""What deserves a user's attention beside the judgement: sentences on input and settings."""

from __future__ import annotations

import filecmp
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.clouds.viewpoint import may_have_seen
from geomoe3d.clouds.voxel_size import choose_voxel_size
from geomoe3d.config import PreparationConfig, expert
from geomoe3d.decision.confidence import Judgement
from geomoe3d.runtime.words import once_more
from geomoe3d.types import FloatArray, PointCloud, PreparedCloud

_NO_DATA = (-9999.0, -99999.0, -32768.0, -32767.0, 9999.0, 99999.0)  # what programs write for no measurement


def remarks(
    given: tuple[Any, Any],
    described: tuple[PreparedCloud, PreparedCloud],
    wanted: float,
    sensors_known: bool,
    config: PreparationConfig,
    judgement: Judgement,
) -> Iterator[str]:
    """Sentences to be added to the reasons of a result.

    Args:
        given: source and target as the user gave them.
        described: the same on their grid.
        wanted: edge of the grid that was asked for or chosen, before the limit of voxels.
        sensors_known: whether the sensors' places were believed, not guessed.
        config: of the preparation.
        judgement: of the answer; where that is ok, nothing is said of what might make it better.
    """
    voxel_size = described[0].voxel_size
    if voxel_size > wanted:
        yield (
            f"a voxel size of {wanted:.4g} gives more than {config.max_points} voxels; "
            f"{voxel_size:.4g} was used (preparation.max_points sets the limit)"
        )
    yield from _one_file(given)
    if judgement.status == "ok":
        return
    for cloud in {cloud.name: cloud for cloud in described}.values():
        flat = flatness(cloud.name, cloud.points)
        if flat is not None:
            yield flat
    fewest = min(described, key=len)
    if len(fewest) < expert().remarks.few_voxels:
        yield (
            f"'{fewest.name}' fills only {len(fewest)} voxels of edge {voxel_size:.4g}; a smaller voxel size "
            "leaves more to go by"
        )
    if not sensors_known and config.viewpoint in ("auto", "guess"):
        yield (
            "where the sensors stood is not known; it was guessed. If you know it, give it: more answers are right "
            "then (`geomoe3d register`: --sensor-source X,Y,Z and --sensor-target; `locate`: --sensor X,Y,Z; any: "
            "--set preparation.viewpoint=origin where they stood at the files' origins)"
        )


def data_remarks(
    clouds: tuple[PointCloud, PointCloud], wanted: float, config: PreparationConfig
) -> Iterator[str]:
    """Causes, in the clouds as loaded, of an answer that is not ok; arguments as `remarks`.

    Numbers that are no measurements, and a voxel size far from the one that would be chosen.
    """
    for loaded in clouds:
        yield from _no_data(loaded)
    usual = choose_voxel_size(*clouds, config.voxel_points)
    most = expert().remarks.unusual_size
    if not 1 / most < wanted / usual < most:
        size = "large" if wanted > usual else "small"
        yield (
            f"the voxel size {wanted:.4g} is {size} for these clouds: without one given {usual:.4g} would be taken"
        )


def _no_data(cloud: PointCloud) -> Iterator[str]:
    """A sentence on each axis with numbers that stand for no measurement, at least three and beside others."""
    for axis, name in enumerate("xyz"):
        values = cloud.points[:, axis] + cloud.origin[axis]
        for number in _NO_DATA:
            count = int(np.count_nonzero(values == number))
            if expert().remarks.least_no_data <= count < len(values):
                yield (
                    f"'{cloud.name}': {count:,} points have the {name} {number:.0f}, which stands for no measurement "
                    "in many programs; remove them"
                )


def far_sensors(clouds: tuple[PointCloud, PointCloud]) -> Iterator[str]:
    """A sentence on each sensor that the user says stood where the cloud looks small from."""
    for cloud in clouds:
        if not cloud.sensor_given or cloud.sensor is None:
            continue
        place = cloud.sensor - cloud.origin
        if not may_have_seen(cloud.points, place):
            away = float(np.linalg.norm(place - cloud.points.mean(axis=0)))
            yield (
                f"the sensor of '{cloud.name}' is said to have stood {away:.4g} from it, more than the cloud is long; "
                "is the place in the coordinates of the file?"
            )


def flatness(name: str, points: FloatArray) -> str | None:
    """A sentence where points (N, 3), four or more, lie on one line or in one plane, else None."""
    if len(points) <= 3:
        return None
    spread = np.linalg.svd(points - points.mean(0), compute_uv=False)
    if spread[1] < expert().remarks.flat * spread[0]:
        return f"all points of '{name}' lie on one straight line; they fix no turn about it"
    if spread[2] < expert().remarks.flat * spread[0]:
        return (
            f"'{name}' is flat: all its points lie in one plane, as those of a 2-D scanner do; this method compares "
            "surfaces in space, so give scans with height"
        )
    return None


def _one_file(given: tuple[Any, Any]) -> Iterator[str]:
    """A sentence where both are one file, or two of the same content."""
    paths = [Path(data) for data in given if isinstance(data, (str, os.PathLike))]
    if len(paths) < 2:
        return
    if paths[0].resolve() == paths[1].resolve():  # asks for no file that may be gone
        yield "source and target are the same file"
        return
    try:
        same = filecmp.cmp(paths[0], paths[1], shallow=False)  # reads them where they are equally long
    except OSError:
        return
    if same:
        yield once_more(str(paths[0]), str(paths[1]))
