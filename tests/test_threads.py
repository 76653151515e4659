"""Work side by side gives what a loop gives."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from geomoe3d.runtime import threads
from geomoe3d.runtime.threads import ahead, beside, each, usable_threads


@pytest.fixture
def three_threads(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")


def test_results_are_in_the_order_of_the_items(three_threads):
    assert each(lambda x: x * x, range(100)) == [x * x for x in range(100)]
    assert each(lambda x: x, []) == []


def test_items_are_done_at_the_same_time(three_threads):
    meeting = threading.Barrier(3, timeout=10)  # passes only where three stand at it together
    each(lambda _: meeting.wait(), range(3))


def test_one_thread_is_a_plain_loop(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert set(each(lambda _: threading.get_ident(), range(5))) == {threading.get_ident()}


def test_the_first_failure_in_order_is_raised(three_threads):
    def fail(x):
        if x >= 4:
            raise KeyError(x)
        return x

    with pytest.raises(KeyError, match="4"):
        each(fail, range(9))


def test_one_inside_another_is_a_loop(three_threads):
    def inner(_):
        outside = threading.get_ident()
        return each(lambda _: threading.get_ident(), range(4)) == [outside] * 4

    assert all(each(inner, range(6)))


def test_two_things_are_done_beside_each_other_and_the_first_may_go_side_by_side(three_threads):
    meeting = threading.Barrier(3, timeout=10)  # the second, and both items of the first
    assert beside(lambda: each(lambda _: meeting.wait(), range(2)), lambda: meeting.wait() >= 0)[1] is True
    assert len(set(beside(lambda: 1, lambda: each(lambda _: threading.get_ident(), range(3)))[1])) == 1
    assert each(lambda _: usable_threads(), range(2)) == [1, 1]


def test_beside_with_one_thread_is_one_after_the_other(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    order = []
    beside(lambda: order.append(threading.get_ident()), lambda: order.append(threading.get_ident()))
    assert order == [threading.get_ident()] * 2


@pytest.mark.parametrize("threads_used", ["1", "3"])
def test_a_failure_of_the_first_comes_before_one_of_the_second(monkeypatch, threads_used):
    monkeypatch.setenv("OMP_NUM_THREADS", threads_used)

    def fail(error):
        raise error

    with pytest.raises(KeyError):
        beside(lambda: fail(KeyError()), lambda: fail(ValueError()))
    with pytest.raises(ValueError):
        beside(lambda: None, lambda: fail(ValueError()))


def test_many_callers_share_the_helpers(three_threads):
    with ThreadPoolExecutor(8) as pool:
        sums = list(pool.map(lambda k: sum(each(lambda x: x + k, range(20))), range(40)))
    assert sums == [190 + 20 * k for k in range(40)]


def test_a_thread_that_outlives_the_main_one_does_its_work_alone():
    code = """
import threading, time
from geomoe3d.runtime.threads import each
def late():
    time.sleep(0.5)
    print(each(lambda x: x + 1, range(4)))
threading.Thread(target=late).start()
"""
    environment = {**os.environ, "OMP_NUM_THREADS": "2"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stdout.strip() == "[1, 2, 3, 4]", done.stderr


def test_an_interrupt_begins_nothing_further(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    begun = []

    def stop(x):
        begun.append(x)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        each(stop, range(50))
    assert len(begun) <= 2


@pytest.mark.parametrize("given", ["", "none", "0", "-2"])
def test_threads_without_a_usable_number_are_the_cores(monkeypatch, given):
    monkeypatch.setenv("OMP_NUM_THREADS", given)
    assert 1 <= usable_threads() <= (os.cpu_count() or 1)


def test_threads_as_the_variable_says(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "5,2")
    assert usable_threads() == 5


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_process_has_helpers_of_its_own(three_threads):
    each(lambda x: x, range(3))
    child = os.fork()
    if child == 0:
        try:
            signal.alarm(20)  # no child may wait for helpers that it has not got
            os._exit(0 if threads.each(lambda x: x + 1, range(9)) == list(range(1, 10)) else 1)
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.mark.parametrize("threads_used", ["1", "3"])
def test_ahead_makes_each_once_and_at_most_one_more_than_was_asked_for(monkeypatch, threads_used):
    monkeypatch.setenv("OMP_NUM_THREADS", threads_used)
    made = []
    of = ahead(lambda item: (made.append(item), item * 10)[1], [1, 2, 3])
    assert of(0) == 10 and sorted(made) == ([1] if threads_used == "1" else [1, 2])
    assert [of(k) for k in range(3)] == [10, 20, 30] and sorted(made) == [1, 2, 3]
