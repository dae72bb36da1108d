"""A call that takes too long is not waited for, and what it raises is raised."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import pytest

from dataflow.transport import publisher
from dataflow.transport.bounded import within
from dataflow.transport.publisher import BusError, undeclare


def test_finished_call_has_ended_when_reported() -> None:
    done: list[str] = []

    assert within(10.0, lambda: done.append(threading.current_thread().name), "leave")
    assert done == ["leave"]


def test_an_act_that_does_not_end_is_not_waited_for() -> None:
    gate = threading.Event()
    try:
        assert not within(0.01, gate.wait, "leave")
    finally:
        gate.set()


def test_exception_of_a_bounded_act_is_raised() -> None:
    def fail() -> None:
        raise ConnectionError("nobody is there")

    with pytest.raises(ConnectionError, match="nobody is there"):
        within(10.0, fail, "leave")


def test_a_declaration_that_does_not_end_is_named_and_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    gate = threading.Event()
    monkeypatch.setattr(publisher, "UNDECLARE_WITHIN", 0.01)
    try:
        with pytest.raises(BusError, match=r"did not end within 0\.01 s"):
            undeclare(SimpleNamespace(undeclare=gate.wait))
    finally:
        gate.set()
