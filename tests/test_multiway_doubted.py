"""What a model says of scans that are placed and may be wrong there, and that it is not ok then: scale, repetition."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from geomoe3d.cli.multiway import summary
from geomoe3d.decision.scale import Scale
from geomoe3d.multiway.edges import Edge
from geomoe3d.multiway.model import EdgeReport, SceneGroup, SceneModel
from geomoe3d.multiway.report import _is_elsewhere
from geomoe3d.multiway.rules import GroupingRules
from geomoe3d.multiway.scans import Scan
from geomoe3d.multiway.tables import scans_text

SAID = Scale(1.1, 0.01).sentence("a.ply", "b.ply")


def model(said: dict[tuple[str, str], str]) -> SceneModel:
    """Four scans in one group, every two of them a pair that is kept."""
    names = ["a", "b", "c", "d"]
    pairs = [(one, other) for k, one in enumerate(names) for other in names[:k]]
    edges = [
        EdgeReport(*pair, "kept", said.get(pair, ""), 0.9, 0.99, 0.01, 0.1, True, False, np.eye(4))
        for pair in pairs
    ]
    group = SceneGroup("a", {name: np.eye(4) for name in names}, {}, (), ())
    scans = tuple(Scan(name, f"/{name}.ply") for name in names)
    return SceneModel(Path("model"), 0.1, scans, (group,), {}, tuple(edges), len(edges), {})


def test_a_scan_that_its_pairs_say_is_of_another_scale_is_named_and_the_model_not_ok() -> None:
    found = model({("d", other): SAID for other in "abc"})
    assert not found.ok
    assert list(found.doubted) == ["d"]
    assert found.doubted["d"] == f"3 of the 3 pairs that hold it say so: {SAID}"
    assert "d may be wrong: 3 of the 3 pairs" in summary(found)
    rows = {row["scan"]: row["reason"] for row in csv.DictReader(io.StringIO(scans_text(found)))}
    assert rows["d"] == found.doubted["d"]
    assert rows["a"] == ""


@pytest.mark.parametrize("pairs", [[], [("d", "a")], [("d", "a"), ("c", "b")]])
def test_single_pairs_of_bent_scans_doubt_none(pairs: list[tuple[str, str]]) -> None:
    found = model(dict.fromkeys(pairs, SAID))
    assert found.ok
    assert not found.doubted


def test_a_sure_pair_that_would_have_a_scan_elsewhere_tells_of_repeated_structure() -> None:
    survey: Any = SimpleNamespace(
        rules=GroupingRules(tolerance=0.2, near_tolerance=0.1, kept_tolerance=0.05, kept_error=0.1),
        outcomes={(0, 1): SimpleNamespace(status="ok"), (0, 2): SimpleNamespace(status="low_confidence")},
    )

    def elsewhere(source: int, shift: float, turn_deg: float, *, of_maps: bool = False) -> bool:
        report = EdgeReport(
            str(source), "0", "rejected", "", 0.98, 0.6, shift, turn_deg, False, of_maps, np.eye(4)
        )
        return _is_elsewhere(survey, Edge(source, 0, np.eye(4), 0.98, np.eye(6), of_maps=of_maps), report)

    assert elsewhere(1, 3.0, 2.0)
    assert elsewhere(1, 0.1, 90.0)
    assert not elsewhere(1, 0.5, 10.0)  # what a bend explains
    assert not elsewhere(2, 3.0, 2.0)  # registration was not sure of it
    assert not elsewhere(1, 3.0, 2.0, of_maps=True)

    whole = model({})
    sure = EdgeReport("d", "a", "rejected", "", 0.98, 0.6, 3.0, 90.0, False, False, np.eye(4))
    found = replace(whole, groups=(replace(whole.groups[0], contradictions=(sure,)),))
    assert whole.ok
    assert not found.ok
    said = found.groups[0].repeated
    assert said.startswith("repeated structure: 1 pair that registration is sure of")
    assert "'d' and 'a' by 3 and 90 deg" in said
    assert said in summary(found)
    assert json.loads(found.to_json())["groups"][0]["repeated"] == said
