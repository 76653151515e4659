"""A network that scores transforms, and bare correspondences that it scores: the same folded, padded, threaded."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from corner_scenes import AT_ZERO, VOXEL, scene
from judged_motions import network, turned

from geomoe3d.clouds.pair import Pair
from geomoe3d.config import EstimatorConfig, RegistrationConfig, build_config
from geomoe3d.correspondence_registration import CorrespondenceRegistrar, likeliest_rows
from geomoe3d.errors import CheckpointError
from geomoe3d.estimators.consensus import ConsensusEstimator
from geomoe3d.filters.geomoe import GeoMoEFilter
from geomoe3d.geometry.se3 import make_transform
from geomoe3d.networks.architecture import NetworkConfig
from geomoe3d.networks.folded import FoldedGeoMoE
from geomoe3d.networks.geomoe import GeoMoE
from geomoe3d.networks.inputs import collate, under_motions
from geomoe3d.networks.motion_inputs import MotionInputs
from geomoe3d.networks.motion_judge import MotionJudge
from geomoe3d.pipeline import Pipeline
from geomoe3d.runtime.timing import StageClock
from geomoe3d.scoring.network import NetworkScorer, opinion_of
from geomoe3d.types import Correspondences, FloatArray, Hypothesis

pytestmark = pytest.mark.usefixtures("one_thread")


class Given(NetworkScorer):
    """A network that a test has made."""

    def __init__(self, judge: MotionJudge) -> None:
        self.__dict__["_judge"] = judge


@dataclass(frozen=True)
class Weighed:
    """Hypotheses that a network has looked at, those it was not asked about, and the weights under the best."""

    hypotheses: list[Hypothesis]
    weights: FloatArray
    logits: FloatArray | None

    @property
    def verdicts(self) -> list[float]:
        found = [opinion_of(h) for h in self.hypotheses]
        return [opinion.verdict for opinion in found if opinion is not None]


def weigh(
    given: Correspondences,
    estimator: EstimatorConfig | None = None,
    convinced: float = 3.0,
    kept: float = 0.5,
) -> Weighed:
    """What bare correspondences come to with an untrained network."""
    config = RegistrationConfig(
        estimator=estimator or EstimatorConfig(),
        scoring={"scorers": ["surfaces"]},
        expert={"correspondences": {"convinced": convinced}, "keypoint_alignment": {"kept_agreement": kept}},
    )
    pipeline = Pipeline(config)
    pipeline.scorers["network"] = Given(MotionJudge(FoldedGeoMoE.of(network())))
    threshold = config.estimator.inlier_threshold * VOXEL
    found, output = CorrespondenceRegistrar.of(pipeline).hypotheses(
        Pair(given, VOXEL, threshold), StageClock()
    )
    return Weighed(found, output.weights, output.logits)


@pytest.mark.parametrize("changes", [{}, {"prior": "none"}, {"feed_forward": "dense"}])
def test_folded_network_gives_the_same_verdict(changes: dict[str, object]) -> None:
    model = network(**changes)
    rows, T = scene(1)
    nowhere = make_transform(np.eye(3), np.full(3, 100.0))  # brings nothing together: all rejected at first
    given = MotionInputs(rows, AT_ZERO, VOXEL, model.config)
    motions = np.stack([T, np.eye(4), nowhere])
    batch = collate(under_motions(given, motions))
    with torch.no_grad():
        plain = model(batch.coordinates, batch.channels, batch.neighbors, insight=True)
    assert plain.verdict is not None
    folded, channels = FoldedGeoMoE.of(model), given.channels(motions)
    several = folded.under_motions(given.coordinates, channels, given.neighbors)
    for k, found in enumerate(several):
        alone = folded(given.coordinates, channels[k], given.neighbors)
        for one in (found, alone):
            assert one.verdict == pytest.approx(float(plain.verdict[k]), abs=1e-5, rel=1e-5)
            np.testing.assert_allclose(one.logits, plain.logits[:, k], atol=1e-5, rtol=1e-5)
            assert (one.sub_field == plain.insights[-1].sub_field[k].numpy()).mean() > 0.99


def test_padding_changes_no_verdict() -> None:
    model = network()
    short, long = scene(1, 200), scene(2, 300)
    inputs = [
        under_motions(MotionInputs(rows, AT_ZERO, VOXEL, model.config), T[None])[0]
        for rows, T in (short, long)
    ]
    both, alone = collate(inputs), collate(inputs[:1])
    assert both.mask is not None
    with torch.no_grad():
        padded = model(both.coordinates, both.channels, both.neighbors, both.mask).verdict
        plain = model(alone.coordinates, alone.channels, alone.neighbors).verdict
    torch.testing.assert_close(padded[:1], plain, atol=1e-4, rtol=1e-4)


def test_a_network_scores_what_consensus_proposes() -> None:
    rows, _ = scene(4)
    found = weigh(Correspondences(rows, viewpoints=AT_ZERO))
    assert found.hypotheses
    assert found.verdicts == sorted(found.verdicts, reverse=True)
    assert found.weights.shape == (len(rows),)
    assert found.logits is not None
    again = weigh(Correspondences(rows, viewpoints=AT_ZERO))
    np.testing.assert_array_equal(again.weights, found.weights)


def test_each_network_has_its_own_filter() -> None:
    with pytest.raises(CheckpointError, match=r"scoring\.weights"):
        GeoMoEFilter(network())
    with pytest.raises(CheckpointError, match=r"filter\.weights"):
        MotionJudge(
            FoldedGeoMoE.of(
                GeoMoE(build_config(NetworkConfig, {"num_layers": 1, "width": 8, "num_heads": 2}))
            )
        )


def test_mutual_rows_come_first() -> None:
    rows, _ = scene(4)
    mutual = np.arange(len(rows)) % 3 == 0
    few = likeliest_rows(Correspondences(rows, mutual=mutual), 120, VOXEL, 0)
    assert few.mutual is not None
    assert len(few) == 120
    assert few.mutual.sum() == mutual.sum()
    assert likeliest_rows(few, 120, VOXEL, 0) is few


def test_more_rows_than_are_scored_are_all_weighed_wherever_they_stand() -> None:
    rows, _ = scene(4, count=1500)
    rows = rows[np.argsort(rows[:, 0])]
    few = likeliest_rows(Correspondences(rows), 1000, VOXEL, 0)
    assert few.source[:, 0].max() > 0.9 * rows[:, 0].max()  # spread, not the first thousand
    found = weigh(Correspondences(rows))
    assert found.hypotheses
    assert found.weights.shape == (1500,)
    assert found.logits is not None
    assert np.isfinite(found.logits).all()


@pytest.mark.parametrize(("convinced", "looked_at"), [(-100.0, 2), (100.0, 6)])
def test_a_network_stops_where_it_has_seen_enough(convinced: float, looked_at: int) -> None:
    found = weigh(Correspondences(scene(3)[0], viewpoints=AT_ZERO), convinced=convinced)
    assert len(found.verdicts) == looked_at < len(found.hypotheses)
    assert found.verdicts == sorted(found.verdicts, reverse=True)


@pytest.mark.parametrize(
    ("convinced", "num_aligned", "moved"), [(-100.0, 1, {1}), (-100.0, 6, {2}), (100.0, 6, {3, 4, 5, 6})]
)
def test_what_the_network_looks_at_is_drawn_closer(
    convinced: float, num_aligned: int, moved: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    # The same proposals whether or not they are drawn closer.
    monkeypatch.setattr(ConsensusEstimator, "with_less_effort", lambda self: self)
    rows, _ = scene(3, share=0.1)

    def found(count: int, given: Correspondences) -> list[Hypothesis]:
        return weigh(
            given, EstimatorConfig(num_aligned=count), convinced, kept=0.0
        ).hypotheses  # wrong ones slide

    def motions(hypotheses: list[Hypothesis]) -> set[bytes]:
        return {h.T_target_source.tobytes() for h in hypotheses}

    bare = Correspondences(rows, viewpoints=AT_ZERO)
    drawn, plain = found(num_aligned, bare), found(0, bare)
    assert len(drawn) == len(plain)
    assert len(motions(drawn) - motions(plain)) in moved  # those that would slide far away stay
    with_clouds = replace(bare, normals=(np.zeros((len(rows), 3)), np.zeros((len(rows), 3))))
    assert motions(found(num_aligned, with_clouds)) == motions(found(0, with_clouds))


@pytest.mark.parametrize("threshold", [2.0, 3.0])
def test_what_is_scored_is_what_is_given(threshold: float) -> None:
    """Whether or not the surfaces, in inlier thresholds, are those that the network wants."""
    rows, _ = scene(3, share=0.1)
    given = Correspondences(rows, viewpoints=AT_ZERO)
    found = weigh(given, EstimatorConfig(inlier_threshold=threshold))
    looked_at = found.hypotheses[: len(found.verdicts)]
    judge = MotionJudge(FoldedGeoMoE.of(network()))
    again = judge.about(given, voxel_size=VOXEL)(np.array([h.T_target_source for h in looked_at]))
    assert len(looked_at) >= 2
    assert found.verdicts == pytest.approx([j.verdict for j in again], abs=1e-4)


def test_bare_correspondences_give_the_same_bytes_for_any_number_of_threads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given = Correspondences(scene(3, count=600, share=0.1)[0], viewpoints=AT_ZERO)
    found = []
    for threads in ("1", "2", "5"):
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
        output = weigh(given)
        found.append((output.weights.tobytes(), [h.T_target_source.tobytes() for h in output.hypotheses]))
    assert found[0] == found[1] == found[2]


def test_verdicts_are_the_same_for_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    rows, T = scene(3)
    motions = np.stack([T @ turned(k) for k in range(0, 180, 25)])
    found = []
    for threads in ("1", "2", "5"):
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
        found.append(
            [
                j.verdict
                for j in MotionJudge(FoldedGeoMoE.of(network())).about(
                    Correspondences(rows), voxel_size=VOXEL
                )(motions)
            ]
        )
    assert found[0] == found[1] == found[2]


def test_without_any_hypothesis_there_is_no_weight() -> None:
    line = np.linspace(0, 1, 30)[:, None] * np.ones(6)
    found = weigh(Correspondences(line))
    assert found.hypotheses == []
    assert not found.weights.any()
    assert not weigh(Correspondences(np.zeros((0, 6)))).weights.any()


def test_rows_that_are_not_finite_weigh_nothing() -> None:
    rows, T = scene(4)
    rows[5, 2] = np.nan
    rows = np.vstack([np.full((1000, 6), np.nan), rows])
    (judged,) = MotionJudge(FoldedGeoMoE.of(network())).about(Correspondences(rows), voxel_size=VOXEL)(
        T[None]
    )
    assert judged.output.weights.shape == (len(rows),)
    assert not judged.output.weights[:1000].any()
    assert judged.output.weights[1005] == 0
    assert judged.output.weights.any()
    assert judged.output.logits is not None
    assert np.isfinite(judged.output.logits[1006:]).all()
