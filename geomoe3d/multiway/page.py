"""One self-contained page to turn a model of many scans in, each in its colour, with the edges between them.

It draws and turns with the scripts of the page of one pair (WebGL 2, or a plain canvas), asks nothing of
any network, and lists every scan and its fate in plain HTML. At most 300,000 points are embedded: 5 MB.
"""

from __future__ import annotations

import colorsys
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from geomoe3d.clouds.io import load_points
from geomoe3d.geometry.se3 import shift_frames, transform_points
from geomoe3d.multiway.model import PAGE_MARK, SceneGroup, SceneModel
from geomoe3d.multiway.scans import copies_in_words
from geomoe3d.runtime.files import write_text
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray
from geomoe3d.visual.drawing import thin
from geomoe3d.visual.templates import base64_floats, render_cloud_page
from geomoe3d.visual.upright import upright_axes

_KEPT, _REJECTED = "#0b9b6b", "#c02626"


def save_model_page(model: SceneModel, path: Path) -> None:
    """Write the page; an older one is replaced.

    Raises:
        OutputError: the page cannot be written.
    """
    write_text(path, render_model_page(model), force=True)


def render_model_page(model: SceneModel) -> str:
    """The text of the page; groups lie beside each other."""
    colors = {scan.name: _color(k) for k, scan in enumerate(model.scans)}
    clouds, centers = _clouds(model, colors)
    lines = _lines(model, centers)
    points = np.concatenate([cloud["raw"] for cloud in clouds]) if clouds else np.zeros((1, 3))
    center = np.percentile(points, [1, 99], axis=0).mean(axis=0)
    radius = float(np.percentile(np.linalg.norm(points - center, axis=1), 98)) or 1.0
    axes, _ = upright_axes(clouds[0]["raw"] if clouds else points, np.random.default_rng(0))
    data = {
        "clouds": [
            {"name": c["name"], "color": c["color"], "points": base64_floats(c["raw"] - center)}
            for c in clouds
        ],
        "lines": {
            "vertices": base64_floats(lines["vertices"] - np.tile(center, 2)),
            "classes": lines["classes"],
        },
        "axes": axes.tolist(),
        "radius": radius,
        "spacing": max(model.voxel_size, radius / 300),
    }
    placed = sum(len(group.poses) for group in model.groups)
    doubtful = [edge for edge in model.edges if not edge.kept and edge.confidence > 0.5]
    values = {
        "generator": Markup(PAGE_MARK),
        "title": f"{placed} of {counted(len(model.scans), 'scan')} placed",
        "summary": _summary(model, placed),
        "groups": model.groups,
        "colors": colors,
        "unplaced": model.unplaced,
        "doubted": model.doubted,
        "copies": copies_in_words(model.copies),
        "kept": sorted((edge for edge in model.edges if edge.kept), key=lambda edge: -(edge.shift or 0.0)),
        "doubtful": sorted(doubtful, key=lambda edge: -edge.confidence),
    }
    return render_cloud_page("multiway", "page", values, data)


def _clouds(model: SceneModel, colors: dict[str, str]) -> tuple[list[dict[str, Any]], dict[str, FloatArray]]:
    """Thinned clouds in page coordinates, groups shifted beside each other, and the middle of each scan."""
    paths = {scan.name: scan.path for scan in model.scans}
    placed = sum(len(group.poses) for group in model.groups)
    share = max(500, 300_000 // max(placed, 1))
    rng = np.random.default_rng(0)
    clouds: list[dict[str, Any]] = []
    centers: dict[str, FloatArray] = {}
    beside = 0.0
    for group in model.groups:
        made = [
            (name, _points(paths[name], group, paths[group.reference], name, share, rng))
            for name in group.poses
        ]
        everything = np.concatenate([points for _, points in made])
        low, high = np.percentile(everything, [0.5, 99.5], axis=0)
        shift = np.array([beside - low[0], 0.0, 0.0])
        beside += 1.15 * float(high[0] - low[0])
        for name, points in made:
            clouds.append({"name": name, "color": colors[name], "raw": points + shift})
            centers[name] = (points + shift).mean(axis=0)
    return clouds, centers


def _points(
    path: str, group: SceneGroup, reference: str, name: str, count: int, rng: np.random.Generator
) -> FloatArray:
    """Some points of a scan about the origin of its group's reference, so that float32 holds them."""
    cloud = load_points(path)
    origin = cloud.origin if path == reference else load_points(reference).origin
    local = shift_frames(group.poses[name], -cloud.origin, -origin)
    moved = transform_points(local, cloud.points)
    return moved[thin(moved, count, rng)]


def _lines(model: SceneModel, centers: dict[str, FloatArray]) -> dict[str, Any]:
    """Edges as lines between the middles of their scans: kept ones, and those found to be wrong."""
    vertices, classes = [], []
    for label, color, kept in (("kept edges", _KEPT, True), ("rejected edges", _REJECTED, False)):
        ends = [
            np.concatenate([centers[e.source], centers[e.target]])
            for e in model.edges
            if e.kept == kept and e.source in centers and e.target in centers and (kept or e.confidence > 0.5)
        ]
        vertices += ends
        classes.append({"label": label, "color": color, "drawn": len(ends), "shown": kept})
    return {"vertices": np.array(vertices).reshape(-1, 6), "classes": classes}


def _summary(model: SceneModel, placed: int) -> str:
    kept = sum(edge.kept for edge in model.edges)
    groups = f" in {len(model.groups)} groups that nothing sure connects" if len(model.groups) > 1 else ""
    return (
        f"{placed} of {counted(len(model.scans), 'scan')} placed{groups}. {counted(model.num_pairs, 'pair')} "
        f"registered, {counted(kept, 'edge')} kept. Common voxel size {model.voxel_size:.4g}."
    )


def _color(number: int) -> str:
    # Steps by the golden ratio: neighbours in the list differ most.
    r, g, b = colorsys.hls_to_rgb((0.58 + 0.61803398875 * number) % 1.0, 0.5 + 0.1 * (number % 3 - 1), 0.7)
    return f"#{round(255 * r):02x}{round(255 * g):02x}{round(255 * b):02x}"
