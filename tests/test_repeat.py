"""A doubtful answer is sought once more on a shifted grid, and both answers decide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geomoe3d.clouds.prepare import prepare
from geomoe3d.config import PreparationConfig, expert, load_config
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.decision.answer import Decision
from geomoe3d.decision.confidence import Judgement, prior_logit
from geomoe3d.decision.information import Information
from geomoe3d.decision.repeat import joined
from geomoe3d.geometry.draws import OFF_ROUND
from geomoe3d.line import Line
from geomoe3d.pipeline import Pipeline, resolved
from geomoe3d.registration import Registrar
from geomoe3d.scoring.surfaces import SURFACES, Evidence
from geomoe3d.types import Hypothesis, PointCloud

NOTHING = Information(np.zeros((6, 6)), np.zeros(3), 0.1, 100)
UNSPECIFIC = "confidence is low"


def decision(confidence: float, x: float = 0.0, status: str = "low_confidence", cause: str | None = None):
    T = np.eye(4)
    T[0, 3] = x
    answer = Hypothesis(T, scores={SURFACES: Evidence(0.5, 0.5, 0.3, 0.0)})
    reasons = () if status == "ok" else (cause or UNSPECIFIC,)
    unspecific = None if status == "ok" or cause else UNSPECIFIC
    return Decision(answer, None, 3.0, NOTHING, Judgement(status, reasons, confidence, unspecific))


def odds(confidence: float) -> float:
    return confidence / (1 - confidence)


def test_two_answers_that_agree_are_as_sure_as_the_mean_of_their_logits() -> None:
    found, taken = joined(decision(0.9), decision(0.98, status="ok"), True, 0.95)
    fit = expert().repeat
    expected = fit.offset + fit.slope * np.log(odds(0.9) * odds(0.98)) / 2
    assert taken and np.log(odds(found.judgement.confidence)) == pytest.approx(expected)
    assert found.repeat is not None and (found.repeat.first, found.repeat.second) == (0.9, 0.98)


def test_a_prior_is_counted_once() -> None:
    fit = expert().repeat
    for prior in (0.2, 0.99):
        added = prior_logit(prior)
        both = [1 / (1 + np.exp(-(strength + added))) for strength in (1.5, 2.5)]
        agreed, _ = joined(decision(both[0]), decision(both[1]), True, 0.95, prior)
        expected = fit.offset + fit.slope * 2.0 + added
        assert np.log(odds(agreed.judgement.confidence)) == pytest.approx(expected)
        low = [1 / (1 + np.exp(-(strength + added))) for strength in (-4.0, -5.0)]
        differing, _ = joined(decision(low[0]), decision(low[1], 5.0), False, 0.95, prior)
        for_that_mix = np.exp([-4.0 + added, -5.0 + added])
        assert differing.judgement.confidence == pytest.approx(for_that_mix[0] / (1 + for_that_mix.sum()))
    assert prior_logit(None) == 0 and prior_logit(expert().confidence.fitted_prior) == 0


def test_two_that_agree_well_enough_are_ok_and_say_no_more_that_one_was_unsure() -> None:
    found, taken = joined(decision(0.97), decision(0.94), True, 0.95)
    assert not taken and found.judgement.status == "ok" and found.judgement.reasons == ()
    low, _ = joined(decision(0.9), decision(0.7), True, 0.95)
    assert low.judgement.status == "low_confidence"
    assert "registered on two grids, the answers agree" in low.judgement.reasons[0]


def test_of_two_that_differ_the_surer_one_is_taken_and_the_other_speaks_against_it() -> None:
    found, taken = joined(decision(0.5), decision(0.97, 5.0, "ok"), False, 0.95)
    assert taken and found.judgement.status == "low_confidence"
    assert found.judgement.confidence == 0.79  # at most, whatever the odds say
    assert "the answers are clearly different (see the alternative)" in found.judgement.reasons[0]
    assert found.T_target_source[0, 3] == 5.0
    assert found.alternative is not None and found.alternative.T_target_source[0, 3] == 0.0
    assert found.lead == pytest.approx(1.0)  # both have the same evidence
    unsure, _ = joined(decision(0.5), decision(0.6, 5.0), False, 0.95)
    assert unsure.judgement.confidence == pytest.approx(odds(0.6) / (1 + odds(0.6) + 1.0))


@pytest.mark.parametrize("status", ["ambiguous", "low_confidence"])
def test_a_cause_that_was_named_stays(status: str) -> None:
    named = decision(0.79, status=status, cause="another transform fits as well")
    found, taken = joined(named, decision(0.75), True, 0.5)
    assert not taken and found.judgement.status == status
    assert found.judgement.reasons == ("another transform fits as well",)
    assert found.judgement.confidence <= 0.79
    sure = decision(0.99, status="ok")
    doubted, taken = joined(named, sure, True, 0.5)  # the same transform, of which one look knew a rival
    assert taken and doubted.judgement.status == status and doubted.judgement.confidence <= 0.79
    rival = decision(0.5, 2.0).answer
    told, _ = joined(replace(named, alternative=rival, lead=1.1), sure, True, 0.5)
    assert told.alternative is rival and told.lead == 1.1  # of which the reason speaks
    sliding = decision(0.2, status=status, cause="the shared surface lets the source slide")
    assert joined(sliding, sure, True, 0.5)[0].judgement.confidence == 0.2
    other, _ = joined(named, replace(sure, answer=decision(0.99, 5.0).answer), False, 0.5)
    assert other.judgement.status == "low_confidence"  # what comes out only once is never ok


def test_a_rival_that_a_reason_speaks_of_stays_the_alternative_of_an_answer_that_differs() -> None:
    rival = decision(0.5, 2.0).answer
    named = replace(
        decision(0.79, 0.0, "ambiguous", "another transform fits as well"), alternative=rival, lead=1.1
    )
    found, taken = joined(named, decision(0.3, 5.0), False, 0.95)
    assert not taken and found.alternative is rival and found.lead == 1.1
    assert found.judgement.reasons == (
        "another transform fits as well",
        "registered on two grids, the answers are clearly different",
    )


def test_a_limit_that_is_missed_by_little_is_not_said_to_be_below_itself() -> None:
    found, _ = joined(decision(0.896), decision(0.896), True, 0.97)
    assert 0.965 < found.judgement.confidence < 0.97
    assert "confidence 0.96 is below 0.97" in found.judgement.reasons[0]


def test_an_answer_that_does_not_come_out_again_is_not_ok(monkeypatch) -> None:
    source, target, _ = make_sample_pair(seed=0)
    registrar = Registrar(load_config(None, ["voxel_size=0.05", "second_look.repeat_below=1.0"]))
    found = Line._best

    def nothing_else(self, clouds, prepared, places, first):
        look = found(self, clouds, prepared, places, first)
        again = self.pipeline.config.preparation.grid_shift > 0
        return look._replace(decision=Decision.failed("nothing")) if again else look

    monkeypatch.setattr(Line, "_best", nothing_else)
    answer = registrar.register(source, target)
    assert answer.status == "low_confidence" and answer.has_transform
    assert answer.reasons[0] == "registered once more on a shifted grid, no transform was found"


def test_points_of_a_shifted_grid_are_the_means_of_other_voxels() -> None:
    points = np.random.default_rng(0).uniform(0, 1, (20_000, 3)) * [1.0, 1.0, 0.05]
    usual, other = (
        prepare(PointCloud(points), 0.1, PreparationConfig(grid_shift=shift), viewpoint=np.array([0, 0, 3.0]))
        for shift in (0.0, 0.5)
    )
    for cloud, shift in ((usual, 0.0), (other, 0.5)):
        inside = np.mod(cloud.points / 0.1 - OFF_ROUND + shift, 1.0)[:, :2]
        assert abs(np.median(inside) - 0.5) < 0.05
        assert np.abs(cloud.points[:, 2] - 0.025).max() < 0.03  # where the surface lies
    assert np.abs(np.median(np.mod(other.points / 0.1 - OFF_ROUND, 1.0)[:, 0]) - 0.5) > 0.3 or len(
        usual
    ) != len(other)


@pytest.fixture
def shifts(monkeypatch):
    seen = []
    original = Pipeline.prepare_both

    def spy(self, *given, **more):
        seen.append((self.config.preparation.grid_shift, self.config.seed))
        return original(self, *given, **more)

    monkeypatch.setattr(Pipeline, "prepare_both", spy)
    return seen


def test_a_sure_answer_is_had_once_and_another_twice_unless_that_is_not_wanted(shifts) -> None:
    source, target, truth = make_sample_pair(seed=0)
    once = Registrar(load_config(None, ["voxel_size=0.05"])).register(source, target)
    assert once.confidence >= 0.97 and shifts == [(0.0, 0)] and "answers_agree" not in once.evidence
    shifts.clear()
    step = expert().repeat
    twice = Registrar(load_config(None, ["voxel_size=0.05", "second_look.repeat_below=1.0"]))
    found = twice.register(source, target)
    assert shifts == [(0.0, 0), (step.shift, step.seed_step)]
    assert found.ok and found.evidence["answers_agree"] == 1.0
    assert found.evidence["confidence_first"] == pytest.approx(once.confidence)
    assert found.evidence["confidence_second"] != found.evidence["confidence_first"]
    assert np.abs(found.T_target_source - truth).max() < 0.05
    shifts.clear()
    never = load_config(None, ["voxel_size=0.05", "second_look.repeat_below=0", "decision.min_confidence=1"])
    assert Registrar(never).register(source, target).status == "low_confidence" and len(shifts) == 1


def test_exchanged_it_is_the_same_answer() -> None:
    source, target, _ = make_sample_pair(seed=0)
    registrar = Registrar(load_config(None, ["voxel_size=0.05", "second_look.repeat_below=1.0"]))
    there, back = registrar.register(source, target), registrar.register(target, source)
    np.testing.assert_allclose(there.T_target_source @ back.T_target_source, np.eye(4), atol=1e-9)
    assert there.confidence == back.confidence


def test_another_grid_is_another_identity_and_leaves_the_first_as_it_was() -> None:
    pipeline = Pipeline(resolved(None))
    other = pipeline.on_another_grid()
    assert pipeline.config.preparation.grid_shift == 0.0 != other.config.preparation.grid_shift
    again = other.on_another_grid()
    assert again.config.preparation.grid_shift == pytest.approx(0.0)
