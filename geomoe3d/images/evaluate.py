"""How good poses and homographies are: several methods on the same pairs, areas under the recall curve, intervals.

A method is what of the matches it uses (all, those that pass the ratio test, what a network keeps) and an
estimator. Shares intervals and their words with the evaluation of clouds.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.errors import InputError
from geomoe3d.evaluation.intervals import Quantity, measure_all
from geomoe3d.evaluation.metrics import precision_recall_f1
from geomoe3d.evaluation.predictions import PHOTOGRAPHS, open_run
from geomoe3d.evaluation.records import Measure, RunInfo
from geomoe3d.evaluation.report_text import markdown_table
from geomoe3d.evaluation.report_words import with_intervals
from geomoe3d.images.cases import Case
from geomoe3d.images.config import KEYPOINTS
from geomoe3d.images.network import ImageNetwork
from geomoe3d.runtime.journal import read_journal
from geomoe3d.runtime.plain import plain
from geomoe3d.runtime.provenance import hardware, source_commit
from geomoe3d.runtime.sources import library_versions, source_closure, source_hash
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray


@dataclass(frozen=True)
class Outcome:
    """One method on one pair."""

    scene: str
    pair: str
    method: str  # which matches, and the estimator
    error: float  # degrees or pixels; infinite without an answer
    status: str  # of the answer
    seconds: float  # beyond keypoints and matches
    matches: int  # given
    true_share: float  # of them that fit the truth
    precision: float  # of those that the method kept before its estimator, likewise
    recall: float
    f1: float
    turned: float = math.nan  # rotation between the cameras, degrees; NaN for homographies


def area_under_recall(
    errors: Sequence[float] | FloatArray, limit: float, counts: FloatArray | None = None
) -> FloatArray:
    """Area (B,) under the share of errors below e, for e from 0 to ``limit``, over ``limit``; in [0, 1], NaN for none.

    The curve runs straight from one error to the next, as SuperGlue (Sarlin et al. 2020) and who followed have
    it. That adds half a pair's share, up to the largest error below the limit, to the area of the steps.

    Args:
        errors: (n,).
        limit: above 0.
        counts: (B, n) how often each error was drawn; None: once.
    """
    e = np.asarray(errors, dtype=np.float64)
    drawn = np.ones((1, len(e))) if counts is None else counts
    below = np.where(e < limit, e, 0.0)
    steps = drawn @ np.where(e < limit, limit - below, 0.0)
    last = np.where(drawn > 0, below, 0.0).max(axis=1, initial=0.0)
    with np.errstate(invalid="ignore"):
        area: FloatArray = (steps + last / 2) / drawn.sum(axis=1) / limit
    return area


ESTIMATORS = {"RANSAC": "ransac", "MAGSAC++": "magsac", "eight-point": "eight_point", "DLT": "dlt"}
ROBUST = ("RANSAC", "MAGSAC++")  # reject matches; the others take the weights themselves
PEERS = ("all", "ratio test")  # which matches are used without a network


def evaluate(scene: str, cases: Iterable[Case], network: ImageNetwork | None) -> Iterator[Outcome]:
    """All methods on the cases of one scene; those with a network where one is given."""
    for case in cases:
        found, true, spent = case.matches, case.true, 0.0
        given = {"all": np.ones(len(found)), "ratio test": found.distinct() * 1.0}
        if network is not None:
            start = time.perf_counter()
            weights = network(case.rays).weights
            spent = time.perf_counter() - start
            kind = {"geomoe": "GeoMoE"}.get(network.model.config.kind, network.model.config.kind)
            loose = found.distinct(KEYPOINTS.loose_ratio)
            given |= {kind: weights, f"{kind} and loose ratio test": weights * loose}
        for (which, weights), name in product(given.items(), (*ROBUST, case.plain)):
            start = time.perf_counter()
            kept = weights > 0
            error, status = case.answer(ESTIMATORS[name], kept * 1.0 if name in ROBUST else weights)
            seconds = time.perf_counter() - start + (0.0 if which in PEERS else spent)
            share = float(true.mean()) if len(true) else 0.0
            yield Outcome(scene, case.name, f"{which}, {name}", error, status, seconds, len(found), share,
                          *precision_recall_f1(kept, true), case.turned)  # fmt: skip


def evaluate_kept(
    folder: Path, scene: str, identity: dict[str, Any], cases: Iterable[Case], network: ImageNetwork | None
) -> list[Outcome]:
    """`evaluate`, each finished pair kept in a folder, as `evaluate predict` keeps its own, and not asked again.

    Args:
        folder: of this scene alone; made if missing.
        identity: what decides the outcomes beside the code.

    Raises:
        InputError: what the folder keeps of the scene is of another identity.
        OutputError: the folder cannot be written, or another process is writing it.
    """
    code = {"code": source_hash(__name__), "libraries": library_versions(source_closure(__name__))}
    info = RunInfo(
        "images", "images", PHOTOGRAPHS, scene, {**identity, **code}, source_commit(), hardware(), 0, "",
        datetime.now(timezone.utc).isoformat(timespec="seconds"),
    )  # fmt: skip
    journal, done = open_run(folder, info)
    with journal:
        for case in cases:
            if case.name not in done:
                found = [plain(one) for one in evaluate(scene, [case], network)]
                journal.append({"pair": case.name, "outcomes": found})
    missing = {"error": math.inf, "turned": math.nan}  # JSON has neither
    return [
        Outcome(**{**one, **{name: value for name, value in missing.items() if one[name] is None}})
        for record in read_journal(journal.path)
        for one in record["outcomes"]
    ]


def peers_of(method: str, methods: Iterable[str]) -> list[str]:
    """Whom a method is compared to: all matches under the same estimator, and, where it uses a network, the
    ratio test, under either robust estimator where its own is one."""
    which, estimator = method.rsplit(", ", 1)
    peers = [f"all, {estimator}"] if which != "all" else []
    if which not in PEERS:
        peers += [f"ratio test, {one}" for one in (ROBUST if estimator in ROBUST else (estimator,))]
    return [peer for peer in peers if peer in set(methods)]


def summarise(
    outcomes: Sequence[Outcome], limits: tuple[float, ...], seed: int = 0
) -> dict[str, dict[str, Measure]]:
    """Measures of every method in %, and the differences of its areas to those of `peers_of` it on the same
    pairs. Raises InputError: nothing to summarise, or methods that were not all given the same pairs."""
    by_method: dict[str, list[Outcome]] = {}
    for one in outcomes:
        by_method.setdefault(one.method, []).append(one)
    pairs = {tuple((one.scene, one.pair) for one in some) for some in by_method.values()}
    if len(pairs) != 1:
        raise InputError("the methods were not given the same pairs" if pairs else "no pairs to summarise")
    errors = {name: np.array([one.error for one in some]) for name, some in by_method.items()}
    scenes = [scene for scene, _ in pairs.pop()]

    def area(limit: float, name: str, peer: str | None = None) -> Quantity:
        def statistic(counts: FloatArray) -> FloatArray:
            less = 0.0 if peer is None else area_under_recall(errors[peer], limit, counts)
            return 100.0 * (area_under_recall(errors[name], limit, counts) - less)

        return Quantity(np.zeros(len(scenes)), "points", statistic)

    quantities: dict[str, Quantity] = {}
    for name, some in by_method.items():
        ok = np.array([one.status == "ok" for one in some])
        of = {f"auc {limit:g}": area(limit, name) for limit in limits}
        for peer in peers_of(name, errors):
            of |= {f"gain {limit:g} over {peer}": area(limit, name, peer) for limit in limits}
        for what in ("precision", "recall", "f1"):
            of[what] = Quantity(100.0 * np.array([getattr(one, what) for one in some]), "%")
        of["ok"] = Quantity(100.0 * ok, "%")
        of["right of ok"] = Quantity(np.where(ok, 100.0 * (errors[name] < limits[1]), np.nan), "%")
        of["seconds"] = Quantity(np.array([one.seconds for one in some]), "s", 0.5)
        quantities |= {f"{name}|{what}": quantity for what, quantity in of.items()}
    table: dict[str, dict[str, Measure]] = {name: {} for name in by_method}
    for key, measure in measure_all(quantities, scenes, seed=seed).items():
        name, what = key.split("|")
        table[name][what] = measure
    return table


def to_markdown(table: dict[str, dict[str, Measure]], num: int) -> str:
    """The summary as two tables: values, and gains over peers on the same pairs with both intervals."""
    columns = [what for what in next(iter(table.values())) if not what.startswith("gain")]
    limits = [what.removeprefix("auc ") for what in columns if what.startswith("auc ")]
    rows = [[name, *(f"{row[c].value:.2f}" for c in columns)] for name, row in table.items()]
    gains = [
        [f"{name}: {peer}"]
        + [with_intervals(row[f"gain {limit} over {peer}"], signed=True) for limit in limits]
        for name, row in table.items()
        for peer in peers_of(name, table)
    ]
    lines = [f"{counted(num, 'pair')}; 95 % intervals over pairs, then over scenes.", ""]
    lines += markdown_table(["", *columns], rows) + markdown_table(["points more, over", *limits], gains)
    return "\n".join(lines).rstrip() + "\n"
