"""One picture of a generated set: plans of its scenes and what their fragments look like.

The plan is the fragments laid together by their poses, seen from above without what lies over 1.9 m; the
crosses are the cameras. About 0.3 s per scene.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.data.collection import fragment_number, load_fragment
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.runtime.files import write_atomically
from geomoe3d.types import FloatArray


def draw_contact_sheet(scenes: list[Path], path: Path, *, force: bool = False) -> None:
    """Write a PNG with a row per scene: its plan and a few fragments as their cameras saw them.

    Args:
        scenes: folders of scenes with cloud_bin_N.ply and poses.txt.
        path: of the picture.
        force: True replaces one that is there.

    Raises:
        OutputError: the picture exists and ``force`` is False, or the disk refuses.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    most = 4  # fragments of a scene
    columns = 1 + most
    figure = Figure(figsize=(3.2 * columns, 2.6 * len(scenes)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(scenes), columns, squeeze=False)
    for row, folder in zip(axes, scenes, strict=True):
        files = sorted(folder.glob("cloud_bin_*.ply"), key=fragment_number)
        clouds = [load_fragment(file).file_points for file in files]
        poses = np.loadtxt(folder / "poses.txt").reshape(-1, 4, 4)
        _plan(row[0], folder.name, clouds, poses)
        for axis in row[1:]:
            axis.set_axis_off()
        chosen = np.linspace(0, len(clouds) - 1, min(most, len(clouds))).round().astype(int)
        for axis, k in zip(row[1:], chosen, strict=False):
            _view(axis, files[k].stem, clouds[k])
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=70), force=force)


def _thinned(points: FloatArray) -> FloatArray:
    return points[:: max(1, len(points) // 6000)]


def _plan(axis: Any, name: str, clouds: list[FloatArray], poses: FloatArray) -> None:
    axis.set_title(name, fontsize=8)
    axis.set_aspect("equal")
    axis.tick_params(labelsize=6)
    for cloud, pose in zip(clouds, poses, strict=True):
        world = transform_points(pose, _thinned(cloud))
        floor = poses[:, 2, 3].min() - 1.8
        world = world[world[:, 2] < floor + 1.9]
        world = world[np.argsort(world[:, 2])]
        axis.scatter(world[:, 0], world[:, 1], s=0.2, c=world[:, 2], cmap="viridis", linewidths=0)
    axis.plot(poses[:, 0, 3], poses[:, 1, 3], "r+", markersize=4)


def _view(axis: Any, name: str, points: FloatArray) -> None:
    """As the first camera saw it: x right, y down, near things drawn last."""
    points = _thinned(points)
    points = points[np.argsort(-points[:, 2])]
    axis.set_title(f"{name}", fontsize=7)
    axis.set_aspect("equal")
    u, v = points[:, 0] / points[:, 2], -points[:, 1] / points[:, 2]
    axis.scatter(u, v, s=0.6, c=points[:, 2], cmap="turbo", vmin=0.5, vmax=3.5, linewidths=0)
