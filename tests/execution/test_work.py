"""Work is the CPU time of calls; wall time stands beside it."""

from __future__ import annotations

import contextlib
import time

import pytest

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


class Clocks:
    """Wall and CPU time (ns) that only go on when told to."""

    def __init__(self) -> None:
        self.wall = self.cpu = self.asked = 0

    def monotonic_ns(self) -> int:
        return self.wall

    def thread_time_ns(self) -> int:
        self.asked += 1
        return self.cpu


def test_work_adds_short_calls_and_excludes_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = Clocks()
    monkeypatch.setattr("dataflow.execution.work.time", clocks)
    work = Work()
    for wall, cpu in [(1000, 1000)] * 1000 + [(5_000_000, 2000)]:
        with work:
            clocks.wall += wall
            clocks.cpu += cpu

    assert work.wall_ns == 1000 * 1000 + 5_000_000
    assert 1000 * 1000 <= work.cpu_ns <= 1100 * 1000
    assert clocks.asked < 200  # it costs as much as a short call


def test_a_call_that_fails_is_counted_too() -> None:
    work = Work()
    with contextlib.suppress(ZeroDivisionError), work:
        burn(0.01)
        1 / 0  # noqa: B018
    assert work.cpu_ns >= 10_000_000
