"""A scan that may be a stranger to its map: when the surface network is asked, and what becomes of its word."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from generated_buildings import GRID

from geomoe3d import Map
from geomoe3d.clouds.pair import Pair
from geomoe3d.config import RegistrationConfig, load_config
from geomoe3d.decision.answer import Decision
from geomoe3d.decision.confidence import Judgement
from geomoe3d.decision.information import Information
from geomoe3d.maps import stranger
from geomoe3d.maps.stranger import LOOKS_STRANGE, shown
from geomoe3d.networks.motion_judge import Judged
from geomoe3d.runtime.timing import StageClock
from geomoe3d.scoring.base import Belief
from geomoe3d.scoring.network import NETWORK, Opinion
from geomoe3d.types import Correspondences, FilterOutput, Hypothesis


def asked(
    factor, status="ok", confidence=0.99, config=None, *, opinion=None, has_margin=True, descriptor="learned"
):
    """What becomes of a decision where the network multiplies by a factor."""

    def about(pair):
        assert pair.clouds == ("described", "described")
        return lambda transforms: [Belief(factor)]

    clouds = ("bare", "bare")
    matched = Correspondences(np.zeros((0, 6)))
    line = SimpleNamespace(
        config=config or RegistrationConfig(),
        second_scorers={"surface_network": SimpleNamespace(about=about, has_margin=has_margin)},
        second_descriptor=None if descriptor == "none" else descriptor,
        described_again=lambda given, clock: ("described", "described"),
        pair=lambda given, matched, places: Pair(matched, 0.1, 0.2, 0, *given),
    )
    nothing = Information(np.eye(6), np.zeros(3), 0.1, 100)
    judgement = Judgement(status, (), confidence)
    answer = Hypothesis(np.eye(4), scores={} if opinion is None else {NETWORK: opinion})
    decision = Decision(answer, None, np.inf, nothing, judgement)
    return shown(line, Pair(matched, 0.1, 0.2, 0, *clouds), decision, StageClock()).judgement


def test_an_ok_answer_that_the_network_holds_for_wrong_is_not_ok():
    denied = asked(0.5)
    assert (denied.status, denied.reasons, denied.confidence) == ("low_confidence", (LOOKS_STRANGE,), 0.79)
    assert asked(2.0) == Judgement("ok", (), 0.99)


def test_the_network_of_the_matches_has_a_voice_if_it_was_asked():
    judged = Judged(0.0, lambda: FilterOutput(np.zeros(0)))
    assert asked(np.exp(-0.7), opinion=Opinion(4.0, judged)).status == "ok"
    assert asked(np.exp(-0.7), opinion=Opinion(1.0, judged)).status == "low_confidence"
    assert asked(np.exp(0.7), opinion=Opinion(-4.0, judged)).status == "low_confidence"
    assert asked(np.exp(-0.7), opinion=Opinion(4.0)).status == "low_confidence"  # assumed


def test_it_is_not_asked_where_it_can_change_nothing_or_nobody_wants_it():
    assert asked(0.5, confidence=0.999).status == "ok"
    assert asked(0.5, status="ambiguous").reasons == ()
    assert asked(0.5, has_margin=False).status == "ok"
    assert asked(0.5, descriptor="none").status == "ok"
    off = RegistrationConfig.model_validate({"second_look": {"checked_below": 0}})
    assert asked(0.5, config=off).status == "ok"


def test_a_scan_in_its_room_stays_ok_when_the_network_is_asked(house, scan, monkeypatch):
    config = load_config(None, ["expert.locating.checked_below=1", f"voxel_size={GRID}"])
    made = Map(house._voxels, house._levels, house.sources, config=config)
    assert made.locate(scan[0]).ok
    monkeypatch.setattr(stranger.Choosers, "likings", lambda self, hypotheses: np.array([-0.1]))
    found = made.locate(scan[0])
    assert found.status == "low_confidence"
    assert found.result.reasons[0] == LOOKS_STRANGE


@pytest.mark.parametrize("times", [0.96, 1.04])
def test_a_scan_four_per_cent_off_is_not_ok_and_the_scale_is_named(house, scan, times):
    found = house.locate(times * scan[0])
    assert not found.ok
    assert any("the scale differs" in reason for reason in found.result.reasons)
