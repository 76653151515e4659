"""Scans that are wrong as a whole, mirrored or in another unit, are named by what several of their pairs say."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from small_scans import CUTS, SETTINGS, cut, scene

from geomoe3d import register_scans
from geomoe3d.batch.store import Outcome
from geomoe3d.config import load_config
from geomoe3d.multiway.edges import Edge
from geomoe3d.multiway.faults import loose_parts, mirrored_scans, scans_of_other_units
from geomoe3d.multiway.rules import Group

pytestmark = pytest.mark.usefixtures("own_cache")

MIRRORED = "mirrored: with x of 'b' the other way round the clouds fit clearly better; ..."
UNITS = "units differ: with all lengths of 'b' divided by 3.28084 the clouds fit; ..."


def outcome(*reasons, status="low_confidence"):
    return Outcome("", SimpleNamespace(status=status, reasons=reasons), None)


def edge(source, target, confidence=0.9):
    return Edge(source, target, np.eye(4), confidence, np.eye(6))


def test_a_mirrored_scan_and_one_in_millimetres_are_named(tmp_path):
    points = scene()
    for number, bounds in enumerate(CUTS):
        part, _ = cut(points, *bounds, seed=number)
        factor = {1: [-1.0, 1.0, 1.0], 3: [1000.0] * 3}.get(number, [1.0] * 3)
        np.save(tmp_path / f"scan_{number}.npy", part * factor)
    config = load_config(None, SETTINGS)
    model = register_scans([tmp_path], tmp_path / "model", config=config, page=False, rounds=0)
    assert not model.ok
    told = {**model.unplaced, **model.doubted}
    assert told["scan_1"].startswith("mirrored: 3 of 3 pairs")
    assert told["scan_3"].startswith("units differ: with all lengths of 'scan_3.npy' divided by 1000")
    assert "'scan_3.npy' seems to be in millimetres" in told["scan_3"]
    assert set(told) == {"scan_1", "scan_3"}
    files = [tmp_path / f"scan_{number}.npy" for number in (0, 1, 2)]
    other = config.model_copy(update={"seed": 1})
    again = register_scans(files, tmp_path / "model", config=other, page=False, rounds=0, fresh=True)
    assert again.unplaced["scan_1"].startswith("mirrored: 2 of 2 pairs")


def test_parts_are_what_pairs_tie_that_are_too_sure_to_be_asked():
    group = Group({k: np.eye(4) for k in range(4)}, [edge(0, 1, 0.999), edge(2, 1, 0.98), edge(3, 2, 0.995)])
    assert loose_parts(range(5), [group]) == [(0, 1), (2, 3), (4,)]


@pytest.mark.parametrize(
    ("told", "named"),
    [
        ([outcome(MIRRORED), outcome(MIRRORED), outcome()], True),
        ([outcome(MIRRORED), outcome("too few"), outcome()], False),
        ([outcome(MIRRORED)], True),
        ([outcome(MIRRORED), outcome(MIRRORED), *[outcome(status="ok")] * 2], False),
        ([], False),
    ],
)
def test_two_pairs_and_most_of_those_that_are_sure_must_say_that_a_part_is_mirrored(told, named):
    pairs = [(k, 9) for k in range(len(told))]
    found = mirrored_scans({(9, 10): pairs}, dict(zip(pairs, told, strict=True)))
    assert set(found) == ({9, 10} if named else set())
    assert all(text.startswith(f"mirrored: {min(len(told), 2)} of") for text in found.values())


def test_a_scan_is_of_another_unit_where_more_pairs_say_so_than_hold_it():
    outcomes = {(0, 2): outcome(UNITS), (1, 2): outcome(UNITS), (0, 1): outcome(status="ok")}
    assert scans_of_other_units(outcomes, [edge(1, 0), edge(2, 1)]) == {2: UNITS}
    assert not scans_of_other_units(outcomes, [edge(1, 0), edge(2, 1), edge(2, 0)])
