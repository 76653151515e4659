"""Stage two: everything that a folder of predictions is worth, and the reports that say so.

Reads the cache and the ground truth alone; no method runs. 1,887 predictions take a few seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from geomoe3d.errors import InputError
from geomoe3d.evaluation.benchmarks import UNRELATED
from geomoe3d.evaluation.compare import Comparison, compare
from geomoe3d.evaluation.evaluation_set import load_run_pairs
from geomoe3d.evaluation.predictions import PHOTOGRAPHS, find_runs, read_info, read_predictions
from geomoe3d.evaluation.records import EvaluationPair, Prediction, RunScore
from geomoe3d.evaluation.report_text import to_json, to_markdown
from geomoe3d.evaluation.report_words import run_key
from geomoe3d.evaluation.summary import summarise
from geomoe3d.runtime.files import write_text
from geomoe3d.runtime.progress import Watch, shows_progress

REPORT_SUFFIXES = (".html", ".md", ".json")


@dataclass(frozen=True)
class ScoredRun:
    """A run with all that its reports need.

    Attributes:
        folder: of its predictions.
        pairs: of its benchmark, in order.
        predictions: those that exist, any order.
        score: what they are worth.
    """

    folder: Path
    pairs: list[EvaluationPair]
    predictions: list[Prediction]
    score: RunScore


@shows_progress("runs")
def score_runs(study: str | Path, *, raw_truth: bool = False, progress: Watch = None) -> list[ScoredRun]:
    """Score every run of a study, or the one run that the folder is.

    Args:
        study: folder of runs, or of one run.
        raw_truth: True compares with the rotations as published instead of projected onto SO(3).
        progress: called with (runs scored, runs in all); None shows a bar when it takes long, False nothing.

    Raises:
        InputError: no predictions there, pairs of photographs, or their ground truth is gone or changed.
        FormatError: a file of the cache is damaged.
    """
    folders = find_runs(Path(study))
    runs = []
    for number, folder in enumerate(folders):
        if progress:
            progress(number, len(folders))
        info = read_info(folder)
        if info.track == PHOTOGRAPHS:
            raise InputError(
                f"'{folder}' keeps pairs of photographs, which are no predictions to be scored: the call of `geomoe3d "
                "evaluate images` with --keep that made it, given again, shows their figures without measuring anew"
            )
        predictions = read_predictions(folder)
        pairs = load_run_pairs(info)
        score = summarise(info, pairs, predictions, raw_truth=raw_truth)
        runs.append(ScoredRun(folder, pairs, predictions, score))
    if progress:
        progress(len(folders), len(folders))
    return runs


def compare_all(runs: list[ScoredRun]) -> list[Comparison]:
    """Every two runs on the same pairs and track, against each other."""
    return [
        compare(one.score, other.score)
        for one, other in combinations(runs, 2)
        if _input_of(one) == _input_of(other) and one.score.info.benchmark != UNRELATED
    ]


def write_report(path: str | Path, runs: list[ScoredRun], *, force: bool = False) -> None:
    """Write a report; the suffix decides: .html to look at, .md to quote, .json to compute with. Raises
    InputError: another suffix; OutputError: the file exists and ``force`` is False, or cannot be written."""
    path = Path(path)
    scores, comparisons = [run.score for run in runs], compare_all(runs)
    if path.suffix == ".html":
        from geomoe3d.evaluation.report_page import save_report

        save_report(
            path,
            scores,
            comparisons,
            pairs={run_key(run.score.info): run.pairs for run in runs},
            predictions={run_key(run.score.info): run.predictions for run in runs},
            force=force,
        )
        return
    if path.suffix not in REPORT_SUFFIXES:
        raise InputError(f"cannot write '{path}': a report is {', '.join(REPORT_SUFFIXES)}")
    text = to_markdown(scores, comparisons) if path.suffix == ".md" else to_json(scores, comparisons)
    write_text(path, text.rstrip() + "\n", force=force)


def _input_of(run: ScoredRun) -> tuple[str, str, str]:
    info = run.score.info
    return info.track, info.benchmark, str(info.identity.get("pairs"))
