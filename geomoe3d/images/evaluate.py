"""How good poses and homographies are: several methods on the same pairs, areas under the recall curve, intervals.

A method is what of the matches it uses (all, those that pass the ratio test, what a network keeps) and an
estimator. Shares intervals and their words with the evaluation of clouds.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any

import numpy as np

from geomoe3d.errors import InputError
from geomoe3d.evaluation.intervals import Quantity, measure_all
from geomoe3d.evaluation.records import Measure
from geomoe3d.images.cases import Case
from geomoe3d.images.config import KEYPOINTS
from geomoe3d.images.network import ImageNetwork
from geomoe3d.runtime.plain import plain
from geomoe3d.runtime.words import counted
from geomoe3d.types import FloatArray


@dataclass(frozen=True)
class Outcome:
    """One method on one pair.

    Attributes:
        scene, pair, method: names.
        error: degrees or pixels; infinite without an answer.
        status: of the answer.
        seconds: beyond keypoints and matches.
        matches: given.
        true_share: share of them that fit the truth.
        precision, recall, f1: of those that the method kept before its estimator; 0 where undefined.
        turned: rotation between the cameras, degrees; NaN for homographies.
    """

    scene: str
    pair: str
    method: str
    error: float
    status: str
    seconds: float
    matches: int
    true_share: float
    precision: float
    recall: float
    f1: float
    turned: float = math.nan


def area_under_recall(
    errors: Sequence[float] | FloatArray, limit: float, counts: FloatArray | None = None
) -> FloatArray:
    """Area under the share of errors below e, for e from 0 to ``limit``, over ``limit``; in [0, 1].

    The curve runs straight from one error to the next, as SuperGlue (Sarlin et al. 2020) and who followed have
    it. That adds half a pair's share, up to the largest error below the limit, to the area of the steps.

    Args:
        errors: (n,).
        limit: above 0.
        counts: (B, n) how often each error was drawn; None: once.

    Returns:
        (B,), NaN for no errors.
    """
    e = np.asarray(errors, dtype=np.float64)
    drawn = np.ones((1, len(e))) if counts is None else counts
    below = np.where(e < limit, e, 0.0)
    steps = drawn @ np.where(e < limit, limit - below, 0.0)
    last = np.where(drawn > 0, below, 0.0).max(axis=1, initial=0.0)
    with np.errstate(invalid="ignore"):
        area: FloatArray = (steps + last / 2) / drawn.sum(axis=1) / limit
    return area


PEERS = ("all", "ratio test")
"""Which matches are used without a network."""


def evaluate(scene: str, cases: Iterable[Case], network: ImageNetwork | None) -> Iterator[Outcome]:
    """All methods on the cases of one scene; those with a network where one is given."""
    for case in cases:
        found, true, spent = case.matches, case.true, 0.0
        given = {"all": np.ones(len(found)), "ratio test": found.distinct().astype(np.float64)}
        if network is not None:
            start = time.perf_counter()
            weights = network(case.rays).weights
            spent = time.perf_counter() - start
            kind = {"geomoe": "GeoMoE"}.get(network.model.config.kind, network.model.config.kind)
            loose = found.distinct(KEYPOINTS.loose_ratio)
            given |= {kind: weights, f"{kind} and loose ratio test": weights * loose}
        for (which, weights), (name, estimator) in product(given.items(), case.estimators.items()):
            start = time.perf_counter()
            kept = weights > 0
            error, status = case.answer(
                weights if name == list(case.estimators)[-1] else kept * 1.0, estimator
            )
            seconds = time.perf_counter() - start + (spent if which not in PEERS else 0.0)
            hits = float((true & kept).sum())
            precision, recall = hits / max(int(kept.sum()), 1), hits / max(int(true.sum()), 1)
            yield Outcome(
                scene, case.name, f"{which}, {name}", error, status, seconds, len(found),
                float(true.mean()) if len(true) else 0.0, precision, recall,
                2 * precision * recall / max(precision + recall, 1e-12), case.turned,
            )  # fmt: skip


def peers_of(method: str, methods: Iterable[str]) -> list[str]:
    """Whom a method is compared to: all matches under the same estimator, and, where it uses a network, the
    ratio test, under either robust estimator where its own is one."""
    which, estimator = method.rsplit(", ", 1)
    robust = ("RANSAC", "MAGSAC++")
    peers = [f"all, {estimator}"] if which != "all" else []
    if which not in PEERS:
        peers += [f"ratio test, {one}" for one in (robust if estimator in robust else (estimator,))]
    return [peer for peer in peers if peer in set(methods)]


def summarise(
    outcomes: Sequence[Outcome], limits: tuple[float, ...], seed: int = 0
) -> dict[str, dict[str, Measure]]:
    """Measures of every method in %, and the differences of its areas to those of `peers_of` it on the same
    pairs. Raises InputError: nothing to summarise, or methods that were not all given the same pairs."""
    by_method: dict[str, list[Outcome]] = {}
    for one in outcomes:
        by_method.setdefault(one.method, []).append(one)
    pairs = {name: [(o.scene, o.pair) for o in some] for name, some in by_method.items()}
    if len({tuple(p) for p in pairs.values()}) != 1:
        raise InputError(
            "no pairs to summarise" if not pairs else "the methods were not given the same pairs"
        )
    quantities: dict[str, Quantity] = {}
    errors = {name: np.array([o.error for o in some]) for name, some in by_method.items()}
    zero = np.zeros(len(next(iter(errors.values()))))
    for name, some in by_method.items():
        for limit in limits:
            quantities[f"{name}|auc {limit:g}"] = Quantity(zero, "points", _area(limit, errors[name]))
            for peer in peers_of(name, errors):
                statistic = _area(limit, errors[name], errors[peer])
                quantities[f"{name}|gain {limit:g} over {peer}"] = Quantity(zero, "points", statistic)
        for what in ("precision", "recall", "f1"):
            quantities[f"{name}|{what}"] = Quantity(100.0 * np.array([getattr(o, what) for o in some]), "%")
        ok = np.array([o.status == "ok" for o in some])
        right = errors[name] < limits[1]
        quantities[f"{name}|ok"] = Quantity(100.0 * ok, "%")
        quantities[f"{name}|right of ok"] = Quantity(np.where(ok, 100.0 * right, np.nan), "%")
        quantities[f"{name}|seconds"] = Quantity(np.array([o.seconds for o in some]), "s", 0.5)
    found = measure_all(quantities, [o.scene for o in next(iter(by_method.values()))], seed=seed)
    table: dict[str, dict[str, Measure]] = {}
    for key, measure in found.items():
        name, what = key.split("|")
        table.setdefault(name, {})[what] = measure
    return table


def _area(
    limit: float, errors: FloatArray, minus: FloatArray | None = None
) -> Callable[[FloatArray], FloatArray]:
    def statistic(counts: FloatArray) -> FloatArray:
        area = area_under_recall(errors, limit, counts)
        return 100.0 * (area if minus is None else area - area_under_recall(minus, limit, counts))

    return statistic


def to_markdown(table: dict[str, dict[str, Measure]], num: int) -> str:
    """The summary as two tables: values, and gains over peers on the same pairs with both intervals."""
    columns = [what for what in next(iter(table.values())) if not what.startswith("gain")]
    limits = [what.removeprefix("auc ") for what in columns if what.startswith("auc ")]
    rows = [["", *columns]] + [
        [name, *(f"{row[c].value:.2f}" for c in columns)] for name, row in table.items()
    ]
    gains = [["points more, over", *limits]] + [
        [f"{name}: {peer}", *(_with_intervals(row[f"gain {limit} over {peer}"]) for limit in limits)]
        for name, row in table.items()
        for peer in peers_of(name, table)
    ]
    lines = [f"{counted(num, 'pair')}; 95 % intervals over pairs, then over scenes.", "", *_table(rows)]
    return "\n".join(lines + (["", *_table(gains)] if len(gains) > 1 else [])) + "\n"


def _table(rows: list[list[str]]) -> list[str]:
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return [lines[0], "|---" * len(rows[0]) + "|", *lines[1:]]


def _with_intervals(measure: Measure) -> str:
    ends = [f"[{low:+.1f}, {high:+.1f}]" for low, high in (measure.interval, measure.scene_interval)]
    return f"{measure.value:+.2f} " + " ".join(ends)


def to_json(outcomes: Sequence[Outcome], table: dict[str, dict[str, Measure]]) -> dict[str, Any]:
    """Summary and every outcome as plain values; infinite and undefined numbers as None."""
    summary = {name: {what: asdict(m) for what, m in row.items()} for name, row in table.items()}
    return {"summary": plain(summary), "pairs": plain([asdict(one) for one in outcomes])}
