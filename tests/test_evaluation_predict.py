"""Predictions: every pair once, kept through kills, never mixed, errors kept as answers."""

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
from fake_methods import Fake, load_like
from posed_scans import COUNT, motion, surface

from geomoe3d.clouds.io import save_points
from geomoe3d.data.threedmatch import write_gt_log
from geomoe3d.errors import FormatError, GeoMoE3DError, InputError, OutputError
from geomoe3d.evaluation import predict as module
from geomoe3d.evaluation.benchmarks import load_pairs
from geomoe3d.evaluation.compare import compare
from geomoe3d.evaluation.evaluation_set import EvaluationSet, load_run_pairs
from geomoe3d.evaluation.predict import MethodSpec, predict, predict_one
from geomoe3d.evaluation.predictions import encode, find_runs, read_info, read_predictions
from geomoe3d.evaluation.records import Answer, MethodInput, Prediction
from geomoe3d.evaluation.summary import summarise
from geomoe3d.evaluation.tracks import InputMaker
from geomoe3d.runtime.journal import Journal

# ---- one pair ---------------------------------------------------------------------------------------


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


# ---- runs -------------------------------------------------------------------------------------------


@pytest.fixture
def use(monkeypatch: pytest.MonkeyPatch):
    """Makes `predict` find the given methods by name."""

    def install(**methods: Fake) -> None:
        monkeypatch.setattr(module, "make_method", lambda spec, assignments=(): methods[spec])

    return install


def run_one(posed_folder: Path, out: Path, **changes):
    chosen = EvaluationSet(str(posed_folder), changes.pop("track", "clouds"), every=changes.pop("every", 1))
    return predict(out, [MethodSpec("fake")], chosen, **changes)


def test_every_pair_once_and_then_never_again(posed_folder: Path, tmp_path: Path, use) -> None:
    fake = Fake()
    use(fake=fake)
    counts: list[tuple[int, int]] = []
    report = run_one(
        posed_folder, tmp_path, progress=lambda done, total: counts.append((done, total)), command="x y"
    )
    assert (report.made, report.kept, report.absent) == (6, 0, {})
    assert counts[0] == (0, 6)
    assert counts[-1] == (6, 6)
    [run] = find_runs(tmp_path)
    assert run == report.folders[0] == tmp_path / "fake.clouds.posed"
    info = read_info(run)
    assert (info.command, info.track, info.benchmark, info.seed) == ("x y", "clouds", "posed", 0)
    assert "core" in info.hardware
    assert [p.pair for p in read_predictions(run)] == [p.id for p in load_pairs(str(posed_folder))]
    report = run_one(posed_folder, tmp_path)
    assert (report.made, report.kept) == (0, 6)
    assert len(fake.seen) == 6 + 1  # once off the clock, to warm up
    assert [p.id for p in load_run_pairs(info)] == [p.id for p in load_pairs(str(posed_folder))]


def test_only_what_is_missing_is_predicted(posed_folder: Path, tmp_path: Path, use) -> None:
    use(fake=Fake())
    run_one(posed_folder, tmp_path)
    file = tmp_path / "fake.clouds.posed" / "predictions.jsonl"
    lines = file.read_bytes().splitlines(keepends=True)
    file.write_bytes(b"".join(lines[:3]) + lines[3][:40])  # as a kill in the middle of a write leaves it
    fake = Fake()
    use(fake=fake)
    report = run_one(posed_folder, tmp_path)
    assert (report.made, report.kept) == (3, 3)
    assert [given.pair for given in fake.seen[1:]] == [p.id for p in load_pairs(str(posed_folder))][3:]
    assert len(read_predictions(file.parent)) == 6


@pytest.mark.parametrize(
    ("identity", "changes", "named"),
    [
        ({"version": 2}, {}, "method.version"),
        ({"version": 1}, {"every": 1, "seed": 3}, "seed"),
    ],
)
def test_other_settings_never_mix(posed_folder: Path, tmp_path: Path, use, identity, changes, named) -> None:
    use(fake=Fake())
    run_one(posed_folder, tmp_path)
    before = (tmp_path / "fake.clouds.posed" / "predictions.jsonl").read_bytes()
    use(fake=Fake(identity=identity))
    chosen = EvaluationSet(str(posed_folder), "clouds", **changes)
    with pytest.raises(InputError, match=named):
        predict(tmp_path, [MethodSpec("fake")], chosen)
    assert (tmp_path / "fake.clouds.posed" / "predictions.jsonl").read_bytes() == before
    report = predict(tmp_path, [MethodSpec("fake")], chosen, fresh=True)
    assert (report.made, report.kept) == (6, 0)


def test_changed_truth_is_noticed(posed_folder: Path, tmp_path: Path, use) -> None:
    import shutil

    copy = tmp_path / "posed"
    shutil.copytree(posed_folder, copy)
    use(fake=Fake())
    run_one(copy, tmp_path / "out")
    pairs = [(i, j) for i in range(COUNT) for j in range(i + 1, COUNT)]
    (copy / "room" / "gt.log").unlink()
    write_gt_log(copy / "room" / "gt.log", [(i, j, motion(i - j)) for i, j in pairs], COUNT)
    with pytest.raises(InputError, match="fingerprint"):
        run_one(copy, tmp_path / "out")
    with pytest.raises(InputError, match="ground truth"):
        load_run_pairs(read_info(tmp_path / "out" / "fake.clouds.posed"))


def test_changed_input_is_noticed(posed_folder: Path, tmp_path: Path, use) -> None:
    import shutil

    copy = tmp_path / "posed"
    shutil.copytree(posed_folder, copy)
    use(fake=Fake())
    run_one(copy, tmp_path / "out")
    save_points(copy / "room" / "cloud_bin_2.ply", surface(np.random.default_rng(5)), force=True)
    with pytest.raises(InputError, match=r"input\.files_sha256"):
        run_one(copy, tmp_path / "out")


def test_predictions_of_unknown_origin_never_mix(posed_folder: Path, tmp_path: Path, use) -> None:
    use(fake=Fake())
    run_one(posed_folder, tmp_path)
    (tmp_path / "fake.clouds.posed" / "run.json").unlink()
    with pytest.raises(InputError, match=r"'run\.json', which says what they come from, is gone"):
        run_one(posed_folder, tmp_path)
    assert run_one(posed_folder, tmp_path, fresh=True).made == 6


def test_fresh_leaves_a_run_alone_that_another_process_writes(
    posed_folder: Path, tmp_path: Path, use
) -> None:
    use(fake=Fake())
    run_one(posed_folder, tmp_path)
    file = tmp_path / "fake.clouds.posed" / "predictions.jsonl"
    before = file.read_bytes()
    with Journal(file), pytest.raises(OutputError, match="another process"):
        run_one(posed_folder, tmp_path, fresh=True)
    assert file.read_bytes() == before


def test_two_methods_see_each_pair_in_turn(posed_folder: Path, tmp_path: Path, use) -> None:
    order: list[str] = []

    def noting(name: str):
        def answer(given: MethodInput) -> Answer:
            order.append(name)
            return Answer(np.eye(4))

        return answer

    use(a=Fake(noting("a")), b=Fake(noting("b")), gone=Fake(absent="pip install gone"))
    chosen = EvaluationSet(str(posed_folder), "clouds", every=2)
    report = predict(tmp_path, [MethodSpec("a"), MethodSpec("gone"), MethodSpec("b")], chosen)
    assert order == ["a", "a", "b", "b", *["a", "b"] * 2]  # the first time once more, off the clock
    assert report.absent == {"gone": "pip install gone"}
    assert sorted(run.name for run in find_runs(tmp_path)) == [
        "a.clouds.posed.every2",
        "b.clouds.posed.every2",
    ]


def test_a_method_that_cannot_take_the_input_is_refused(posed_folder: Path, tmp_path: Path, use) -> None:
    fake = Fake()
    fake.inputs = frozenset({"correspondences"})
    use(fake=fake)
    with pytest.raises(InputError, match="takes correspondences, but the track 'clouds' gives clouds"):
        run_one(posed_folder, tmp_path)
    assert not list(tmp_path.iterdir())


def test_two_runs_of_one_name_are_refused(posed_folder: Path, tmp_path: Path, use) -> None:
    use(fake=Fake(), other=Fake())
    specs = [MethodSpec("fake", label="x"), MethodSpec("other", label="x")]
    with pytest.raises(InputError, match="same name"):
        predict(tmp_path, specs, EvaluationSet(str(posed_folder), "clouds"))


def test_damaged_files_are_named(posed_folder: Path, tmp_path: Path, use) -> None:
    use(fake=Fake())
    run_one(posed_folder, tmp_path)
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


def test_sigkill_loses_nothing_and_repeats_nothing(posed_folder: Path, tmp_path: Path) -> None:
    words = [
        *COMMAND,
        str(tmp_path),
        "--method",
        "consensus",
        "--track",
        "1k",
        "--benchmark",
        str(posed_folder),
    ]
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
    assert sorted(json.loads(line)["pair"] for line in lines) == sorted(
        p.id for p in load_pairs(str(posed_folder))
    )


def comparable(prediction: Prediction) -> str:
    record = encode(prediction)
    for key in ("seconds", "stages", "peak_memory"):
        del record[key]
    return json.dumps(record, sort_keys=True)


def test_two_workers_predict_the_same(posed_folder: Path, tmp_path: Path) -> None:
    chosen, specs = EvaluationSet(str(posed_folder), "1k"), [MethodSpec("consensus"), MethodSpec("spectral")]
    for workers in (1, 2):
        predict(tmp_path / str(workers), specs, chosen, workers=workers)
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


def test_a_method_that_takes_its_process_along_loses_that_pair_alone(
    posed_folder: Path, tmp_path: Path
) -> None:
    pairs = load_pairs(str(posed_folder))
    victim = InputMaker("clouds", str(posed_folder))(pairs[3]).source
    assert victim is not None
    own = tmp_path / "own.py"
    own.write_text(DEADLY.replace("LIMIT", repr(float(victim[0, 0]))))
    died = [pair.id for pair in pairs if pair.source == pairs[3].source]
    specs = [MethodSpec(f"{own}:{name}", label=name) for name in ("harmless", "deadly")]
    report = predict(tmp_path, specs, EvaluationSet(str(posed_folder), "clouds"), workers=2)
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


def test_unrelated_pairs_are_not_thinned() -> None:
    assert EvaluationSet("unrelated", "clouds", every=40) == EvaluationSet("unrelated", "clouds")
