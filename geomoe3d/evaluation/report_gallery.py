"""The gallery of the HTML report: the worst failures of a run as two thinned clouds to turn in the browser.

A failure is a wrong answer; between unrelated scans it is an answer called ok. The most confident come
first, because these are what a user would have believed. Place: between `records` and `report_page`; reads
clouds from disk. Cost: about 0.3 s and 50 kB per failure.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from geomoe3d.data.collection import load_fragment
from geomoe3d.errors import GeoMoE3DError
from geomoe3d.evaluation.measures import has_motion
from geomoe3d.evaluation.records import EvaluationPair, PairScore, Prediction, RunScore
from geomoe3d.evaluation.report_chart import escape
from geomoe3d.evaluation.report_plots import is_unrelated
from geomoe3d.geometry.se3 import shift_frames, transform_points
from geomoe3d.types import FloatArray
from geomoe3d.visual.scene import thin
from geomoe3d.visual.upright import upright_axes

MAX_POINTS = 3_000
MAX_TOTAL_POINTS = 400_000
"""Of all clouds of a page, 8 bytes each: with more failures than fit, every cloud is thinned further."""


@dataclass(frozen=True)
class Card:
    """One failure, ready for the page.

    Attributes:
        text: its HTML.
        clouds: what the script draws, as plain JSON; None where the clouds cannot be read.
    """

    text: str
    clouds: dict[str, Any] | None


def choose_run(scores: Sequence[RunScore]) -> RunScore | None:
    """The run whose failures are shown: the first with confidence, else the best recall; None for no runs."""
    if not scores:
        return None
    for score in scores:
        if score.calibration is not None:
            return score

    def recall(score: RunScore) -> float:
        measure = score.measures.get("recall_15")
        return -1.0 if measure is None or math.isnan(measure.value) else measure.value

    return max(scores, key=recall)


def worst_failures(score: RunScore, most: int) -> list[PairScore]:
    """At most ``most`` failures: by falling confidence (none last), then overlap, then in the run's order."""
    if is_unrelated(score):
        failures = [pair for pair in score.pairs if pair.status == "ok"]
    else:
        failures = [pair for pair in score.pairs if not pair.right]

    def badness(pair: PairScore) -> tuple[float, float]:
        return (_or(pair.confidence, -1.0), _or(pair.overlap, -1.0))

    return sorted(failures, key=badness, reverse=True)[:most]


def make_card(
    number: int, failure: PairScore, pair: EvaluationPair, prediction: Prediction | None, max_points: int
) -> Card:
    """A failure as text and clouds.

    Args:
        number: of the card on its page.
        failure: its measures.
        pair: its scans and truth.
        prediction: its answer; None shows the truth alone.
        max_points: drawn per cloud at most.
    """
    estimate = prediction.T_target_source if prediction is not None else None
    if not has_motion(estimate):
        estimate = None
    clouds: dict[str, Any] | None = None
    problem = ""
    if estimate is None and pair.T_target_source is None:
        problem = "There is neither an answer nor a true motion to show."
    else:
        try:
            clouds = _clouds(pair, estimate, max_points)
        except GeoMoE3DError as error:
            problem = f"The clouds cannot be shown here: {error}"
    return Card(_text(number, failure, clouds, problem), clouds)


def _clouds(pair: EvaluationPair, estimate: FloatArray | None, max_points: int) -> dict[str, Any]:
    """Both clouds, each about its own middle, and the motions between them so centred.

    Raises:
        GeoMoE3DError: a cloud cannot be read or holds no finite point.
    """
    rng = np.random.default_rng(0)
    parts: dict[str, FloatArray] = {}
    for name, path in (("source", pair.source), ("target", pair.target)):
        points = load_fragment(path).file_points
        parts[name] = points[thin(points, max_points, rng)]
    centers = {name: np.percentile(points, [1, 99], axis=0).mean(axis=0) for name, points in parts.items()}
    source, target = parts["source"] - centers["source"], parts["target"] - centers["target"]
    motions, fits = {}, {}
    for name, T in (("estimate", estimate), ("truth", pair.T_target_source)):
        if T is None:
            continue
        centred = shift_frames(T, -centers["source"], -centers["target"])
        motions[name] = np.round(centred, 6).ravel().tolist()
        shown = np.concatenate([target, transform_points(centred, source)])
        middle = np.percentile(shown, [1, 99], axis=0).mean(axis=0)
        radius = float(np.percentile(np.linalg.norm(shown - middle, axis=1), 98)) or 1.0
        fits[name] = {"center": np.round(middle, 4).tolist(), "radius": round(radius, 4)}
    return {
        "source": _packed(source),
        "target": _packed(target),
        "motions": motions,
        "fits": fits,
        "axes": np.round(upright_axes(target, rng)[0], 6).tolist(),
        "spacing": _spacing(target if len(target) >= len(source) else source),
    }


def _packed(points: FloatArray) -> dict[str, Any]:
    """Points (n, 3) as base64 of little-endian int16; one step, ``scale``, is about 0.2 mm in a room."""
    scale = (float(np.abs(points).max()) / 32767.0 if points.size else 0.0) or 1.0
    levels = np.ascontiguousarray(np.round(points / scale), dtype="<i2")
    return {"points": base64.b64encode(levels.tobytes()).decode("ascii"), "scale": scale}


def _spacing(points: FloatArray) -> float:
    """Typical distance of neighbouring points, for their drawn size."""
    from scipy.spatial import cKDTree

    if len(points) < 2:
        return 0.05
    distance = np.asarray(cKDTree(points).query(points, k=2)[0])[:, 1]
    positive = distance[distance > 0]
    return round(float(np.median(positive)), 5) if len(positive) else 0.05


def _text(number: int, failure: PairScore, clouds: dict[str, Any] | None, problem: str) -> str:
    facts = [
        ("confidence", _number(failure.confidence, ".2f")),
        ("status", failure.status or "not told"),
        ("rotation error", _number(failure.rotation_error_deg, ".1f", "°")),
        ("translation error", _number(failure.translation_error, ".2f", " m")),
        ("overlap", _number(failure.overlap, ".1%")),
        ("true inliers", _number(failure.inlier_ratio, ".1%")),
    ]
    if failure.error:
        facts.append(("error", failure.error))
    rows = "".join(f"<div><dt>{name}</dt><dd>{escape(value)}</dd></div>" for name, value in facts)
    name = escape(failure.pair)
    head = f'<article class="card" id="card-{number}"><h4>{name}</h4>'
    if clouds is None:
        return f'{head}<p class="lacking">{escape(problem)}</p><dl>{rows}</dl></article>'
    choices = ""
    words = {"estimate": "as estimated", "truth": "true motion"}
    for k, motion in enumerate(clouds["motions"]):
        checked = " checked" if k == 0 else ""
        choices += (
            f'<label><input type="radio" name="motion-{number}" value="{motion}"{checked}> '
            f"{words[motion]}</label>"
        )
    if "estimate" not in clouds["motions"]:
        choices = f"<span>no answer</span>{choices}"
    sides = "".join(
        f'<button type="button" data-side="{side}">{side}</button>' for side in ("slanted", "top", "front")
    )
    return (
        f'{head}<div class="stage" tabindex="0" role="application" aria-roledescription="3D view" '
        f'aria-describedby="gallery-keys" aria-label="Both clouds of {name}">'
        '<canvas aria-hidden="true"></canvas></div>'
        f'<div class="controls"><span role="radiogroup" aria-label="Source moved by">{choices}</span>'
        f'<span class="sides" role="group" aria-label="View">{sides}</span></div><dl>{rows}</dl></article>'
    )


def _number(value: float | None, form: str, unit: str = "") -> str:
    if value is None or math.isnan(value):
        return "unknown"
    return "no answer" if math.isinf(value) else f"{value:{form}}{unit}"


def _or(value: float | None, other: float) -> float:
    return other if value is None or math.isnan(value) else value
