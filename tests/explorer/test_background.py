"""The thread of which only the newest request matters."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from ckc_pin.explorer.background import NewestTask


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_newer_request_replaces_the_one_that_waits() -> None:
    begun, may_end, done = [], threading.Event(), []

    def compute(what: int, is_outdated: Callable[[], bool]) -> None:
        begun.append(what)
        may_end.wait(30)
        done.append((what, is_outdated()))

    task = NewestTask(compute, "test")
    task.request(1)
    wait_for(lambda: begun == [1])
    for k in (2, 3, 4):
        task.request(k)
    assert task.is_busy
    may_end.set()
    wait_for(lambda: not task.is_busy)
    assert done == [(1, True), (4, False)]
    task.close()


def test_closed_task_ends_its_thread_and_computes_nothing_more() -> None:
    before, done = set(threading.enumerate()), []
    task = NewestTask(lambda what, is_outdated: done.append(what), "test", rests=True)
    assert set(threading.enumerate()) == before  # no thread without a request
    task.request(1)
    (thread,) = set(threading.enumerate()) - before
    wait_for(lambda: done == [1])
    task.close()
    task.close()
    thread.join(30)
    assert not thread.is_alive()
    task.request(2)
    assert not task.is_busy
    assert done == [1]


def test_thread_rests_as_long_as_it_computes() -> None:
    times = []

    def compute(what: int, is_outdated: Callable[[], bool]) -> None:
        times.append(time.monotonic())
        time.sleep(0.2)

    task = NewestTask(compute, "test", rests=True)
    task.request(1)
    wait_for(lambda: len(times) == 1)
    task.request(2)
    wait_for(lambda: len(times) == 2)
    assert times[1] - times[0] >= 0.39
    task.close()
