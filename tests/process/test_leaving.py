"""A process leaves the network in bounded time, whatever a neighbour or a library does."""

from __future__ import annotations

import threading

import pytest

from dataflow.process import network
from dataflow.process.network import leave_network
from dataflow.transport import BusError


class Part:
    def __init__(self, closed: list[str], name: str, error: Exception | None = None) -> None:
        self._closed, self._name, self._error = closed, name, error

    def close(self) -> None:
        if self._error is not None:
            raise self._error
        self._closed.append(self._name)


class Stuck:
    """A part whose `close` waits for somebody who does not come."""

    def __init__(self) -> None:
        self.gate = threading.Event()

    def close(self) -> None:
        self.gate.wait()


def test_parts_are_closed_in_order_without_output(capsys: pytest.CaptureFixture[str]) -> None:
    closed: list[str] = []

    leave_network("head", Part(closed, "taps").close, Part(closed, "bus").close)

    assert closed == ["taps", "bus"]
    assert capsys.readouterr().err == ""


def test_a_part_that_hangs_is_left_behind_and_named(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(network, "LEAVE_WITHIN", 0.01)
    stuck = Stuck()
    try:
        leave_network("head", stuck.close, Part([], "bus").close)
    finally:
        stuck.gate.set()

    assert capsys.readouterr().err == "process 'head' leaves the network unheard: not done within 0.01 s\n"


def test_a_network_that_fails_at_the_end_does_not_fail_the_run(capsys: pytest.CaptureFixture[str]) -> None:
    leave_network("head", Part([], "taps", BusError("Zenoh did not close within 20 s")).close)

    assert "leaves the network unheard: Zenoh did not close within 20 s" in capsys.readouterr().err
