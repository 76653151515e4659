"""The HTML report of an evaluation: one self-contained page with tables, plots and the worst failures.

The page asks nothing of any network: style, script, plots and points are inside it, and its own content
security policy forbids everything else. The numbers are in the HTML itself, readable without script. Cost:
about 0.3 s per failure shown, the rest a fraction of a second.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from geomoe3d import __version__
from geomoe3d.errors import InputError
from geomoe3d.evaluation.compare import Comparison
from geomoe3d.evaluation.records import EvaluationPair, Prediction, RunScore
from geomoe3d.evaluation.report_chart import escape
from geomoe3d.evaluation.report_gallery import (
    MAX_POINTS,
    MAX_TOTAL_POINTS,
    choose_run,
    make_card,
    worst_failures,
)
from geomoe3d.evaluation.report_plots import figures, is_unrelated
from geomoe3d.evaluation.report_tables import (
    Group,
    calibration_table,
    comparison_table,
    group_title,
    main_table,
    measure_table,
    provenance_of,
    scene_tables,
    swatch,
)
from geomoe3d.evaluation.report_words import LEGEND, benchmark_rank, run_key, warnings
from geomoe3d.runtime.files import write_atomically
from geomoe3d.visual.page import fill_page


def save_report(
    path: str | os.PathLike[str],
    scores: Sequence[RunScore],
    comparisons: Sequence[Comparison] = (),
    *,
    pairs: Mapping[str, Sequence[EvaluationPair]],
    predictions: Mapping[str, Sequence[Prediction]],
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

    def write(temporary: Path) -> None:
        text = render_report(
            scores, comparisons, pairs=pairs, predictions=predictions, num_failures=num_failures
        )
        temporary.write_text(text, encoding="utf-8", newline="\n")

    write_atomically(path, write, force=force)


def render_report(
    scores: Sequence[RunScore],
    comparisons: Sequence[Comparison] = (),
    *,
    pairs: Mapping[str, Sequence[EvaluationPair]],
    predictions: Mapping[str, Sequence[Prediction]],
    num_failures: int = 6,
    made: str | None = None,
) -> str:
    """The text of the page that `save_report` writes, which has the same arguments.

    Args:
        scores: as there.
        comparisons: as there.
        pairs: as there.
        predictions: as there.
        num_failures: as there.
        made: date of the page; None takes the present time.

    Raises:
        InputError: as there.
    """
    _check(scores, pairs, predictions)
    groups = _group(scores)
    members = [score for group in groups.values() for score in group]
    runs = {label: number for number, label in enumerate(dict.fromkeys(s.info.label for s in members))}
    gallery, clouds = _gallery(groups, pairs, predictions, num_failures)
    made_by = escape(f"geomoe3d {__version__}")
    date = escape(made or datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"))
    values = {
        "generator": f'<meta name="generator" content="{made_by}">',
        "title": f"Registration evaluation, {date}",
        "made_by": made_by,
        "made": date,
        "contents": _contents(groups, bool(comparisons)),
        "summary": escape(_summary(groups)),
        "warnings": _warnings(members),
        "main": main_table(groups, runs),
        "legend": escape(LEGEND[:1].upper() + LEGEND[1:]),
        "groups": "".join(
            _section(f"group-{number}", group, scores, runs)
            for number, (group, scores) in enumerate(groups.items())
        ),
        "comparisons": _comparisons(comparisons),
        "gallery": gallery,
        "provenance": "".join(provenance_of(score) for score in members),
    }
    return fill_page("geomoe3d.evaluation", "report", values, clouds)


def _check(
    scores: Sequence[RunScore],
    pairs: Mapping[str, Sequence[EvaluationPair]],
    predictions: Mapping[str, Sequence[Prediction]],
) -> None:
    if not scores:
        raise InputError("there are no runs to report; predict first")
    keys = [run_key(score.info) for score in scores]
    for key in keys:
        if keys.count(key) > 1:
            raise InputError(f"two runs are called '{key}'; give one of them another label")
        for what, given in (("pairs", pairs), ("predictions", predictions)):
            if key not in given:
                raise InputError(f"the {what} of run '{key}' are not given; keys must be those of run_key")


def _group(scores: Sequence[RunScore]) -> dict[Group, list[RunScore]]:
    """Runs by benchmark and track, the best first; published benchmarks first, unrelated scans last."""

    def rank(score: RunScore) -> tuple[Any, ...]:
        name = score.info.benchmark
        best = -_value(score, "recall_15", -1.0), _value(score, "accepted", 101.0)
        return benchmark_rank(name), name, score.info.track, *best, score.info.label

    groups: dict[Group, list[RunScore]] = {}
    for score in sorted(scores, key=rank):
        groups.setdefault((score.info.benchmark, score.info.track), []).append(score)
    return groups


def _value(score: RunScore, name: str, other: float) -> float:
    measure = score.measures.get(name)
    return other if measure is None or measure.value != measure.value else measure.value


def _summary(groups: Mapping[Group, Sequence[RunScore]]) -> str:
    members = [score for group in groups.values() for score in group]
    num_answers = sum(len(score.pairs) for score in members)
    benchmarks = ", ".join(dict.fromkeys(benchmark for benchmark, _ in groups))
    plural = "" if len(members) == 1 else "s"
    return f"{len(members)} run{plural} on {benchmarks}; {num_answers:,} answers scored."


def _contents(groups: Mapping[Group, Sequence[RunScore]], compared: bool) -> str:
    links = [("main", "All runs")]
    links += [(f"group-{number}", group_title(group)) for number, group in enumerate(groups)]
    links += [("comparisons", "Comparisons")] if compared else []
    links += [("gallery", "Worst failures"), ("provenance", "Where the numbers come from")]
    return "".join(f'<li><a href="#{target}">{escape(text)}</a></li>' for target, text in links)


def _warnings(members: Sequence[RunScore]) -> str:
    found = "".join(
        f"<li>{escape(f'{group_title((score.info.benchmark, score.info.track))}: {text}')}</li>"
        for score in members
        for text in warnings(score)
    )
    return f'<ul class="warnings" aria-label="Warnings">{found}</ul>' if found else ""


def _section(anchor: str, group: Group, members: Sequence[RunScore], runs: Mapping[str, int]) -> str:
    """Plots and tables of one benchmark and track."""
    numbers = [runs[score.info.label] for score in members]
    legend = "".join(
        f'<button type="button" data-run="{number}" aria-pressed="true">{swatch(number)}'
        f"{escape(score.info.label)}</button>"
        for number, score in zip(numbers, members, strict=True)
    )
    return (
        f'<section id="{anchor}"><h2>{escape(group_title(group))}</h2>'
        f'<div class="legend" role="group" aria-label="Runs shown in the plots">{legend}</div>'
        f'<div class="plots">{"".join(figures(members, numbers))}</div>'
        f"{calibration_table(members)}{scene_tables(members)}{measure_table(members)}</section>"
    )


def _comparisons(comparisons: Sequence[Comparison]) -> str:
    if not comparisons:
        return ""
    return (
        '<section id="comparisons"><h2>Comparisons, pair by pair</h2><p>Over the pairs that both runs '
        "answered; right is 15 deg and 0.30 m. Small: 95 % intervals over pairs, then over scenes.</p>"
        f"{comparison_table(comparisons)}</section>"
    )


def _gallery(
    groups: Mapping[Group, Sequence[RunScore]],
    pairs: Mapping[str, Sequence[EvaluationPair]],
    predictions: Mapping[str, Sequence[Prediction]],
    num_failures: int,
) -> tuple[str, dict[str, Any]]:
    """The cards of one run per benchmark, and what their views draw by the number of the card."""
    chosen = []
    for benchmark in dict.fromkeys(name for name, _ in groups):
        score = choose_run(
            [run for (name, _), members in groups.items() if name == benchmark for run in members]
        )
        if score is not None:
            chosen.append((benchmark, score, worst_failures(score, num_failures)))
    total = sum(len(failures) for _, _, failures in chosen)
    max_points = min(MAX_POINTS, MAX_TOTAL_POINTS // max(1, 2 * total))
    text, clouds = "", {}
    number = 0
    for benchmark, score, failures in chosen:
        key = run_key(score.info)
        known = {pair.id: pair for pair in pairs[key]}
        answers = {prediction.pair: prediction for prediction in predictions[key]}
        cards = ""
        for failure in failures:
            if failure.pair not in known:
                raise InputError(
                    f"run '{key}' scores the pair '{failure.pair}', which is not among its pairs"
                )
            card = make_card(number, failure, known[failure.pair], answers.get(failure.pair), max_points)
            cards += card.text
            if card.clouds is not None:
                clouds[str(number)] = card.clouds
            number += 1
        text += f"<h3>{escape(benchmark)}</h3><p>{escape(_gallery_words(score, len(failures)))}</p>"
        text += f'<div class="cards">{cards}</div>' if cards else ""
    return text, clouds


def _gallery_words(score: RunScore, shown: int) -> str:
    name = f"'{score.info.label}', track {score.info.track}"
    if is_unrelated(score):
        if all(pair.status is None for pair in score.pairs):
            return (
                f"Run {name} does not say of which answers it is sure, so it accepts none and refuses none."
            )
        count = sum(pair.status == "ok" for pair in score.pairs)
        if not count:
            return f"Run {name} called none of {len(score.pairs):,} unrelated pairs ok."
        return (
            f"Run {name} called {count:,} of {len(score.pairs):,} pairs ok whose scans have nothing in "
            f"common; shown: the {shown:,} most confident."
        )
    count = sum(not pair.right for pair in score.pairs)
    if not count:
        return f"Run {name} has no wrong answer among {len(score.pairs):,} pairs."
    order = "the most confident first, then by overlap"
    if all(pair.confidence is None for pair in score.pairs):
        order = "by overlap, as the run states no confidence"
    return f"Run {name} is wrong on {count:,} of {len(score.pairs):,} pairs; shown: {shown:,}, {order}."
