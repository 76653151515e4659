"""Threads: one for each of the many small matrix products of a registration, all there are for its parts.

Products of some hundred rows are over before a second thread has woken up; on a machine whose cores have
other work, waiting for it made solving four times slower. So BLAS keeps to one thread (`single_blas_thread`),
and work is divided where its parts are independent and large (`each`). Either way the same last bits come
out on any number of cores.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import copy_context
from functools import lru_cache
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
Other = TypeVar("Other")
THREADS_VARIABLE = "OMP_NUM_THREADS"

_lock = threading.Lock()
_depth = 0
_limits: Any = None
_inside = threading.local()


@contextmanager
def single_blas_thread() -> Iterator[None]:
    """Inside, BLAS calls of this process use one thread; also a decorator; may be nested, and entered
    by several threads at once: the last one out restores what was set before the first one came in."""
    global _depth, _limits
    with _lock:
        if _depth == 0:
            _limits = _controller().limit(limits=1, user_api="blas")
        _depth += 1
    try:
        yield
    finally:
        with _lock:
            _depth -= 1
            if _depth == 0:
                _limits.restore_original_limits()
                _limits = None


def usable_threads() -> int:
    """``OMP_NUM_THREADS`` where it is a positive number, as in worker processes, else the process's cores; one inside
    `each`, whose items have the others."""
    if getattr(_inside, "busy", False):
        return 1
    given = os.environ.get(THREADS_VARIABLE, "").split(",")[0].strip()
    if given.isdigit() and int(given) > 0:
        return int(given)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def each(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """``[function(item) for item in items]``, several at a time where there are threads for it.

    Results are in order, and the first item's exception in order is raised, as in a loop; but all items are
    begun. One inside another is a plain loop. With several threads BLAS keeps to one; in a plain loop it
    does as the caller said, so products that must not vary by a bit belong inside `single_blas_thread`. Threads take
    over the caller's context, as for `geomoe3d.config.expert`.
    Worth it from about a millisecond per item, spent outside the interpreter (numpy, torch).
    """
    todo = list(items)
    usable = usable_threads()
    if min(usable, len(todo)) < 2:
        return [function(item) for item in todo]
    futures: list[Future[Result]] = [Future() for _ in todo]
    numbers = iter(range(len(todo)))  # shared by the threads: `next` on it is atomic

    def work() -> None:
        _inside.busy = True
        try:
            for number in numbers:
                try:
                    futures[number].set_result(function(todo[number]))
                except BaseException as error:
                    futures[number].set_exception(error)
                    if not isinstance(error, Exception):  # an interrupt: nothing further is begun
                        for left in numbers:
                            futures[left].set_exception(error)
        finally:
            _inside.busy = False

    with single_blas_thread():
        helpers = []
        try:
            for _ in range(min(usable, len(todo)) - 1):
                helpers.append(_pool(os.getpid(), usable - 1).submit(copy_context().run, work))
        except RuntimeError:  # no thread can be started, as where the interpreter is ending: alone, then
            pass
        work()
        for helper in helpers:  # one that never began, as others kept the pool busy, has nothing to do
            helper.cancel()
        return [future.result() for future in futures]


def beside(first: Callable[[], Result], second: Callable[[], Other]) -> tuple[Result, Other]:
    """``(first(), second())``, the second on another thread where one is idle while the caller does the first.

    For a first one that keeps one thread busy most of the time; unlike an item of `each` it may itself go side by side.
    An exception of the first one comes before one of the second. BLAS and contexts are as in `each`.
    """
    if usable_threads() < 2:
        return first(), second()

    def work() -> Other:
        _inside.busy = True
        try:
            return second()
        finally:
            _inside.busy = False

    with single_blas_thread():
        try:
            begun = _pool(os.getpid(), usable_threads() - 1).submit(copy_context().run, work)
        except RuntimeError:  # as in `each`
            return first(), second()
        try:
            found = first()
        finally:
            mine = begun.cancel()  # nobody was idle
            if not mine:
                wait([begun])
        return found, second() if mine else begun.result()


def ahead(function: Callable[[Item], Result], items: Sequence[Item]) -> Callable[[int], Result]:
    """What gives ``function`` of an item by its number; that of the next one is made beside it, where a thread is idle:
    it is wanted as a rule."""
    made: dict[int, Result] = {}

    def of(number: int) -> Result:
        if number not in made:
            if number + 1 < len(items) and usable_threads() > 1:
                this, following = items[number], items[number + 1]
                made[number], made[number + 1] = beside(lambda: function(this), lambda: function(following))
            else:
                made[number] = function(items[number])
        return made[number]

    return of


@lru_cache(maxsize=1)
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """Helpers that wait for work; a forked process, which has not got them, makes its own."""
    return ThreadPoolExecutor(threads, thread_name_prefix="geomoe3d")


@lru_cache(maxsize=1)
def _controller() -> Any:
    """The libraries found once: looking for them takes 4 ms, which is much beside a small product."""
    import scipy.linalg  # noqa: F401 - brings a BLAS of its own, which must be there to be found
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
