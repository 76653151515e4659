"""Predictions: the right pairs, the right input, kept through kills, never mixed."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geomoe3d.clouds.io import save_points
from geomoe3d.data.threedmatch import (
    find_benchmark_root,
    load_benchmark,
    load_fixed_correspondences,
    write_gt_log,
    write_gt_overlap,
)
from geomoe3d.errors import FormatError, GeoMoE3DError, InputError, OutputError
from geomoe3d.evaluation import predict as module
from geomoe3d.evaluation.benchmarks import load_pairs, thin_out
from geomoe3d.evaluation.compare import compare
from geomoe3d.evaluation.predict import MethodSpec, predict, predict_one
from geomoe3d.evaluation.records import Answer, MethodInput, Prediction
from geomoe3d.evaluation.store import decode, encode, find_runs, read_info, read_predictions
from geomoe3d.evaluation.summary import summarise
from geomoe3d.evaluation.task import Task, load_run_pairs
from geomoe3d.evaluation.tracks import TRACKS, InputMaker
from geomoe3d.geometry.se3 import inverse, make_transform, transform_points
from geomoe3d.journal import Journal

COUNT = 4


def motion(k: int) -> np.ndarray:
    R = Rotation.from_euler("xyz", [3.0 * k, -5.0 * k, 8.0 * k], degrees=True).as_matrix()
    return make_transform(R, np.array([0.1 * k, 0.05 * k, -0.04 * k]))


def surface(rng: np.random.Generator, count: int = 6000) -> np.ndarray:
    x, y = rng.uniform(-1.2, 1.2, (2, count))
    z = 2.0 + 0.25 * np.sin(3 * x) * np.cos(4 * y) + 0.1 * np.sin(9 * x + 5 * y)
    return np.column_stack([x, y, z])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four views of one surface with all their six pairs."""
    room = tmp_path_factory.mktemp("posed") / "posed" / "room"
    room.mkdir(parents=True)
    rng = np.random.default_rng(0)
    poses = [motion(k) for k in range(COUNT)]
    for k, pose in enumerate(poses):
        save_points(room / f"cloud_bin_{k}.ply", transform_points(inverse(pose), surface(rng)))
    pairs = [(i, j) for i in range(COUNT) for j in range(i + 1, COUNT)]
    write_gt_log(room / "gt.log", [(i, j, inverse(poses[i]) @ poses[j]) for i, j in pairs], COUNT)
    write_gt_overlap(room / "gt_overlap.log", dict.fromkeys(pairs, 0.9))
    return room.parent


class Fake:
    """A method whose answers and identity a test decides; counts what it was given."""

    name = "fake"
    inputs = frozenset({"correspondences", "clouds"})

    def __init__(self, answer=None, identity=None, absent=None) -> None:
        self.seen: list[MethodInput] = []
        self._answer = answer or (lambda given: Answer(np.eye(4)))
        self._identity, self._absent = identity or {"version": 1}, absent

    def identity(self):
        return self._identity

    def absent(self):
        return self._absent

    def __call__(self, given: MethodInput) -> Answer:
        self.seen.append(given)
        return self._answer(given)


@pytest.fixture
def use(monkeypatch: pytest.MonkeyPatch):
    """Makes `predict` find the given methods by name."""

    def install(**methods: Fake) -> None:
        monkeypatch.setattr(module, "make_method", lambda spec, assignments=(): methods[spec])

    return install


# ---- pairs and input --------------------------------------------------------------------------------


def test_a_folder_gives_its_pairs(folder: Path) -> None:
    pairs = load_pairs(str(folder))
    assert [p.id.split("/")[1] for p in pairs] == [
        "cloud_bin_0--cloud_bin_1",
        "cloud_bin_0--cloud_bin_2",
        "cloud_bin_0--cloud_bin_3",
        "cloud_bin_1--cloud_bin_2",
        "cloud_bin_1--cloud_bin_3",
        "cloud_bin_2--cloud_bin_3",
    ]
    assert [p.consecutive for p in pairs] == [True, False, False, True, False, True]
    assert np.allclose(pairs[1].T_target_source, inverse(motion(2)))
    assert pairs[0].overlap == 0.9
    assert thin_out(pairs, 4) == [pairs[0], pairs[4]]


@pytest.mark.parametrize("name", ["3DMatsch", "/no/such/folder"])
def test_unknown_benchmarks_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="no benchmark"):
        load_pairs(name)


def test_every_must_be_positive(folder: Path) -> None:
    with pytest.raises(InputError, match="at least 1"):
        thin_out(load_pairs(str(folder)), 0)


@pytest.mark.parametrize("track", TRACKS)
def test_input_of_a_track(folder: Path, track: str) -> None:
    pair = load_pairs(str(folder))[0]
    given = InputMaker(track, str(folder), seed=5)(pair)
    assert given.seed == 5
    if track == "clouds":
        assert given.correspondences is None
        assert given.source.shape == given.target.shape == (6000, 3)
        return
    assert given.source is None
    rows = given.correspondences
    assert len(rows) == 1000 if track == "1k" else len(rows) > 1000
    assert len(np.unique(rows[:, :3], axis=0)) == len(rows)
    right = np.linalg.norm(transform_points(pair.T_target_source, rows[:, :3]) - rows[:, 3:], axis=1) < 0.1
    assert right.mean() > 0.1  # the features of this surface are distinctive
    assert np.array_equal(rows, InputMaker(track, str(folder))(pair).correspondences)


def test_unknown_track() -> None:
    with pytest.raises(InputError, match="no track 'some'"):
        InputMaker("some", "3DMatch")


# ---- the store --------------------------------------------------------------------------------------


def test_predictions_survive_the_store() -> None:
    rng = np.random.default_rng(0)
    rows = np.hstack([rng.normal(size=(1003, 3)), rng.normal(size=(1003, 3))])
    T = motion(3)
    rows[:500, 3:] = transform_points(T, rows[:500, :3])
    weights = rng.uniform(size=1003)
    answer = Answer(T, 0.7, "ok", (motion(1), motion(2)), None, weights, weights > 0.5, {"solve": 0.25})
    pair = load_like(T)
    prediction = predict_one(Fake(lambda given: answer), pair, MethodInput("a/0-1", correspondences=rows))
    found = decode(json.loads(json.dumps(encode(prediction), allow_nan=False)))
    assert np.array_equal(found.T_target_source, T)
    assert found.labels.true[:500].all()
    assert not found.labels.true[500:].all()
    for name in ("true", "kept", "verified"):
        assert np.array_equal(getattr(found.labels, name), getattr(prediction.labels, name))
    assert np.array_equal(found.labels.kept, weights > 0.5)
    assert np.abs(found.weights - weights).max() < 1e-3
    assert [np.array_equal(a, b) for a, b in zip(found.hypotheses, answer.hypotheses, strict=True)] == [
        True
    ] * 2
    assert (found.pair, found.confidence, found.status) == ("a/0-1", 0.7, "ok")
    assert found.stages == {"solve": 0.25}
    assert found.seconds == prediction.seconds > 0
    assert found.error is None


def load_like(T: np.ndarray):
    from geomoe3d.evaluation.records import EvaluationPair

    return EvaluationPair("a/0-1", "3DMatch", "a", Path("a"), Path("b"), T)


@pytest.mark.parametrize("T", [None, np.full((4, 4), np.nan)])
def test_no_motion_is_stored_as_none(T: np.ndarray | None) -> None:
    given = MethodInput("a/0-1", correspondences=np.ones((5, 6)))
    prediction = predict_one(Fake(lambda _: Answer(T)), load_like(np.eye(4)), given)
    assert prediction.T_target_source is None
    assert prediction.labels.true.all()
    assert not prediction.labels.verified.any()
    assert decode(encode(prediction)).T_target_source is None


def test_an_error_of_the_method_is_kept_as_its_answer() -> None:
    def refuse(given: MethodInput) -> Answer:
        raise GeoMoE3DError("too few points")

    prediction = predict_one(Fake(refuse), load_like(np.eye(4)), MethodInput("a/0-1", np.ones((5, 6))))
    assert prediction.error == "too few points"
    assert prediction.T_target_source is None


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells the peak memory")
def test_peak_memory_sees_an_allocation_that_is_gone() -> None:
    def allocate(given: MethodInput) -> Answer:
        np.ones(40_000_000).sum()
        return Answer(None)

    small = predict_one(Fake(), load_like(np.eye(4)), MethodInput("a/0-1", np.ones((5, 6)))).peak_memory
    large = predict_one(
        Fake(allocate), load_like(np.eye(4)), MethodInput("a/0-1", np.ones((5, 6)))
    ).peak_memory
    again = predict_one(Fake(), load_like(np.eye(4)), MethodInput("a/0-1", np.ones((5, 6)))).peak_memory
    assert large - small > 250e6
    assert again < large - 250e6


# ---- predicting -------------------------------------------------------------------------------------


def run_one(folder: Path, out: Path, **changes):
    task = Task(str(folder), changes.pop("track", "clouds"), every=changes.pop("every", 1))
    return predict(out, [MethodSpec("fake")], task, **changes)


def test_every_pair_once_and_then_never_again(folder: Path, tmp_path: Path, use) -> None:
    fake = Fake()
    use(fake=fake)
    counts: list[tuple[int, int]] = []
    report = run_one(
        folder, tmp_path, progress=lambda done, total: counts.append((done, total)), command="x y"
    )
    assert (report.made, report.kept, report.absent) == (6, 0, {})
    assert counts[0] == (0, 6)
    assert counts[-1] == (6, 6)
    [run] = find_runs(tmp_path)
    assert run == report.folders[0] == tmp_path / "fake.clouds.posed"
    info = read_info(run)
    assert (info.command, info.track, info.benchmark, info.seed) == ("x y", "clouds", "posed", 0)
    assert "core" in info.hardware
    assert [p.pair for p in read_predictions(run)] == [p.id for p in load_pairs(str(folder))]
    report = run_one(folder, tmp_path)
    assert (report.made, report.kept) == (0, 6)
    assert len(fake.seen) == 6 + 1  # once off the clock, to warm up
    assert [p.id for p in load_run_pairs(info)] == [p.id for p in load_pairs(str(folder))]


def test_only_what_is_missing_is_predicted(folder: Path, tmp_path: Path, use) -> None:
    use(fake=Fake())
    run_one(folder, tmp_path)
    file = tmp_path / "fake.clouds.posed" / "predictions.jsonl"
    lines = file.read_bytes().splitlines(keepends=True)
    file.write_bytes(b"".join(lines[:3]) + lines[3][:40])  # as a kill in the middle of a write leaves it
    fake = Fake()
    use(fake=fake)
    report = run_one(folder, tmp_path)
    assert (report.made, report.kept) == (3, 3)
    assert [given.pair for given in fake.seen[1:]] == [p.id for p in load_pairs(str(folder))][3:]
    assert len(read_predictions(file.parent)) == 6


@pytest.mark.parametrize(
    ("identity", "changes", "named"),
    [
        ({"version": 2}, {}, "method.version"),
        ({"version": 1}, {"every": 1, "seed": 3}, "seed"),
    ],
)
def test_other_settings_never_mix(folder: Path, tmp_path: Path, use, identity, changes, named) -> None:
    use(fake=Fake())
    run_one(folder, tmp_path)
    before = (tmp_path / "fake.clouds.posed" / "predictions.jsonl").read_bytes()
    use(fake=Fake(identity=identity))
    task = Task(str(folder), "clouds", **changes)
    with pytest.raises(InputError, match=named):
        predict(tmp_path, [MethodSpec("fake")], task)
    assert (tmp_path / "fake.clouds.posed" / "predictions.jsonl").read_bytes() == before
    report = predict(tmp_path, [MethodSpec("fake")], task, fresh=True)
    assert (report.made, report.kept) == (6, 0)


def test_changed_truth_is_noticed(folder: Path, tmp_path: Path, use) -> None:
    import shutil

    copy = tmp_path / "posed"
    shutil.copytree(folder, copy)
    use(fake=Fake())
    run_one(copy, tmp_path / "out")
    pairs = [(i, j) for i in range(COUNT) for j in range(i + 1, COUNT)]
    write_gt_log(copy / "room" / "gt.log", [(i, j, motion(i - j)) for i, j in pairs], COUNT, force=True)
    with pytest.raises(InputError, match="fingerprint"):
        run_one(copy, tmp_path / "out")
    with pytest.raises(InputError, match="ground truth"):
        load_run_pairs(read_info(tmp_path / "out" / "fake.clouds.posed"))


def test_changed_input_is_noticed(folder: Path, tmp_path: Path, use) -> None:
    import shutil

    copy = tmp_path / "posed"
    shutil.copytree(folder, copy)
    use(fake=Fake())
    run_one(copy, tmp_path / "out")
    save_points(copy / "room" / "cloud_bin_2.ply", surface(np.random.default_rng(5)), force=True)
    with pytest.raises(InputError, match=r"input\.files_sha256"):
        run_one(copy, tmp_path / "out")


def test_matched_input_depends_on_the_code_that_matches(folder: Path) -> None:
    pairs = load_pairs(str(folder))
    keys = {track: set(InputMaker(track, str(folder)).identity(pairs)) for track in TRACKS}
    assert keys["clouds"] == {"from", "files_sha256"}
    assert {"source_sha256", "preparation", "versions"} < keys["all"] == keys["1k"]


def test_predictions_of_unknown_origin_never_mix(folder: Path, tmp_path: Path, use) -> None:
    use(fake=Fake())
    run_one(folder, tmp_path)
    (tmp_path / "fake.clouds.posed" / "run.json").unlink()
    with pytest.raises(InputError, match=r"'run\.json', which says what they come from, is gone"):
        run_one(folder, tmp_path)
    assert run_one(folder, tmp_path, fresh=True).made == 6


def test_fresh_leaves_a_run_alone_that_another_process_writes(folder: Path, tmp_path: Path, use) -> None:
    use(fake=Fake())
    run_one(folder, tmp_path)
    file = tmp_path / "fake.clouds.posed" / "predictions.jsonl"
    before = file.read_bytes()
    with Journal(file), pytest.raises(OutputError, match="another process"):
        run_one(folder, tmp_path, fresh=True)
    assert file.read_bytes() == before


def test_two_methods_see_each_pair_in_turn(folder: Path, tmp_path: Path, use) -> None:
    order: list[str] = []

    def noting(name: str):
        def answer(given: MethodInput) -> Answer:
            order.append(name)
            return Answer(np.eye(4))

        return answer

    use(a=Fake(noting("a")), b=Fake(noting("b")), gone=Fake(absent="pip install gone"))
    task = Task(str(folder), "clouds", every=2)
    report = predict(tmp_path, [MethodSpec("a"), MethodSpec("gone"), MethodSpec("b")], task)
    assert order == ["a", "a", "b", "b", *["a", "b"] * 2]  # the first time once more, off the clock
    assert report.absent == {"gone": "pip install gone"}
    assert sorted(run.name for run in find_runs(tmp_path)) == [
        "a.clouds.posed.every2",
        "b.clouds.posed.every2",
    ]


def test_a_method_that_cannot_take_the_input_is_refused(folder: Path, tmp_path: Path, use) -> None:
    fake = Fake()
    fake.inputs = frozenset({"correspondences"})
    use(fake=fake)
    with pytest.raises(InputError, match="takes correspondences, but the track 'clouds' gives clouds"):
        run_one(folder, tmp_path)
    assert not list(tmp_path.iterdir())


def test_two_runs_of_one_name_are_refused(folder: Path, tmp_path: Path, use) -> None:
    use(fake=Fake(), other=Fake())
    specs = [MethodSpec("fake", label="x"), MethodSpec("other", label="x")]
    with pytest.raises(InputError, match="same name"):
        predict(tmp_path, specs, Task(str(folder), "clouds"))


def test_damaged_files_are_named(folder: Path, tmp_path: Path, use) -> None:
    use(fake=Fake())
    run_one(folder, tmp_path)
    run = tmp_path / "fake.clouds.posed"
    (run / "predictions.jsonl").write_text('{"pair": "x"}\n')
    with pytest.raises(FormatError, match="line 1"):
        read_predictions(run)
    (run / "run.json").write_text("{}")
    with pytest.raises(FormatError, match=r"run\.json"):
        read_info(run)
    with pytest.raises(InputError, match="no predictions"):
        find_runs(tmp_path / "nothing")


COMMAND = [sys.executable, "-m", "geomoe3d", "evaluate", "predict"]


def test_sigkill_loses_nothing_and_repeats_nothing(folder: Path, tmp_path: Path) -> None:
    words = [*COMMAND, str(tmp_path), "--method", "consensus", "--track", "1k", "--benchmark", str(folder)]
    file = tmp_path / "consensus.1k.posed" / "predictions.jsonl"
    process = subprocess.Popen(words, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not (file.is_file() and file.read_bytes().count(b"\n") >= 2):
        assert time.monotonic() < deadline
        if process.poll() is not None:
            break
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    first = [line for line in file.read_bytes().splitlines(keepends=True) if line.endswith(b"\n")]
    again = subprocess.run(words, stderr=subprocess.PIPE, text=True, check=False)
    assert again.returncode == 0, again.stderr
    lines = file.read_bytes().splitlines(keepends=True)
    assert lines[: len(first)] == first
    assert sorted(json.loads(line)["pair"] for line in lines) == sorted(p.id for p in load_pairs(str(folder)))


def comparable(prediction: Prediction) -> str:
    record = encode(prediction)
    for key in ("seconds", "stages", "peak_memory"):
        del record[key]
    return json.dumps(record, sort_keys=True)


def test_two_workers_predict_the_same(folder: Path, tmp_path: Path) -> None:
    task, specs = Task(str(folder), "1k"), [MethodSpec("consensus"), MethodSpec("spectral")]
    for workers in (1, 2):
        predict(tmp_path / str(workers), specs, task, workers=workers)
    for name in ("consensus.1k.posed", "spectral.1k.posed"):
        one, two = (read_predictions(tmp_path / str(workers) / name) for workers in (1, 2))
        assert sorted(map(comparable, one)) == sorted(map(comparable, two))
        assert len(one) == 6


DEADLY = """
import os
import numpy as np

def harmless(source, target):
    return np.eye(4)

def deadly(source, target):
    if source[0, 0] == LIMIT:
        os._exit(9)
    return np.eye(4)
"""


def test_a_method_that_takes_its_process_along_loses_that_pair_alone(folder: Path, tmp_path: Path) -> None:
    pairs = load_pairs(str(folder))
    victim = InputMaker("clouds", str(folder))(pairs[3]).source
    assert victim is not None
    own = tmp_path / "own.py"
    own.write_text(DEADLY.replace("LIMIT", repr(float(victim[0, 0]))))
    died = [pair.id for pair in pairs if pair.source == pairs[3].source]
    specs = [MethodSpec(f"{own}:{name}", label=name) for name in ("harmless", "deadly")]
    report = predict(tmp_path, specs, Task(str(folder), "clouds"), workers=2)
    assert report.made == 12
    harmless, deadly = (read_predictions(run) for run in report.folders)
    assert [prediction.error for prediction in harmless] == [None] * 6
    lost = {prediction.pair: prediction for prediction in deadly if prediction.error is not None}
    assert sorted(lost) == sorted(died)
    for prediction in lost.values():
        assert "died" in (prediction.error or "")
        assert prediction.T_target_source is None
        assert math.isnan(prediction.seconds)
    score = summarise(read_info(report.folders[1]), pairs, deadly, resamples=50)
    assert score.measures["errors"].value == pytest.approx(100 * len(died) / 6)
    assert score.measures["time_median"].count == 6 - len(died)
    compare(score, summarise(read_info(report.folders[0]), pairs, harmless, resamples=50), resamples=50)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (Answer(np.eye(4), weights=np.ones(4)), r"weights of shape \(4,\) for 5 correspondences"),
        (Answer(np.eye(4), inliers=np.ones(6, dtype=bool)), r"labels of shape \(6,\) for 5"),
        (Answer(np.eye(4), weights=np.ones((5, 1))), r"weights of shape \(5, 1\) for 5"),
        (Answer(np.eye(4), correspondences=np.ones((7, 6)), weights=np.ones(5)), r"for 7 correspondences"),
    ],
)
def test_weights_and_labels_of_another_length_are_refused(answer: Answer, message: str) -> None:
    given = MethodInput("a/0-1", correspondences=np.ones((5, 6)))
    with pytest.raises(InputError, match=message):
        predict_one(Fake(lambda _: answer), load_like(np.eye(4)), given)


def test_unrelated_pairs_are_not_thinned() -> None:
    assert Task("unrelated", "clouds", every=40) == Task("unrelated", "clouds")


# ---- the published benchmark ------------------------------------------------------------------------


def real_root() -> Path:
    try:
        return find_benchmark_root()
    except InputError as error:
        pytest.skip(str(error))


def test_published_pairs_and_their_fixed_correspondences() -> None:
    real_root()
    for benchmark, count in (("3DMatch", 843), ("3DLoMatch", 1044)):
        pairs = load_pairs(benchmark)
        assert len(pairs) == len({pair.id for pair in pairs}) == count
        maker = InputMaker("1k", benchmark)
        assert maker.identity(pairs)["from"] == "published 1k correspondences"
        fixed = load_fixed_correspondences(None, benchmark)
        for pair, expected in list(zip(pairs, fixed, strict=True))[:: count // 20]:
            assert pair.id == f"{expected.scene}/{expected.source_index}-{expected.target_index}"
            assert np.array_equal(maker(pair).correspondences, expected.points)
            assert np.allclose(pair.T_target_source, expected.T_target_source, atol=1e-6)


def test_unrelated_pairs_come_from_different_scenes() -> None:
    real_root()
    pairs = load_pairs("unrelated", num_unrelated=50)
    assert len({pair.id for pair in pairs}) == 50
    assert load_pairs("unrelated", num_unrelated=20) == pairs[:20]
    scene_of = {path: pair.scene for pair in load_benchmark() for path in (pair.source, pair.target)}
    for pair in pairs:
        assert pair.T_target_source is None
        assert scene_of[pair.source] != scene_of[pair.target]


def test_raw_truth_differs_only_where_rotations_are_not_orthonormal() -> None:
    real_root()
    gaps: dict[str, float] = {}
    for pair in load_pairs("3DMatch"):
        gap = float(np.abs(pair.raw_T_target_source - pair.T_target_source)[:3, :3].max())
        gaps[pair.scene] = max(gaps.get(pair.scene, 0.0), gap)
    red = next(name for name in gaps if "redkitchen" in name)
    assert gaps[red] > 1e-4
    assert all(gap < gaps[red] for name, gap in gaps.items() if name != red)
