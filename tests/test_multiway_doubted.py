"""A scan of another scale agrees with all others and is placed: the model says so and is not ok."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pytest

from geomoe3d.cli.multiway import summary
from geomoe3d.decision.scale import Scale
from geomoe3d.multiway.model import EdgeReport, SceneGroup, SceneModel
from geomoe3d.multiway.scans import Scan
from geomoe3d.multiway.tables import scans_text

SAID = Scale(1.1, 0.01).sentence()


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
