"""Independent tasks in processes of their own, results as they finish, with bounded memory.

One code path for everything that is parallel over items: few tasks are under way at a time, so that an
interrupt loses little, and each worker gets a fixed number of threads, so that they do not fight for cores.
`run_surviving` goes on where workers die, on any executor of the ``concurrent.futures`` form: this process,
local processes, or a Dask cluster.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any, TypeVar

from geomoe3d.errors import InputError, OutputError
from geomoe3d.runtime.optional import optional_module
from geomoe3d.runtime.threads import THREADS_VARIABLE

Item = TypeVar("Item")
Result = TypeVar("Result")
_DIED = "the worker died over it several times, perhaps for lack of memory or by a fault of native code"
THREAD_VARIABLES = (THREADS_VARIABLE, "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class WorkerDied:
    """In place of a result: the workers died over this item, again and again."""

    reason: str


class Pool:
    """Where tasks run: opened when needed, and opened anew where its processes died.

    Attributes:
        opened: the executor in use, or None.
    """

    opened: Executor | None = None

    def open(self) -> Executor:
        """A working executor."""
        raise NotImplementedError

    def window(self) -> int:
        """Tasks to keep under way."""
        return 1

    def close(self, *, broken: bool = False) -> None:
        """Let go of the executor; tasks that have not begun are dropped.

        Args:
            broken: it has lost a process, and its others are ended too.
        """
        if broken and isinstance(self.opened, _LimitedPool):
            self.opened.kill()
        if self.opened is not None:
            self.opened.shutdown(wait=True, cancel_futures=True)
        self.opened = None


class _SerialExecutor(Executor):
    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(function(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class SerialPool(Pool):
    """This process, one task after the other."""

    def open(self) -> Executor:
        """See `Pool`."""
        self.opened = self.opened or _SerialExecutor()
        return self.opened


class ProcessPool(Pool):
    """Local processes, which end with this one however it ends.

    Args:
        workers: how many, at least 1.
        threads: of each.
        memory_limit: bytes of data that each may hold; beyond it an allocation fails there. None: no limit.

    Raises:
        InputError: fewer than one worker.
    """

    def __init__(self, workers: int, *, threads: int = 1, memory_limit: int | None = None) -> None:
        if workers < 1:
            raise InputError(f"there must be at least 1 worker, found {workers}")
        self._workers, self._threads, self._limit = workers, threads, memory_limit

    def open(self) -> Executor:
        """See `Pool`."""
        if self.opened is None:
            self.opened = _LimitedPool(
                self._workers,
                self._threads,
                initializer=_begin_worker,
                initargs=(os.getpid(), self._limit),
            )
        return self.opened

    def window(self) -> int:
        """See `Pool`."""
        return 2 * self._workers


class _KnownProcesses(SpawnContext):
    """Remembers every process that is started through it."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[SpawnProcess] = []

    def Process(self, *args: Any, **named: Any) -> SpawnProcess:  # type: ignore[override]
        process = SpawnProcess(*args, **named)
        self.started.append(process)
        return process


class _LimitedPool(ProcessPoolExecutor):
    """Processes are started by `submit`: the limit of threads must hold then."""

    def __init__(self, workers: int, threads: int, **named: Any) -> None:
        self._known = _KnownProcesses()
        super().__init__(workers, mp_context=self._known, **named)
        self._threads = threads

    def kill(self) -> None:
        """End every process; for a pool that has lost one, whose others are of no more use.

        The library ends them itself, but one that was just being started may escape it and wait for work for ever,
        and `shutdown` for it.
        """
        for process in self._known.started:
            if process.is_alive():
                process.kill()

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        with _limited_threads(self._threads):
            return super().submit(function, *args, **kwargs)


class DaskPool(Pool):
    """The workers of a running Dask scheduler.

    Args:
        address: of the scheduler, such as ``tcp://10.0.0.5:8786``.
        wait_seconds: how long to wait for the scheduler, and then for its first worker.

    Raises:
        DependencyError: Dask is not installed.
        InputError: no scheduler answers, or it has no workers.
    """

    def __init__(self, address: str, *, wait_seconds: float = 30.0) -> None:
        distributed = optional_module("distributed", "a cluster needs Dask", "dask distributed")
        try:
            self._client = distributed.Client(address, timeout=wait_seconds)
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(f"no Dask scheduler answers at '{address}': {error}") from None
        try:
            self._client.wait_for_workers(1, timeout=wait_seconds)
        except TimeoutError:
            self._client.close()
            raise InputError(
                f"the scheduler at '{address}' has no workers; start some: dask worker {address}"
            ) from None

    def open(self) -> Executor:
        """See `Pool`."""
        if self.opened is None:
            executor: Executor = self._client.get_executor(pure=False)
            self.opened = executor
        return self.opened

    def window(self) -> int:
        """See `Pool`; workers may come and go."""
        return 2 * max(1, int(sum(self._client.nthreads().values())))

    def describe(self) -> str:
        """How many workers with how much memory, for the eye."""
        workers = self._client.scheduler_info(n_workers=-1)["workers"].values()
        least = min((worker.get("memory_limit") or 0 for worker in workers), default=0)
        held = f", each held to {least / 2**30:.1f} GiB or more" if least else ""
        return f"{len(workers)} worker{'s' * (len(workers) != 1)} of the scheduler{held}"

    def close(self, *, broken: bool = False) -> None:
        """See `Pool`."""
        if self.opened is not None:
            self.opened.shutdown(wait=False)
        self.opened = None
        self._client.close()


def run_surviving(
    pool: Pool, function: Callable[[Item], Result], items: Iterable[Item]
) -> Iterator[tuple[Item, Result | WorkerDied]]:
    """Every item with its result, in the order in which they finish, though workers may die.

    Where a local process dies, all of its pool are lost, and which item was to blame is not known: what was
    under way is done again, one item at a time; one over which a process then dies twice more is given up.
    A Dask scheduler moves tasks of a dead worker by itself and gives one up after some deaths.

    Args:
        pool: where to run; it is closed in the end.
        function: at module level, so that another process finds it.
        items: picklable; read only as far as there is room.

    Raises:
        OutputError: the cluster went away. Exceptions of ``function`` pass through.
    """
    rest = iter(items)
    suspects: deque[tuple[Item, int]] = deque()
    waiting: dict[Future[Result], tuple[Item, int]] = {}
    try:
        while True:
            alone = bool(suspects)
            if alone:
                room = [suspects.popleft()] if not waiting else []
            else:
                room = [(item, 0) for item in islice(rest, max(0, pool.window() - len(waiting)))]
            for item, deaths in room:
                waiting[_submit(pool, function, item)] = item, deaths
            if not waiting:
                return
            done, _ = wait(waiting, return_when=FIRST_COMPLETED)
            if any(isinstance(_failure(future), BrokenExecutor) for future in done):
                done, _ = wait(waiting)
                pool.close(broken=True)
            for future in done:
                item, deaths = waiting.pop(future)
                error = _failure(future)
                if error is None:
                    yield item, future.result()
                elif isinstance(error, BrokenExecutor):
                    if deaths > 1:  # one may be chance
                        yield item, WorkerDied(_DIED)
                    else:
                        suspects.append((item, deaths + 1))
                elif type(error).__name__ == "KilledWorker":
                    yield item, WorkerDied(_DIED)
                elif isinstance(error, CancelledError):
                    raise OutputError(
                        "the cluster went away; what is finished is kept: start again to go on with the rest"
                    ) from None
                else:
                    raise error
    finally:
        pool.close()


def _submit(pool: Pool, function: Callable[[Item], Result], item: Item) -> Future[Result]:
    try:
        return pool.open().submit(function, item)
    except BrokenExecutor as error:  # it broke just now; to be treated like those under way
        future: Future[Result] = Future()
        future.set_exception(error)
        return future


def _failure(future: Future[Any]) -> BaseException | None:
    try:
        return future.exception()
    except CancelledError as error:
        return error


def _begin_worker(parent: int, memory_limit: int | None) -> None:
    """Ends this process soon after its parent, and makes allocations beyond the limit fail."""
    if memory_limit is not None:
        try:
            import resource

            resource.setrlimit(resource.RLIMIT_DATA, (memory_limit, memory_limit))
        except (ImportError, ValueError, OSError):  # not on this system
            pass

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)  # nobody is left to take the result

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _limited_threads(threads: int) -> Iterator[None]:
    """Processes started inside inherit the limit."""
    kept = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(threads)))
    try:
        yield
    finally:
        for name, value in kept.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
