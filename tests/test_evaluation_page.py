"""The HTML report: complete, self-contained, escaped, honest about gaps, and drawn in a browser."""

from __future__ import annotations

import base64
import html
import json
import math
import os
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomoe3d.errors import InputError, OutputError
from geomoe3d.evaluation import report_gallery
from geomoe3d.evaluation.compare import compare
from geomoe3d.evaluation.records import (
    EvaluationPair,
    Labels,
    Measure,
    PairScore,
    Prediction,
    RunInfo,
    RunScore,
)
from geomoe3d.evaluation.report_chart import Axis, Series, chart
from geomoe3d.evaluation.report_gallery import choose_run, make_card, worst_failures
from geomoe3d.evaluation.report_page import render_report, run_key, save_report
from geomoe3d.evaluation.report_plots import figures, is_unrelated
from geomoe3d.evaluation.report_words import MAIN_MEASURES, interval_text, main_row, value_text
from geomoe3d.evaluation.summary import summarise
from geomoe3d.geometry.se3 import inverse, make_transform, transform_points

NASTY = "</script><b>x & {{data}} \"'é"
VOID = {"meta", "br", "input", "link", "img", "hr", "source"}


# ---------------------------------------------------------------- made-up runs


def write_clouds(folder: Path) -> tuple[Path, Path, np.ndarray]:
    """Two views of a box-shaped room as files, and the true motion."""
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 1, (9000, 3)) * (5.0, 4.0, 2.5)
    side = rng.integers(0, 5, 9000)
    for k, (axis, value) in enumerate(((2, 0.0), (0, 0.0), (0, 5.0), (1, 0.0), (1, 4.0))):
        points[side == k, axis] = value
    truth = make_transform(Rotation.from_rotvec([0.1, 0.2, 1.0]).as_matrix(), np.array([1.0, -2.0, 0.3]))
    paths = folder / "cloud_bin_0.npz", folder / "cloud_bin_1.npz"
    np.savez(paths[0], pcd=transform_points(inverse(truth), points[points[:, 0] < 3.5]))
    np.savez(paths[1], pcd=points[points[:, 0] > 1.5])
    return paths[0], paths[1], truth


def make_pairs(folder: Path, *, benchmark: str = "3DMatch", count: int = 12) -> list[EvaluationPair]:
    source, target, truth = write_clouds(folder)
    related = benchmark != "unrelated"
    return [
        EvaluationPair(
            f"{'kitchen' if k % 2 else 'hall'}/{k}-{k + 2}",
            benchmark,
            "kitchen" if k % 2 else "hall",
            source,
            target,
            truth if related else None,
            overlap=0.3 + 0.05 * k if related else None,
            information=np.eye(6) if related else None,
        )
        for k in range(count)
    ]


def predict(
    pairs: list[EvaluationPair], *, right: set[int], confident: bool = True, silent: tuple[int, ...] = ()
) -> list[Prediction]:
    """Right on the given rows, turned by 40 degrees elsewhere; confidence falls with the row."""
    wrong = make_transform(Rotation.from_rotvec([0, 0, math.radians(40)]).as_matrix(), np.ones(3))
    found = []
    for k, pair in enumerate(pairs):
        truth = np.eye(4) if pair.T_target_source is None else pair.T_target_source
        T = None if k in silent else truth if k in right else wrong @ truth
        true = np.arange(50) < 5 + k
        found.append(
            Prediction(
                pair.id,
                T,
                None if not confident or k in silent else 0.95 - 0.05 * k,
                None if not confident else "ok" if k < 4 and k not in silent else "low_confidence",
                (),
                Labels(true, None, true if k in right else ~true),
                None,
                0.020 + 0.001 * k,
                {"match": 0.005, "filter": 0.010, "total": 0.020} if confident else {},
                1 << 28,
                NASTY if k in silent else None,
            )
        )
    return found


def make_run(
    label: str, pairs: list[EvaluationPair], predictions: list[Prediction], **changes: object
) -> RunScore:
    info = RunInfo(
        label,
        "some-method",
        "1k",
        pairs[0].benchmark,
        {"method": {"name": label}},
        "0123456789ab-dirty",
        "Some CPU, 2 cores, 8 GiB",
        7,
        f"geomoe3d evaluate run --label '{label}'",
        "2026-01-02T03:04:05+00:00",
        2,
        1,
    )
    return replace(summarise(info, pairs, predictions, resamples=100), **changes)


def report(*runs: tuple[RunScore, list[EvaluationPair], list[Prediction]], **options: object) -> str:
    scores = [score for score, _, _ in runs]
    return render_report(
        scores,
        options.pop("comparisons", ()),
        pairs={run_key(score.info): pairs for score, pairs, _ in runs},
        predictions={run_key(score.info): predictions for score, _, predictions in runs},
        made="2026-05-06 07:08 UTC",
        **options,
    )


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> list[EvaluationPair]:
    return make_pairs(tmp_path_factory.mktemp("clouds"))


@pytest.fixture(scope="module")
def two_runs(pairs: list[EvaluationPair]) -> list[tuple[RunScore, list[EvaluationPair], list[Prediction]]]:
    first = predict(pairs, right={1, 2, 4, 5, 7, 8, 9}, silent=(11,))
    second = predict(pairs, right={1, 3, 5}, confident=False)[:-2]
    return [
        (make_run("alpha", pairs, first), pairs, first),
        (make_run(NASTY, pairs, second), pairs, second),
    ]


class Document(HTMLParser):
    """Checks nesting, collects text per element, ids, attributes and the inside of scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.text = ""
        self.ids: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[str] = []
        self.feed(text)
        self.close()
        assert self.stack == [], f"not closed: {self.stack}"

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        found = dict(attributes)
        self.tags.append((tag, found))
        if "id" in found:
            self.ids.append(str(found["id"]))
        if tag not in VOID:
            self.stack.append(tag)
            if tag == "script":
                self.scripts.append("")

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attributes)))

    def handle_endtag(self, tag: str) -> None:
        assert self.stack, f"</{tag}> without a beginning"
        assert self.stack.pop() == tag, f"</{tag}> closes something else"

    def handle_data(self, data: str) -> None:
        if self.stack and self.stack[-1] == "script":
            self.scripts[-1] += data
        elif not self.stack or self.stack[-1] != "style":
            self.text += data + " "

    def count(self, tag: str) -> int:
        return sum(found == tag for found, _ in self.tags)

    @property
    def words(self) -> str:
        return " ".join(self.text.split())

    @property
    def data(self) -> dict:
        return json.loads(self.scripts[0])


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


def test_columns_are_those_of_the_text_reports(two_runs):
    for score, _, _ in two_runs:
        own = [value_text(m) for m in map(score.measures.get, MAIN_MEASURES)]
        assert own == main_row(score)


def test_main_table_row_by_row(two_runs):
    table = report(*two_runs).split('id="main"')[1].split("</table>")[0]
    rows = re.findall(r'<tr><th scope="row">(.*?)</th>(.*?)</tr>', table)
    for (name, cells), (score, _, _) in zip(rows, two_runs, strict=True):
        assert html.escape(score.info.label, quote=True) in name
        values = [re.sub("<small>.*", "", cell) for cell in re.findall("<td>(.*?)</td>", cells)]
        assert values == main_row(score)
        intervals = re.findall("<td>.*?(?:<small>(.*?)</small>)?</td>", cells)
        measures = map(score.measures.get, MAIN_MEASURES)
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
    assert len(document.scripts) == 3
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
    assert "called 4 of 12 pairs ok whose scans have nothing in common" in document.words
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
    assert "does not say of which answers it is sure" in words
    modest = [replace(prediction, status="low_confidence") for prediction in predictions]
    words = Document(report((make_run("modest", pairs, modest), pairs, modest))).words
    assert "called none of 12 unrelated pairs ok" in words


def test_clouds_that_are_gone(pairs, tmp_path):
    moved = [replace(pair, source=tmp_path / "gone.npz") for pair in pairs]
    predictions = predict(moved, right={1})
    document = Document(report((make_run("homeless", moved, predictions), moved, predictions)))
    assert document.data == {}
    assert document.words.count("The clouds cannot be shown here") == 6
    assert "gone.npz" in document.words
    assert "40.0°" in document.words


# ---------------------------------------------------------------- gallery


def score_of(pair: str, **changes: object) -> PairScore:
    values = dict.fromkeys(PairScore.__dataclass_fields__)
    values |= {"pair": pair, "scene": "s", "right": False, "right_20": False, "any_right": False}
    values |= {"rotation_error_deg": 90.0, "translation_error": 2.0, "seconds": 1.0, "stages": {}}
    return PairScore(**{**values, **changes})


def test_worst_failures_first(two_runs):
    scores = (
        score_of("right", confidence=1.0, overlap=0.9, right=True),
        score_of("silent", overlap=0.8),
        score_of("doubtful", confidence=0.2, overlap=0.9),
        score_of("sure, little overlap", confidence=0.9, overlap=0.1),
        score_of("sure, much overlap", confidence=0.9, overlap=0.5),
        score_of("not a number", confidence=math.nan, overlap=math.nan),
    )
    score = replace(two_runs[0][0], pairs=scores)
    order = [failure.pair for failure in worst_failures(score, 99)]
    assert order == ["sure, much overlap", "sure, little overlap", "doubtful", "silent", "not a number"]
    assert [failure.pair for failure in worst_failures(score, 2)] == order[:2]


def test_run_of_the_gallery(two_runs):
    confident, mute = two_runs[0][0], two_runs[1][0]
    assert choose_run([]) is None
    assert choose_run([mute, confident]) is confident
    best = Measure(99.0, "%", 12, (98.0, 100.0), (math.nan, math.nan))
    better = replace(mute, measures={**mute.measures, "recall_15": best})
    assert choose_run([mute, better]) is better
    unknown = replace(mute, measures={})
    assert choose_run([unknown, mute]) is mute


def unpack(cloud: dict) -> np.ndarray:
    levels = np.frombuffer(base64.b64decode(cloud["points"]), dtype="<i2").reshape(-1, 3)
    return levels * cloud["scale"]


def test_card_shows_both_clouds_under_both_motions(two_runs):
    score, pairs, predictions = two_runs[0]
    failure = next(p for p in score.pairs if p.pair == pairs[3].id)
    card = make_card(5, failure, pairs[3], predictions[3], 2000)
    clouds = card.clouds
    source, target = unpack(clouds["source"]), unpack(clouds["target"])
    assert 1500 < len(source) <= 2000
    assert 1500 < len(target) <= 2000
    truth, estimate = (np.reshape(clouds["motions"][name], (4, 4)) for name in ("truth", "estimate"))
    moved = transform_points(truth, source)  # the floor of the room: both lie on it, centred alike
    assert np.abs(moved[:, 2].min() - target[:, 2].min()) < 0.005
    assert np.abs(np.percentile(moved[:, 1], [0, 100]) - np.percentile(target[:, 1], [0, 100])).max() < 0.005
    assert np.abs(moved[:, 0].min() + 1.5 - target[:, 0].min()) < 0.01
    turned = Rotation.from_matrix(estimate[:3, :3] @ truth[:3, :3].T).magnitude()
    assert abs(math.degrees(turned) - 40.0) < 1e-3
    for name, T in (("truth", truth), ("estimate", estimate)):
        fit = clouds["fits"][name]
        shown = np.concatenate([target, transform_points(T, source)])
        inside = np.linalg.norm(shown - fit["center"], axis=1) <= fit["radius"] * 1.001
        assert 0.97 < inside.mean() < 1.0
    axes = np.array(clouds["axes"])
    assert np.allclose(axes @ axes.T, np.eye(3), atol=1e-5)
    for word in ("40.0°", "45.0%", "0.80", "16.0%", "ok", pairs[3].id):
        assert word in card.text
    json.dumps(clouds, allow_nan=False)


def test_card_without_an_answer(two_runs):
    score, pairs, predictions = two_runs[0]
    card = make_card(0, score.pairs[11], pairs[11], predictions[11], 500)
    assert card.clouds["motions"].keys() == {"truth"}
    assert "no answer" in card.text
    assert html.escape(NASTY, quote=True) in card.text
    alone = replace(pairs[11], T_target_source=None)
    assert make_card(0, score.pairs[11], alone, predictions[11], 500).clouds is None
    assert make_card(0, score.pairs[11], pairs[11], None, 500).clouds is not None


def test_many_failures_share_the_points(two_runs, monkeypatch):
    monkeypatch.setattr("geomoe3d.evaluation.report_page.MAX_TOTAL_POINTS", 5000)
    data = Document(report(two_runs[0], num_failures=5)).data
    assert len(data) == 5
    assert (
        3500 < sum(len(unpack(card[name])) for card in data.values() for name in ("source", "target")) <= 5000
    )
    assert report_gallery.MAX_TOTAL_POINTS * 8 < 4e6


# ---------------------------------------------------------------- plots


def test_axis():
    linear, decades = Axis("x", 2.0, 4.0), Axis("x", 0.01, 10.0, log=True)
    assert [linear.share(v) for v in (2.0, 2.5, 4.0, 9.0, -1.0)] == [0.0, 0.25, 1.0, 1.0, 0.0]
    assert decades.share(1.0) == pytest.approx(2 / 3)
    assert [text for _, text in decades.ticks()] == ["0.01", "0.1", "1", "10"]
    for high in (0.013, 0.5, 1.0, 7.0, 100.0, 2345.0):
        values = [value for value, _ in Axis("x", 0.0, high).ticks()]
        assert 3 <= len(values) <= 11
        assert values[0] == 0.0
        assert high * 0.6 <= values[-1] <= high * (1 + 1e-9)


def test_chart_places_points_and_breaks_at_nan():
    nan = math.nan
    points = [(0.0, 0.0), (1.0, 50.0), (2.0, nan), (3.0, 100.0), (4.0, 100.0)]
    band = [(0.0, 10.0), (40.0, 60.0), (nan, nan), (90.0, 100.0), (nan, nan)]
    text = chart("T", Axis("x", 0.0, 4.0), Axis("y", 0.0, 100.0), [Series(9, "r", points, band, ["tip"] * 5)])
    lines = re.findall(r'class="line" d="M([^"]*)"', text)
    assert [len(line.split("L")) for line in lines] == [2, 2]
    circles = [tuple(map(float, c)) for c in re.findall(r'cx="([\d.]+)" cy="([\d.]+)"', text)]
    assert len(circles) == 4
    (x0, y0), (x1, y1), (_, y3), _ = circles
    assert x0 < x1
    assert y1 == pytest.approx((y0 + y3) / 2, abs=0.11)  # upwards, half way
    assert len(re.findall('class="band"', text)) == 1
    assert len(re.findall('class="whisker"', text)) == 1
    assert 'class="run r9 c1 d1"' in text


def test_cumulative_errors_count_pairs_without_an_answer(two_runs):
    score = two_runs[0][0]  # 7 right exactly, 4 turned by 40 degrees, 1 without an answer
    text = next(f for f in figures([score], [0]) if "<figcaption>Rotation error<" in f)
    (line,) = re.findall(r'class="line" d="M([^"]*)"', text)
    heights = [float(point.split()[1]) for point in line.split("L")]
    bottom, top = 250.0, 10.0  # of the plot in the figure
    shares = [(bottom - height) / (bottom - top) for height in heights]
    assert shares[0] == pytest.approx(7 / 12, abs=1e-3)
    assert shares[-1] == pytest.approx(11 / 12, abs=1e-3)
    assert shares == sorted(shares)


def test_time_bars_add_up(two_runs):
    score = two_runs[0][0]
    text = next(f for f in figures([score], [0]) if "Time per pair" in f)
    widths = {name: float(w) for w, name in re.findall(r'width:([\d.]+)%" title="([\w ]+):', text)}
    mean = np.mean([pair.seconds for pair in score.pairs])
    assert widths.keys() == {"match", "filter", "not told apart"}  # total is not a stage
    assert widths["filter"] == pytest.approx(100 * 0.010 / mean, abs=0.02)
    assert sum(widths.values()) == pytest.approx(100.0, abs=0.05)


# ---------------------------------------------------------------- in a browser


def chromium() -> str:
    for name in ("chromium", "chromium-browser", "google-chrome", "chrome"):
        found = shutil.which(name)
        if found:
            return found
    message = "no Chromium found (chromium, chromium-browser, google-chrome): the page cannot be tried"
    if os.environ.get("CI", "").lower() == "true":
        pytest.fail(message)
    pytest.skip(message)


# Under virtual time a browser without a screen may call neither for frames nor for what is visible.
BEFORE = """<script>
window.requestAnimationFrame = (f) => setTimeout(() => f(performance.now()), 16);
window.IntersectionObserver = class {
  constructor(call) { this.call = call; }
  observe(target) { setTimeout(() => this.call([{ target, isIntersecting: true }]), 10); }
};
</script>"""
USE = r"""
(async () => {
  const settle = () => new Promise((done) => setTimeout(done, 200));
  const body = document.body, log = {};
  const note = async (name) => { await settle(); log[name] = { ...body.dataset }; };
  await note("start");
  const card = document.querySelector("#card-0"), stage = card.querySelector(".stage");
  stage.setPointerCapture = () => {};
  const pointer = (kind, clientX) => stage.dispatchEvent(
    new PointerEvent("pointer" + kind, { bubbles: true, pointerId: 1, clientX, clientY: 50, buttons: 1 }));
  pointer("down", 100); pointer("move", 150); pointer("up", 150); await note("turned");
  stage.dispatchEvent(new KeyboardEvent("keydown", { key: "+" })); await note("zoomed");
  card.querySelector('input[value="truth"]').click(); await note("truth");
  card.querySelector('[data-side="top"]').click(); await note("top");
  const pixels = stage.querySelector("canvas").getContext("2d").getImageData(0, 0, 300, 200).data;
  const tint = (_, i) => pixels.slice(4 * i, 4 * i + 3).join();
  log.tints = new Set(Array.from({ length: pixels.length / 4 }, tint)).size;
  const marks = [...document.querySelectorAll("#group-0 figure .r0")];
  const shown = () => marks.filter((mark) => mark.getClientRects().length).length;
  log.shown = [shown()];
  document.querySelector('button[data-run="0"]').click(); log.shown.push(shown());
  document.querySelector('button[data-run="0"]').click(); log.shown.push(shown());
  body.dataset.log = JSON.stringify(log);
})();
"""


@pytest.mark.parametrize("webgl", [True, False])
def test_gallery_turns_in_a_browser(two_runs, tmp_path, webgl):
    path = tmp_path / "report.html"
    text = report(*two_runs, num_failures=2)
    text = text.replace("<title>", BEFORE + "<title>").replace("</body>", f"<script>{USE}</script></body>")
    path.write_text(text, encoding="utf-8")
    graphics = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    command = [
        chromium(),
        "--headless",
        "--no-sandbox",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        f"--user-data-dir={tmp_path / 'profile'}",
        "--window-size=500,700",
        "--virtual-time-budget=20000",
        *(graphics if webgl else ["--disable-gpu", "--disable-3d-apis"]),
        "--dump-dom",
        path.as_uri(),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    body = re.search(r"<body[^>]*>", done.stdout)
    assert body, f"Chromium gave no page: {done.stderr[-2000:]}"
    found = {k: html.unescape(v) for k, v in re.findall(r'data-([\w-]+)="([^"]*)"', body.group(0))}
    assert "error" not in found
    assert (found["ready"], found["cards"], found["drawn"]) == ("true", "2", "2")
    assert found["renderer"] == ("webgl2" if webgl else "canvas2d")
    assert 0.02 < float(found["covered"]) < 0.9
    log = json.loads(found["log"])
    state = {name: entry["first"].split() for name, entry in log.items() if isinstance(entry, dict)}
    assert [state[name][0] for name in ("start", "zoomed", "truth")] == ["estimate", "estimate", "truth"]
    assert float(state["turned"][1]) == pytest.approx(float(state["start"][1]) - 50 * 0.009, abs=1e-3)
    assert float(state["zoomed"][3]) == pytest.approx(0.87 * float(state["turned"][3]), rel=1e-3)
    assert float(state["top"][2]) == pytest.approx(math.pi / 2, abs=1e-3)
    assert log["tints"] > 10
    assert log["shown"][0] > 5
    assert log["shown"] == [log["shown"][0], 0, log["shown"][0]]
