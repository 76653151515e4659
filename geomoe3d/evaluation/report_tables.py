"""The tables of the HTML report; words and rounding are those of `report_words`, so that no two forms differ.

Everything that a user can influence (labels, scenes, commands) is escaped here. Place: between `report_words`
and `report_page`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence

from geomoe3d.evaluation.compare import Comparison
from geomoe3d.evaluation.records import Measure, RunScore
from geomoe3d.evaluation.report_chart import escape, run_classes
from geomoe3d.evaluation.report_words import (
    HEADINGS,
    MAIN_MEASURES,
    finite,
    interval_text,
    pairs_text,
    provenance,
    value_text,
)
from geomoe3d.evaluation.summary import title

Group = tuple[str, str]
"""Benchmark and track."""


def group_title(group: Group) -> str:
    """Benchmark and track in words."""
    return f"{group[0]}, track {group[1]}"


def swatch(run: int) -> str:
    """The colour of a run."""
    return f'<i class="swatch {run_classes(run)}"></i>'


def main_table(groups: Mapping[Group, Sequence[RunScore]], runs: Mapping[str, int]) -> str:
    """The main measures of all runs.

    Args:
        groups: runs by benchmark and track, in the order of the rows.
        runs: label -> number, for the colour.
    """
    head = "".join(
        f'<th scope="col" title="{escape(title(name))}">{escape(heading).replace(chr(10), "<br>")}</th>'
        for name, heading in zip(MAIN_MEASURES, HEADINGS, strict=True)
    )
    body = ""
    for group, members in groups.items():
        body += (
            f'<tbody><tr class="group"><th scope="rowgroup" colspan="{len(MAIN_MEASURES) + 1}">'
            f"<span>{escape(group_title(group))}</span></th></tr>"
        )
        for score in members:
            cells = "".join(f"<td>{_cell(score.measures.get(name))}</td>" for name in MAIN_MEASURES)
            missing = ' class="lacking"' if score.num_missing else ""
            body += (
                f'<tr><th scope="row">{swatch(runs[score.info.label])}{escape(score.info.label)}'
                f"<small{missing}>{escape(pairs_text(score))}</small></th>{cells}</tr>"
            )
        body += "</tbody>"
    return _scrolling(f'<thead><tr><th scope="col">run</th>{head}</tr></thead>{body}', "All runs")


def scene_tables(members: Sequence[RunScore]) -> str:
    """One table per measure, a row per scene and a column per run; the first one open, the others folded."""
    names = dict.fromkeys(name for score in members for found in score.scenes.values() for name in found)
    scenes = dict.fromkeys(scene for score in members for scene in score.scenes)
    text = ""
    for number, name in enumerate(names):
        rows = []
        for scene in scenes:
            found = [score.scenes.get(scene, {}).get(name) for score in members]
            count = max((measure.count for measure in found if measure is not None), default=0)
            rows.append([escape(scene), f"{count:,}", *(_cell(measure) for measure in found)])
        whole = [score.measures.get(name) for score in members]
        count = max((measure.count for measure in whole if measure is not None), default=0)
        rows.append(["all scenes", f"{count:,}", *(_cell(measure) for measure in whole)])
        heads = ["scene", "pairs", *(escape(score.info.label) for score in members)]
        unit = _unit(score.scenes[scene].get(name) for score in members for scene in score.scenes)
        caption = f"Per scene: {title(name)}{unit}"
        state = "" if number else " open"
        text += (
            f"<details{state}><summary>{escape(caption)}</summary>{_table(heads, rows, caption)}</details>"
        )
    return text


def measure_table(members: Sequence[RunScore]) -> str:
    """Every measure of every run with both intervals and its count, folded."""
    names = dict.fromkeys(name for score in members for name in score.measures)
    rows = [
        [
            f"{escape(title(name))}{_unit(score.measures.get(name) for score in members)}",
            *(_cell(score.measures.get(name), full=True) for score in members),
        ]
        for name in names
    ]
    heads = ["measure", *(escape(score.info.label) for score in members)]
    return (
        "<details><summary>All measures, with intervals over pairs and over scenes</summary>"
        f"{_table(heads, rows, 'All measures')}</details>"
    )


def calibration_table(members: Sequence[RunScore]) -> str:
    """Calibration error and AUROC of the runs with confidence; empty without any."""
    rows = [
        [
            escape(score.info.label),
            _cell(score.calibration.calibration_error, full=True),
            _cell(score.calibration.auroc, full=True),
        ]
        for score in members
        if score.calibration is not None
    ]
    heads = ["run", "expected calibration error", "AUROC"]
    return f"<h3>Confidence</h3>{_table(heads, rows, 'Confidence')}" if rows else ""


def comparison_table(comparisons: Sequence[Comparison]) -> str:
    """One row per comparison, run a over run b; a note that counts for several is told once for each."""
    heads = [
        "a against b",
        "pairs",
        "only a<br>right",
        "only b<br>right",
        "both<br>right",
        "neither<br>right",
        "exact<br>McNemar p",
        "recall of a<br>minus b, points",
        "median time<br>a over b",
        "time a over b,<br>median over pairs",
    ]
    rows, notes = [], ""
    for found in comparisons:
        name = f'{escape(found.a.label)} <span class="fine">against</span> {escape(found.b.label)}'
        where = escape(group_title((found.a.benchmark, found.a.track)))
        known = found.mcnemar_p is not None
        counts = (
            len(found.a_only_right),
            len(found.b_only_right),
            found.num_both_right,
            found.num_neither_right,
        )
        rows.append(
            [
                f"{name}<small>{where}</small>",
                f"{found.num_pairs:,}",
                *(f"{count:,}" if known else "-" for count in counts),
                f"{found.mcnemar_p:.3g}" if found.mcnemar_p is not None else "-",
                _cell(found.recall_difference, full=True, signed=True),
                _cell(found.time_ratio, full=True),
                _cell(found.pair_time_ratio, full=True),
            ]
        )
        notes += "".join(f"<li>{name}, {where}: {escape(note)}</li>" for note in found.notes)
    return _table(heads, rows, "Comparisons") + (f'<ul class="notes">{notes}</ul>' if notes else "")


def provenance_of(score: RunScore) -> str:
    """Where the numbers of a run come from: commit, hardware, seed, command, and its whole identity."""
    rows = [("method", score.info.method), *provenance(score)]
    text = ""
    for name, value in rows:
        shown = f"<code>{escape(value)}</code>" if name == "command" else escape(value)
        text += f"<div><dt>{name}</dt><dd>{shown}</dd></div>"
    identity = json.dumps(finite(score.info.identity), indent=1, sort_keys=True)
    return (
        f"<article><h3>{escape(score.info.label)}</h3><dl>{text}</dl>"
        "<details><summary>Everything that decides its predictions</summary>"
        f"<pre>{escape(identity)}</pre></details></article>"
    )


def _cell(measure: Measure | None, *, full: bool = False, signed: bool = False) -> str:
    """Value and interval over pairs; in full also the one over scenes and the count."""
    if measure is None:
        return "-"
    value = value_text(measure)
    if signed and measure.value > 0:
        value = f"+{value}"
    over_pairs, over_scenes = interval_text(measure), interval_text(measure, over_scenes=True)
    text = value + (f"<small>{over_pairs}</small>" if over_pairs else "")
    if full:
        text += f"<small>scenes {over_scenes}</small>" if over_scenes else ""
        text += f"<small>{measure.count:,} pairs</small>"
    return text


def _unit(measures: Iterable[Measure | None]) -> str:
    units = [measure.unit for measure in measures if measure is not None and measure.unit]
    return f", {escape(units[0])}" if units else ""


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]], name: str) -> str:
    """A table from HTML; the first cell of each row is its heading."""
    head = "".join(f'<th scope="col">{text}</th>' for text in heads)
    body = "".join(
        f'<tr><th scope="row">{row[0]}</th>{"".join(f"<td>{cell}</td>" for cell in row[1:])}</tr>'
        for row in rows
    )
    return _scrolling(f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody>", name)


def _scrolling(inside: str, name: str) -> str:
    """A table that scrolls by itself where the screen is narrow, by keyboard too."""
    words = escape(name)
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{words}"><table>{inside}</table></div>'
    )
