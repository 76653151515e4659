"""The HTML report: complete, self-contained, escaped, honest about gaps and odd runs."""

from __future__ import annotations

import html
import math
import re
from dataclasses import replace

import pytest
from markupsafe import escape
from report_runs import NASTY, Document, make_pairs, make_run, predict, report

from geomoe3d.errors import InputError, OutputError
from geomoe3d.evaluation.compare import compare
from geomoe3d.evaluation.records import EvaluationPair, Measure, Prediction, RunScore
from geomoe3d.evaluation.report_figures import is_unrelated
from geomoe3d.evaluation.report_page import render_report, run_key, save_report, worst_failures
from geomoe3d.evaluation.report_text import terminal_table, to_markdown
from geomoe3d.evaluation.report_words import COLUMNS, interval_text, main_row, value_text


@pytest.fixture(scope="module")
def pairs(two_runs: list[tuple[RunScore, list[EvaluationPair], list[Prediction]]]) -> list[EvaluationPair]:
    return two_runs[0][1]


# ---------------------------------------------------------------- the page


def test_page_is_well_formed_and_complete(two_runs):
    comparisons = [compare(two_runs[0][0], two_runs[1][0], resamples=100)]
    document = Document(report(*two_runs, comparisons=comparisons))
    assert len(document.ids) == len(set(document.ids))
    linked = {str(found["href"])[1:] for tag, found in document.tags if tag == "a"}
    assert {"main", "group-0", "comparisons", "gallery", "provenance"} == linked <= set(document.ids)
    for score, _, _ in two_runs:
        for cell in main_row(score):
            assert cell in document.words
        for measure in score.measures.values():
            assert value_text(measure) in document.words
            for text in (
                interval_text(measure),
                interval_text(measure, over_scenes=True),
            ):
                assert text in document.words
        for scene, measures in score.scenes.items():
            assert scene in document.words
            assert all(value_text(measure) in document.words for measure in measures.values())
        for word in (
            score.info.commit,
            score.info.hardware,
            score.info.created,
            "workers 2, threads of each 1",
        ):
            assert word in document.words
        assert " ".join(score.info.command.split()) in document.words
        assert score.info.label in document.words
    assert "seed 7" in document.words
    assert "2026-05-06 07:08 UTC" in document.words
    assert f"{comparisons[0].mcnemar_p:.3g}" in document.words
    assert value_text(comparisons[0].recall_difference) in document.words


def main_table(text: str) -> tuple[list[str], list[tuple[str, str]]]:
    """Headings of the page's main table, and name and cells of each row, as HTML."""
    table = text.split('id="main"')[1].split("</table>")[0]
    heads = re.findall(r'<th scope="col"[^>]*>(.*?)</th>', table)
    return heads, re.findall(r'<tr><th scope="row">(.*?)</th>(.*?)</tr>', table)


def cell_values(cells: str) -> list[str]:
    return [re.sub("<small>.*", "", cell) for cell in re.findall("<td>(.*?)</td>", cells)]


def test_columns_are_those_of_the_text_reports(two_runs):
    heads, rows = main_table(report(*two_runs))
    shown = [cell_values(cells) for _, cells in rows]
    assert len(shown) == 2 and shown[0] != shown[1]
    scores = [score for score, _, _ in two_runs]
    table = to_markdown(scores).split("\n## ")[1]
    head, _, *written = [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("|")]
    assert [heading.replace("<br>", " ") for heading in heads] == head
    # The first number has its interval beside it.
    assert shown == [[row[1].split()[0], *row[2:]] for row in written]
    lines = terminal_table(scores, width=300).splitlines()
    for score, values in zip(scores, shown, strict=True):
        (line,) = (line for line in lines if line.startswith(score.info.label))
        assert line.removeprefix(score.info.label).split() == values


def test_main_table_row_by_row(two_runs):
    _, rows = main_table(report(*two_runs))
    for (name, cells), (score, _, _) in zip(rows, two_runs, strict=True):
        assert escape(score.info.label) in name
        assert cell_values(cells) == main_row(score)
        intervals = re.findall("<td>.*?(?:<small>(.*?)</small>)?</td>", cells)
        measures = map(score.measures.get, COLUMNS)
        assert intervals == [interval_text(measure) for measure in measures]


def test_page_asks_nothing_of_the_network(two_runs):
    text = report(*two_runs)
    assert not re.search(r"(?i)\bhttps?:|//[a-z0-9-]+\.[a-z]|@import|url\(", text.split("<body>")[1])
    document = Document(text)
    for tag, found in document.tags:
        assert tag not in {"link", "iframe", "img", "object", "embed"}
        assert not {"src", "srcset", "action", "background"} & found.keys()
        assert tag != "a" or str(found["href"]).startswith("#")
    policy = next(
        str(f["content"]) for t, f in document.tags if f.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy.startswith("default-src 'none';")
    assert "http" not in policy


def test_everything_given_is_escaped(pairs):
    named = [replace(pair, id=pair.id + NASTY, scene=NASTY, benchmark=NASTY) for pair in pairs]
    predictions = [
        replace(prediction, pair=prediction.pair + NASTY, error=NASTY, status=NASTY, stages={NASTY: 0.001})
        for prediction in predict(pairs, right={1, 2})
    ]
    score = make_run(NASTY, named, predictions)
    bad = dict.fromkeys(("method", "track", "commit", "hardware", "command", "created"), NASTY)
    score = replace(score, info=replace(score.info, **bad, identity={NASTY: NASTY}))
    document = Document(report((score, named, predictions)))
    assert document.count("b") == 1  # the tick of the median, nothing of the names
    assert len(document.scripts) == 4
    assert " ".join(NASTY.split()) in document.words
    assert document.data.keys() == {"0", "1", "2", "3", "4", "5"}


def test_order_and_groups(pairs, tmp_path):
    other = [replace(pair, benchmark="3DLoMatch") for pair in pairs]
    folder = [replace(pair, benchmark="a-folder") for pair in pairs]
    unrelated = make_pairs(tmp_path, benchmark="unrelated")
    runs = []
    for benchmark, right in (
        (unrelated, set()),
        (folder, {1}),
        (other, {1}),
        (pairs, {1}),
        (pairs, {1, 2, 3}),
    ):
        predictions = predict(benchmark, right=right)
        runs.append((make_run(f"run-{len(runs)}", benchmark, predictions), benchmark, predictions))
    text = report(*runs)
    titles = re.findall(r"<h2>(.*?)</h2>", text)
    benchmarks = [title for title in titles if ", track" in title]
    assert benchmarks == [f"{n}, track 1k" for n in ("3DMatch", "3DLoMatch", "a-folder", "unrelated")]
    rows = re.findall(r'<tr><th scope="row">.*?(run-\d)', text.split('id="group-0"')[0])
    assert rows == ["run-4", "run-3", "run-2", "run-1", "run-0"]
    one_color = {re.search(rf'class="swatch run r(\d+) [^"]*"></i>run-{k}<', text).group(1) for k in range(5)}
    assert len(one_color) == 5


def test_missing_pairs_are_loud(two_runs):
    text = report(*two_runs)
    assert '<ul class="warnings"' in text
    assert "has not answered 2 of 12 pairs" in html.unescape(text)
    assert '<small class="lacking">10 of 12 pairs</small>' in text
    complete = report(two_runs[0])
    assert "has not answered" not in complete
    assert '<small class="lacking">' not in complete


def test_a_share_of_the_benchmark_is_told(pairs):
    predictions = predict(pairs, right={1})
    whole = make_run("same", pairs, predictions)
    share = replace(whole, info=replace(whole.info, identity={"pairs": {"every": 15}}))
    assert run_key(whole.info) == "same.1k.3DMatch"
    assert run_key(share.info) == "same.1k.3DMatch.every15"
    words = Document(report((whole, pairs, predictions), (share, pairs, predictions))).words
    assert words.count("12 pairs, 1 in 15 of the benchmark") == 2  # in the main table and beside the command


def test_bad_arguments(two_runs, tmp_path):
    score, pairs, predictions = two_runs[0]
    key = run_key(score.info)
    with pytest.raises(InputError, match="no runs"):
        render_report([], pairs={}, predictions={})
    with pytest.raises(InputError, match="two runs are called"):
        render_report([score, score], pairs={key: pairs}, predictions={key: predictions})
    with pytest.raises(InputError, match=r"predictions of run 'alpha\.1k\.3DMatch' are not given"):
        render_report([score], pairs={key: pairs}, predictions={})
    with pytest.raises(InputError, match="not among its pairs"):
        render_report([score], pairs={key: pairs[-1:]}, predictions={key: predictions})
    path = tmp_path / "report.html"
    save_report(path, [score], pairs={key: pairs}, predictions={key: predictions})
    before = path.read_bytes()
    Document(before.decode("utf-8"))
    with pytest.raises(OutputError, match="--force"):
        save_report(path, [score], pairs={key: pairs}, predictions={key: predictions})
    with pytest.raises(InputError):
        save_report(path, [score], pairs={}, predictions={}, force=True)
    assert path.read_bytes() == before
    save_report(path, [score], pairs={key: pairs}, predictions={key: predictions}, num_failures=1, force=True)
    assert 0 < path.stat().st_size < len(before)
    assert list(tmp_path.iterdir()) == [path]


# ---------------------------------------------------------------- empty and odd cases


def test_run_without_failures_or_confidence(pairs):
    predictions = predict(pairs, right=set(range(12)), confident=False)
    document = Document(report((make_run("all-right", pairs, predictions), pairs, predictions)))
    assert "has no wrong answer among 12 pairs" in document.words
    assert document.data == {}
    assert "Reliability" not in document.words
    assert "AUROC" not in document.words
    assert document.count("canvas") == 0


def test_run_with_nothing_predicted(pairs):
    score = make_run("unborn", pairs, [])
    text = report((score, pairs, []))
    document = Document(text)
    assert "has not answered 12 of 12 pairs" in document.words
    assert document.data == {}
    assert "nan" not in document.words.lower().split()


def test_measures_that_are_not_numbers(pairs):
    predictions = predict(pairs, right={1})
    score = make_run("odd", pairs, predictions)
    nothing = Measure(math.nan, "%", 0, (math.nan, math.nan), (math.nan, math.nan))
    infinite = Measure(math.inf, "deg", 3, (1.0, math.inf), (math.nan, math.nan))
    score = replace(
        score,
        measures={**score.measures, "recall_15": nothing, "rotation_q90": infinite},
        scenes={scene: dict.fromkeys(found, nothing) for scene, found in score.scenes.items()},
        curves={
            name: replace(curve, measures=tuple(nothing for _ in curve.measures))
            for name, curve in score.curves.items()
        },
        pairs=tuple(replace(p, rotation_error_deg=math.nan, confidence=math.nan) for p in score.pairs),
    )
    text = report((score, pairs, predictions))
    document = Document(text)
    assert "Recall against overlap" not in document.words
    assert "[1.00, inf]" in document.words
    for tag, found in document.tags:
        if tag in {"path", "circle", "text"}:
            assert not re.search("nan|inf", " ".join(str(v) for v in found.values()))


def test_unrelated_scans(tmp_path):
    pairs = make_pairs(tmp_path, benchmark="unrelated")
    predictions = predict(pairs, right=set())
    score = make_run("sure", pairs, predictions)
    assert is_unrelated(score)
    assert [p.status for p in worst_failures(score, 99)] == ["ok"] * 4
    document = Document(report((score, pairs, predictions)))
    assert "accepted 4 of 12 pairs whose scans have nothing in common" in document.words
    assert "Confidence in unrelated scans" in document.words
    for absent in ("Reliability", "Risk and coverage", "Rotation error", "Recall against"):
        assert not any(
            found.get("aria-label", "").startswith(absent) for t, found in document.tags if t == "svg"
        )
    assert len(document.data) == 4
    assert all(card["motions"].keys() == {"estimate"} for card in document.data.values())
    choices = [found["value"] for tag, found in document.tags if tag == "input"]
    assert choices == ["estimate"] * 4
    silent = predict(pairs, right=set(), confident=False)
    words = Document(report((make_run("mute", pairs, silent), pairs, silent))).words
    assert "states no status" in words
    modest = [replace(prediction, status="low_confidence") for prediction in predictions]
    words = Document(report((make_run("modest", pairs, modest), pairs, modest))).words
    assert "accepted none of 12 unrelated pairs" in words


def test_clouds_that_are_gone(pairs, tmp_path):
    moved = [replace(pair, source=tmp_path / "gone.npz") for pair in pairs]
    predictions = predict(moved, right={1})
    document = Document(report((make_run("homeless", moved, predictions), moved, predictions)))
    assert document.data == {}
    assert document.words.count("The clouds cannot be shown here") == 6
    assert "gone.npz" in document.words
    assert "40.0°" in document.words
