"""One self-contained HTML page in which a registration can be turned, moved and compared in a browser.

The page asks nothing of any network: style, script and points are inside it, and its own content security
policy forbids everything else. It draws with WebGL 2 and falls back to a plain canvas. The numbers are in
the HTML itself, readable without script. Cost: about a second; at most 50,000 points per cloud are
embedded, so the file stays under 3 MB however large the clouds are. `fill_page` makes the other pages with
clouds to turn, too: a model of many scans, the report of an evaluation.
"""

from __future__ import annotations

import base64
import html
import json
import os
import re
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomoe3d.geometry.se3 import transform_points
from geomoe3d.runtime.files import write_atomically
from geomoe3d.types import FloatArray, IntArray
from geomoe3d.visual.paper import number
from geomoe3d.visual.scene import (
    GROUP_COLORS,
    KEPT_COLOR,
    REJECTED_COLOR,
    STATUS_WORDS,
    Scene,
    build_scene,
    choose_rows,
    distance_to_target,
)
from geomoe3d.visual.view import RegistrationView

MAX_POINTS = 50_000
MAX_LINES = 2_000  # of each kind of correspondence


def save_page(view: RegistrationView, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write one registration as a self-contained HTML file.

    Args:
        view: what to show.
        path: the file to be written.
        force: True replaces an existing file.

    Raises:
        OutputError: the file exists and ``force`` is False, or it cannot be written.
    """

    def write(temporary: Path) -> None:
        temporary.write_text(render_page(view), encoding="utf-8", newline="\n")

    write_atomically(path, write, force=force)


def render_page(view: RegistrationView) -> str:
    """The text of the page that `save_page` writes; the same view gives the same text."""
    scene = build_scene(view, max_points=MAX_POINTS)
    result = view.result
    source, target = result.source.name, result.target.name
    made_by = _escape(f"geomoe3d {result.versions.get('geomoe3d', '')}".strip())
    values = {
        "generator": f'<meta name="generator" content="{made_by}">',
        "made_by": made_by,
        "title": _escape(f"{source} on {target}: {STATUS_WORDS[result.status]}"),
        "stage_label": _escape(f"Point clouds {source} and {target}, {STATUS_WORDS[result.status]}"),
        "status": result.status,
        "status_words": STATUS_WORDS[result.status],
        "confidence": _escape(f"confidence {number(result.confidence, '.2f')}"),
        "source_name": _escape(source),
        "target_name": _escape(target),
        "reasons": _reasons(view),
        "transform": _transform(view),
        "facts": _facts(view, scene),
        "timings": _timings(view),
        "drawn": _escape(_drawn(view, scene)),
    }
    return fill_page("geomoe3d.visual", "page", values, _data(view, scene))


def fill_page(package: str, name: str, values: dict[str, str], data: dict[str, Any]) -> str:
    """The text of a self-contained page with clouds to turn.

    Args:
        package: with ``name``.html (the inside of the body), ``name``.css and ``name``.js.
        name: of these files.
        values: HTML for every {{word}} in the body, and "title" and "generator" for the head.
        data: for the script, which finds it as JSON in the element "data".
    """
    shared = "geomoe3d.visual"
    parts = {
        **values,
        "frame_style": _read(shared, "page_frame.css"),
        "style": _read(package, f"{name}.css"),
        "draw_script": _read(shared, "page_draw.js"),
        "view_script": _read(shared, "page_view.js"),
        "script": _read(package, f"{name}.js"),
        "data": _embed_json(data),
    }
    template = _read(shared, "page_frame.html").replace("{{body}}", _read(package, f"{name}.html").rstrip())
    # One pass: a file name that holds {{data}} stays a file name.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match.group(1)], template)


def base64_floats(values: FloatArray) -> str:
    """Numbers as the scripts unpack them: little-endian float32 in base64."""
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode("ascii")


def _data(view: RegistrationView, scene: Scene) -> dict[str, Any]:
    """What the script needs, as JSON; arrays are base64 of little-endian float32 or uint8."""
    motions = {"before": scene.before, "answer": scene.after, "alternative": scene.alternative}
    result = view.result
    limit = 2.0 * result.inlier_threshold
    if not (np.isfinite(limit) and limit > 0):  # a registration that failed before there was a threshold
        limit = 0.1 * scene.radius
    distances = {
        name: _base64_bytes(distance_to_target(view, scene, motion, limit) / limit)
        for name, motion in motions.items()
        if name != "before" and motion is not None
    }
    matrices = {"answer": result.T_target_source}
    if result.alternative is not None:
        matrices["alternative"] = result.alternative.T_target_source
    return {
        "source": {
            "points": base64_floats(scene.source),
            "colors": _colors(view.source_colors, scene.source_rows),
        },
        "target": {
            "points": base64_floats(scene.target),
            "colors": _colors(view.target_colors, scene.target_rows),
        },
        "lines": _lines(view, scene),
        "motions": {name: None if T is None else T.ravel().tolist() for name, T in motions.items()},
        "fits": {name: _fit(scene, T) for name, T in motions.items() if T is not None},
        "distances": distances,
        "distanceLimit": limit,
        "matrices": {name: _matrix_text(T) for name, T in matrices.items() if np.isfinite(T).all()},
        "axes": scene.axes.tolist(),
        "radius": scene.radius,
        "spacing": scene.spacing,
    }


def _lines(view: RegistrationView, scene: Scene) -> dict[str, Any]:
    """Correspondences, grouped by kind: each line starts in the centred source and ends in the scene."""
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
    chosen = [choose_rows(mask & finite, MAX_LINES, seed) for _, _, mask in kinds]
    rows = np.concatenate([*chosen, np.zeros(0, dtype=np.int64)])
    ends = view.correspondences[rows] - np.concatenate([scene.source_center, scene.target_center])
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


def _fit(scene: Scene, motion: FloatArray) -> dict[str, Any]:
    """Middle and half size of both clouds under a motion, for the camera."""
    points = np.concatenate([scene.target, transform_points(motion, scene.source)])
    if not len(points):
        return {"center": [0.0, 0.0, 0.0], "radius": 1.0}
    center = np.percentile(points, [1, 99], axis=0).mean(axis=0)
    radius = float(np.percentile(np.linalg.norm(points - center, axis=1), 98)) or scene.radius
    return {"center": center.tolist(), "radius": radius}


def _reasons(view: RegistrationView) -> str:
    if not view.result.reasons:
        return ""
    items = "".join(f"<li>{_escape(reason)}</li>" for reason in view.result.reasons)
    return f'<ul class="reasons" aria-label="Reasons">{items}</ul>'


def _transform(view: RegistrationView) -> str:
    result = view.result
    if not view.has_transform:
        return (
            '<section class="transform"><h2>Transform</h2><p><b>No transform was found.</b> '
            "Only the clouds as their files give them are shown.</p></section>"
        )
    text = _matrix(
        "answer",
        "Transform",
        "p<sub>target</sub> = R p<sub>source</sub> + t maps SOURCE into TARGET, "
        "in the files' own coordinates.",
        result.T_target_source,
        result.voxel_size,
    )
    other = result.alternative
    if other is not None and np.isfinite(other.T_target_source).all():
        text += _matrix(
            "alternative",
            "Alternative",
            f"The best clearly different motion: {other.rotation_difference_deg:.1f}° and "
            f"{other.translation_difference:.3g} away, "
            f"its score is {other.relative_score:.2f} of the answer's.",
            other.T_target_source,
            result.voxel_size,
        )
    return text


def _matrix(key: str, title: str, sentence: str, T: FloatArray, voxel_size: float) -> str:
    decimals = int(np.clip(np.ceil(3.0 - np.log10(voxel_size)), 0, 9)) if voxel_size > 0 else 6
    cells = [[f"{v:.6f}" for v in row[:3]] + [f"{row[3]:.{decimals}f}"] for row in T[:3]]
    cells.append(["0", "0", "0", "1"])
    rows = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in cells)
    return (
        f'<section class="transform"><h2>{title}</h2><p>{sentence}</p><div class="matrix" tabindex="0" '
        f'role="group" aria-label="Matrix of the {title.lower()}"><table>{rows}</table></div>'
        f'<button type="button" data-copy="{key}">Copy the matrix</button><span class="copied" role="status">'
        '</span><p class="fine">Rounded here; copied with every digit.</p></section>'
    )


def _facts(view: RegistrationView, scene: Scene) -> str:
    result = view.result
    share = f" ({result.num_inliers / result.num_correspondences:.1%})" if result.num_correspondences else ""
    rows = [
        ("overlap of source", number(result.overlap, ".1%")),
        ("inliers", f"{result.num_inliers:,} of {result.num_correspondences:,} correspondences{share}"),
        ("inlier threshold", f"{result.inlier_threshold:.6g}"),
        ("voxel size", f"{result.voxel_size:.6g}"),
        ("source points", f"{len(view.source_points):,}"),
        ("target points", f"{len(view.target_points):,}"),
        ("seed", str(result.seed)),
    ]
    return _table("Numbers", rows)


def _timings(view: RegistrationView) -> str:
    rows = [(name, f"{seconds:.3f} s") for name, seconds in view.result.seconds.items()]
    return _table("Time", rows) if rows else ""


def _table(title: str, rows: list[tuple[str, str]]) -> str:
    body = "".join(f'<tr><th scope="row">{_escape(a)}</th><td>{_escape(b)}</td></tr>' for a, b in rows)
    return f"<h2>{title}</h2><table>{body}</table>"


def _drawn(view: RegistrationView, scene: Scene) -> str:
    parts = []
    for name, drawn, points in (
        ("source", scene.source, view.source_points),
        ("target", scene.target, view.target_points),
    ):
        of_all = "all" if len(drawn) == len(points) else f"{len(drawn):,} of"
        parts.append(f"{of_all} {len(points):,} {name} points")
    text = f"Drawn: {' and '.join(parts)}"
    if len(scene.source) < len(view.source_points) or len(scene.target) < len(view.target_points):
        text += f", chosen evenly over the surface with seed {view.result.seed}"
    text += f". Up is taken from the target's file ({scene.up_words})."
    if scene.apart is not None:
        text += (
            f" In their files the clouds lie {scene.apart:,.6g} units apart, too far to be drawn:"
            " before lays the source beside the target."
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


def _embed_json(data: dict[str, Any]) -> str:
    """JSON for the inside of a script element: no character in it can end the element or open another."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _escape(text: str) -> str:
    return html.escape(text, quote=True)


def _read(package: str, name: str) -> str:
    return resources.files(package).joinpath(name).read_text(encoding="utf-8")
