"""One self-contained HTML page in which a registration can be turned, moved and compared in a browser.

The page asks nothing of any network: style, script and points are inside it, and its own content security
policy forbids everything else. It draws with WebGL 2 and falls back to a plain canvas. The numbers are in
the HTML itself, readable without script. Cost: about a second; at most 50,000 points per cloud are
embedded, so the file stays under 3 MB however large the clouds are.
"""

from __future__ import annotations

import base64
import os
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from geomoe3d.geometry.se3 import transform_points
from geomoe3d.runtime.files import check_output, write_text
from geomoe3d.runtime.words import counted, of_the_score
from geomoe3d.types import FloatArray, IntArray
from geomoe3d.visual.accuracy_facts import accuracy_facts, length, margin_facts
from geomoe3d.visual.drawing import (
    GROUP_COLORS,
    KEPT_COLOR,
    REJECTED_COLOR,
    STATUS_WORDS,
    Drawing,
    build_drawing,
    camera_fit,
    choose_rows,
    distance_to_target,
)
from geomoe3d.visual.paper import number
from geomoe3d.visual.templates import base64_floats, render_cloud_page
from geomoe3d.visual.view import RegistrationView


def save_page(view: RegistrationView, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write one registration as a self-contained HTML file.

    Args:
        view: what to show.
        path: the file to be written.
        force: True replaces an existing file.

    Raises:
        OutputError: the file exists and ``force`` is False, or it cannot be written.
    """
    check_output(path, force=force)
    write_text(path, render_page(view), force=force)


def render_page(view: RegistrationView, *, max_points: int = 50_000, mark: str = "") -> str:
    """The text of the page that `save_page` writes; the same view gives the same text.

    Args:
        view: what to show.
        max_points: of each cloud.
        mark: one more element for the head, as HTML.
    """
    drawing = build_drawing(view, max_points=max_points)
    result = view.result
    source, target = result.source.name, result.target.name
    made_by = f"geomoe3d {result.versions.get('geomoe3d', '')}".strip()
    status_words = STATUS_WORDS[result.status]
    values = {
        "generator": Markup('<meta name="generator" content="{}">').format(made_by) + Markup(mark),
        "made_by": made_by,
        "title": f"{source} on {target}: {status_words}",
        "stage_label": f"Point clouds {source} and {target}, {status_words}",
        "result": result,
        "status_words": status_words,
        "confidence": f"confidence {number(result.confidence, '.2f')}",
        "matrices": {key: _shown_matrix(T, result.voxel_size) for key, T in _transforms(view).items()},
        "tables": {"Numbers": _facts(view), "Time": [(k, f"{s:.3f} s") for k, s in result.seconds.items()]},
        "drawn": _drawn(view, drawing),
        "unit": view.unit,
        "share": None if result.alternative is None else of_the_score(result.alternative.relative_score),
    }
    return render_cloud_page("visual", "page", values, _data(view, drawing))


def _data(view: RegistrationView, drawing: Drawing) -> dict[str, Any]:
    """What the script needs, as JSON; arrays are base64 of little-endian float32 or uint8."""
    motions = {"before": drawing.before, "answer": drawing.after}
    motions["alternative"] = None if view.rival is None else drawing.alternative
    reach = distance_reach(view, drawing)
    distances = {
        name: distance_to_target(view, drawing, motion, reach)
        for name, motion in motions.items()
        if name != "before" and motion is not None
    }
    limit = distance_limit(distances.get("answer", np.zeros(0)), reach)
    return {
        "source": {
            "points": base64_floats(drawing.source),
            "colors": _colors(view.source_colors, drawing.source_rows),
        },
        "target": {
            "points": base64_floats(drawing.target),
            "colors": _colors(view.target_colors, drawing.target_rows),
        },
        "lines": _lines(view, drawing),
        "motions": {name: None if T is None else T.ravel().tolist() for name, T in motions.items()},
        "fits": {
            name: camera_fit(drawing.target, transform_points(T, drawing.source))
            for name, T in motions.items()
            if T is not None
        },
        "distances": {name: _levels(values, limit, reach) for name, values in distances.items()},
        "distanceLimit": limit,
        "distanceReach": reach,
        "matrices": {name: _matrix_text(T) for name, T in _transforms(view).items()},
        "axes": drawing.axes.tolist(),
        "radius": drawing.radius,
        "spacing": drawing.spacing,
        "unit": view.unit,
    }


def distance_reach(view: RegistrationView, drawing: Drawing) -> float:
    """Up to where distances to the target are looked for: two inlier thresholds."""
    reach = 2.0 * view.result.inlier_threshold
    if not (np.isfinite(reach) and reach > 0):  # a registration that failed before there was a threshold
        return 0.1 * drawing.radius
    return reach


def distance_limit(distances: FloatArray, reach: float) -> float:
    """The end of the colour scale: six robust deviations above the median distance, rounded up to two digits.

    A quantile would be that of the rim, where the target ends and distances grow up to ``reach``.
    """
    near = distances[np.isfinite(distances)]
    median = float(np.median(near)) if len(near) else 0.0
    largest = median + 6 * 1.4826 * float(np.median(np.abs(near - median))) if len(near) else 0.0
    if not largest > 0:
        return reach
    step = 10.0 ** (np.floor(np.log10(largest)) - 1)
    return min(float(np.ceil(largest / step) * step), reach)


def _levels(distances: FloatArray, limit: float, reach: float) -> str:
    """One byte per point: 0 to 254 for 0 to ``limit`` and more; 255 where nothing lies within ``reach``."""
    levels = np.where(distances < reach, np.minimum(distances / limit, 1.0) * 254.0 / 255.0, 1.0)
    return _base64_bytes(levels)


def _lines(view: RegistrationView, drawing: Drawing) -> dict[str, Any]:
    """Correspondences, grouped by kind: each line starts in the centred source and ends in the drawing."""
    seed = view.result.seed
    finite = np.isfinite(view.correspondences).all(axis=1)
    if view.groups is not None:
        kinds = [
            (view.group_label(int(group)), GROUP_COLORS[int(group) % len(GROUP_COLORS)], view.groups == group)
            for group in np.unique(view.groups)
        ]
    else:
        kept, (yes, no) = view.kept(), view.kept_words
        kinds = [(yes, KEPT_COLOR, kept), (no, REJECTED_COLOR, ~kept)]
    # At most so many of each kind of correspondence.
    chosen = [choose_rows(mask & finite, 2_000, seed) for _, _, mask in kinds]
    rows = np.concatenate([*chosen, np.zeros(0, dtype=np.int64)])
    ends = view.correspondences[rows] - np.concatenate([drawing.source_center, drawing.target_center])
    classes = [
        {
            "label": label,
            "color": color,
            "total": int(mask.sum()),
            "drawn": len(rows_of_kind),
            "shown": color != REJECTED_COLOR,
        }
        for (label, color, mask), rows_of_kind in zip(kinds, chosen, strict=True)
        if mask.any()
    ]
    return {"vertices": base64_floats(ends), "classes": classes}


def _transforms(view: RegistrationView) -> dict[str, FloatArray]:
    """The answer and the alternative, as far as there are any."""
    result = view.result
    found = {"answer": result.T_target_source} if view.has_transform else {}
    if found and view.rival is not None:
        found["alternative"] = view.rival.T_target_source
    return found


def _shown_matrix(T: FloatArray, voxel_size: float) -> list[list[str]]:
    decimals = int(np.clip(np.ceil(3.0 - np.log10(voxel_size)), 0, 9)) if voxel_size > 0 else 6
    cells = [[f"{v:.6f}" for v in row[:3]] + [f"{row[3]:.{decimals}f}"] for row in T[:3]]
    return [*cells, ["0", "0", "0", "1"]]


def _facts(view: RegistrationView) -> list[tuple[str, str]]:
    result = view.result
    share = f" ({result.num_inliers / result.num_correspondences:.1%})" if result.num_correspondences else ""
    return [
        *accuracy_facts(result, view.unit),
        *margin_facts(result),
        (
            "inliers",
            f"{result.num_inliers:,} of {counted(result.num_correspondences, 'correspondence')}{share}",
        ),
        ("inlier threshold", length(result.inlier_threshold, view.unit)),
        ("voxel size", length(result.voxel_size, view.unit)),
        ("source points", f"{len(view.source_points):,}"),
        ("target points", f"{len(view.target_points):,}"),
        ("seed", str(result.seed)),
    ]


def _drawn(view: RegistrationView, drawing: Drawing) -> str:
    parts = []
    for name, drawn, points in (
        ("source", drawing.source, view.source_points),
        ("target", drawing.target, view.target_points),
    ):
        of_all = "all" if len(drawn) == len(points) else f"{len(drawn):,} of"
        parts.append(f"{of_all} {counted(len(points), name + ' point')}")
    text = f"Drawn: {' and '.join(parts)}"
    if len(drawing.source) < len(view.source_points) or len(drawing.target) < len(view.target_points):
        text += f", chosen evenly over the surface with seed {view.result.seed}"
    text += f". Up is taken from the target's file ({drawing.up_words})."
    if drawing.apart is not None:
        apart = length(drawing.apart, view.unit or "units", ",.6g")
        text += (
            f" In their files the clouds lie {apart} apart, too far to be drawn:"
            " before draws the source beside the target."
        )
    if view.has_transform:
        text += " Between before and after the source turns about its own middle; it stays rigid."
    return text


def _matrix_text(T: FloatArray) -> str:
    """Four rows of four numbers that read back bit by bit."""
    return "\n".join(" ".join(repr(float(value)) for value in row) for row in T) + "\n"


def _colors(colors: FloatArray | None, rows: IntArray) -> str | None:
    return None if colors is None else _base64_bytes(colors[rows])


def _base64_bytes(values: NDArray[np.float64]) -> str:
    """Values in [0, 1] as 0 to 255; larger ones become 255, NaN becomes 0."""
    levels = np.round(255.0 * np.clip(np.nan_to_num(values, posinf=1.0), 0.0, 1.0)).astype(np.uint8)
    return base64.b64encode(np.ascontiguousarray(levels).tobytes()).decode("ascii")
