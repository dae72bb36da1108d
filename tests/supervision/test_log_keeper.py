"""The recorder is given the log in order, and no faster than it can take it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from dataflow.recording.streams.logs import LogLine
from dataflow.supervision.core.log_keeper import AT_ONCE, KEPT, LogKeeper


class Run:
    """Stands in for the state of a run with a recorder and an operator process."""

    def __init__(self) -> None:
        self.processes = {"@recorder": SimpleNamespace(is_sink=True), "p": SimpleNamespace(is_sink=False)}
        self.sent: list[list[str]] = []

    def send(self, process: Any, kind: str, *, lines: list[dict[str, Any]]) -> None:
        assert process.is_sink
        assert kind == "logs"
        self.sent.append([line["text"] for line in lines])


def keeper() -> tuple[LogKeeper, Run]:
    run: Any = Run()
    return LogKeeper(run), run


def test_lines_are_handed_on_in_order_a_few_at_a_look() -> None:
    logs, run = keeper()
    logs.hand_on()
    for k in range(AT_ONCE + 2):
        logs.take(LogLine("info", str(k)))
    logs.hand_on()
    assert run.sent == [[str(k) for k in range(AT_ONCE)]]
    logs.hand_on_all()
    assert run.sent[1:] == [[str(AT_ONCE), str(AT_ONCE + 1)]]


def test_flood_of_log_lines_is_cut_and_counted() -> None:
    logs, run = keeper()
    for k in range(KEPT + 7):
        logs.take(LogLine("info", str(k)))
    logs.hand_on_all()
    texts = [text for lines in run.sent for text in lines]
    assert texts[:KEPT] == [str(k) for k in range(KEPT)]
    assert texts[KEPT:] == ["7 lines of the log are left out here: they came faster than they could be recorded"]
