"""Independent tasks in processes of their own, results as they finish, with bounded memory.

One code path for everything that is parallel over items: few tasks are under way at a time, so that an
interrupt loses little, and each worker gets a fixed number of threads, so that they do not fight for cores.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from multiprocessing import get_context
from typing import Any, TypeVar

from geomoe3d.errors import InputError, OutputError

Item = TypeVar("Item")
Result = TypeVar("Result")
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def run_parallel(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    workers: int,
    threads: int = 1,
    setup: Callable[..., None] | None = None,
    arguments: tuple[Any, ...] = (),
) -> Iterator[Result]:
    """Results of ``function`` over ``items``, in the order in which they finish.

    Args:
        function: at module level, so that another process finds it.
        items: picklable; read only as far as there is room.
        workers: 1 works in this process, in order, with its own number of threads; more start as many.
        threads: threads of each started worker; libraries read it as they are imported.
        setup: called once in each worker before its first item.
        arguments: of ``setup``.

    Raises:
        InputError: fewer than one worker.
        OutputError: a worker died, for instance for lack of memory. Exceptions of ``function`` pass through.
    """
    if workers < 1:
        raise InputError(f"there must be at least 1 worker, found {workers}")
    if workers == 1:
        if setup is not None:
            setup(*arguments)
        yield from map(function, items)
        return
    with _limited_threads(threads):
        pool = ProcessPoolExecutor(
            workers, mp_context=get_context("spawn"), initializer=setup, initargs=arguments
        )
        try:
            yield from run_on(pool, function, items, window=2 * workers)
        except BrokenProcessPool:
            raise OutputError(
                "a worker died, perhaps for lack of memory; what is finished is kept: start again, with "
                "fewer workers"
            ) from None
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def run_on(
    executor: Executor, function: Callable[[Item], Result], items: Iterable[Item], *, window: int
) -> Iterator[Result]:
    """As `run_parallel` on any executor of the ``concurrent.futures`` form, ``window`` tasks under way."""
    rest = iter(items)
    waiting: set[Future[Result]] = set()
    while True:
        waiting |= {executor.submit(function, item) for item in islice(rest, window - len(waiting))}
        if not waiting:
            return
        done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
        for future in done:
            yield future.result()


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
