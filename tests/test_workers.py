"""Tasks in processes: each once, errors told, memory bounded, and nobody left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from dying_tasks import die_always, die_once

from geomoe3d.errors import InputError
from geomoe3d.runtime.workers import Pool, ProcessPool, SerialPool, WorkerDied, run_surviving


def _square(number):
    if number < 0:
        raise InputError(f"{number} is negative")
    time.sleep(0.01)
    return number * number, os.environ.get("OMP_NUM_THREADS")


def _pool(workers: int) -> Pool:
    return SerialPool() if workers == 1 else ProcessPool(workers, threads=1)


@pytest.mark.parametrize("workers", [1, 2])
def test_every_item_is_done_once(workers):
    items = list(range(30))
    results = list(run_surviving(_pool(workers), _square, iter(items)))
    assert sorted(item for item, _ in results) == items
    assert all(square == item * item for item, (square, _) in results)
    if workers > 1:
        assert {threads for _, (_, threads) in results} == {"1"}


@pytest.mark.parametrize("workers", [1, 2])
def test_errors_of_an_item_pass_through(workers):
    with pytest.raises(InputError, match="negative"):
        list(run_surviving(_pool(workers), _square, [1, -2, 3]))


def test_items_are_read_only_as_far_as_needed():
    taken = []

    def items():
        for k in range(100):
            taken.append(k)
            yield k

    results = run_surviving(_pool(2), _square, items())
    next(results)
    assert len(taken) <= 8
    results.close()


def test_no_workers_is_refused():
    with pytest.raises(InputError, match="at least 1"):
        ProcessPool(0)


_PARENT = """
import os, sys, time
from geomoe3d.runtime.workers import ProcessPool, run_surviving
sys.path.insert(0, sys.argv[1])
from napping import nap
if __name__ == "__main__":
    for _ in run_surviving(ProcessPool(2), nap, [sys.argv[2]] * 100):
        pass
"""
_NAP = """
import os, time
def nap(folder):
    open(f"{folder}/{os.getpid()}", "w").close()
    time.sleep(0.05)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
def test_workers_end_with_a_parent_that_is_killed(tmp_path: Path):
    (tmp_path / "napping.py").write_text(_NAP)
    (tmp_path / "parent.py").write_text(_PARENT)
    seen = tmp_path / "seen"
    seen.mkdir()
    process = subprocess.Popen([sys.executable, tmp_path / "parent.py", tmp_path, seen])
    deadline = time.monotonic() + 60
    while len(list(seen.iterdir())) < 2:
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    workers = [Path("/proc") / path.name for path in seen.iterdir()]
    while any(worker.exists() for worker in workers):
        assert time.monotonic() < deadline, "workers outlive their parent"
        time.sleep(0.1)


# ---- workers that die --------------------------------------------------------------------------------


def square(number):
    return number * number


def complain(number):
    raise InputError(f"number {number}")


def hungry(_):
    return len(bytearray(3 << 30))


def test_results_of_a_pool_that_loses_no_worker():
    found = dict(run_surviving(SerialPool(), square, range(7)))
    assert found == {k: k * k for k in range(7)}
    assert list(run_surviving(SerialPool(), square, [])) == []
    with pytest.raises(InputError, match="number 0"):
        list(run_surviving(SerialPool(), complain, range(3)))


def test_workers_that_are_killed_lose_nothing_and_repeat_no_result(tmp_path):
    jobs = [(number, str(tmp_path)) for number in range(8)]
    found = [made for _, made in run_surviving(ProcessPool(2), die_once, jobs)]
    assert sorted(found) == list(range(8))
    assert len(list(tmp_path.iterdir())) == 3


def test_an_item_that_kills_every_worker_is_given_up_alone():
    found = dict(run_surviving(ProcessPool(2), die_always, range(5)))
    assert isinstance(found.pop(2), WorkerDied)
    assert found == {k: k for k in (0, 1, 3, 4)}


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of memory as Linux has them")
def test_a_worker_is_held_to_its_memory():
    with pytest.raises(MemoryError):
        list(run_surviving(ProcessPool(1, memory_limit=1 << 30), hungry, [0]))


def test_a_worker_that_outlives_its_broken_pool_is_ended():
    """One that waits for work that never comes would be waited for in turn."""
    pool = ProcessPool(2)
    executor = pool.open()
    list(executor.map(square, range(4)))
    workers = executor._known.started
    assert workers
    assert all(worker.is_alive() for worker in workers)
    pool.close(broken=True)
    assert not any(worker.is_alive() for worker in workers)
    assert pool.opened is None
