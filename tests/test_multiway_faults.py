"""Scans that are wrong as a whole, mirrored or in another unit, are named by what several of their pairs say."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
from small_scans import CUTS, SETTINGS, cut, scene

from geomoe3d import register_scans
from geomoe3d.batch.folder import RUN_FILE
from geomoe3d.batch.store import Outcome
from geomoe3d.config import load_config
from geomoe3d.config.expert import in_force
from geomoe3d.errors import OutputError
from geomoe3d.multiway.edges import Edge
from geomoe3d.multiway.faults import (
    find_faults,
    loose_parts,
    mirrored_scans,
    scans_of_other_units,
    shared_out,
)
from geomoe3d.multiway.rules import Group

pytestmark = pytest.mark.usefixtures("own_cache")

MIRRORED = "mirrored: with x of 'b' the other way round the clouds fit clearly better; ..."
UNITS = "units differ: lengths in 'b' are 3.28084 times those in 'a', ..."


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
    assert told["scan_3"].startswith("units differ: lengths in 'scan_3.npy' are 1000 times those in")
    assert "'scan_3.npy' seems to be in millimetres" in told["scan_3"]
    assert set(told) == {"scan_1", "scan_3"}
    files = [tmp_path / f"scan_{number}.npy" for number in (0, 1, 2)]
    other = config.model_copy(update={"seed": 1})
    again = register_scans(files, tmp_path / "model", config=other, page=False, rounds=0, fresh=True)
    assert again.unplaced["scan_1"].startswith("mirrored: 2 of 2 pairs")
    run = tmp_path / "model" / "pairs" / "checks" / RUN_FILE
    for fresh in (False, True):  # pairs that were looked at again are kept, unless all is made anew
        data = json.loads(run.read_text())
        run.write_text(json.dumps({**data, "created": "of old"}))
        register_scans(files, tmp_path / "model", config=other, page=False, rounds=0, fresh=fresh)
        assert (json.loads(run.read_text())["created"] == "of old") != fresh
    for fresh in (False, True):  # damaged ones cost neither the model nor what is known of its scans
        run.write_text("{")
        (tmp_path / "model" / "poses.json").unlink()
        for rest in (tmp_path / "model").glob("group1.*"):
            rest.unlink()
        said: list[str] = []
        last = register_scans(
            files, tmp_path / "model", config=other, page=False, rounds=0, fresh=fresh, say=said.append
        )
        assert set(last.unplaced) == {"scan_1"}
        assert last.unplaced["scan_1"].startswith("mirrored: 2 of 2 pairs")
        assert (tmp_path / "model" / "poses.json").is_file()
        assert run.read_text() == "{"
        assert any("looked at again and not kept" in one and "run.json" in one for one in said)


def test_scans_that_could_not_be_looked_at_again_are_doubted():
    def fail(*_):
        raise OutputError("no room is left")

    scans = [SimpleNamespace(name=f"scan_{k}") for k in range(3)]
    similarity = np.ones((3, 3))
    survey = SimpleNamespace(
        scans=scans, say=lambda text: None, register_apart=fail, config=load_config(None, SETTINGS),
        usable=lambda: [0, 1, 2], similarity=similarity, outcomes={},
    )  # fmt: skip
    edges = [edge(0, 1, 0.999), edge(2, 1, 0.9)]
    group = Group({k: np.eye(4) for k in range(3)}, edges)
    found = find_faults(survey, [group], edges)
    assert set(found) == {2}
    assert found[2].startswith("not asked about mirrored axes and units")
    assert "no room is left" in found[2]


def test_parts_are_what_pairs_tie_that_are_too_sure_to_be_asked():
    group = Group({k: np.eye(4) for k in range(4)}, [edge(0, 1, 0.999), edge(2, 1, 0.98), edge(3, 2, 0.995)])
    assert loose_parts(range(5), [group]) == [(0, 1), (2, 3), (4,)]


@pytest.mark.parametrize(
    ("told", "unasked", "named"),
    [
        ([outcome(MIRRORED), outcome(MIRRORED), outcome()], 0, True),
        ([outcome(MIRRORED), outcome("too few"), outcome()], 0, False),
        ([outcome(MIRRORED)], 0, True),
        ([outcome(MIRRORED)], 2, False),
        ([outcome(MIRRORED), outcome(MIRRORED), *[outcome(status="ok")] * 2], 0, False),
        ([], 0, False),
    ],
)
def test_two_pairs_and_most_of_those_that_are_sure_must_say_that_a_part_is_mirrored(told, unasked, named):
    pairs = [(k, 9) for k in range(len(told) + unasked)]
    found = mirrored_scans({(9, 10): pairs}, dict(zip(pairs, told, strict=False)))
    assert set(found) == ({9, 10} if named else set())
    assert all(text.startswith(f"mirrored: {min(len(told), 2)} of") for text in found.values())


def test_one_pair_is_enough_where_a_scan_is_not_placed_and_none_is_sure():
    pairs = [(k, 9) for k in range(6)]
    told = dict(zip(pairs, [outcome(MIRRORED), *[outcome("too few")] * 5], strict=True))
    asked = {(9,): pairs}
    assert mirrored_scans(asked, told) == {}
    assert mirrored_scans(asked, told, {(9,)})[9].startswith("mirrored: 1 of 6 pairs fits clearly better")
    assert mirrored_scans(asked, {**told, (5, 9): outcome(status="ok")}, {(9,)}) == {}


def test_a_good_scan_is_not_named_for_its_pair_with_a_mirrored_one():
    mirrored, good = (3,), (4,)
    asked = {good: [(3, 4), (0, 4), (1, 4)], mirrored: [(0, 3), (1, 3), (3, 4)]}
    checks = {(3, 4): outcome(MIRRORED), (0, 3): outcome(MIRRORED), (1, 3): outcome(MIRRORED)}
    checks |= {(0, 4): outcome("too few"), (1, 4): outcome("too few")}
    found = mirrored_scans(asked, checks, {mirrored, good})
    assert set(found) == {3}
    assert found[3].startswith("mirrored: 3 of 3 pairs")
    checks[1, 4] = outcome(MIRRORED)  # a pair with a scan that is not named does count
    assert set(mirrored_scans(asked, checks, {mirrored, good})) == {3, 4}


def test_pairs_are_shared_out_so_that_every_part_asked_gets_as_many_as_a_verdict_needs():
    asked = {(5,): [(0, 5), (1, 5), (2, 5)], (6,): [(3, 6)], (7,): [(0, 7), (1, 7), (2, 7)]}
    needed = {(0, 5), (1, 5), (3, 6), (0, 7), (1, 7)}
    assert shared_out(asked, 60) == (needed | {(2, 5), (2, 7)}, [])
    assert shared_out(asked, 6) == (needed | {(2, 5)}, [])
    assert shared_out(asked, 5) == (needed, [])
    assert shared_out(asked, 4) == ({(0, 5), (1, 5), (3, 6), (2, 5)}, [(7,)])
    assert shared_out(asked, 0) == (set(), list(asked))


def test_parts_that_the_limit_leaves_unasked_are_said():
    said: list[str] = []
    settings = load_config(None, ["expert.many_pairs.most_checked=2"])
    survey = SimpleNamespace(
        scans=[SimpleNamespace(name=name) for name in "abcd"],
        similarity=np.ones((4, 4)),
        config=settings,
        outcomes={},
        say=said.append,
        usable=lambda: range(4),
        register_apart=lambda pairs, *rest: dict.fromkeys(pairs, outcome(MIRRORED)),
    )
    with in_force(settings.expert):
        found = find_faults(survey, [], [])
    assert set(found) == {1}
    assert len(said) == 1
    assert "2 parts of the 3 that nothing sure ties to the rest, those of c, d; 2 pairs in all" in said[0]


def test_a_scan_is_of_another_unit_where_more_pairs_say_so_than_hold_it():
    outcomes = {(0, 2): outcome(UNITS), (1, 2): outcome(UNITS), (0, 1): outcome(status="ok")}
    assert scans_of_other_units(outcomes, [edge(1, 0), edge(2, 1)]) == {2: UNITS}
    assert not scans_of_other_units(outcomes, [edge(1, 0), edge(2, 1), edge(2, 0)])


def test_good_scans_are_not_named_for_what_their_pairs_with_bad_ones_say():
    chain = [edge(k + 1, k) for k in range(3)]
    outcomes = {(good, bad): outcome(UNITS) for good in range(4) for bad in (4, 5)}
    assert set(scans_of_other_units(outcomes, chain)) == {4, 5}
    assert set(scans_of_other_units(outcomes, [*chain, edge(5, 4)])) == {4, 5}
