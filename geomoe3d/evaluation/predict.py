"""Stage one: every method on every pair, each finished prediction kept at once.

All methods see a pair one after the other, on the same input, so that the ratio of their times holds on a
busy machine. Killed at any moment and started again, it goes on with what is missing; with two workers or
more, a method that takes its process with it loses that pair and nothing else. The truth is used for one
thing only: to label the correspondences that a method weighed, after it has answered.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.errors import GeoMoE3DError, InputError
from geomoe3d.evaluation.evaluation_set import EvaluationSet, fingerprint
from geomoe3d.evaluation.methods import make_method
from geomoe3d.evaluation.peak_memory import PeakMemory
from geomoe3d.evaluation.predictions import encode, open_run, remove_run
from geomoe3d.evaluation.records import (
    Answer,
    EvaluationPair,
    Labels,
    Method,
    MethodInput,
    Prediction,
    RunInfo,
)
from geomoe3d.evaluation.tracks import InputMaker, needs
from geomoe3d.geometry.se3 import transform_points
from geomoe3d.runtime.journal import Journal
from geomoe3d.runtime.progress import Watch, shows_progress
from geomoe3d.runtime.provenance import hardware, source_commit, usable_cores
from geomoe3d.runtime.workers import Pool, ProcessPool, SerialPool, WorkerDied, run_surviving
from geomoe3d.types import BoolArray, FloatArray


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


@shows_progress("predictions")
def predict(
    study: str | Path,
    methods: Sequence[MethodSpec],
    chosen: EvaluationSet,
    *,
    workers: int = 1,
    fresh: bool = False,
    command: str = "",
    progress: Watch = None,
) -> PredictReport:
    """Predict what is missing of every method's run on one evaluation set.

    Args:
        study: folder of the runs; made if missing. Each run lies in ``<label>.<track>.<benchmark>``.
        methods: at least one; those that are not installed are reported, not run.
        chosen: pairs and input.
        workers: processes over pairs; times are only comparable between runs of as many.
        fresh: True removes the predictions of these runs first.
        command: for the record.
        progress: called with (predictions there, predictions in all); None shows a bar when it takes long, False
            shows nothing.

    Raises:
        InputError: no worker; an unknown method, benchmark or track; a method that cannot take the track's
            input; two runs of one name; a folder with predictions of another identity.
        OutputError: the cache cannot be written.
    """
    if workers < 1:
        raise InputError(f"there must be at least 1 worker, found {workers}")
    wanted = needs(chosen.track)
    pairs = chosen.pairs()
    made = {spec: make_method(spec.spec, spec.assignments) for spec in methods}
    absent = {spec.spec: reason for spec, method in made.items() if (reason := method.absent()) is not None}
    present = [spec for spec in made if spec.spec not in absent]
    for spec in present:
        if wanted not in made[spec].inputs:
            raise InputError(
                f"method '{spec.spec}' takes {' or '.join(sorted(made[spec].inputs))}, but the track "
                f"'{chosen.track}' gives {wanted}; leave it out or choose another track"
            )
    folders = {spec: Path(study) / run_name(spec, chosen) for spec in present}
    if len(set(folders.values())) < len(folders):
        raise InputError("two runs have the same name; give one of them another label")
    todo: dict[str, list[int]] = {}
    kept = 0
    with ExitStack() as stack:
        journals: list[Journal] = []
        for number, spec in enumerate(present):
            if fresh:
                remove_run(folders[spec])
            info = _info(spec, made[spec], chosen, pairs, workers, command)
            journal, done = open_run(folders[spec], info)
            journals.append(stack.enter_context(journal))
            kept += len(done)
            for pair in pairs:
                if pair.id not in done:
                    todo.setdefault(pair.id, []).append(number)
        jobs = [_Job(tuple(present), chosen, pair, tuple(todo[pair.id])) for pair in pairs if pair.id in todo]
        total, count = kept + sum(map(len, todo.values())), kept
        if progress:
            progress(count, total)
        _bench.cache_clear()  # files of the user's may have changed since the last call
        pool = SerialPool() if workers == 1 else ProcessPool(workers, threads=_threads(workers))
        for answers in _answers(pool, jobs):
            for number, record in answers:
                journals[number].append(record)
                count += 1
            if progress:
                progress(count, total)
    return PredictReport(tuple(folders.values()), count - kept, kept, absent)


def run_name(spec: MethodSpec, chosen: EvaluationSet) -> str:
    """Folder of a run inside its study: label, track, benchmark, and the share of pairs."""
    label = spec.label or spec.spec
    benchmark = Path(chosen.benchmark).name or "folder"
    name = f"{label}.{chosen.track}.{benchmark}" + (f".every{chosen.every}" if chosen.every > 1 else "")
    return "".join(c if c.isalnum() or c in "._-+" else "_" for c in name)


def _info(
    spec: MethodSpec,
    method: Method,
    chosen: EvaluationSet,
    pairs: list[EvaluationPair],
    workers: int,
    command: str,
) -> RunInfo:
    maker = InputMaker(chosen.track, chosen.benchmark, chosen.root)
    identity: dict[str, Any] = {
        "method": method.identity(),
        "input": maker.identity(pairs),
        "pairs": {
            "benchmark": chosen.benchmark,
            "root": chosen.root,
            "every": chosen.every,
            "num_unrelated": chosen.num_unrelated,
            "fingerprint": fingerprint(pairs),
        },
        "workers": workers,
        "threads": _threads(workers),
    }
    return RunInfo(
        label=spec.label or spec.spec,
        method=spec.spec,
        track=chosen.track,
        benchmark=pairs[0].benchmark,
        identity=identity,
        commit=source_commit(),
        hardware=hardware(),
        seed=chosen.seed,
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


@dataclass(frozen=True)
class _Job:
    """One pair and the methods that have not answered it yet, by their place in ``specs``."""

    specs: tuple[MethodSpec, ...]
    chosen: EvaluationSet
    pair: EvaluationPair
    numbers: tuple[int, ...]


_Answers = list[tuple[int, dict[str, Any]]]


def _answers(pool: Pool, jobs: Iterable[_Job]) -> Iterator[_Answers]:
    """The records of every job. Where a process died over several methods, each is tried alone."""
    apart: list[_Job] = []
    for job, found in run_surviving(pool, _predict_pair, jobs):
        if not isinstance(found, WorkerDied):
            yield found
        elif len(job.numbers) == 1:
            yield [(job.numbers[0], encode(_no_answer(job.pair, found.reason)))]
        else:
            apart += [replace(job, numbers=(number,)) for number in job.numbers]
    if apart:
        yield from _answers(pool, apart)


def _no_answer(pair: EvaluationPair, reason: str) -> Prediction:
    """What is kept of a method that took its process with it; how long it took is not known."""
    return Prediction(pair.id, None, None, None, (), None, None, math.nan, {}, None, reason)


class _Bench:
    """What a process keeps between pairs: methods and the maker of their input."""

    def __init__(self, specs: tuple[MethodSpec, ...], chosen: EvaluationSet) -> None:
        self.methods = [make_method(spec.spec, spec.assignments) for spec in specs]
        self.inputs = InputMaker(chosen.track, chosen.benchmark, chosen.root, seed=chosen.seed)
        self._warm: set[int] = set()

    def warm_up(self, number: int, given: MethodInput) -> None:
        """Let a method answer once in this process, off the clock: libraries load and threads start."""
        if number not in self._warm:
            self._warm.add(number)
            with suppress(GeoMoE3DError):
                self.methods[number](given)


_bench = lru_cache(maxsize=1)(_Bench)


def _predict_pair(job: _Job) -> _Answers:
    """The named methods on one pair, as records."""
    bench = _bench(job.specs, job.chosen)
    given = bench.inputs(job.pair)
    found = []
    for number in job.numbers:
        bench.warm_up(number, given)
        found.append((number, encode(predict_one(bench.methods[number], job.pair, given))))
    return found


def predict_one(method: Method, pair: EvaluationPair, given: MethodInput) -> Prediction:
    """One method on one pair, timed, its correspondences labelled.

    A `GeoMoE3DError` of the method makes a prediction without motion that holds its message.

    Raises:
        InputError: the method breaks its contract: weights or labels of another length than what it weighed.
    """
    error = None
    with PeakMemory() as memory:
        begin = time.perf_counter()
        try:
            answer = method(given)
        except GeoMoE3DError as caught:
            answer, error = Answer(None), str(caught)
        seconds = time.perf_counter() - begin
    _check_lengths(method, answer, given)
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
        stages={name: float(value) for name, value in answer.stages.items()},
        peak_memory=memory.peak,
        error=error,
    )


def _check_lengths(method: Method, answer: Answer, given: MethodInput) -> None:
    """Labels of another length would be cut or filled up as they are stored, and scored all the same."""
    rows = given.correspondences if answer.correspondences is None else answer.correspondences
    for what, values in (("weights", answer.weights), ("labels", answer.inliers)):
        if values is None:
            continue
        count = 0 if rows is None else len(rows)
        if np.shape(values) != (count,):
            raise InputError(
                f"{given.pair}: '{method.name}' gives {what} of shape {np.shape(values)} for {count} "
                f"correspondences, expected ({count},)"
            )


def _near(T: FloatArray | None, rows: FloatArray, limit: float) -> BoolArray:
    """(N,) True where a correspondence's residual under T is below the limit; all False without T."""
    if T is None:
        return np.zeros(len(rows), dtype=np.bool_)
    residuals = np.linalg.norm(transform_points(T, rows[:, :3]) - rows[:, 3:], axis=1)
    return np.asarray(residuals < limit)
