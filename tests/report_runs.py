"""Made-up runs of an evaluation, the report of them, and its page taken apart."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geomoe3d.evaluation.records import EvaluationPair, Labels, Prediction, RunInfo, RunScore
from geomoe3d.evaluation.report_page import render_report, run_key
from geomoe3d.evaluation.summary import summarise
from geomoe3d.geometry.se3 import inverse, make_transform, transform_points

NASTY = "</script><b>x & {{data}} \"'é"
VOID = {"meta", "br", "input", "link", "img", "hr", "source"}


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


def make_two_runs(
    pairs: list[EvaluationPair],
) -> list[tuple[RunScore, list[EvaluationPair], list[Prediction]]]:
    """One with confidences that fails on some pairs, and one without that lacks two pairs."""
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
