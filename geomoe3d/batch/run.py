"""Many pairs registered into a folder: started, killed, gone on with, finished; on one machine or on many."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import BrokenExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from geomoe3d.batch.contents import Contents
from geomoe3d.batch.folder import (
    PAGE_FILE,
    PAGES_FOLDER,
    TRANSFORMS_FOLDER,
    check_can_be_folder,
    check_extras,
    extras_of,
    write_transforms,
)
from geomoe3d.batch.memory import LONG_READ, choose_workers, gibibytes, worker_bytes
from geomoe3d.batch.mix import shared_out
from geomoe3d.batch.store import BatchStore, Outcome
from geomoe3d.batch.table import PairLike, PairRow, as_rows, read_pairs
from geomoe3d.batch.task import Settings, Task, as_record, make_ready, register_pair
from geomoe3d.clouds.transform_files import has_transform
from geomoe3d.config import RegistrationConfig
from geomoe3d.errors import InputError, OutputError
from geomoe3d.features.cache import CACHE_VARIABLE, default_cache_folder
from geomoe3d.pipeline import resolved
from geomoe3d.runtime.progress import Watch, shows_progress
from geomoe3d.runtime.words import counted
from geomoe3d.runtime.workers import DaskPool, Pool, ProcessPool, SerialPool, WorkerDied, run_surviving


@dataclass(frozen=True)
class BatchReport:
    """What a batch came to.

    Attributes:
        folder: of the batch.
        outcomes: one per pair, in the order given.
        made: pairs done by this call.
        kept: pairs that were done already.
        share: of the registered pairs, those that seem to belong together; None where no confidence is lower for it
            (`geomoe3d.batch.mix`).
    """

    folder: Path
    outcomes: tuple[Outcome, ...]
    made: int
    kept: int
    share: float | None = None

    @property
    def ok(self) -> bool:
        """True where every pair is sure."""
        return all(outcome.status == "ok" for outcome in self.outcomes)

    def table(self) -> Any:
        """A row per pair, in the order given: id, status, confidence, overlap, the transform, reasons.

        Returns:
            A pandas DataFrame where pandas is installed, else a list of dictionaries; NaN and None where a pair
            could not be registered, whose error then stands among the reasons.
        """
        rows = [outcome.row() for outcome in self.outcomes]
        try:
            from pandas import DataFrame
        except ImportError:
            return rows
        return DataFrame(rows)

    def counts(self) -> dict[str, int]:
        """Number of pairs by status, the frequent first."""
        found: dict[str, int] = {}
        for outcome in self.outcomes:
            found[outcome.status] = found.get(outcome.status, 0) + 1
        return dict(sorted(found.items(), key=lambda item: (-item[1], item[0])))


@dataclass(frozen=True)
class Labour:
    """Who does the work.

    Attributes:
        workers: local processes; None: this process; 0: as many as cores and memory allow.
        scheduler: address of a Dask scheduler, whose workers are used instead.
        cache: folder of described clouds; None: the user's own on each machine; empty: none.
    """

    workers: int | None = None
    scheduler: str | None = None
    cache: str | None = None

    def checked(self) -> Labour:
        """The same with the folder of the cache found, once for all workers of this machine.

        What needs no look at the pairs is refused.

        Raises:
            InputError: workers and a scheduler at once.
            OutputError: the cache is no folder.
        """
        if self.scheduler is not None and self.workers is not None:
            raise InputError("give either workers or a scheduler: a cluster has its own workers")
        cache = self.cache
        if cache is None and self.scheduler is None:  # the workers of a cluster have their own
            cache = os.environ.get(CACHE_VARIABLE)
        if cache:
            check_can_be_folder(Path(cache), "the cache of features is a folder: give one, or none")
        if self.cache is None and self.scheduler is None:
            return replace(self, cache=str(default_cache_folder() or ""))
        return self

    def pool(self, each: int, say: Callable[[str], None]) -> Pool:
        """Where to run, after saying how much memory it takes.

        Args:
            each: bytes that a worker takes, from `geomoe3d.batch.memory`.
            say: called with a sentence.

        Raises:
            InputError, DependencyError: as the pools of `geomoe3d.runtime.workers` and `choose_workers`.
        """
        if self.scheduler is not None:
            pool = DaskPool(self.scheduler)
            say(f"{pool.describe()}; the largest pair takes about {gibibytes(each)} of a worker")
            return pool
        if self.workers is None:
            say(f"this process; the largest pair takes about {gibibytes(each)}")
            return SerialPool()
        workers, limit = choose_workers(self.workers or None, each)
        held = "" if limit is None else f", each held to {gibibytes(limit)}"
        say(f"{workers} worker{'s' * (workers > 1)} of about {gibibytes(each)}{held}")
        return ProcessPool(workers, threads=1, memory_limit=limit)  # the same bytes for any number of workers


def try_out(pool: Pool, settings: Settings) -> None:
    """Let a worker make ready, so that what it refuses is known before anything is written or removed. Raises
    OutputError: it died. What it refuses passes through, see `geomoe3d.batch.task.make_ready`."""
    try:
        pool.open().submit(make_ready, settings).result()
    except Exception as error:
        if not isinstance(error, BrokenExecutor) and type(error).__name__ != "KilledWorker":
            raise
        raise OutputError(
            "a worker died as it began, so nothing was done: it may lack memory (give fewer workers), and a "
            'script that asks for workers needs `if __name__ == "__main__":`'
        ) from None


def register_pairs(
    pairs: str | os.PathLike[str] | Iterable[PairLike | PairRow],
    out: str | os.PathLike[str],
    *,
    config: RegistrationConfig | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    transforms: bool = False,
    page: bool = False,
    pages: bool = False,
    fresh: bool = False,
    retry: bool = False,
    cache: str | None = None,
    progress: Watch = None,
    say: Callable[[str], None] | None = None,
) -> BatchReport:
    """Register many pairs into a folder, where an interrupted batch is gone on with.

    Called again with the same folder it does what is missing: new pairs, and pairs whose row or files
    changed. A cloud that cannot be read fails its own pairs alone. Answers do not depend on who did the work. Where few
    of the pairs belong together, confidences are lower than of each pair alone (`geomoe3d.batch.mix`).

    Args:
        pairs: a CSV file as `geomoe3d.batch.table.read_pairs` explains, or (source, target) paths.
        out: folder; made if missing. ``journal.jsonl`` grows as pairs are finished, ``results.jsonl`` is
            written in the end.
        config: of all pairs; None takes the defaults.
        workers: local processes, 0 as many as fit; None works in this process. More than one process needs
            the caller's script to be importable (``if __name__ == "__main__":``).
        scheduler: address of a Dask scheduler instead; its workers must see the files under the same paths.
        transforms: write ``transforms/<id>.txt`` for every pair that has a transform.
        page: write ``page.html`` with a picture of every pair.
        pages: write ``pages/<id>.html`` for every pair that has a transform, to turn its clouds in. These three, where
            an earlier call wrote them, are always brought up to date.
        fresh: forget what the folder holds of an earlier batch; not before all that can be refused is known.
        retry: do the pairs again that could not be registered.
        cache: folder of described clouds; None: the user's own; "": none.
        progress: called with (pairs done, pairs in all); None shows a bar when it takes long, and another as
            pictures are drawn; False shows nothing.
        say: called with a sentence on workers and memory before the work begins.

    Raises:
        InputError: a table that cannot be used, more workers than fit, or a folder with results of another
            configuration or with files of the user's under the names of a batch's own.
        DependencyError: Dask is not installed, or a worker has other versions.
        OutputError: the folder cannot be written, or another process is writing it; or the cache is a file.
    """
    is_table = isinstance(pairs, (str, os.PathLike))
    rows = read_pairs(pairs) if is_table else as_rows(pairs)  # type: ignore[arg-type]
    folder = Path(out)
    config = resolved(config)
    labour = Labour(workers, scheduler, cache).checked()
    store = BatchStore(folder, config, fresh=fresh)
    if not fresh:  # what an earlier call wrote must not show what is no longer so
        before = extras_of(folder)
        transforms, page, pages = transforms or before[0], page or before[1], pages or before[2]
    check_extras(folder, [row.id for row in rows], transforms=transforms, page=page, pages=pages)
    alone, kept = work(rows, store, config, labour, retry, progress=progress, say=say)
    records, share = shared_out(alone.values(), config)
    outcomes = tuple(store.outcome(records[row.id]) for row in rows)
    store.write_results(records[row.id] for row in rows)
    if transforms:
        found = ((o.id, o.result) for o in outcomes if o.result is not None and has_transform(o.result))
        write_transforms(folder / TRANSFORMS_FOLDER, found)
    told: Watch = False if progress is not None else None
    if pages:
        from geomoe3d.batch.pair_pages import write_pages

        write_pages(folder / PAGES_FOLDER, rows, outcomes, progress=told)
    if page:
        from geomoe3d.batch.page import save_batch_page

        save_batch_page(folder / PAGE_FILE, rows, outcomes, progress=told)
    return BatchReport(folder, outcomes, len(rows) - kept, kept, share)


def _fingerprints(rows: list[PairRow], contents: Contents, say: Callable[[str], None]) -> dict[str, str]:
    """Fingerprints by id, after saying so where many bytes must be read for them."""
    count, size = contents.unread(dict.fromkeys(path for row in rows for path in (row.source, row.target)))
    if size > LONG_READ:
        say(
            f"first reading {counted(count, 'new or changed file')} of {gibibytes(size)}, to know them again later"
        )
    try:
        return {row.id: row.fingerprint(contents) for row in rows}
    finally:
        contents.save()


@shows_progress("pairs")
def work(
    rows: list[PairRow],
    store: BatchStore,
    config: RegistrationConfig,
    labour: Labour,
    retry: bool = False,
    *,
    progress: Watch = None,
    say: Callable[[str], None] | None = None,
) -> tuple[dict[str, dict[str, Any]], int]:
    """Records of all rows by id, those that were missing made now, and how many were there.

    Where nothing has been written yet, all that can be refused is before anything is written or removed.
    """
    settings = Settings.of(config, labour.cache)
    say = say or (lambda text: None)
    pool: Pool | None = None
    try:
        if store.begins:
            pool = labour.pool(worker_bytes(rows), say)
            try_out(pool, settings)
            store.begin()
        with store.journal() as journal:
            wanted = _fingerprints(rows, store.contents, say)
            records = store.finished(wanted, with_errors=not retry)
            kept = len(records)
            if progress:
                progress(kept, len(rows))
            missing = [row for row in rows if row.id not in records]
            if not missing:
                return records, kept
            pool = pool or labour.pool(worker_bytes(missing), say)
            tasks = (Task(row, wanted[row.id], settings) for row in missing)
            for task, made in run_surviving(pool, register_pair, tasks):
                name = task.row.id
                if isinstance(made, WorkerDied):
                    made = as_record(name, task.fingerprint, None, made.reason)
                journal.append(made)
                records[name] = made
                if progress:
                    progress(len(records), len(rows))
        return records, kept
    finally:
        if pool is not None:
            pool.close()
