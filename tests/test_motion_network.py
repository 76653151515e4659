"""A network that judges motions: its channels, its data, its loss, and its place as a filter."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geomoe3d.clouds.viewpoint import believed_viewpoints
from geomoe3d.config import ConfigError, EstimatorConfig, FilterConfig, build_config
from geomoe3d.data.shards import DescribedScene
from geomoe3d.data.shards import write_shard as write_described
from geomoe3d.errors import CheckpointError, FormatError, InputError, OutputError
from geomoe3d.estimators.consensus import ConsensusEstimator
from geomoe3d.estimators.proposals import propose
from geomoe3d.filters.aligned import CHANNELS, AlignedChannels
from geomoe3d.filters.architecture import CHANNEL_WIDTHS, NetworkConfig
from geomoe3d.filters.base import resolve_filter
from geomoe3d.filters.folded import FoldedGeoMoE
from geomoe3d.filters.geomoe import PRIOR_KERNEL, GeoMoE
from geomoe3d.filters.geomoe_filter import GeoMoEFilter
from geomoe3d.filters.inputs import MotionInputs, collate, pair_input
from geomoe3d.filters.motion_judge import MotionJudge, likeliest_rows
from geomoe3d.filters.one_thread import single_torch_thread
from geomoe3d.geometry.se3 import make_transform, rotation_error_deg, transform_points
from geomoe3d.training import motions as motions_module
from geomoe3d.training.batches import choose_motions, make_batch, make_sample
from geomoe3d.training.config import TrainConfig, load_train_config
from geomoe3d.training.losses import verdict_loss
from geomoe3d.training.measures import best_of_pair, evaluate
from geomoe3d.training.motions import NUM_MOTIONS, propose_motions, with_motions
from geomoe3d.training.pairs import ShardFolder, TrainingPair, write_shard
from geomoe3d.types import Correspondences, FloatArray

VOXEL = 0.05
SMALL: dict[str, Any] = {
    "num_layers": 2, "width": 16, "num_sub_fields": 6, "num_heads": 2, "expert_width": 4,
    "motion_form": "none", "embedding_norm": False, "extra_channels": ("aligned",), "knn_space": "source",
}  # fmt: skip


pytestmark = pytest.mark.usefixtures("one_thread")


def random_motion(rng: np.random.Generator) -> FloatArray:
    return make_transform(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-2, 2, 3))


def corner(rng: np.random.Generator, count: int) -> FloatArray:
    """Points on a floor and two walls, seen from the sensor at zero in front of them."""
    u, v = rng.uniform(-1.5, 1.5, (2, count))
    side = rng.integers(3, size=count)
    floor = np.stack([u, np.full(count, -1.0), v + 3], 1)
    back = np.stack([u, v + 0.5, np.full(count, 4.5)], 1)
    left = np.stack([np.full(count, -1.5), v + 0.5, u + 3], 1)
    return np.where((side == 0)[:, None], floor, np.where((side == 1)[:, None], back, left))


def scene(seed: int = 0, count: int = 300, share: float = 0.4) -> tuple[FloatArray, FloatArray]:
    """Correspondences (N, 6) of one corner seen twice, the first ``share`` true, and the true motion."""
    rng = np.random.default_rng(seed)
    source = corner(rng, count)
    T = make_transform(Rotation.from_rotvec([0.05, 0.3, -0.1]).as_matrix(), np.array([0.3, -0.1, 0.2]))
    target = transform_points(T, corner(rng, count))
    right = np.arange(count) < share * count
    target[right] = transform_points(T, source[right]) + rng.normal(0, 0.01, (int(right.sum()), 3))
    return np.hstack([source, target]), T


AT_ZERO = (np.zeros(3), np.zeros(3))


def aligned(rows: FloatArray, motions: FloatArray, views: Any = AT_ZERO) -> FloatArray:
    channels = AlignedChannels(rows, views, 2 * VOXEL)
    return channels(motions[:, :3, :3], motions[:, :3, 3]).astype(np.float64)


def column(channels: FloatArray, name: str) -> FloatArray:
    return channels[..., CHANNELS.index(name)]


def test_the_true_motion_looks_better_than_a_wrong_one_in_every_respect() -> None:
    rows, T = scene()
    wrong = T @ make_transform(Rotation.from_rotvec([0.0, 0.9, 0.0]).as_matrix(), np.array([0.4, 0.3, -0.8]))
    channels = aligned(rows, np.stack([T, wrong]))
    assert channels.shape == (2, 300, CHANNEL_WIDTHS["aligned"])
    assert np.isfinite(channels).all()
    assert np.abs(channels).max() <= 5
    good, bad = channels
    for name in ("residual", "source_near", "source_in_plane", "target_in_plane", "matched_normals"):
        assert column(good, name).mean() > column(bad, name).mean(), name
    in_front = [sum(column(c, f"{side}_in_front").mean() for side in ("source", "target")) for c in channels]
    assert in_front[0] < in_front[1]


def test_channels_do_not_change_when_either_scan_is_moved() -> None:
    rows, T = scene()
    rng = np.random.default_rng(3)
    A, B = random_motion(rng), random_motion(rng)
    moved = np.hstack([transform_points(A, rows[:, :3]), transform_points(B, rows[:, 3:])])
    before = aligned(rows, T[None])
    after = aligned(moved, (B @ T @ np.linalg.inv(A))[None], (A[:3, 3], B[:3, 3]))
    # Pixels of the range images may fall otherwise; everything else is the same.
    free = [CHANNELS.index(n) for n in CHANNELS if n.endswith(("seen", "in_front", "on_view"))]
    rest = [k for k in range(len(CHANNELS)) if k not in free]
    np.testing.assert_allclose(after[..., rest], before[..., rest], atol=1e-4)
    assert np.abs(after[..., free].mean(1) - before[..., free].mean(1)).max() < 0.05


def test_without_the_sensors_places_free_space_says_nothing() -> None:
    rows, T = scene()
    channels = aligned(rows, T[None], (None, None))
    for name in ("source_seen", "source_in_front", "target_on_view", "source_range"):
        assert not column(channels, name).any()
    assert column(channels, "matched_normals").min() >= 0  # lines, not directions


def test_channels_need_their_own_form_of_network() -> None:
    for change in ({"motion_form": "difference"}, {"knn_space": "compatibility"},
                   {"extra_channels": ("aligned", "ratio")}):  # fmt: skip
        with pytest.raises(ConfigError, match="aligned"):
            build_config(NetworkConfig, {**SMALL, **change})
    with pytest.raises(InputError, match="judges motions"):
        pair_input(scene()[0], VOXEL, build_config(NetworkConfig, SMALL))


def network(**changes: object) -> GeoMoE:
    torch.manual_seed(0)
    model = GeoMoE(build_config(NetworkConfig, {**SMALL, **changes})).train()
    rows, T = scene()
    batch = collate(MotionInputs(rows, (None, None), VOXEL, model.config).under(T[None].repeat(3, 0)))
    model(batch.coordinates, batch.channels, batch.neighbors)
    return model.eval()


@pytest.mark.parametrize("changes", [{}, {"prior": "none"}, {"feed_forward": "dense"}])
def test_folded_network_gives_the_same_verdict(changes: dict[str, object]) -> None:
    model = network(**changes)
    rows, T = scene(1)
    nowhere = make_transform(np.eye(3), np.full(3, 100.0))  # brings nothing together: all rejected at first
    inputs = MotionInputs(rows, AT_ZERO, VOXEL, model.config).under(np.stack([T, np.eye(4), nowhere]))
    batch = collate(inputs)
    with torch.no_grad():
        plain = model(batch.coordinates, batch.channels, batch.neighbors)
    assert plain.verdict is not None
    folded = FoldedGeoMoE(model)
    for k, one in enumerate(inputs):
        found = folded(one.coordinates, one.channels, one.neighbors)
        assert found.verdict is not None
        torch.testing.assert_close(found.verdict, plain.verdict[k], atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(found.logits, plain.logits[:, k], atol=1e-4, rtol=1e-4)
    channels = batch.channels
    several = folded.under_motions(inputs[0].coordinates, channels, inputs[0].neighbors, insight=True)
    for k, found in enumerate(several):
        alone = folded(inputs[k].coordinates, inputs[k].channels, inputs[k].neighbors, insight=True)
        torch.testing.assert_close(found.verdict, alone.verdict, atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(found.logits, alone.logits, atol=1e-4, rtol=1e-4)
        assert found.sub_field is not None
        assert alone.sub_field is not None
        assert (found.sub_field == alone.sub_field).float().mean() > 0.99


def test_padding_changes_no_verdict() -> None:
    model = network()
    short, long = scene(1, 200), scene(2, 300)
    inputs = [MotionInputs(rows, AT_ZERO, VOXEL, model.config).under(T[None])[0] for rows, T in (short, long)]
    both, alone = collate(inputs), collate(inputs[:1])
    assert both.mask is not None
    with torch.no_grad():
        padded = model(both.coordinates, both.channels, both.neighbors, both.mask).verdict
        plain = model(alone.coordinates, alone.channels, alone.neighbors).verdict
    torch.testing.assert_close(padded[:1], plain, atol=1e-4, rtol=1e-4)


def test_the_first_prior_keeps_what_the_motion_brings_together() -> None:
    rows, T = scene()
    channels = aligned(rows, T[None])[0]
    gap = np.linalg.norm(transform_points(T, rows[:, :3]) - rows[:, 3:], axis=1)
    np.testing.assert_array_equal(column(channels, "residual") > PRIOR_KERNEL, gap < 2 * VOXEL)


def test_verdict_loss_against_a_case_by_hand() -> None:
    verdict = torch.tensor([2.0, 0.0, 1.0, -1.0, 3.0])
    right = torch.tensor([True, False, False, False, True])
    pair = torch.tensor([0, 0, 0, 1, 2])  # the second pair has no right motion, the third no wrong one
    preference = -np.log(np.exp(2) / (np.exp(2) + 1 + np.exp(1)))
    doubt = np.mean([np.log1p(np.exp(-2)), np.log(2), np.log1p(np.exp(1)), np.log1p(np.exp(-1)),
                     np.log1p(np.exp(-3))])  # fmt: skip
    assert float(verdict_loss(verdict, right, pair)) == pytest.approx(preference + doubt, abs=1e-6)
    v = verdict.clone().requires_grad_()
    verdict_loss(v, torch.zeros(5, dtype=torch.bool), pair).backward()
    assert v.grad is not None
    assert torch.isfinite(v.grad).all()


def test_the_best_of_each_pair() -> None:
    best = best_of_pair(torch.tensor([0.0, 5.0, 1.0, 7.0, 7.0]), torch.tensor([0, 0, 1, 1, 1]))
    assert best.tolist() == [1, 3]


def training_pair(seed: int = 0) -> TrainingPair:
    rows, T = scene(seed)
    labels = np.linalg.norm(transform_points(T, rows[:, :3]) - rows[:, 3:], axis=1) < 2 * VOXEL
    return TrainingPair(rows.astype(np.float32), labels, T, VOXEL)


def test_motions_are_kept_in_shards(tmp_path: Path) -> None:
    pairs = [with_motions(training_pair(k)) for k in range(3)]
    write_shard(tmp_path / "a", pairs)
    folder = ShardFolder(tmp_path)
    for k, pair in enumerate(pairs):
        back = folder[k]
        assert pair.motions is not None
        assert back.motions is not None
        np.testing.assert_array_equal(back.motions, pair.motions)
        assert rotation_error_deg(back.motions[0], pair.T_target_source) < 2
        np.testing.assert_array_equal(back.viewpoints, np.zeros((2, 3)))
    with pytest.raises(InputError, match="2 of 3 pairs have 'motions'"):
        write_shard(tmp_path / "b", [replace(pairs[0], motions=None), *pairs[1:]])
    (tmp_path / "a" / "motion_start.npy").unlink()
    with pytest.raises(FormatError, match="lacks motion_start"):
        ShardFolder(tmp_path)[0]


def test_a_right_motion_is_among_those_chosen_for_training() -> None:
    T = training_pair().T_target_source
    rng = np.random.default_rng(0)
    motions = np.stack([random_motion(rng) for _ in range(20)] + [T])
    pair = replace(training_pair(), motions=motions, viewpoints=np.zeros((2, 3)))
    for seed in range(10):
        chosen, right = choose_motions(pair, 6, np.random.default_rng(seed))
        assert len(chosen) == 6
        assert right.sum() == 1
        np.testing.assert_array_equal(chosen[right][0], T)
        np.testing.assert_array_equal(chosen[:2], motions[:2])
    assert not choose_motions(pair, 6, None)[1].any()  # the first six, in validation
    with pytest.raises(InputError, match="data motions"):
        choose_motions(training_pair(), 6, None)


def test_a_few_steps_teach_which_motion_is_right() -> None:
    config = build_config(
        TrainConfig,
        {"network": SMALL, "data": {"augmentation": {"rotate": False, "swap": 0, "jitter": 0}}},
    )
    rng = np.random.default_rng(0)
    samples = []
    for k in range(6):
        pair = training_pair(k)
        wrong = [pair.T_target_source @ random_motion(rng) for _ in range(3)]
        motions = np.stack([*wrong[:1], pair.T_target_source, *wrong[1:]])
        samples.append(
            make_sample(replace(pair, motions=motions, viewpoints=np.zeros((2, 3))), config.network)
        )
    model = GeoMoE(config.network).train()
    optimizer = torch.optim.Adam(model.parameters(), lr=5e-3)
    batch = make_batch(samples)
    assert batch.right is not None
    assert batch.input.coordinates.shape[0] == len(batch.right) == 24
    for _ in range(30):
        out = model(batch.input.coordinates, batch.input.channels, batch.input.neighbors)
        loss = verdict_loss(out.verdict, batch.right, batch.pair)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    measures = evaluate(model, samples, torch.device("cpu"), batch_size=4)
    assert measures["verdict_recall"] == 1.0


def test_settings_that_do_not_fit_a_network_that_judges_motions_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"rotate=false"):
        build_config(TrainConfig, {"network": SMALL})
    with pytest.raises(ConfigError, match="best_metric=verdict"):
        build_config(TrainConfig, {"validation": {"best_metric": "verdict"}})
    assert load_train_config("configs/train/motions.yaml").network.judges_motions


def test_filter_judges_what_consensus_proposes() -> None:
    rows, _ = scene(4)
    found = MotionJudge(network())(Correspondences(rows, viewpoints=AT_ZERO), voxel_size=VOXEL)
    assert found.hypotheses
    verdicts = [h.verdict for h in found.hypotheses if h.verdict is not None]
    assert verdicts == sorted(verdicts, reverse=True)
    assert found.weights.shape == (len(rows),)
    assert found.logits is not None
    again = MotionJudge(network())(Correspondences(rows, viewpoints=AT_ZERO), voxel_size=VOXEL)
    np.testing.assert_array_equal(again.weights, found.weights)


def test_each_network_has_its_own_filter() -> None:
    with pytest.raises(CheckpointError, match="MotionJudge"):
        GeoMoEFilter(network())
    with pytest.raises(CheckpointError, match="GeoMoEFilter"):
        MotionJudge(GeoMoE(build_config(NetworkConfig, {"num_layers": 1, "width": 8, "num_heads": 2})))


def test_mutual_rows_come_first() -> None:
    rows, _ = scene(4)
    mutual = np.arange(len(rows)) % 3 == 0
    few = likeliest_rows(Correspondences(rows, mutual=mutual), 120, 0)
    assert few.mutual is not None
    assert len(few) == 120
    assert few.mutual.sum() == mutual.sum()
    assert likeliest_rows(few, 120, 0) is few


def test_more_rows_than_are_judged_are_all_weighed_wherever_they_stand() -> None:
    rows, _ = scene(4, count=1500)
    rows = rows[np.argsort(rows[:, 0])]
    rows[:3] = np.nan
    few = likeliest_rows(Correspondences(rows), 1000, 0)
    assert np.nanmax(few.source[:, 0]) > 0.9 * np.nanmax(rows[:, 0])  # spread, not the first thousand
    rows = np.vstack([np.full((1000, 6), np.nan), rows])
    found = MotionJudge(network())(Correspondences(rows), voxel_size=VOXEL)
    assert found.hypotheses
    assert found.weights.shape == (2500,)
    assert not found.weights[:1003].any()
    assert found.logits is not None
    assert np.isfinite(found.logits[1003:]).all()


def test_no_motions_are_no_channels() -> None:
    rows, _ = scene()
    assert aligned(rows, np.zeros((0, 4, 4))).shape == (0, 300, len(CHANNELS))
    assert MotionJudge(network()).about(Correspondences(rows), voxel_size=VOXEL)(np.zeros((0, 4, 4))) == []


def test_a_judge_stops_where_it_has_seen_enough() -> None:
    rows, T = scene(3)
    motions = np.stack([T @ turned(k) for k in (0, 90, 180, 30, 60)])
    judge = MotionJudge(network()).about(Correspondences(rows), voxel_size=VOXEL)
    every = [j.verdict for j in judge(motions)]
    assert len(every) == 5
    assert [j.verdict for j in judge(motions, max(every) + 1)] == pytest.approx(every, abs=1e-4)
    assert [j.verdict for j in judge(motions, min(every) - 1)] == pytest.approx(every[:2], abs=1e-4)


def test_verdicts_are_the_same_for_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    rows, T = scene(3)
    motions = np.stack([T @ turned(k) for k in range(0, 180, 25)])
    found = []
    for threads in ("1", "2", "5"):
        monkeypatch.setenv("OMP_NUM_THREADS", threads)
        found.append(
            [
                j.verdict
                for j in MotionJudge(network()).about(Correspondences(rows), voxel_size=VOXEL)(motions)
            ]
        )
    assert found[0] == found[1] == found[2]


def test_judging_leaves_the_threads_of_torch_as_they_were(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    torch.set_num_threads(2)
    rows, T = scene(3)
    judge = MotionJudge(network()).about(Correspondences(rows), voxel_size=VOXEL)
    for _ in range(10):
        judge(np.stack([T @ turned(k) for k in range(0, 180, 40)]))
        seen: list[int] = []
        fresh = threading.Thread(target=lambda seen=seen: seen.append(torch.get_num_threads()))
        fresh.start()
        fresh.join()
        assert (torch.get_num_threads(), seen) == (2, [2])


def turned(degrees: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return T


def test_one_thread_is_the_callers_own_and_ends() -> None:
    torch.set_num_threads(2)
    seen = []

    def other() -> None:
        with single_torch_thread(), single_torch_thread():
            seen.append(torch.get_num_threads())

    with single_torch_thread():
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        seen.append(torch.get_num_threads())
    assert seen == [1, 1]
    assert torch.get_num_threads() == 2
    torch.set_num_threads(1)


def test_auto_takes_the_network_where_it_can_be_had(monkeypatch: pytest.MonkeyPatch) -> None:
    assert resolve_filter(FilterConfig()).name == "geomoe"
    assert resolve_filter(FilterConfig(name="spectral")).name == "spectral"
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert resolve_filter(FilterConfig()).name == "none"
    assert resolve_filter(FilterConfig(weights="mine.safetensors")).name == "geomoe"  # and says what lacks
    monkeypatch.undo()
    monkeypatch.setattr("geomoe3d.filters.base.packaged_names", list)
    assert resolve_filter(FilterConfig()).name == "none"


def test_bare_correspondences_have_their_sensors_at_the_origins_that_are_near() -> None:
    rows, _ = scene()
    zero = np.zeros(3)
    found = believed_viewpoints(rows, (zero, zero))
    assert found is not None
    np.testing.assert_array_equal(found, np.zeros((2, 3)))
    assert believed_viewpoints(rows, (zero, np.array([3e5, 0, 0]))) is None


@pytest.fixture
def shards(tmp_path: Path) -> Path:
    """One described scene of two fragments that see one corner."""
    rng = np.random.default_rng(0)
    T = make_transform(Rotation.from_rotvec([0.0, 0.2, 0.0]).as_matrix(), np.array([0.2, 0.0, 0.1]))
    points = [corner(rng, 900), transform_points(T, corner(rng, 900))]
    features = rng.normal(size=(900, 33))
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    described = DescribedScene(
        "corner",
        np.concatenate(points).astype(np.float32),
        np.concatenate([features, features]).astype(np.float16),
        np.array([0, 900, 1800]),
        np.array([[0, 1]]),
        T[None],
        np.array([0.9], dtype=np.float32),
        VOXEL,
    )
    (tmp_path / "features").mkdir()
    write_described(tmp_path / "features" / "corner", described, {}, "")
    return tmp_path / "features"


def test_motions_are_proposed_once_and_the_run_goes_on(shards: Path, tmp_path: Path) -> None:
    out = tmp_path / "motions"
    report = propose_motions(shards, out, 150)
    assert (report.made, report.kept, report.failed) == (2, 0, ())
    folder = ShardFolder(out)
    assert len(folder) == 200
    pair = folder[0]
    assert pair.motions is not None
    assert 1 <= len(pair.motions) <= NUM_MOTIONS
    again = propose_motions(shards, out, 250)
    assert (again.made, again.kept) == (1, 2)
    with pytest.raises(OutputError, match="seed"):
        propose_motions(shards, out, 50, seed=3)


def test_pairs_without_a_motion_are_left_out(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, calls = motions_module.propose, []

    def sometimes(*arguments: Any, **named: Any) -> Any:
        calls.append(1)
        return real(*arguments, **named) if len(calls) % 4 else []

    monkeypatch.setattr(motions_module, "propose", sometimes)
    propose_motions(shards, tmp_path / "some", 100)
    folder = ShardFolder(tmp_path / "some")
    assert len(folder) == 75
    assert all(len(folder[i].motions) > 0 for i in range(75))  # type: ignore[arg-type]
    monkeypatch.setattr(motions_module, "propose", lambda *_, **__: [])
    with pytest.raises(InputError, match=r"pairs 0 to 99 .* no motion for any"):
        propose_motions(shards, tmp_path / "none", 100)


def test_filter_without_any_motion_gives_no_weight() -> None:
    line = np.linspace(0, 1, 30)[:, None] * np.ones(6)
    found = MotionJudge(network())(Correspondences(line), voxel_size=VOXEL)
    assert found.hypotheses == ()
    assert not found.weights.any()
    assert not MotionJudge(network())(Correspondences(np.zeros((0, 6))), voxel_size=VOXEL).weights.any()


def test_rows_that_are_not_finite_weigh_nothing() -> None:
    rows, _ = scene(4)
    rows[5, 2] = np.nan
    found = MotionJudge(network())(Correspondences(rows), voxel_size=VOXEL)
    assert found.hypotheses
    assert found.weights[5] == 0


def test_proposals_take_a_second_round_from_mutual_matches() -> None:
    rows, _ = scene(4)
    mutual = np.arange(len(rows)) % 2 == 0
    config = EstimatorConfig(mutual_round=True)

    def run(estimator: EstimatorConfig, mutual: Any) -> int:
        found = propose(
            ConsensusEstimator(num_hypotheses=3),
            Correspondences(rows, mutual=mutual),
            np.ones(len(rows)),
            estimator,
            inlier_threshold=2 * VOXEL,
            seed=0,
        )
        return len(found)

    assert (
        run(config, mutual)
        > run(config, None)
        == run(config.model_copy(update={"mutual_round": False}), mutual)
    )
