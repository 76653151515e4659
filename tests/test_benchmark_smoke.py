"""The benchmark in small: 24 real pairs through prediction, score, comparison and report, end to end."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from geomoe3d.data.threedmatch import find_benchmark_root
from geomoe3d.errors import InputError
from geomoe3d.evaluation.compare import compare
from geomoe3d.evaluation.evaluation_set import EvaluationSet
from geomoe3d.evaluation.predict import MethodSpec, predict
from geomoe3d.evaluation.score import score_runs, write_report

EVERY = {"3DMatch": 72, "3DLoMatch": 87}
"""Twelve pairs each."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory):
    try:
        find_benchmark_root()
    except InputError as error:
        pytest.skip(str(error))
    study = tmp_path_factory.mktemp("smoke")
    for benchmark, every in EVERY.items():
        specs = [MethodSpec("consensus"), MethodSpec("spectral")]
        predict(study, specs, EvaluationSet(benchmark, "1k", every=every))
        predict(study, [MethodSpec("geomoe3d")], EvaluationSet(benchmark, "clouds", every=every))
    return {(run.score.info.label, run.score.info.benchmark): run for run in score_runs(study)}


def test_every_run_is_there_with_all_its_pairs(runs) -> None:
    assert len(runs) == 6
    for run in runs.values():
        assert (run.score.num_pairs, run.score.num_missing, len(run.score.pairs)) == (12, 0, 12)


def right(run) -> int:
    return sum(score.right for score in run.score.pairs)


def test_real_pairs_are_registered(runs) -> None:
    """Limits well below what is measured over all pairs (96 and 77 %; 92 and 49 %), above chance."""
    assert right(runs["geomoe3d", "3DMatch"]) >= 10
    assert right(runs["geomoe3d", "3DLoMatch"]) >= 6
    assert right(runs["consensus", "3DMatch"]) >= 9
    assert right(runs["consensus", "3DLoMatch"]) >= 2
    assert right(runs["consensus", "3DMatch"]) > right(runs["spectral", "3DMatch"])


def test_ok_can_be_relied_on(runs) -> None:
    accepted = [
        score
        for benchmark in EVERY
        for score in runs["geomoe3d", benchmark].score.pairs
        if score.status == "ok"
    ]
    assert len(accepted) >= 12
    assert sum(not score.right for score in accepted) <= 1


def test_errors_of_right_pairs_are_small(runs) -> None:
    measures = runs["geomoe3d", "3DMatch"].score.measures
    assert measures["rotation_median"].value < 3
    assert measures["translation_median"].value < 10


def test_methods_are_compared_on_the_same_pairs(runs) -> None:
    found = compare(runs["consensus", "3DMatch"].score, runs["spectral", "3DMatch"].score)
    assert found.num_pairs == 12
    sides = len(found.a_only_right) + len(found.b_only_right)
    assert found.num_both_right + found.num_neither_right + sides == 12
    difference = right(runs["consensus", "3DMatch"]) - right(runs["spectral", "3DMatch"])
    assert found.recall_difference.value == pytest.approx(100 * difference / 12)


def test_reports_are_written(runs, tmp_path: Path) -> None:
    for suffix in (".html", ".md", ".json"):
        write_report(tmp_path / f"report{suffix}", list(runs.values()))
    found = json.loads((tmp_path / "report.json").read_text())
    assert len(found["runs"]) == 6
    assert "geomoe3d" in (tmp_path / "report.md").read_text()
    assert (tmp_path / "report.html").stat().st_size > 100_000
