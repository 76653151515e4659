"""The information of a fit and the judgement: derivatives, monotony, documented rules."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from surface_pairs import VOXEL, pair

import geomoe3d
from geomoe3d.config import DecisionConfig, expert
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.decision import confidence
from geomoe3d.decision.confidence import Judgement, confidence_score, lead_over
from geomoe3d.decision.information import Information, measure_information
from geomoe3d.geometry.se3 import rotation_error_deg, transform_points
from geomoe3d.scoring.network import Opinion
from geomoe3d.scoring.surfaces import Evidence
from geomoe3d.types import Hypothesis

# ---- judgement ------------------------------------------------------------------------------------------


FIRM = Information(np.eye(6), np.zeros(3), 0.1, 500, 0.2, sensors_known=True)
LOOSE = Information(np.eye(6), np.zeros(3), 0.0, 500, 0.2, sensors_known=True)


def evidence(score: float, overlap: float = 0.6, violation: float = 0.0) -> Evidence:
    return Evidence(overlap, overlap, score * np.exp(10 * violation), violation)


def scored(found: Evidence, verdict: float | None = None) -> Hypothesis:
    """A hypothesis of which the clouds say this, and a network that."""
    said = {} if verdict is None else {"network": Opinion(verdict)}
    return Hypothesis(np.eye(4), scores={"surfaces": found, **said})


def judge(
    found: Evidence, lead: float, support: float, information: Information, config: DecisionConfig
) -> Judgement:
    return confidence.judge(scored(found), None, lead, support, information, config)


def test_strong_evidence_with_a_lead_is_ok() -> None:
    judged = judge(evidence(0.8), 5.0, 0.05, FIRM, DecisionConfig())
    assert judged.status == "ok"
    assert judged.reasons == ()
    assert judged.confidence > 0.9


def test_weak_evidence_is_low_confidence_and_says_so() -> None:
    judged = judge(evidence(0.05), 1.5, 0.05, FIRM, DecisionConfig())
    assert judged.status == "low_confidence"
    assert judged.confidence < 0.95
    assert any(re.search(r"confidence 0\.\d\d is below 0\.95", reason) for reason in judged.reasons)


def test_a_rival_about_as_good_is_ambiguous() -> None:
    judged = judge(evidence(0.8), 1.1, 0.05, FIRM, DecisionConfig())
    assert judged.status == "ambiguous"
    assert judged.confidence <= expert().confidence.most_doubted
    assert any("91 %" in reason for reason in judged.reasons)
    limit = 1 / DecisionConfig().ambiguity_ratio
    assert judge(evidence(2.0), limit * 1.001, 0.05, FIRM, DecisionConfig()).status != "ambiguous"
    assert judge(evidence(2.0), limit * 0.999, 0.05, FIRM, DecisionConfig()).status == "ambiguous"
    # Where even without a rival nothing would be believed, the rival is not the reason.
    assert judge(evidence(0.002), 1.1, 0.05, FIRM, DecisionConfig()).status == "low_confidence"


def test_a_surface_that_slides_is_ambiguous_whatever_the_evidence() -> None:
    for score, lead in ((5.0, 30.0), (0.01, 1.0)):
        judged = judge(evidence(score), lead, 0.05, LOOSE, DecisionConfig())
        assert judged.status == "ambiguous"
        assert judged.confidence <= 0.3
        assert any("slide" in reason for reason in judged.reasons)


def test_where_sensor_lies_on_sensor_the_surface_must_hold_more() -> None:
    for apart, held, status in (
        (0.5, 0.02, "ambiguous"),
        (0.5, 0.04, "ok"),
        (5.0, 0.02, "ok"),
        (np.inf, 0.02, "ok"),
    ):
        information = replace(FIRM, sensors_apart=apart, observability=held)
        judged = judge(evidence(4.0), 30.0, 0.2, information, DecisionConfig())
        assert judged.status == status
        assert any("own pattern" in reason for reason in judged.reasons) == (status == "ambiguous")
    source, target, T = pair(seed=5)
    place = np.array([0.3, -0.2, 0.1])
    there = transform_points(T, place[None])[0] + np.array([0, 0, 4 * VOXEL])
    two = replace(source, viewpoint=place), replace(target, viewpoint=there)
    assert measure_information(T, *two, VOXEL).sensors_apart == pytest.approx(4 * VOXEL / source.voxel_size)


def test_where_sensor_lies_on_sensor_a_rival_that_fits_nearly_as_well_makes_ambiguous() -> None:
    """Each scan's own pattern fits itself: car parks, meeting rooms and pipe racks were ok by it, turned or shifted."""
    answer, config = scored(evidence(2.0), 9.0), DecisionConfig()
    for apart, share, overlap, status in (
        (1.0, 0.5, 0.85, "ambiguous"),
        (1.0, 0.2, 0.85, "ok"),  # it fits far worse
        (1.0, 0.5, 0.5, "ok"),  # it lies on little
        (20.0, 0.5, 0.85, "ok"),  # the sensors do not lie on each other
    ):
        rival = scored(evidence(2.0 * share, overlap=overlap), -3.0)
        information = replace(FIRM, sensors_apart=apart)
        judged = confidence.judge(answer, rival, 50.0, 0.05, information, config)
        assert judged.status == status, (apart, share, overlap)
        assert (status == "ok") == (judged.confidence > 0.9)


@pytest.mark.parametrize(
    ("agreeing", "matches", "points", "status"),
    [
        (5, 1000, 500, "low_confidence"),
        (6, 1000, 500, "ok"),
        (3, 5, 500, "ok"),
        (2, 5, 500, "low_confidence"),
        (50, 1000, 29, "low_confidence"),
        (50, 1000, 30, "ok"),
    ],
)
def test_next_to_nothing_that_agrees_is_never_ok(
    agreeing: int, matches: int, points: int, status: str
) -> None:
    information = replace(FIRM, num_matched=points)
    found = scored(evidence(20.0))
    judged = confidence.judge(found, None, 30.0, agreeing / matches, information, DecisionConfig(), matches)
    assert judged.status == status
    assert (status == "ok") == (judged.reasons == ())


def test_little_overlap_and_violated_free_space_are_told_even_when_ok() -> None:
    judged = judge(evidence(2.0, overlap=0.09), 10.0, 0.05, FIRM, DecisionConfig())
    assert judged.status == "ok"
    assert any("overlap 9 %" in reason for reason in judged.reasons)
    judged = judge(evidence(2.0, violation=0.12), 10.0, 0.05, FIRM, DecisionConfig())
    assert any("free space" in reason and "0.12" in reason for reason in judged.reasons)


def test_nothing_scored_is_never_ok() -> None:
    for lead in (1.0, 3.0, np.inf):
        judged = judge(evidence(0.0), lead, 0.05, FIRM, DecisionConfig())
        assert judged.status == "low_confidence"
        assert judged.confidence == 0


@pytest.mark.parametrize("least", [0.0, 0.5, 0.99])
def test_the_threshold_is_the_users(least: float) -> None:
    for score, lead in itertools.product((0.05, 0.2, 0.5, 2.0), (1.5, 5.0)):
        judged = judge(evidence(score), lead, 0.05, FIRM, DecisionConfig(min_confidence=least))
        assert (judged.status == "ok") == (judged.confidence >= least)


def test_a_prior_shifts_the_odds_by_what_it_differs_by() -> None:
    def odds(prior: float | None) -> float:
        p = confidence_score(evidence(0.2), 2.0, 0.05, FIRM, prior=prior)
        return p / (1 - p)

    assert odds(None) == pytest.approx(odds(expert().confidence.fitted_prior))
    assert odds(0.5) / odds(0.2) == pytest.approx(4.0)
    judged = [
        judge(evidence(0.2), 2.0, 0.05, FIRM, DecisionConfig(prior=p)).confidence for p in (0.05, 0.5, 0.95)
    ]
    assert judged == sorted(judged) and judged[0] < judged[-1]


def test_confidence_rises_with_evidence_and_lead_and_stays_in_range() -> None:
    scores, leads = np.geomspace(1e-6, 50, 40), [*np.geomspace(0.5, 30, 20), np.inf]
    table = np.array([[confidence_score(evidence(s), x, 0.05, FIRM) for x in leads] for s in scores])
    assert ((table >= 0) & (table <= 1)).all()
    assert (np.diff(table, axis=0) >= 0).all()
    assert (np.diff(table, axis=1) >= 0).all()
    assert table[0, 0] < 0.01
    assert table[-1, -1] > 0.999
    assert (
        confidence_score(evidence(0.0), np.inf, 0.05, FIRM)
        == confidence_score(evidence(-1.0), 5.0, 0.05, FIRM)
        == 0
    )


def test_confidence_rises_with_hold_and_falls_with_looseness_and_violation_up_to_a_bound() -> None:
    for verdict in (None, 2.0):
        sure, heard = Evidence(0.5, 0.5, 0.3, 0.0), verdict is not None
        held = [replace(FIRM, observability=x) for x in (0.0, 0.005, 0.05, 0.3)]
        by_hold = [confidence_score(sure, 3.0, 0.05, x, heard=heard) for x in held]
        assert np.isfinite(by_hold).all()
        assert (np.diff(by_hold) > 0).all()
        loose = [replace(FIRM, looseness=x) for x in (0.02, 0.1, 1.0, 10.0, 1000.0)]
        by_looseness = [confidence_score(sure, 3.0, 0.05, x, heard=heard) for x in loose]
        assert (np.diff(by_looseness[:4]) < 0).all()
        assert by_looseness[4] == by_looseness[3]
        floating = [Evidence(0.5, 0.5, 0.3 * np.exp(10 * x), x) for x in (0.0, 0.02, 0.1, 0.4)]
        by_violation = [
            confidence_score(e, 3.0, 0.05, FIRM, heard=heard) for e in floating
        ]  # at equal surface score
        assert (np.diff(by_violation[:3]) < 0).all()
        assert by_violation[3] == pytest.approx(by_violation[2])


@pytest.mark.parametrize("verdict", [None, 2.0])
def test_where_free_space_was_not_asked_the_same_evidence_is_worth_less(verdict: float | None) -> None:
    found, heard = Evidence(0.3, 0.3, 0.25, 0.0), verdict is not None
    blind = replace(FIRM, sensors_known=False)
    for lead in (1.0, 1.5, 3.0):
        one, other = (confidence_score(found, lead, 0.05, x, heard=heard) for x in (blind, FIRM))
        assert one < other


def test_the_networks_verdict_counts_by_the_lead_alone() -> None:
    """It says what fits better, of motions of the same scans; how sure it is by itself is not believed."""
    found, config = Evidence(0.5, 0.5, 0.3, 0.0), DecisionConfig()
    at = [confidence.judge(scored(found, x), None, 3.0, 0.05, FIRM, config).confidence for x in (-5.0, 2.0)]
    assert at[0] == at[1] == confidence_score(found, 3.0, 0.05, FIRM, heard=True)


def test_the_margin_of_a_second_look_makes_surer_up_to_a_bound() -> None:
    """One that says nothing, an answer liked less than another, one liked more; and no more than its bound."""
    found, bounds = Evidence(0.5, 0.5, 0.3, 0.0), expert().confidence.second_look
    at = [bounds.least_margin - 1, bounds.least_margin, 0.0, 2.0, bounds.most_margin, np.inf]
    sure = [confidence_score(found, 3.0, 0.05, FIRM, heard=True, margin=m) for m in at]
    assert sure[0] == sure[1] < sure[2] < sure[3] < sure[4] == sure[5] < 1
    assert confidence_score(evidence(0.0), 3.0, 0.05, FIRM, margin=4.0) == 0
    blind = replace(FIRM, sensors_known=False)  # the fit is of scans whose sensors are known
    without, told = (confidence_score(found, 3.0, 0.05, blind, margin=m) for m in (None, 4.0))
    assert without == told


@pytest.mark.parametrize(
    ("lead", "surface", "margin", "words"),
    [
        (0.5, 1.0, None, r"fits better than this one \(2 times the score\); see"),  # nobody else was asked
        (
            1 / 1.97,
            1.0,
            1.0,
            r"\(1.97 times the score\), and only the surface network prefers the answer; see",
        ),
        (
            1.0,
            1.0,
            None,
            r"^a clearly different transform fits as well as this one \(100 % of the score\); see",
        ),
        (1.1, 1.0, None, r"fits nearly as well as this one \(91 % of the score\)"),
        (
            3.0,
            0.9,
            None,
            r"by the surfaces alone a clearly different transform fits nearly as well .*\(90 % of",
        ),
        (3.0, 1.97, 1.0, r"by the surfaces alone .* fits better than this one \(1.97 times the score\); see"),
    ],
)
def test_a_rival_is_told_of_by_what_makes_it_one(
    lead: float, surface: float, margin: float | None, words: str
) -> None:
    mine, rival = (scored(evidence(5.0 * share, overlap=0.5), 3.0) for share in (1.0, surface))
    judged = confidence.judge(mine, rival, lead, 0.3, FIRM, DecisionConfig(), margin=margin)
    assert judged.status == "ambiguous"
    assert any(re.search(words, reason) for reason in judged.reasons)


def test_a_repeated_place_is_told_with_its_share_of_the_score() -> None:
    was = Judgement("ok", (), 0.99)
    assert "has 1.97 times the score of this one and would" in confidence.repeated(was, 1 / 1.97).reasons[0]
    assert "has 41 % of the score of this one and would" in confidence.repeated(was, 1 / 0.41).reasons[0]


@pytest.mark.parametrize(("margin", "status"), [(None, "ambiguous"), (0.4, "ambiguous"), (3.0, "ok")])
def test_a_clear_margin_tells_two_transforms_apart_that_are_liked_alike(
    margin: float | None, status: str
) -> None:
    mine, rival = (scored(evidence(5.0, overlap=0.5), verdict) for verdict in (3.0, 2.5))
    judged = confidence.judge(mine, rival, 1.2, 0.3, FIRM, DecisionConfig(min_confidence=0.5), margin=margin)
    assert judged.status == status


def test_confidence_rises_with_support_and_falls_with_overlap_at_equal_evidence() -> None:
    by_support = [confidence_score(evidence(0.2), 2.0, x, FIRM) for x in (0, 0.005, 0.02, 0.3)]
    by_overlap = [confidence_score(evidence(0.2, overlap=x), 2.0, 0.05, FIRM) for x in (0.1, 0.3, 0.9)]
    assert by_support == sorted(set(by_support))
    assert by_overlap == sorted(set(by_overlap), reverse=True)


def test_lead_over_the_other() -> None:
    assert lead_over(0.6, 0.2) == pytest.approx(3)
    assert lead_over(0.2, 0.6) == pytest.approx(1 / 3)
    assert lead_over(0.6, 0.0) == np.inf
    assert lead_over(0.0, 0.0) == 1
    assert lead_over(0.0, None) == 1
    # An answer without a rival has beaten none: more than a tie, less than a clear victory.
    assert 1 < lead_over(0.6, None) < 10


@pytest.mark.parametrize(("name", "least"), [("surfaces", 0.8), ("surfaces, network", 0.05)])
def test_a_scene_that_stands_twice_in_the_target_is_ambiguous(name: str, least: float) -> None:
    """A room with two halves alike, seen from its middle: both places are right, and the answer knows it."""
    source, target, T = make_sample_pair(0)
    half_turn = np.diag([-1.0, 1, -1, 1])
    twice = np.vstack([target.file_points, transform_points(half_turn, target.file_points)])
    answer = geomoe3d.register(
        source.file_points, twice, voxel_size=0.07, scoring={"scorers": name.split(", ")}
    )
    places = [T, half_turn @ T]
    errors = [rotation_error_deg(answer.T_target_source, place) for place in places]
    assert min(errors) < 1
    assert answer.status == "ambiguous"
    assert answer.confidence <= expert().confidence.most_doubted
    other = answer.alternative
    assert other is not None
    assert rotation_error_deg(other.T_target_source, places[1 - int(np.argmin(errors))]) < 5
    assert other.rotation_difference_deg > 175
    assert other.relative_score > least  # the clouds like both alike; a network may prefer one


@pytest.mark.parametrize(
    ("surface", "verdicts", "status"),
    [(0.8, (3.0, 1.5), "ambiguous"), (0.8, (6.0, -3.0), "ok"), (0.3, (6.0, 4.5), "ok")],
    ids=["liked alike by both", "told apart by the network", "told apart by the clouds"],
)
def test_a_rival_makes_ambiguous_only_where_clouds_and_network_like_it_alike(
    surface: float, verdicts: tuple[float, float], status: str
) -> None:
    mine = scored(evidence(0.8, overlap=0.5), verdicts[0])
    rival = scored(evidence(surface, overlap=0.5), verdicts[1])
    judged = confidence.judge(mine, rival, 5.0, 0.3, FIRM, DecisionConfig(min_confidence=0.5))
    assert judged.status == status


# ---- verdicts that do not hang on the last bits ----------------------------------------------------------


@pytest.mark.parametrize("seed", range(10))
def test_statuses_survive_points_that_move_by_a_millionth(seed: int) -> None:
    """Another processor rounds otherwise; a millionth of the extent is far more than that."""
    source, target, T = make_sample_pair(0)
    half_turn = np.diag([-1.0, 1, -1, 1])
    twice = np.vstack([target.file_points, transform_points(half_turn, target.file_points)])
    rng = np.random.default_rng(seed)

    def moved(points: np.ndarray) -> np.ndarray:
        return points + rng.normal(0, 1e-6 * np.ptp(points, axis=0).max(), points.shape)

    answer = geomoe3d.register(moved(source.file_points), moved(target.file_points))
    assert answer.status == "ok"
    assert rotation_error_deg(answer.T_target_source, T) < 1
    answer = geomoe3d.register(moved(source.file_points), moved(twice), voxel_size=0.07)
    assert answer.status == "ambiguous"
    assert min(rotation_error_deg(answer.T_target_source, place) for place in (T, half_turn @ T)) < 1


@pytest.mark.parametrize(("name", "heard"), [("with the network:", True), ("without the network:", False)])
def test_the_formula_of_the_confidence_in_the_docs_has_its_coefficients(name: str, heard: bool) -> None:
    """To the last digit that is printed; after a new fit docs/concepts.md is changed too."""
    text = (Path(__file__).parents[1] / "docs" / "concepts.md").read_text()
    formula = " ".join(text[text.index(name) :].split("violation)")[0].split()).partition("sigmoid(")[2]
    added = [float(number) for number in re.findall(r"\+ ([\d.]+)\)", formula)]
    limits = expert().confidence
    assert added == [limits.added_overlap, limits.added_observability, limits.added_support]
    terms = re.sub(r"ln\([^)]*\)", "", formula)
    printed = [float(number.replace(" ", "")) for number in re.findall(r"[-+]? ?\d+\.\d+", terms)]
    fit = limits.fit(heard=heard, sensors_known=True)
    assert printed == pytest.approx([fit.offset, *fit.slopes], abs=0.00501)
    names = re.findall(r"ln\((\w+)", formula)
    assert names == ["surface_score", "lead", "overlap", "observability", "looseness", "support"]


def test_the_formula_of_the_margin_in_the_docs_has_its_coefficients() -> None:
    text = (Path(__file__).parents[1] / "docs" / "concepts.md").read_text()
    printed = re.search(r"after a second look: sigmoid\((\S+) \+ (\S+) logit \+ (\S+) m\)", text)
    assert printed is not None
    fit = expert().confidence.second_look
    assert [float(x) for x in printed.groups()] == pytest.approx(
        [fit.offset, fit.evidence, fit.margin], abs=0.00501
    )
    assert f"between {fit.least_margin} and {fit.most_margin:g}" in " ".join(text.split())
    twice = expert().repeat
    assert f"both agree: sigmoid({twice.offset} + {twice.slope} mean)" in text


def test_numbers_that_say_nothing_are_not_believed() -> None:
    found = Evidence(0.5, 0.5, 0.3, 0.0)
    assert confidence_score(found, 3.0, 0.05, replace(FIRM, looseness=np.nan)) == 0.0
    assert confidence_score(found, 3.0, 0.05, FIRM, margin=np.nan) == 0.0


@pytest.mark.parametrize(
    ("value", "limit", "said"), [(0.918, 0.95, "0.92"), (0.9496, 0.95, "0.94"), (0.9599, 0.96, "0.95")]
)
def test_a_confidence_is_said_as_on_top_and_never_as_a_limit_that_it_misses(value, limit, said):
    assert confidence.said_below(value, limit) == said
