"""Stage one: every method on every pair, each finished prediction kept at once.

All methods see a pair one after the other, on the same input, so that the ratio of their times holds on a
busy machine. Killed at any moment and started again, it goes on with what is missing. The truth is used for
one thing only: to label the correspondences that a method weighed, after it has answered.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.errors import GeoMoE3DError, InputError
from geomoe3d.evaluation.memory import PeakMemory
from geomoe3d.evaluation.methods import make_method
from geomoe3d.evaluation.records import (
    Answer,
    EvaluationPair,
    Labels,
    Method,
    MethodInput,
    Prediction,
    RunInfo,
)
from geomoe3d.evaluation.store import encode, open_run, remove_run
from geomoe3d.evaluation.task import Task, fingerprint
from geomoe3d.evaluation.tracks import InputMaker, needs
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.journal import Journal
from geomoe3d.provenance import hardware, source_commit, usable_cores
from geomoe3d.types import BoolArray, FloatArray
from geomoe3d.workers import run_parallel


@dataclass(frozen=True)
class MethodSpec:
    """A method by name, as it can be sent to another process.

    Attributes:
        spec: name, or ``file.py:function``.
        assignments: ``key=value`` of the configuration.
        label: what the run is called; None: the spec.
    """

    spec: str
    assignments: tuple[str, ...] = ()
    label: str | None = None


@dataclass(frozen=True)
class PredictReport:
    """What a call of `predict` came to.

    Attributes:
        folders: of the runs, in the order of the methods that could run.
        made: predictions made by this call.
        kept: predictions that were there.
        absent: method -> why it cannot run here.
    """

    folders: tuple[Path, ...]
    made: int
    kept: int
    absent: dict[str, str]


def predict(
    study: str | Path,
    methods: Sequence[MethodSpec],
    task: Task,
    *,
    workers: int = 1,
    fresh: bool = False,
    command: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> PredictReport:
    """Predict what is missing of every method's run on one task.

    Args:
        study: folder of the runs; made if missing. Each run lies in ``<label>.<track>.<benchmark>``.
        methods: at least one; those that are not installed are reported, not run.
        task: pairs and input.
        workers: processes over pairs; times are only comparable between runs of as many.
        fresh: True removes the predictions of these runs first.
        command: for the record.
        progress: called with (predictions there, predictions in all).

    Raises:
        InputError: no worker; an unknown method, benchmark or track; a method that cannot take the track's
            input; two runs of one name; a folder with predictions of another identity.
        OutputError: the cache cannot be written, or a worker died.
    """
    if workers < 1:
        raise InputError(f"there must be at least 1 worker, found {workers}")
    wanted = needs(task.track)
    pairs = task.pairs()
    made = {spec: make_method(spec.spec, spec.assignments) for spec in methods}
    absent = {spec.spec: reason for spec, method in made.items() if (reason := method.absent()) is not None}
    present = [spec for spec in made if spec.spec not in absent]
    for spec in present:
        if wanted not in made[spec].inputs:
            raise InputError(
                f"method '{spec.spec}' takes {' or '.join(sorted(made[spec].inputs))}, but the track "
                f"'{task.track}' gives {wanted}; leave it out or choose another track"
            )
    folders = {spec: Path(study) / run_name(spec, task) for spec in present}
    if len(set(folders.values())) < len(folders):
        raise InputError("two runs have the same name; give one of them another label")
    todo: dict[str, list[int]] = {}
    kept = 0
    with ExitStack() as stack:
        journals: list[Journal] = []
        for number, spec in enumerate(present):
            if fresh:
                remove_run(folders[spec])
            info = _info(spec, made[spec], task, pairs, workers, command)
            journal, done = open_run(folders[spec], info)
            journals.append(stack.enter_context(journal))
            kept += len(done)
            for pair in pairs:
                if pair.id not in done:
                    todo.setdefault(pair.id, []).append(number)
        jobs = [(pair, tuple(todo[pair.id])) for pair in pairs if pair.id in todo]
        total, count = kept + sum(map(len, todo.values())), kept
        if progress is not None:
            progress(count, total)
        results = run_parallel(
            _predict_pair,
            jobs,
            workers=workers,
            threads=_threads(workers),
            setup=_set_up,
            arguments=(tuple(present), task),
        )
        for answers in results:
            for number, record in answers:
                journals[number].append(record)
                count += 1
            if progress is not None:
                progress(count, total)
    return PredictReport(tuple(folders.values()), count - kept, kept, absent)


def run_name(spec: MethodSpec, task: Task) -> str:
    """Folder of a run inside its study: label, track, benchmark, and the share of pairs."""
    label = spec.label or spec.spec
    benchmark = Path(task.benchmark).name or "folder"
    name = f"{label}.{task.track}.{benchmark}" + (f".every{task.every}" if task.every > 1 else "")
    return "".join(c if c.isalnum() or c in "._-+" else "_" for c in name)


def _info(
    spec: MethodSpec, method: Method, task: Task, pairs: list[EvaluationPair], workers: int, command: str
) -> RunInfo:
    maker = InputMaker(task.track, task.benchmark, task.root)
    identity: dict[str, Any] = {
        "method": method.identity(),
        "input": maker.source,
        "pairs": {
            "benchmark": task.benchmark,
            "root": task.root,
            "every": task.every,
            "num_unrelated": task.num_unrelated,
            "fingerprint": fingerprint(pairs),
        },
        "workers": workers,
        "threads": _threads(workers),
    }
    return RunInfo(
        label=spec.label or spec.spec,
        method=spec.spec,
        track=task.track,
        benchmark=pairs[0].benchmark,
        identity=identity,
        commit=source_commit(),
        hardware=hardware(),
        seed=task.seed,
        command=command,
        created=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        workers=workers,
        threads=_threads(workers),
    )


def _threads(workers: int) -> int:
    """Threads of each worker; a single one works in this process, with what its environment allows."""
    if workers == 1:
        limit = os.environ.get("OMP_NUM_THREADS", "")
        return min(int(limit), usable_cores()) if limit.isdecimal() and int(limit) > 0 else usable_cores()
    return max(1, usable_cores() // workers)


class _Bench:
    """What a worker keeps between pairs."""

    methods: Sequence[Method] = ()
    inputs: InputMaker


def _set_up(specs: tuple[MethodSpec, ...], task: Task) -> None:
    _Bench.methods = [make_method(spec.spec, spec.assignments) for spec in specs]
    _Bench.inputs = InputMaker(task.track, task.benchmark, task.root, seed=task.seed)


def _predict_pair(job: tuple[EvaluationPair, tuple[int, ...]]) -> list[tuple[int, dict[str, Any]]]:
    """The named methods on one pair, as records."""
    pair, numbers = job
    given = _Bench.inputs(pair)
    return [(number, encode(predict_one(_Bench.methods[number], pair, given))) for number in numbers]


def predict_one(method: Method, pair: EvaluationPair, given: MethodInput) -> Prediction:
    """One method on one pair, timed, its correspondences labelled.

    A `GeoMoE3DError` of the method makes a prediction without motion that holds its message.
    """
    error = None
    with PeakMemory() as memory:
        begin = time.perf_counter()
        try:
            answer = method(given)
        except GeoMoE3DError as caught:
            answer, error = Answer(None), str(caught)
        seconds = time.perf_counter() - begin
    T = answer.T_target_source
    if T is not None and not np.isfinite(T).all():
        T = None
    rows = given.correspondences if answer.correspondences is None else answer.correspondences
    labels = None
    if rows is not None:
        limit = given.inlier_threshold
        labels = Labels(_near(pair.T_target_source, rows, limit), answer.inliers, _near(T, rows, limit))
    return Prediction(
        pair=pair.id,
        T_target_source=T,
        confidence=None if answer.confidence is None else float(answer.confidence),
        status=answer.status,
        hypotheses=answer.hypotheses,
        labels=labels,
        weights=answer.weights,
        seconds=seconds,
        stages={name: float(value) for name, value in answer.seconds.items()},
        peak_memory=memory.peak,
        error=error,
    )


def _near(T: FloatArray | None, rows: FloatArray, limit: float) -> BoolArray:
    """(N,) True where a correspondence's residual under T is below the limit; all False without T."""
    if T is None:
        return np.zeros(len(rows), dtype=np.bool_)
    residuals = np.linalg.norm(transform_points(T, rows[:, :3]) - rows[:, 3:], axis=1)
    return np.asarray(residuals < limit)
