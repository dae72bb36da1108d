"""What an agent passes on to the processes of its machine."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from dataflow.machines.pipe import Clocks
from dataflow.supervision import agent
from dataflow.supervision.agent import Stay


class Children:
    """Stands for the processes: keeps what was sent to each."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, str]] = []

    def spawn(self, label: str) -> None:
        self.sent.append((label, "spawn"))

    def send(self, label: str, kind: str, fields: dict[str, Any], *, replaces: bool) -> None:
        self.sent.append((label, kind))


def test_a_process_is_told_of_the_clock_only_once_it_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = Clocks()
    clocks.exchanged(100, 1600, 1700, 1200)
    monkeypatch.setattr(agent, "Pipe", lambda *_, **__: SimpleNamespace(clocks=clocks))
    monkeypatch.setattr(agent, "CLOCK_EVERY", 0.0)
    stay, children = Stay(SimpleNamespace(name="robot"), None, "run", "none"), Children()  # type: ignore[arg-type]
    stay._children, stay._corrected = children, frozenset({"camera"})  # type: ignore[assignment]

    for _ in range(2):  # started, and started again
        stay._obey("camera", "spawn", {})
        stay._tell_clock()  # between two frames of the supervisor
        stay._obey("camera", "send", {"kind": "polled", "fields": {}, "replaces": False})
        stay._obey("camera", "send", {"kind": "go", "fields": {"at": 0.0}, "replaces": False})
        stay._tell_clock()

    started = ["spawn", "polled", "clock", "go", "clock"]
    assert children.sent == [("camera", kind) for kind in started * 2]
