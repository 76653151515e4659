"""Two runs side by side, and scores as text: hand-made cases and what every report must name."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from geomoe3d.errors import InputError
from geomoe3d.evaluation.compare import agresti_min, compare, mcnemar_p
from geomoe3d.evaluation.records import EvaluationPair, Labels, Prediction, RunInfo, RunScore
from geomoe3d.evaluation.report_text import terminal_table, to_json, to_markdown
from geomoe3d.evaluation.summary import summarise

NOWHERE = Path("nowhere.ply")
LABELS = Labels(*np.ones((3, 4), dtype=bool))


def run(
    right: str,
    label: str = "ours",
    *,
    seconds: float | list[float] = 0.1,
    scenes: str | None = None,
    skip: tuple[int, ...] = (),
    unrelated: bool = False,
    status: str | None = "ok",
    **changes,
) -> RunScore:
    """A run that is right on the pairs with a 1; one letter of ``scenes`` per pair."""
    raw = changes.pop("raw_truth", False)
    plain = RunInfo(
        label,
        "geomoe",
        "1k",
        "3DMatch",
        {"seed": 3},
        "abc1234",
        "2 cores, 8 GB",
        3,
        "geomoe3d evaluate",
        "2025",
    )
    pairs, predictions = [], []
    for k, sign in enumerate(right):
        scene = "room" if scenes is None else scenes[k]
        truth = None if unrelated else np.eye(4)
        pairs.append(EvaluationPair(f"{scene}/{k}", "3DMatch", scene, NOWHERE, NOWHERE, truth, overlap=0.35))
        T = np.eye(4)
        T[0, 3] = 0.0 if sign == "1" else 5.0
        time = seconds if isinstance(seconds, float) else seconds[k]
        confidence = None if status is None else 0.75
        if k not in skip:
            predictions.append(
                Prediction(
                    f"{scene}/{k}", T, confidence, status, (), LABELS, None, time, {"solve": time}, 2**20
                )
            )
    return summarise(dataclasses.replace(plain, **changes), pairs, predictions, raw_truth=raw, resamples=200)


# ---- comparison -------------------------------------------------------------------------------------------


def test_who_changed_sides_by_hand() -> None:
    found = compare(run("1110001"), run("1001000", "peer"))
    assert found.a_only_right == ("room/1", "room/2", "room/6")
    assert found.b_only_right == ("room/3",)
    assert (found.num_both_right, found.num_neither_right, found.num_pairs) == (1, 2, 7)
    assert found.recall_difference is not None
    assert found.recall_difference.value == pytest.approx(100 * 2 / 7)
    # 3 of 4 changes one way: 2 (C(4,3) + C(4,4)) / 16.
    assert found.mcnemar_p == pytest.approx(10 / 16)
    back = compare(run("1001000", "peer"), run("1110001"))
    assert back.recall_difference is not None
    assert back.recall_difference.value == pytest.approx(-found.recall_difference.value)
    assert (back.a_only_right, back.b_only_right) == (found.b_only_right, found.a_only_right)
    assert (back.mcnemar_p, back.num_both_right) == (found.mcnemar_p, found.num_both_right)


@pytest.mark.parametrize(
    ("a_only", "b_only", "p"), [(0, 0, 1.0), (5, 5, 1.0), (1, 8, 20 / 512), (0, 10, 2 / 1024), (6, 0, 2 / 64)]
)
def test_mcnemar_by_hand(a_only: int, b_only: int, p: float) -> None:
    assert mcnemar_p(a_only, b_only) == pytest.approx(p)


def test_a_paired_difference_is_sharper_than_two_intervals() -> None:
    """b is a with 10 of 400 pairs lost: 2.5 points, standard error sqrt(0.025 - 0.025^2) / 20."""
    rng = np.random.default_rng(0)
    signs = np.where(rng.random(400) < 0.6, "1", "0")
    lost = signs.copy()
    lost[np.flatnonzero(signs == "1")[:10]] = "0"
    a, b = run("".join(signs), scenes="abcd" * 100), run("".join(lost), "peer", scenes="abcd" * 100)
    found = compare(a, b).recall_difference
    assert found is not None and found.value == pytest.approx(2.5)
    half = 196 * math.sqrt(0.025 - 0.025**2) / 20
    assert found.interval == pytest.approx((2.5 - half, 2.5 + half), abs=0.35)
    assert found.interval[0] > 0
    assert a.measures["recall_15"].interval[0] < b.measures["recall_15"].interval[1]
    assert found.scene_interval[0] <= 2.5 <= found.scene_interval[1]


def test_no_change_is_no_certainty() -> None:
    same = compare(run("1100" * 25), run("1100" * 25, "peer"))
    assert same.mcnemar_p == 1.0 and same.recall_difference is not None
    assert same.recall_difference.value == 0.0
    low, high = same.recall_difference.interval
    assert low == pytest.approx(-high) and high == pytest.approx(100 * norm.ppf(0.975) / 102, rel=1e-6)
    assert math.isnan(same.recall_difference.scene_interval[0])
    total = compare(run("1" * 20), run("0" * 20, "peer")).recall_difference
    assert total is not None and total.value == 100.0
    # (20.5 - 0.5) / 22 = 0.90909; 1.96 sqrt((21 / 22 - 0.90909^2) / 22) = 0.14956
    assert total.interval == (pytest.approx(75.953, abs=1e-2), 100.0)
    assert agresti_min(0, 20, 20) == pytest.approx((-100.0, -total.interval[0]))


def test_time_ratios_by_hand() -> None:
    a = run("1111", seconds=[0.1, 0.2, 0.3, 0.4])
    b = run("1111", "peer", seconds=[0.4, 0.1, 0.1, 0.1])
    found = compare(a, b)
    assert found.time_ratio.value == pytest.approx(0.25 / 0.1)
    assert found.pair_time_ratio.value == pytest.approx(2.5)  # of 0.25, 2, 3, 4
    assert found.time_ratio.interval[0] <= found.time_ratio.value <= found.time_ratio.interval[1]
    assert compare(a, a).time_ratio.interval == (1.0, 1.0)
    assert math.isnan(compare(a, run("1111", "peer", seconds=0.0)).time_ratio.value)


def test_only_common_pairs_are_compared() -> None:
    found = compare(run("11110", skip=(0,)), run("11111", "peer", skip=(3, 4)))
    assert (found.num_pairs, found.num_only_in_a, found.num_only_in_b) == (2, 2, 1)
    assert found.notes == ("Pairs answered by one run only are left out: 'ours' 2, 'peer' 1.",)


def test_what_cannot_be_compared_is_refused() -> None:
    a = run("11")
    with pytest.raises(InputError, match=r"benchmark is '3DMatch' and '3DLoMatch'.*same benchmark and track"):
        compare(a, run("11", "peer", benchmark="3DLoMatch"))
    with pytest.raises(InputError, match="track is '1k' and 'all'"):
        compare(a, run("11", "peer", track="all"))
    with pytest.raises(InputError, match="score both alike"):
        compare(a, run("11", "peer", raw_truth=True))
    with pytest.raises(InputError, match="no pair in common"):
        compare(run("11", skip=(0,)), run("11", skip=(1,)))


def test_times_of_different_machines_are_flagged() -> None:
    notes = compare(run("11"), run("11", "peer", hardware="64 cores", threads=4, commit="def")).notes
    text = " ".join(notes)
    assert "'2 cores, 8 GB' and '64 cores'" in text and "number of threads is '1' and '4'" in text
    assert "'abc1234' and 'def'" in text
    assert compare(run("11"), run("01", "peer")).notes == ()


def test_on_unrelated_scans_only_times_are_compared() -> None:
    found = compare(run("11", unrelated=True), run("11", "peer", unrelated=True))
    assert found.mcnemar_p is None and found.recall_difference is None
    assert found.time_ratio.value == 1.0
    assert "McNemar" not in to_markdown([], [found])


# ---- reports ----------------------------------------------------------------------------------------------


def strict(text: str):
    def refuse(constant: str):
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(text, parse_constant=refuse)


FACTS = {
    "label": "run [a|b]_*c*",
    "benchmark": "3DLoMatch",
    "track": "clouds",
    "commit": "f00ba47+",
    "hardware": "Pentium 90, 2 GB",
    "seed": 90125,
    "command": "geomoe3d evaluate --methods a|b `c` [d]",
}


@pytest.mark.parametrize("width", [None, 80, 60, 200])
def test_the_table_names_everything(width: int | None) -> None:
    text = terminal_table([run("1110", **FACTS)], width=width)
    flat = " ".join(text.split())
    for value in FACTS.values():
        assert str(value) in flat
    assert "4 pairs" in flat and "75.0" in flat and "WARNING" not in flat
    assert "\x1b" not in text
    if width != 60:
        assert "…" not in text
    assert max(len(line) for line in text.splitlines() if "command" not in line) <= (width or 118)


def test_the_table_in_colour() -> None:
    assert "\x1b[" in terminal_table([run("10")], color=True)


def test_markdown_and_json_name_everything() -> None:
    a, b = run("1110", **FACTS), run("1000", "peer", **{k: v for k, v in FACTS.items() if k != "label"})
    markdown, document = to_markdown([a, b], [compare(a, b)]), strict(to_json([a, b], [compare(a, b)]))
    for key, value in FACTS.items():
        assert document["runs"][0]["info"][key] == value
        escaped = str(value)
        for sign in "[]|_*":
            escaped = escaped.replace(sign, f"\\{sign}")
        assert (str(value) if key == "command" else escaped) in markdown
    assert document["runs"][0]["num_pairs"] == 4
    assert document["runs"][0]["measures"]["recall_15"]["value"] == 75.0
    assert document["comparisons"][0]["a_only_right"] == ["room/1", "room/2"]
    assert "Only run \\[a\\|b\\]\\_\\*c\\* right: room/1, room/2" in markdown
    assert "+50.00" in markdown


def test_markdown_tables_are_whole() -> None:
    """Every row of a table has as many cells as its head, whatever stands in the names."""
    a, b = (
        run("1110", **FACTS, scenes="aab|"),
        run("1000", "x", **{k: v for k, v in FACTS.items() if k != "label"}, scenes="aab|"),
    )
    lines = to_markdown([a, b], [compare(a, b)]).splitlines()
    for previous, line in itertools.pairwise(lines):
        if line.startswith("|") and previous.startswith("|"):
            assert line.replace("\\|", "").count("|") == previous.replace("\\|", "").count("|")
    assert sum(line.startswith("| ---") for line in lines) >= 8


def test_json_has_null_for_what_is_not_finite() -> None:
    silent = run("1", status=None)
    silent = dataclasses.replace(
        silent, pairs=(dataclasses.replace(silent.pairs[0], rotation_error_deg=math.inf),)
    )
    (found,) = strict(to_json([silent]))["runs"]
    assert found["pairs"][0]["rotation_error_deg"] is None
    assert found["measures"]["recall_15"]["scene_interval"] == [None, None]
    assert found["calibration"] is None
    numpy_inside = run(
        "1", identity={"a": np.float64(0.5), "b": np.arange(2), "c": np.bool_(True), "d": math.nan}
    )
    (found,) = strict(to_json([numpy_inside]))["runs"]
    assert found["info"]["identity"] == {"a": 0.5, "b": [0, 1], "c": True, "d": None}


def test_missing_pairs_and_errors_are_said_loudly() -> None:
    part = run("1111", skip=(2, 3))
    for text in (terminal_table([part]), to_markdown([part])):
        flat = " ".join(text.replace("\\", "").split())
        assert "2 of 4 pairs" in flat
        assert "'ours' has not answered 2 of 4 pairs" in flat
        assert "WARNING" in flat or "Warning" in flat
    failed = dataclasses.replace(part, pairs=(dataclasses.replace(part.pairs[0], error="x"), part.pairs[1]))
    assert "ended with an error on 1 of 2 pairs" in terminal_table([failed])
    assert "scored against the truth as published" in " ".join(
        terminal_table([run("1", raw_truth=True)]).split()
    )


def test_runs_are_grouped_by_benchmark_and_track() -> None:
    text = terminal_table([run("1", "one"), run("0", "two", track="all"), run("0", "three")])
    assert text.index("3DMatch, track 1k") < text.index("one") < text.index("three")
    assert text.index("three") < text.index("3DMatch, track all") < text.index("two")


def test_measures_that_are_not_defined_show_a_dash() -> None:
    (row,) = [
        line for line in terminal_table([run("11", unrelated=True)]).splitlines() if line[:4] == "ours"
    ][:1]
    assert row.split()[1:] == ["-", "-", "-", "-", "-", "-", "-", "100.0", "-", "100.0"]
