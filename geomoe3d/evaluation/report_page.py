"""The HTML report of an evaluation: one self-contained page with tables, figures and the worst failures.

The page asks nothing of any network: style, script, figures and points are inside it, and its own content
security policy forbids everything else. The numbers are in the HTML itself, readable without script. Cost:
about 0.3 s and 50 kB per failure shown, a second for the rest.
"""

from __future__ import annotations

import base64
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any

import numpy as np
from markupsafe import Markup

from geomoe3d import __version__
from geomoe3d.data.collection import load_fragment
from geomoe3d.errors import GeoMoE3DError, InputError
from geomoe3d.evaluation import report_words
from geomoe3d.evaluation.compare import Comparison
from geomoe3d.evaluation.metrics import has_motion
from geomoe3d.evaluation.records import EvaluationPair, PairScore, Prediction, RunScore
from geomoe3d.evaluation.report_drawing import NUM_COLORS
from geomoe3d.evaluation.report_figures import figures, is_unrelated, time_bars
from geomoe3d.evaluation.report_words import benchmark_rank, recall_of, run_key, warnings
from geomoe3d.evaluation.summary import title
from geomoe3d.geometry.se3 import shift_frames, transform_points
from geomoe3d.runtime.files import check_output, write_text
from geomoe3d.runtime.plain import plain
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray
from geomoe3d.visual.drawing import camera_fit, spacing_of, thin
from geomoe3d.visual.templates import render_cloud_page
from geomoe3d.visual.upright import upright_axes

MAX_TOTAL_POINTS = 400_000
"""Of all clouds of a page, 8 bytes each: with more failures than fit, every cloud is thinned further."""

Pairs = Mapping[str, Sequence[EvaluationPair]]
Predictions = Mapping[str, Sequence[Prediction]]
Groups = dict[tuple[str, str], list[RunScore]]
"""Runs by benchmark and track."""


def save_report(
    path: str | os.PathLike[str],
    scores: Sequence[RunScore],
    comparisons: Sequence[Comparison] = (),
    *,
    pairs: Pairs,
    predictions: Predictions,
    num_failures: int = 6,
    force: bool = False,
) -> None:
    """Write the report of an evaluation as one HTML file.

    Args:
        path: the file to be written.
        scores: runs, in any order.
        comparisons: of these runs.
        pairs: `run_key` of each run -> the pairs of its benchmark; for the gallery.
        predictions: `run_key` of each run -> its predictions; for the gallery.
        num_failures: shown per benchmark at most.
        force: True replaces an existing file.

    Raises:
        InputError: no runs, or two of the same key, or a run whose pairs or predictions are not given.
        OutputError: the file exists and ``force`` is False, or it cannot be written.
    """
    check_output(path, force=force)
    text = render_report(scores, comparisons, pairs=pairs, predictions=predictions, num_failures=num_failures)
    write_text(path, text, force=force)


def render_report(
    scores: Sequence[RunScore],
    comparisons: Sequence[Comparison] = (),
    *,
    pairs: Pairs,
    predictions: Predictions,
    num_failures: int = 6,
    made: str | None = None,
) -> str:
    """The text of the page that `save_report` writes, which has the same arguments.

    ``made`` is the date of the page; None takes the present time.
    """
    _check(scores, pairs, predictions)
    groups = _group(scores)
    members = [score for group in groups.values() for score in group]
    numbers = {label: k for k, label in enumerate(dict.fromkeys(s.info.label for s in members))}
    sections = [_section(group, found, numbers) for group, found in groups.items()]
    stages = dict.fromkeys(name for found in sections for bar in found["bars"] for name in bar.stages)
    galleries = _galleries(groups, pairs, predictions, num_failures)
    cards = [card for _, _, found in galleries for card in found]
    date = made or datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    values = {
        "generator": Markup('<meta name="generator" content="geomoe3d {}">').format(__version__),
        "title": f"Registration evaluation, {date}",
        "made": f"{date} by geomoe3d {__version__}",
        "summary": _summary(groups),
        "groups": groups,
        "warnings": [(group, said) for group, found in groups.items() for s in found for said in warnings(s)],
        "members": members,
        "numbers": numbers,
        "num_colors": NUM_COLORS,
        "sections": sections,
        "stages": {name: k % 16 for k, name in enumerate(stages)},
        "comparisons": comparisons,
        "galleries": galleries,
        "name_of": title,
        "text": report_words,
        "counted": counted,
        "dumped": lambda identity: json.dumps(plain(identity), indent=1, sort_keys=True),
    }
    data = {str(card.number): card.clouds for card in cards if card.clouds is not None}
    return render_cloud_page("evaluation", "report", values, data)


def _check(scores: Sequence[RunScore], pairs: Pairs, predictions: Predictions) -> None:
    if not scores:
        raise InputError("there are no runs to report; predict first")
    keys = [run_key(score.info) for score in scores]
    for key in keys:
        if keys.count(key) > 1:
            raise InputError(f"two runs are called '{key}'; give one of them another label")
        for what, given in (("pairs", pairs), ("predictions", predictions)):
            if key not in given:
                raise InputError(f"the {what} of run '{key}' are not given; keys must be those of run_key")


def _group(scores: Sequence[RunScore]) -> Groups:
    """Runs by benchmark and track, the best first; published benchmarks first, unrelated scans last."""

    def rank(score: RunScore) -> tuple[Any, ...]:
        accepted = score.measures.get("accepted")
        refused = 101.0 if accepted is None or math.isnan(accepted.value) else accepted.value
        name = score.info.benchmark
        return benchmark_rank(name), name, score.info.track, -recall_of(score), refused, score.info.label

    groups: Groups = {}
    for score in sorted(scores, key=rank):
        groups.setdefault((score.info.benchmark, score.info.track), []).append(score)
    return groups


def _section(group: tuple[str, str], scores: list[RunScore], numbers: Mapping[str, int]) -> dict[str, Any]:
    """Figures and tables of one benchmark and track; a table is a list of rows of names and measures."""
    runs = [numbers[score.info.label] for score in scores]
    scene_names = dict.fromkeys(name for score in scores for found in score.scenes.values() for name in found)
    scenes = dict.fromkeys(scene for score in scores for scene in score.scenes)
    names = dict.fromkeys(name for score in scores for name in score.measures)
    tables = {
        name: [
            *((scene, [score.scenes.get(scene, {}).get(name) for score in scores]) for scene in scenes),
            ("all scenes", [score.measures.get(name) for score in scores]),
        ]
        for name in scene_names
    }
    return {
        "group": group,
        "scores": scores,
        "figures": figures(scores, runs),
        "bars": time_bars(scores, runs),
        "scenes": tables,
        "measures": {name: [score.measures.get(name) for score in scores] for name in names},
        "calibrated": [score for score in scores if score.calibration is not None],
    }


def _summary(groups: Groups) -> str:
    members = [score for group in groups.values() for score in group]
    num_answers = sum(len(score.pairs) for score in members)
    benchmarks = ", ".join(dict.fromkeys(benchmark for benchmark, _ in groups))
    return f"{counted(len(members), 'run')} on {benchmarks}; {counted(num_answers, 'answer')} scored."


# ---- the gallery of failures ----------------------------------------------------------------------


@dataclass(frozen=True)
class Card:
    """One failure: a wrong answer; between unrelated scans, an answer called ok.

    Attributes:
        number: of the card on its page.
        name: of the pair.
        facts: names and values.
        clouds: what the script draws, as plain JSON; None where there is nothing to draw.
        problem: why, then.
    """

    number: int
    name: str
    facts: list[tuple[str, str]]
    clouds: dict[str, Any] | None
    problem: str


def _galleries(
    groups: Groups, pairs: Pairs, predictions: Predictions, num_failures: int
) -> list[tuple[str, str, list[Card]]]:
    """Benchmark, words and cards of one run per benchmark."""
    chosen = []
    for benchmark in dict.fromkeys(name for name, _ in groups):
        members = [run for (name, _), found in groups.items() if name == benchmark for run in found]
        score = choose_run(members)
        if score is not None:
            chosen.append((benchmark, score, worst_failures(score, num_failures)))
    total = sum(len(failures) for _, _, failures in chosen)
    max_points = min(3_000, MAX_TOTAL_POINTS // max(1, 2 * total))
    found = []
    number = 0
    for benchmark, score, failures in chosen:
        key = run_key(score.info)
        known = {pair.id: pair for pair in pairs[key]}
        answers = {prediction.pair: prediction for prediction in predictions[key]}
        cards = []
        for failure in failures:
            if failure.pair not in known:
                raise InputError(
                    f"run '{key}' scores the pair '{failure.pair}', which is not among its pairs"
                )
            pair, answer = known[failure.pair], answers.get(failure.pair)
            cards.append(make_card(number, failure, pair, answer, max_points))
            number += 1
        found.append((benchmark, _gallery_words(score, len(failures)), cards))
    return found


def choose_run(scores: Sequence[RunScore]) -> RunScore | None:
    """The run whose failures are shown: the first with confidence, else the best recall; None for no runs."""
    confident = [score for score in scores if score.calibration is not None]
    return confident[0] if confident else max(scores, key=recall_of, default=None)


def worst_failures(score: RunScore, most: int) -> list[PairScore]:
    """At most ``most`` failures: by falling confidence (none last), then overlap, then in the run's order.

    The most confident come first, because these are what a user would have believed.
    """
    if is_unrelated(score):
        failures = [pair for pair in score.pairs if pair.status == "ok"]
    else:
        failures = [pair for pair in score.pairs if not pair.right]

    def badness(pair: PairScore) -> list[float]:
        return [-1.0 if v is None or math.isnan(v) else v for v in (pair.confidence, pair.overlap)]

    return sorted(failures, key=badness, reverse=True)[:most]


def make_card(
    number: int, failure: PairScore, pair: EvaluationPair, prediction: Prediction | None, max_points: int
) -> Card:
    """A failure as facts and clouds.

    Args:
        number: of the card on its page.
        failure: its measures.
        pair: its scans and truth.
        prediction: its answer; None shows the truth alone.
        max_points: drawn per cloud at most.
    """
    estimate = prediction.T_target_source if prediction is not None else None
    motions = {"estimate": estimate if has_motion(estimate) else None, "truth": pair.T_target_source}
    clouds, problem = None, ""
    if all(T is None for T in motions.values()):
        problem = "There is neither an answer nor a true transform to show."
    else:
        try:
            clouds = _clouds(pair, motions, max_points)
        except GeoMoE3DError as error:
            problem = f"The clouds cannot be shown here: {error}"
    facts = [
        ("confidence", _number(failure.confidence, ".2f")),
        ("status", failure.status or "not told"),
        ("rotation error", _number(failure.rotation_error_deg, ".1f", "°")),
        ("translation error", _number(failure.translation_error, ".2f", " m")),
        ("overlap", _number(failure.overlap, ".1%")),
        ("true inliers", _number(failure.inlier_ratio, ".1%")),
        *([("error", failure.error)] if failure.error else []),
    ]
    return Card(number, failure.pair, facts, clouds, problem)


def _clouds(pair: EvaluationPair, given: Mapping[str, FloatArray | None], max_points: int) -> dict[str, Any]:
    """Both clouds, each about its own middle, and the motions between them so centred. Raises GeoMoE3DError:
    a cloud cannot be read or holds no finite point."""
    rng = np.random.default_rng(0)
    points, centers = [], []
    for path in (pair.source, pair.target):
        whole = load_fragment(path).file_points
        few = whole[thin(whole, max_points, rng)]
        centers.append(np.percentile(few, [1, 99], axis=0).mean(axis=0))
        points.append(few - centers[-1])
    source, target = points
    motions = {k: shift_frames(T, -centers[0], -centers[1]) for k, T in given.items() if T is not None}
    return {
        "source": _packed(source),
        "target": _packed(target),
        "motions": {name: np.round(T, 6).ravel().tolist() for name, T in motions.items()},
        "fits": {name: camera_fit(target, transform_points(T, source)) for name, T in motions.items()},
        "axes": np.round(upright_axes(target, rng)[0], 6).tolist(),
        "spacing": spacing_of(max(target, source, key=len)),
    }


def _packed(points: FloatArray) -> dict[str, Any]:
    """Points (n, 3) as base64 of little-endian int16; one step, ``scale``, is about 0.2 mm in a room."""
    scale = (float(np.abs(points).max()) / 32767.0 if points.size else 0.0) or 1.0
    levels = np.ascontiguousarray(np.round(points / scale), dtype="<i2")
    return {"points": base64.b64encode(levels.tobytes()).decode("ascii"), "scale": scale}


def _number(value: float | None, form: str, unit: str = "") -> str:
    if value is None or math.isnan(value):
        return "unknown"
    return "no answer" if math.isinf(value) else f"{value:{form}}{unit}"


def _gallery_words(score: RunScore, shown: int) -> str:
    name = f"'{score.info.label}', track {score.info.track}"
    if is_unrelated(score):
        if all(pair.status is None for pair in score.pairs):
            return f"Run {name} states no status, so it accepts and refuses no pair."
        count = sum(pair.status == "ok" for pair in score.pairs)
        if not count:
            return f"Run {name} accepted none of {len(score.pairs):,} unrelated pairs."
        return (
            f"Run {name} accepted {count:,} of {counted(len(score.pairs), 'pair')} whose scans have nothing in "
            f"common; shown: the {shown:,} most confident."
        )
    count = sum(not pair.right for pair in score.pairs)
    if not count:
        return f"Run {name} has no wrong answer among {counted(len(score.pairs), 'pair')}."
    order = "the most confident first, then by overlap"
    if all(pair.confidence is None for pair in score.pairs):
        order = "by overlap, as the run states no confidence"
    return (
        f"Run {name} is wrong on {count:,} of {counted(len(score.pairs), 'pair')}; shown: {shown:,}, {order}."
    )
