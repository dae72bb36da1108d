"""Before a process is given up, it is asked where it is: what its threads are at becomes part of its last words."""

from __future__ import annotations

from collections.abc import Iterable

from dataflow.process.stacks import ASK
from dataflow.supervision.core.run_state import RunState
from dataflow.supervision.core.supervised import Supervised

ASK_BEFORE = 1.0
"""Seconds before the time is up; of a short time, a fifth."""


def notice(timeout: float) -> float:
    """Returns how many seconds before the end of a time, which is so long, to ask."""
    return min(ASK_BEFORE, timeout / 5)


class Asking:
    """Asks each process once, for each time that it is stuck."""

    def __init__(self, run: RunState) -> None:
        self._run = run
        self._asked: dict[str, object] = {}

    def ask(self, late: Iterable[Supervised], since: object) -> None:
        """Asks processes; `since` is something that changes when they go on."""
        for process in late:
            if self._asked.get(process.label) != since:
                self._asked[process.label] = since
                self._run.signal(process, ASK)
