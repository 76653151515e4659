"""Second looks, the choice among lots of hypotheses, and the single thread they run on."""

from __future__ import annotations

import threading
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomoe3d.clouds.pair import Pair
from geomoe3d.clouds.prepare import prepare
from geomoe3d.config import RegistrationConfig, load_config
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.decision.distinct import distinct
from geomoe3d.decision.selection import Selection
from geomoe3d.features.base import with_features
from geomoe3d.features.fpfh import FpfhDescriptor
from geomoe3d.geometry.se3 import make_transform, rotation_error_deg
from geomoe3d.matching.nearest import match
from geomoe3d.networks.motion_judge import Judged
from geomoe3d.refinement.base import refiner
from geomoe3d.runtime.threads import single_blas_thread
from geomoe3d.runtime.timing import StageClock
from geomoe3d.scoring.base import Scorer
from geomoe3d.scoring.network import NetworkScorer, Opinion, opinion_of
from geomoe3d.scoring.surfaces import SurfaceScorer
from geomoe3d.types import FilterOutput, Hypothesis

VOXEL = 0.05
FPFH = FpfhDescriptor()


@pytest.fixture(scope="module")
def pair():
    config = RegistrationConfig().preparation
    source, target, T = make_sample_pair(seed=0)
    clouds = tuple(
        with_features(prepare(c, VOXEL, config, viewpoint=-c.origin), FPFH) for c in (source, target)
    )
    return clouds, T


def selection(pair, *assignments: str, network: Scorer | None = None) -> Selection:
    config = load_config(None, list(assignments))
    seen = Pair(match(*pair[0], config.matching), VOXEL, 2 * VOXEL, 0, *pair[0])
    scorers: dict[str, Scorer] = {"surfaces": SurfaceScorer()}
    if network is not None:
        scorers["network"] = network
    if config.scoring.scorers == ():
        scorers = {}
    return Selection(seen, scorers, refiner.make(config.refinement).about(seen), config, StageClock())


def off(T, degrees: float, shift: float) -> Hypothesis:
    turn = make_transform(Rotation.from_euler("z", degrees, degrees=True).as_matrix(), np.full(3, shift))
    return Hypothesis(turn @ T, 1.0, 10)


def test_the_clouds_choose_whatever_the_order_of_the_lots(pair):
    right, wrong = off(pair[1], 0.5, 0.01), off(pair[1], 90, 1.0)
    for lots in ([[wrong], [right]], [[right], [wrong]], [[wrong, right]]):
        asked = selection(pair)
        for lot in lots:
            asked.add(lot)
        findings = asked.decide()
        assert rotation_error_deg(findings.T_target_source, pair[1]) < 1
        assert findings.judgement.status == "ok"


def test_refining_several_before_the_choice_saves_one_that_lay_off(pair):
    """Three hypotheses, the right one too far off to look best; refined, it is."""
    asked = selection(pair)
    asked.add([off(pair[1], 90, 0.3), off(pair[1], 180, 0.2), off(pair[1], 4, 0.06)])
    assert rotation_error_deg(asked.decide(3).T_target_source, pair[1]) < 1


def test_what_refines_to_the_answer_is_no_rival(pair):
    """A motion that was proposed 18 degrees off the answer leads to it: how well it scores says nothing."""
    near, far = off(pair[1], 18, 0.02), off(pair[1], 90, 0.3)
    asked = selection(pair)
    asked.add([off(pair[1], 0.3, 0.0), near, far])
    found = asked.decide()
    assert near.score > far.score
    assert found.alternative in (far, far.refined)
    alone = selection(pair)
    alone.add([off(pair[1], 0.3, 0.0), off(pair[1], 18, 0.02)])
    assert alone.decide().alternative is None


def test_without_verification_the_first_of_the_first_lot_is_the_answer(pair):
    asked = selection(pair, "scoring.scorers=[]", "refinement.name=none")
    asked.add([off(pair[1], 90, 1.0), off(pair[1], 0, 0.0)])
    asked.add([off(pair[1], 0, 0.0)])
    assert rotation_error_deg(asked.decide().T_target_source, pair[1]) == pytest.approx(90)


class Believer(NetworkScorer):
    """A network that believes in transforms close to the given ones and in no other."""

    def __init__(self, liked, shown) -> None:
        self._liked, self._shown = liked, shown

    def about(self, pair):
        def say(transforms):
            self._shown.extend(transforms)
            return [
                Opinion(verdict, Judged(verdict, partial(FilterOutput, np.full(3, k + 1.0))))
                for k, verdict in enumerate(map(self._verdict, transforms))
            ]

        return say

    def _verdict(self, T) -> float:
        return 6.0 if any(np.abs(T - x).max() < 0.1 for x in self._liked) else -6.0


def opinions(*liked: np.ndarray):
    """Such a network, and what it was shown."""
    shown: list[np.ndarray] = []
    return Believer(liked, shown), shown


def with_network(pair, network, *assignments: str) -> Selection:
    return selection(pair, *assignments, network=network)


def verdict_of(decision) -> float | None:
    opinion = opinion_of(decision.answer)
    return None if opinion is None else opinion.verdict


def test_a_network_turns_the_choice_where_the_clouds_waver(pair):
    right, near = off(pair[1], 0.5, 0.01), off(pair[1], 20, 0.0)
    plain = selection(pair, "refinement.name=none")
    plain.add([right, near])
    assert rotation_error_deg(plain.decide().T_target_source, pair[1]) < 1
    network, shown = opinions(near.T_target_source)
    asked = with_network(pair, network, "refinement.name=none")
    asked.add([right, near])
    findings = asked.decide()
    assert len(shown) == 2
    assert rotation_error_deg(findings.T_target_source, pair[1]) == pytest.approx(20, abs=0.1)
    assert verdict_of(findings) == 6.0
    np.testing.assert_array_equal(opinion_of(findings.answer).output.weights, [2.0, 2.0, 2.0])


def test_a_network_is_shown_a_few_distinct_motions_once(pair):
    motions = [off(pair[1], angle, 0.0) for angle in (0, 1, 40, 80, 120, 160)]
    network, shown = opinions(motions[0].T_target_source)
    given = {h.T_target_source.tobytes() for h in motions}
    asked = with_network(pair, network)
    asked.add(motions)
    asked.decide(1, 2)
    assert len(shown) == 3  # two hypotheses, and the better one again once it is refined
    assert sum(m.tobytes() in given for m in shown) == 2
    findings = asked.decide(3, 4)
    assert len({m.tobytes() for m in shown}) == len(shown)
    assert not any(m.tobytes() in given for m in shown[3:5])  # several are refined first
    assert rotation_error_deg(findings.T_target_source, pair[1]) < 1


class Silent(NetworkScorer):
    """A network that must not be asked."""

    def about(self, pair):
        """See `Scorer`."""
        raise RuntimeError("asked")


def test_what_correspondences_and_clouds_both_settle_is_shown_to_no_network(pair):
    right, wrong = off(pair[1], 0.5, 0.01), off(pair[1], 90, 1.0)
    right.settled = True
    asked = selection(pair, network=Silent())
    asked.add([right, wrong])
    findings = asked.decide()
    assert rotation_error_deg(findings.T_target_source, pair[1]) < 1
    assert findings.judgement.status == "ok"
    assert verdict_of(findings) == NetworkScorer().granted().verdict > 0 > opinion_of(wrong).verdict
    liked, settled = off(pair[1], 0.5, 0.01), off(pair[1], 90, 1.0)
    settled.settled = True  # but the clouds like another one
    asked = selection(pair, network=Silent())
    asked.add([liked, settled])
    with pytest.raises(RuntimeError, match="asked"):
        asked.decide()


def test_the_verdict_is_on_the_refined_motion(pair):
    """A start 8 degrees off, which the network doubts; refined it is as good as the truth, which it likes."""
    network, _ = opinions(pair[1])
    asked = with_network(pair, network)
    asked.add([off(pair[1], 8, 0.05)])
    findings = asked.decide()
    assert verdict_of(findings) == 6.0
    assert rotation_error_deg(findings.T_target_source, pair[1]) < 1
    plain = with_network(pair, network, "refinement.name=none")
    plain.add([off(pair[1], 8, 0.05)])
    assert verdict_of(plain.decide()) == -6.0


def test_without_verification_no_network_is_asked(pair):
    network, shown = opinions()
    asked = with_network(pair, network, "scoring.scorers=[]")
    asked.add([off(pair[1], 0, 0.0)])
    assert verdict_of(asked.decide()) is None
    assert not shown


def test_nothing_considered_is_a_failure_and_not_identity(pair):
    findings = selection(pair).decide(3)
    assert findings.judgement.status == "failed"
    assert np.isnan(findings.T_target_source).all()


def test_distinct_motions_are_told_apart(pair):
    motions = [off(pair[1], 0, 0), off(pair[1], 5, 0.05), off(pair[1], 40, 0), off(pair[1], 42, 0)]
    found = distinct(motions, pair[0][0], 6 * VOXEL, 3)
    assert [id(h) for h in found] == [id(motions[0]), id(motions[2])]
    assert len(distinct(motions, pair[0][0], 6 * VOXEL, 1)) == 1


def blas_threads() -> set[int]:
    import scipy.linalg  # noqa: F401 - brings its own BLAS
    from threadpoolctl import threadpool_info

    return {entry["num_threads"] for entry in threadpool_info() if entry["user_api"] == "blas"}


def test_one_thread_inside_and_what_was_set_before_after_the_last_one_out():
    from threadpoolctl import threadpool_limits

    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        entered, leave = threading.Event(), threading.Event()

        def other() -> None:
            with single_blas_thread():
                entered.set()
                leave.wait(10)

        thread = threading.Thread(target=other)
        with single_blas_thread():
            thread.start()
            assert entered.wait(10)
            assert blas_threads() == {1}
        assert blas_threads() == {1}  # the other is still inside
        leave.set()
        thread.join()
        assert blas_threads() == before
        with pytest.raises(KeyError), single_blas_thread():
            raise KeyError
        assert blas_threads() == before
