"""The cache of predictions: one folder per run, guarded by what the run depends on.

``<study>/<label>.<track>.<benchmark>/run.json`` says what the predictions come from, ``predictions.jsonl``
beside it holds them, one line per pair. A run is only ever continued with the very same identity: settings,
method, code, input. Weights are stored in half precision and label sets as bits: about 3 kB per pair of 1,000
correspondences.
"""

from __future__ import annotations

import base64
import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from geomoe3d.errors import FormatError, InputError, plain_reason
from geomoe3d.evaluation.records import Labels, Prediction, RunInfo
from geomoe3d.runtime.files import make_folder, remove, write_text
from geomoe3d.runtime.journal import Journal, read_journal
from geomoe3d.runtime.plain import parse_json
from geomoe3d.runtime.provenance import differences, in_words
from geomoe3d.types import BoolArray, FloatArray

RUN_FILE = "run.json"
PREDICTIONS_FILE = "predictions.jsonl"
PHOTOGRAPHS = "photographs"
"""The track of what `evaluate images --keep` keeps, which is scored there alone."""


def open_run(folder: Path, info: RunInfo) -> tuple[Journal, set[str]]:
    """The journal of a run, and the pairs that it holds already; the folder is made if missing.

    Raises:
        InputError: the folder holds predictions of another identity (names what differs) or of none.
        OutputError: the folder or its files cannot be written, or another process writes them.
        FormatError: a file in it is damaged.
    """
    make_folder(folder)
    if (folder / RUN_FILE).is_file():
        differing = differences(_compared(read_info(folder)), _compared(info))
        if differing:
            other = (
                "holds predictions of another run; give another folder or label, or --fresh to predict again"
            )
            if info.track == PHOTOGRAPHS:
                other = "keeps pairs of other arguments or of another version; give another folder, or remove this one"
            raise InputError(f"'{folder}' {other}. They differ in {in_words(differing)}")
    else:
        if (folder / PREDICTIONS_FILE).is_file() and (folder / PREDICTIONS_FILE).stat().st_size:
            raise InputError(
                f"'{folder}' holds predictions, but '{RUN_FILE}', which says what they come from, is gone; "
                "give another folder or label, or --fresh to predict again"
            )
        write_text(folder / RUN_FILE, json.dumps(asdict(info), indent=2) + "\n", force=False)
    journal = Journal(folder / PREDICTIONS_FILE)
    try:
        done = {str(record.get("pair")) for record in read_journal(journal.path)}
    except BaseException:
        journal.close()
        raise
    return journal, done


def remove_run(folder: Path) -> None:
    """Delete the predictions of a run and what it says of itself; nothing else in the folder is touched.
    Raises OutputError: a file cannot be removed, or another process is writing the predictions."""
    if (folder / PREDICTIONS_FILE).is_file():
        Journal(folder / PREDICTIONS_FILE).close()  # refused while another process holds it
    remove(folder / name for name in (PREDICTIONS_FILE, RUN_FILE))


def find_runs(study: Path) -> list[Path]:
    """Folders of the runs in a study: itself, or those inside it, by name. Raises InputError: there is none."""
    if (study / RUN_FILE).is_file():
        return [study]
    found = sorted(path.parent for path in study.glob(f"*/{RUN_FILE}")) if study.is_dir() else []
    if not found:
        raise InputError(
            f"'{study}' holds no predictions ({RUN_FILE}); `geomoe3d evaluate predict` makes them"
        )
    return found


def read_info(folder: Path) -> RunInfo:
    """What a run says of itself. Raises FormatError: run.json is damaged."""
    path = folder / RUN_FILE
    try:
        return RunInfo(**parse_json(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise FormatError(f"'{path}' does not describe a run: {error}") from None


def read_predictions(folder: Path) -> list[Prediction]:
    """The predictions of a run; of a pair that was written twice, the first. Raises FormatError: a line is
    damaged; names it."""
    predictions: dict[str, Prediction] = {}
    path = folder / PREDICTIONS_FILE
    for number, record in enumerate(read_journal(path), start=1):
        try:
            prediction = decode(record)
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(
                f"'{path}' line {number} is no prediction ({plain_reason(error)}); the file was damaged: remove "
                "that line and predict again, and what it stood for is done again"
            ) from None
        predictions.setdefault(prediction.pair, prediction)
    return list(predictions.values())


def encode(prediction: Prediction) -> dict[str, Any]:
    """A prediction as JSON; infinite or NaN motions are no motion."""
    labels = prediction.labels
    return {
        "pair": prediction.pair,
        "T": _matrix(prediction.T_target_source),
        "confidence": prediction.confidence,
        "status": prediction.status,
        "hypotheses": [_matrix(T) for T in prediction.hypotheses],
        "labels": None
        if labels is None
        else {
            "count": len(labels.true),
            "true": _bits(labels.true),
            "kept": None if labels.kept is None else _bits(labels.kept),
            "verified": _bits(labels.verified),
        },
        "weights": None if prediction.weights is None else _halves(prediction.weights),
        "seconds": None if math.isnan(prediction.seconds) else prediction.seconds,
        "stages": prediction.stages,
        "peak_memory": prediction.peak_memory,
        "error": prediction.error,
    }


def decode(record: dict[str, Any]) -> Prediction:
    """Inverse of `encode`. Raises KeyError, TypeError, ValueError: the record is no prediction."""
    stored = record["labels"]
    labels = None
    if stored is not None:
        count = int(stored["count"])
        kept = None if stored["kept"] is None else _from_bits(stored["kept"], count)
        labels = Labels(_from_bits(stored["true"], count), kept, _from_bits(stored["verified"], count))
    weights = record["weights"]
    return Prediction(
        pair=str(record["pair"]),
        T_target_source=_from_matrix(record["T"]),
        confidence=record["confidence"],
        status=record["status"],
        hypotheses=tuple(T for T in map(_from_matrix, record["hypotheses"]) if T is not None),
        labels=labels,
        weights=None
        if weights is None
        else np.frombuffer(base64.b64decode(weights), dtype="<f2").astype(np.float64),
        seconds=math.nan if record["seconds"] is None else float(record["seconds"]),
        stages=dict(record["stages"]),
        peak_memory=record["peak_memory"],
        error=record["error"],
    )


def _matrix(T: FloatArray | None) -> list[float] | None:
    return None if T is None or not np.isfinite(T).all() else [float(value) for value in np.ravel(T)]


def _from_matrix(values: list[float] | None) -> FloatArray | None:
    return None if values is None else np.array(values, dtype=np.float64).reshape(4, 4)


def _bits(mask: BoolArray) -> str:
    return base64.b64encode(np.packbits(mask).tobytes()).decode("ascii")


def _from_bits(text: str, count: int) -> BoolArray:
    packed = np.frombuffer(base64.b64decode(text), dtype=np.uint8)
    return np.unpackbits(packed, count=count).astype(np.bool_)


def _halves(weights: FloatArray) -> str:
    return base64.b64encode(np.asarray(weights).astype("<f2").tobytes()).decode("ascii")


def _compared(info: RunInfo) -> dict[str, Any]:
    """What decides predictions. Commit, hardware and time are told, not compared."""
    named = {"method name": info.method, "track": info.track, "benchmark": info.benchmark, "seed": info.seed}
    return {**info.identity, **named}
