"""A process is watched over to its end, whatever goes wrong in the watching."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from dataflow.process import watchdog as module
from dataflow.process.channel import ChannelClosed
from dataflow.process.watchdog import Watchdog


class Beats:
    """A supervisor that refuses what it is told at first."""

    def __init__(self, *refusals: Exception) -> None:
        self.refusals = list(refusals)
        self.memory: list[int] = []
        self.heard, self.refused = threading.Event(), threading.Event()

    def send(self, kind: str, /, **fields: Any) -> None:
        assert kind == "beat"
        if self.refusals:
            self.refused.set()
            raise self.refusals.pop(0)
        self.memory.append(fields["memory"])
        self.heard.set()


def test_an_unexpected_exception_does_not_end_the_watching(capsys: pytest.CaptureFixture[str]) -> None:
    beats = Beats(ValueError("who is this"))
    watchdog = Watchdog(beats, [], deadlines=True)

    assert beats.heard.wait(10)
    watchdog.stop()

    assert beats.memory[0] > 0
    assert "watchdog: ValueError: who is this" in capsys.readouterr().err


def test_a_process_whose_memory_is_unknown_still_gives_signs_of_life(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(self: psutil.Process) -> None:
        raise OSError(24, "too many open files")

    monkeypatch.setattr(psutil.Process, "memory_info", unknown)
    beats = Beats()
    watchdog = Watchdog(beats, [], deadlines=True)

    assert beats.heard.wait(10)
    watchdog.stop()

    assert beats.memory[0] == 0


def test_the_watching_ends_when_the_supervisor_is_gone() -> None:
    beats = Beats(ChannelClosed("gone"))
    watchdog = Watchdog(beats, [], deadlines=True)

    assert beats.refused.wait(10)
    watchdog._thread.join(10)

    assert not watchdog._thread.is_alive()
    watchdog.stop()


class Looked:
    """A watchdog that looks when the test says, at one operator with a deadline of 200 ms that is at a call."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = self.cpu = 10.0
        self.overdue: list[float] = []
        self.work: list[Any] = []
        thread = SimpleNamespace(start=lambda: None)
        monkeypatch.setattr(module, "threading", SimpleNamespace(Event=threading.Event, Thread=lambda **fields: thread))
        clock = SimpleNamespace(monotonic=lambda: self.now, process_time=lambda: self.cpu)
        monkeypatch.setattr(module, "time", clock)
        node = SimpleNamespace(name="n", live=SimpleNamespace(deadline=200_000_000))
        self.runner = SimpleNamespace(node=node, working_since=10.0, working_stamp=5)
        self._watchdog = Watchdog(self, [self.runner], deadlines=True)

    def send(self, kind: str, /, **fields: Any) -> None:
        if kind == "overdue":
            self.overdue.append(round(fields["seconds"], 6))
        else:
            self.work.append(fields["work"])

    def look(self, *, after: float, computed: float = 0.0) -> None:
        self.now += after
        self.cpu += computed
        self._watchdog._look()


def test_a_call_is_overdue_after_its_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    looked = Looked(monkeypatch)
    looked.look(after=0.1)
    looked.look(after=0.09)
    assert looked.overdue == []
    looked.look(after=0.1)
    assert looked.overdue == [0.29]


def test_a_time_in_which_the_process_was_stopped_is_no_part_of_a_call(monkeypatch: pytest.MonkeyPatch) -> None:
    looked = Looked(monkeypatch)
    looked.look(after=0.05)
    looked.look(after=60.0)

    assert looked.overdue == []
    assert looked.work == [None, None]  # no call of more than a second
    for _ in range(3):
        looked.look(after=0.05)
    assert looked.overdue == [0.25]


def test_a_call_that_keeps_pythons_lock_counts_in_full(monkeypatch: pytest.MonkeyPatch) -> None:
    looked = Looked(monkeypatch)
    looked.look(after=0.05)
    looked.look(after=4.0, computed=4.0)

    assert looked.overdue == [4.05]
    assert looked.work[-1] == ("n", 5, pytest.approx(4.05))
