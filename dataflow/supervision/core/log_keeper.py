"""Hands the lines of the run's log on to the recorder and the viewer file, as many as these can take."""

from __future__ import annotations

from collections import deque

from dataflow.recording.streams.logs import LogLine
from dataflow.supervision.core.run_state import RunState

KEPT = 2000
"""Lines that wait; of more, the newest are left out, and counted."""
AT_ONCE = 200
"""Lines that are handed on at one look: 4,000 a second."""


class LogKeeper:
    """Queues lines until the next look. Processes can print more between the looks of a second than is recorded."""

    def __init__(self, run: RunState) -> None:
        self._run = run
        self._waiting: deque[LogLine] = deque()
        self._lost = 0

    def take(self, line: LogLine) -> None:
        if len(self._waiting) < KEPT:
            self._waiting.append(line)
        else:
            self._lost += 1

    def hand_on(self) -> None:
        """Sends what waits, in order."""
        if not self._waiting:
            return
        lines = [self._waiting.popleft() for _ in range(min(AT_ONCE, len(self._waiting)))]
        if self._lost and not self._waiting:
            text = f"{self._lost} lines of the log are left out here: they came faster than they could be recorded"
            lines.append(LogLine("warning", text, "supervisor", time=lines[-1].time))
            self._lost = 0
        for process in self._run.processes.values():
            if process.is_sink:
                self._run.send(process, "logs", lines=[line.to_json() for line in lines])

    def hand_on_all(self) -> None:
        """Sends everything: the run comes to its end."""
        while self._waiting:
            self.hand_on()
