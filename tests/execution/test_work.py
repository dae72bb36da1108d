"""Work is the CPU time of calls; wall time stands beside it."""

from __future__ import annotations

import contextlib
import time

from dataflow.execution.work import Work


def burn(seconds: float) -> None:
    until = time.thread_time() + seconds
    while time.thread_time() < until:
        pass


def test_waiting_is_no_work_and_shows_in_wall_time() -> None:
    work = Work()
    with work:
        time.sleep(0.05)
    assert work.wall_ns >= 50_000_000
    assert work.cpu_ns < work.wall_ns / 2


def test_computing_is_work() -> None:
    work = Work()
    for _ in range(2):
        with work:
            burn(0.01)
    assert work.wall_ns >= work.cpu_ns * 0.999 >= 20_000_000 * 0.999


def test_a_call_that_fails_is_counted_too() -> None:
    work = Work()
    with contextlib.suppress(ZeroDivisionError), work:
        burn(0.01)
        1 / 0  # noqa: B018
    assert work.cpu_ns >= 10_000_000
