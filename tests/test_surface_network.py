"""The surface network: its channels, numpy and torch, training, and that it is shown finished hypotheses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geomoe3d.clouds.pair import Pair
from geomoe3d.clouds.prepare import prepare
from geomoe3d.config import PreparationConfig, RegistrationConfig, load_config
from geomoe3d.data.sample import make_sample_pair
from geomoe3d.decision.selection import Selection
from geomoe3d.errors import CheckpointError
from geomoe3d.features.base import with_features
from geomoe3d.features.fpfh import FpfhDescriptor
from geomoe3d.features.learned import LearnedDescriptor
from geomoe3d.geometry.se3 import inverse, make_transform, motions_apart, rotation_error_deg
from geomoe3d.pipeline import Pipeline, resolved
from geomoe3d.registration import Registrar
from geomoe3d.runtime.timing import StageClock
from geomoe3d.scoring.base import Belief, PairScorer, Scorer
from geomoe3d.scoring.surface_channels import NUM_CHANNELS, NUM_POINTS, RAW, SurfaceChannels, channels_of
from geomoe3d.scoring.surface_network import (
    SURFACE_NETWORK,
    WEIGHTS,
    SurfaceNetworkScorer,
    load_tensors,
    logits,
)
from geomoe3d.training.surface_network import (
    Examples,
    SurfaceNetwork,
    read_examples,
    save,
    train,
    write_examples,
)
from geomoe3d.types import Correspondences, Hypothesis, PreparedCloud

VOXEL = 0.08
COLUMN = {name: k for k, name in enumerate(RAW)}


def paired(source: PreparedCloud, target: PreparedCloud, known: bool = True) -> Pair:
    rows = np.arange(10)
    matched = Correspondences.between(source, target, rows, rows)
    places = (source.viewpoint, target.viewpoint) if known else None
    return Pair(replace(matched, viewpoints=places), VOXEL, 2 * VOXEL, 0, source, target)


@pytest.fixture(scope="module")
def sample() -> tuple[Pair, np.ndarray]:
    """Two views of a furnished room, and the true transform in local coordinates."""
    source, target, T = make_sample_pair(3)
    clouds = [prepare(c, VOXEL, PreparationConfig(), viewpoint=-c.origin) for c in (source, target)]
    first, second = (with_features(c, LearnedDescriptor()) for c in clouds)
    return paired(first, second), T


def wrong(T: np.ndarray) -> np.ndarray:
    turn = make_transform(Rotation.from_rotvec([0, np.pi / 2, 0]).as_matrix(), np.array([0.5, 0.1, -0.3]))
    return T @ turn


def test_the_right_transform_lays_more_on_each_other_and_is_believed_over_others(sample):
    pair, T = sample
    raw = SurfaceChannels(pair)(np.array([T, wrong(T)]))
    assert raw.shape == (2, 2, NUM_POINTS, len(RAW))
    near = channels_of(raw)[..., 1].mean((1, 2))
    assert near[0] > 3 * near[1]
    hit = raw[0, ..., COLUMN["hit"]] > 0
    assert np.median(raw[0, ..., COLUMN["normal"]][hit]) > 0.9
    assert (raw[..., COLUMN["better_there"]] >= -1e-6).all()
    right, other = SurfaceNetworkScorer().about(pair)(np.array([T, wrong(T)]))
    assert right.verdict > 3 > 0 > other.verdict
    assert right.factor > 1 > other.factor


def test_a_point_in_front_of_what_the_other_sensor_saw_has_a_negative_margin(sample):
    pair, T = sample
    # Half way from the target's sensor to what it saw.
    nearer = T.copy()
    nearer[:3, 3] += 0.5 * (
        pair.clouds[1].viewpoint - (T[:3, :3] @ pair.clouds[0].points.T).T.mean(0) - T[:3, 3]
    )
    raw = SurfaceChannels(pair)(np.array([T, nearer]))[:, 0]
    seen = raw[..., COLUMN["seen"]] > 0
    through = ((raw[..., COLUMN["margin"]] < -2) & seen).sum(1) / seen.sum(1)
    assert through[0] < 0.05 < 0.3 < through[1]


def test_exchanging_the_clouds_exchanges_the_sides_and_leaves_the_verdict(sample):
    pair, T = sample
    back = paired(*pair.clouds[::-1])
    one, other = SurfaceChannels(pair)(T[None]), SurfaceChannels(back)(inverse(T)[None])
    np.testing.assert_allclose(one, other[:, ::-1], atol=2e-5)
    tensors = load_tensors(WEIGHTS)
    np.testing.assert_allclose(
        logits(tensors, channels_of(one)), logits(tensors, channels_of(other)), atol=1e-3
    )


def test_without_sensors_nothing_is_seen_and_normals_have_no_sign(sample):
    pair, T = sample
    raw = SurfaceChannels(paired(*pair.clouds, known=False))(T[None])
    for name in ("seen", "margin", "range"):
        assert (raw[..., COLUMN[name]] == 0).all()
    assert (raw[..., COLUMN["normal"]] >= 0).all()


def test_it_says_nothing_of_clouds_without_the_learned_descriptor(sample):
    pair, T = sample
    first, second = (with_features(cloud, FpfhDescriptor()) for cloud in pair.clouds)
    assert list(SurfaceNetworkScorer().about(paired(first, second))(T[None])) == []


def test_small_clouds_are_asked_about_all_their_points(sample):
    pair, T = sample
    few = np.arange(300)
    small = replace(
        pair.clouds[0], points=pair.clouds[0].points[few], normals=pair.clouds[0].normals[few],
        features=pair.clouds[0].features[few],
    )  # fmt: skip
    raw = SurfaceChannels(paired(small, pair.clouds[1]))(T[None])
    assert raw.shape[2] == NUM_POINTS
    assert np.isfinite(raw).all()


def examples(rng: np.random.Generator) -> Examples:
    """Four hypotheses; the right one has its points close by."""
    raw = rng.uniform(0, 1, (4, 2, NUM_POINTS, len(RAW))).astype(np.float32)
    raw[..., COLUMN["hit"]] = 1
    raw[0, ..., COLUMN["distance"]] *= 0.1
    raw[1:, ..., COLUMN["distance"]] += 1
    return Examples(raw, np.array([0.0, 1.0, 2.0, 0.4]), np.array([0.0, 40.0, 3.0, 15.0]))


def test_training_learns_which_is_right_and_numpy_says_what_torch_says(tmp_path: Path):
    rng = np.random.default_rng(0)
    write_examples(tmp_path / "one.npz", [examples(rng), examples(rng)])
    read = list(read_examples([tmp_path / "one.npz"]))
    assert [len(one.shift) for one in read] == [4, 4]
    *_, (step, steps, loss, network) = train(read, np.ones(2), epochs=60)
    assert step == steps == 30
    assert loss < 0.4
    save(network, tmp_path / "w.safetensors")
    seen = channels_of(read[0].channels.astype(np.float32))
    found = logits(load_tensors(tmp_path / "w.safetensors"), seen)
    assert found[0] > 0 > found[1:3].max()
    with torch.no_grad():
        expected = network.eval()(torch.from_numpy(seen)).numpy()
    np.testing.assert_allclose(found, expected, atol=0.05)  # weights are kept in half precision


def test_tensors_have_the_names_of_the_module():
    module = SurfaceNetwork(torch.zeros(NUM_CHANNELS), torch.ones(NUM_CHANNELS))
    assert {k: tuple(v.shape) for k, v in module.state_dict().items()} == {
        k: v.shape for k, v in load_tensors(WEIGHTS).items()
    }


def test_missing_and_foreign_weights_are_refused(tmp_path: Path):
    from safetensors.numpy import save_file

    with pytest.raises(CheckpointError, match="no weights of the surface network"):
        SurfaceNetworkScorer(str(tmp_path / "none.safetensors")).warm_up()
    save_file({"a": np.zeros(3)}, tmp_path / "other.safetensors")
    with pytest.raises(CheckpointError, match="holds no weights of the surface network"):
        SurfaceNetworkScorer(str(tmp_path / "other.safetensors")).warm_up()


def test_it_is_asked_in_the_second_look_alone_and_joins_the_identity():
    line = Pipeline(resolved(RegistrationConfig()))
    assert SURFACE_NETWORK not in line.scorers
    assert list(line.second_scorers) == [SURFACE_NETWORK]
    assert SURFACE_NETWORK in line.identity()["parts"]
    for without in ("second_look.scorers=[]", "second_look.descriptor=none", "scoring.scorers=[surfaces]"):
        assert Pipeline(resolved(load_config(None, [without]))).second_scorers == {}


def test_a_right_transform_that_was_proposed_badly_is_refined_before_the_costly_scorers_are_asked(sample):
    pair, T = sample
    line = Pipeline(resolved(RegistrationConfig()))
    off = T @ make_transform(Rotation.from_rotvec([0, 0.08, 0]).as_matrix(), np.array([0.1, 0.0, 0.05]))
    selection = Selection(
        pair, line.scorers, line.refiner.about(pair), line.config, StageClock(), line.second_scorers
    )
    selection.add([Hypothesis(wrong(T)), Hypothesis(off)])
    decision = selection.decide(4, 4)
    finished = [h for h in selection.hypotheses if h.is_refined]
    assert len(finished) == 2
    assert all("network" in h.asked for h in finished)
    assert decision.answer is not None
    assert decision.answer.is_refined
    shift, turn = motions_apart(T, decision.T_target_source, pair.clouds[0].points.mean(0))
    assert shift < 0.05
    assert turn < 2


class Contrary(Scorer):
    """Likes what lies far off, and the rest by a factor of ``other``."""

    def __init__(self, T: np.ndarray, other: float) -> None:
        self._T, self._other = T, other

    def about(self, pair: Pair) -> PairScorer:
        def say(transforms: np.ndarray) -> list[Belief]:
            shifts = [motions_apart(self._T, T, np.zeros(3))[0] for T in transforms]
            return [Belief(1.0 if shift > 5 else self._other) for shift in shifts]

        return say


BESIDE = np.array([20.0, 0.0, 0.0])


def with_its_copy_beside(cloud: PreparedCloud) -> PreparedCloud:
    """The cloud and the same again, 20 m away, seen by nobody."""
    return replace(
        cloud,
        points=np.vstack([cloud.points, cloud.points + BESIDE]),
        normals=np.vstack([cloud.normals, cloud.normals]),
        features=np.vstack([cloud.features, cloud.features]),
        scanned=False,
    )


class Fitted(Contrary):
    """As if the confidence had been fitted on its word."""

    has_margin = True


def test_scorers_of_the_second_look_choose_and_leave_score_and_lead_alone(sample):
    pair, T = sample
    line = Pipeline(resolved(load_config(None, ["scoring.scorers=[surfaces]"])))
    twice = with_its_copy_beside(pair.clouds[1])
    both = paired(pair.clouds[0], twice)
    beside = make_transform(np.eye(3), BESIDE) @ T

    def decided(choosing):
        selection = Selection(
            both, line.scorers, line.refiner.about(both), line.config, StageClock(), choosing
        )
        selection.add([Hypothesis(T), Hypothesis(beside)])
        return selection.decide(4, 4)

    alone = decided({})
    assert alone.judgement.status == "ambiguous" and alone.margin is None
    for other, status in ((0.5, "ambiguous"), (1e-6, "low_confidence")):
        chosen = decided({"contrary": Fitted(T, other)})
        assert motions_apart(T, chosen.T_target_source, np.zeros(3))[0] > 5
        assert set(chosen.answer.scores) == {"surfaces"}
        assert chosen.lead == pytest.approx(1 / alone.lead, rel=0.1)
        assert chosen.margin == pytest.approx(-np.log(other))
        assert chosen.judgement.status == status  # told apart only by one who prefers it by far
    chosen = decided({"contrary": Contrary(T, 1e-6)})  # on whom the confidence was not fitted
    assert motions_apart(T, chosen.T_target_source, np.zeros(3))[0] > 5
    assert chosen.margin is None and chosen.judgement.status == "ambiguous"


def test_an_answer_that_is_ok_by_little_is_checked(monkeypatch):
    """By the surface network where it is below the limit; one that it denies is looked at again."""
    source, target, T = make_sample_pair(seed=0)

    def answer(*settings):
        registrar = Registrar(load_config(None, ["voxel_size=0.08", "second_look.repeat_below=0", *settings]))
        return registrar.register(source.file_points, target.file_points)

    doubting = "expert.confidence.plain_matches=1000000"
    never, always = (answer(f"second_look.checked_below={least}", doubting) for least in (0, 1))
    assert never.status == always.status == "ok"
    assert "margin" not in never.evidence and always.evidence["margin"] > 1
    assert never.num_correspondences == always.num_correspondences  # the second descriptor proposed nothing
    plain = answer("second_look.checked_below=1")  # no rival, and many matches agree
    assert "margin" not in plain.evidence
    own = answer("second_look.checked_below=1", doubting, "second_look.scorers=[surfaces]")
    assert own.confidence == never.confidence and "margin" not in own.evidence

    def denies(self, pair):
        return lambda transforms: [Belief(np.exp(2.0 if k else -2.0)) for k in range(len(transforms))]

    monkeypatch.setattr(SurfaceNetworkScorer, "about", denies)
    denied = answer("second_look.checked_below=1", doubting)
    assert denied.num_correspondences > always.num_correspondences
    assert rotation_error_deg(denied.T_target_source, T) < 2
