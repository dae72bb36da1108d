"""What processes say reaches the terminal, and a terminal that takes nothing holds up nobody."""

from __future__ import annotations

import threading

import pytest

from dataflow.supervision import console as words
from dataflow.supervision.console import KEPT, Console


def test_a_terminal_that_is_stopped_holds_up_no_process() -> None:
    shown: list[str] = []
    entered, stopped = threading.Event(), threading.Event()

    def show(label: str, line: str) -> None:
        entered.set()
        stopped.wait(20)
        shown.append(f"[{label}] {line}")

    said = Console(show)
    said.put("left", "first")
    assert entered.wait(10)
    for k in range(KEPT + 5):
        said.put("left", str(k))
    stopped.set()
    said.close()

    assert shown[:3] == ["[left] first", "[left] (5 lines before this one were not shown)", "[left] 5"]
    assert shown[-1] == f"[left] {KEPT + 4}"


def test_the_end_waits_for_the_last_words_but_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(words, "CLOSE_WITHIN", 0.01)
    stopped = threading.Event()
    said = Console(lambda label, line: bool(stopped.wait(20)))
    said.put("left", "last")

    said.close()

    assert said._thread.is_alive()
    stopped.set()
