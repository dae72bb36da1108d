"""A process is watched over to its end, whatever goes wrong in the watching."""

from __future__ import annotations

import threading
from typing import Any

import psutil
import pytest

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
    watchdog = Watchdog(beats, [], deadlines=True)  # type: ignore[arg-type]

    assert beats.heard.wait(10)
    watchdog.stop()

    assert beats.memory[0] > 0
    assert "watchdog: ValueError: who is this" in capsys.readouterr().err


def test_a_process_whose_memory_is_unknown_still_gives_signs_of_life(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(self: psutil.Process) -> None:
        raise OSError(24, "too many open files")

    monkeypatch.setattr(psutil.Process, "memory_info", unknown)
    beats = Beats()
    watchdog = Watchdog(beats, [], deadlines=True)  # type: ignore[arg-type]

    assert beats.heard.wait(10)
    watchdog.stop()

    assert beats.memory[0] == 0


def test_the_watching_ends_when_the_supervisor_is_gone() -> None:
    beats = Beats(ChannelClosed("gone"))
    watchdog = Watchdog(beats, [], deadlines=True)  # type: ignore[arg-type]

    assert beats.refused.wait(10)
    watchdog._thread.join(10)

    assert not watchdog._thread.is_alive()
    watchdog.stop()
