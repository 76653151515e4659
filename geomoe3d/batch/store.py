"""The folder of a batch: what it depends on, a journal of finished pairs, and the results in order.

``run.json`` holds the configuration and versions that decide every answer; a folder is only gone on with
under the same. ``journal.jsonl`` gets one line as each pair is finished. ``results.jsonl`` is written in the
end, in the order of the table and without times: the same bytes whoever worked on it; ``results.csv`` is the
same for spreadsheets. ``files.json`` keeps the hashes of the files, so that none is read twice for them.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from geomoe3d.batch.contents import CONTENTS_MARK, Contents
from geomoe3d.batch.folder import (
    CONTENTS_FILE,
    FORMAT,
    JOURNAL_FILE,
    RESULTS_FILE,
    RUN_FILE,
    TABLE_FILE,
    TABLE_HEAD,
    check_can_be_folder,
    foreign,
    has_mark,
    read_identity,
    remove_batch,
)
from geomoe3d.batch.table import MATRIX_COLUMNS
from geomoe3d.clouds.formats.registry import own_readers
from geomoe3d.config import RegistrationConfig
from geomoe3d.decision.answer import library_versions
from geomoe3d.errors import FormatError, InputError, OutputError
from geomoe3d.pipeline import Pipeline, resolved
from geomoe3d.result import RegistrationResult
from geomoe3d.runtime.csv_text import csv_text
from geomoe3d.runtime.files import make_folder, write_atomically, write_text
from geomoe3d.runtime.journal import Journal, read_journal
from geomoe3d.runtime.provenance import differences, hardware, in_words, source_commit


@dataclass(frozen=True)
class Outcome:
    """What became of one pair.

    Attributes:
        id: of the pair.
        result: the answer, or None where the pair could not be registered at all.
        error: the reason then.
    """

    id: str
    result: RegistrationResult | None
    error: str | None

    @property
    def status(self) -> str:
        """That of the result, or ``error``."""
        return "error" if self.result is None else self.result.status

    @property
    def confidence(self) -> float:
        """That of the result, or 0."""
        return 0.0 if self.result is None else self.result.confidence

    def row(self) -> dict[str, Any]:
        """The columns of `geomoe3d.batch.run.BatchReport.table`."""
        found = self.result
        return {
            "id": self.id,
            "status": self.status,
            "confidence": self.confidence,
            "overlap": float("nan") if found is None else found.overlap,
            "T_target_source": None if found is None else found.T_target_source,
            "reasons": self.error if found is None else "; ".join(found.reasons),
        }


class BatchStore:
    """The folder of one batch; looked at when made, written from `begin` on.

    Args:
        folder: there or to be made.
        config: of all its pairs.
        fresh: what it holds of an earlier batch does not count, and goes when this one begins.

    Attributes:
        folder: as given.
        begins: whether nothing of this batch has been written yet.
        contents: of the files of its pairs, to be asked once it has begun.

    Raises:
        InputError: the folder holds a batch of another configuration or version (names what differs), or
            files of the user's under the names of a batch's own.
        OutputError: the folder cannot be made or written.
        FormatError: a file in it is damaged.
        CheckpointError: the filter's weights are missing.
    """

    def __init__(self, folder: Path, config: RegistrationConfig, *, fresh: bool = False) -> None:
        self.folder = folder
        self._fresh = fresh
        self._shared: dict[str, Any] = {
            "config": config.model_dump(mode="json"),
            "versions": library_versions(),
            "seed": config.seed,
        }
        self._identity = {"format": FORMAT, **self._shared, "pipeline": Pipeline(resolved(config)).identity()}
        readers = own_readers()
        self._identity |= {"readers": readers} if readers else {}
        there = check_can_be_folder(folder, "results are written into a folder")
        if not os.access(there, os.W_OK | os.X_OK):
            raise OutputError(f"cannot write into '{folder}': no right to write into '{there}'")
        stored = read_identity(folder)
        self.begins = fresh or stored is None
        for path in (folder / JOURNAL_FILE, folder / RESULTS_FILE):
            if path.exists() and (stored is None or not path.is_file()):
                raise InputError(foreign(path))
        for path, mark in ((folder / TABLE_FILE, TABLE_HEAD), (folder / CONTENTS_FILE, CONTENTS_MARK)):
            if path.exists() and not has_mark(path, mark):
                raise InputError(foreign(path))
        self.contents = Contents(folder / CONTENTS_FILE)
        differing = {} if stored is None or fresh else differences(stored, self._identity)
        if differing:
            raise InputError(
                f"'{folder}' holds pairs that another configuration or version registered; its answers are not mixed "
                "with these. The same command with --fresh (fresh=True) registers every pair anew and takes what the "
                "cache has of the scans; another folder keeps both. They differ in "
                f"{in_words(differing)}"
            )

    def begin(self) -> None:
        """Make the folder, without what is left of an earlier batch where this one is fresh.

        Does nothing where the batch was begun before.

        Raises:
            OutputError: it cannot be written, or another process is writing it.
        """
        if not self.begins:
            return
        if self._fresh:
            remove_batch(self.folder)
        make_folder(self.folder)
        text = {
            "identity": self._identity,
            "commit": source_commit(),
            "hardware": hardware(),
            "created": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        }
        write_text(self.folder / RUN_FILE, json.dumps(text, indent=2) + "\n", force=False)
        self.begins = False

    def journal(self) -> Journal:
        """Open for appending; keeps a second process out."""
        return Journal(self.folder / JOURNAL_FILE)

    def finished(self, wanted: dict[str, str], *, with_errors: bool = True) -> dict[str, dict[str, Any]]:
        """Records of the pairs that are done, by id; of a pair that was done twice, the last.

        Args:
            wanted: fingerprint by id. A record of another fingerprint is of another input and not counted; one of
                another id is that of the same files elsewhere.
            with_errors: False leaves out the pairs that could not be registered.
        """
        found: dict[str, dict[str, Any]] = {}
        if self.begins:
            return found
        by_input: dict[Any, list[str]] = {}
        for name, fingerprint in wanted.items():
            by_input.setdefault(fingerprint, []).append(name)
        for record in read_journal(self.folder / JOURNAL_FILE):
            for name in by_input.get(record.get("fingerprint"), ()):
                elsewhere = record.get("error") is None and name not in found
                if name == record.get("id") or elsewhere:
                    found[name] = {**record, "id": name}
        if with_errors:
            return found
        return {name: record for name, record in found.items() if record.get("error") is None}

    def outcome(self, record: dict[str, Any]) -> Outcome:
        """A record as a result that can be used. Raises FormatError: the record is damaged."""
        try:
            name, plain, error = str(record["id"]), record["result"], record["error"]
            if plain is None:
                return Outcome(name, None, str(error))
            whole = {**plain, **self._shared, "seconds": record.get("seconds", {})}
            return Outcome(name, RegistrationResult.from_json(json.dumps(whole)), None)
        except (KeyError, TypeError, InputError) as error:
            raise FormatError(
                f"'{self.folder / JOURNAL_FILE}' holds a line that is no result: {error}"
            ) from None

    def write_results(self, records: Iterable[dict[str, Any]]) -> Path:
        """All records in the given order, without what differs from run to run; also as a table."""
        path = self.folder / RESULTS_FILE
        records = list(records)

        def write(temporary: Path) -> None:
            with temporary.open("w", encoding="utf-8", newline="\n") as stream:
                for record in records:
                    kept = {key: record[key] for key in ("id", "error", "result")}
                    stream.write(json.dumps(kept, allow_nan=False, separators=(",", ":")) + "\n")

        write_atomically(path, write, force=True)
        write_text(self.folder / TABLE_FILE, results_table(records), force=True)
        return path


def results_table(records: Iterable[dict[str, Any]]) -> str:
    """A row per pair for spreadsheets: id, status, confidence, overlap, the transform's 16 numbers, reasons.

    Cells without a value are empty; in place of reasons stands the error of a pair that has no result.
    """
    rows: list[list[Any]] = []
    for record in records:
        result = record["result"]
        if result is None:
            rows.append([record["id"], "error", *[""] * 18, record["error"]])
            continue
        matrix = [value for row in result["T_target_source"] for value in row]
        numbers = [result["confidence"], result["overlap"], *matrix]
        rows.append([record["id"], result["status"], *numbers, "; ".join(result["reasons"])])
    return csv_text([*TABLE_HEAD.rstrip(",").split(","), *MATRIX_COLUMNS, "reasons"], rows)
