"""A part of the supervisor's core: it is notified of what happens, and acts through the run's state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dataflow.records.black_box import RecoveredRecords
from dataflow.supervision.core.run_state import RunState
from dataflow.supervision.core.supervised import Supervised


class Watcher:
    """Does nothing about anything. What a part must not let pass, it ends the run for by raising `RunFailed`."""

    def __init__(self, run: RunState) -> None:
        self.run = run

    def said(self, process: Supervised, kind: str, fields: Mapping[str, Any]) -> None:
        """A process that works, or has ended, sent a message."""

    def not_reading(self, process: Supervised, seconds: float, *, overflowed: bool) -> None:
        """A process has not read its control channel for a while."""

    def remained(self, process: Supervised, remains: RecoveredRecords) -> None:
        """A process has ended, and left these firing records."""

    def released(self) -> None:
        """The sources were released."""

    def away(self, process: Supervised) -> None:
        """A process has died and is to be started again."""

    def back(self, process: Supervised) -> None:
        """A process that was started again takes part."""

    def tick(self) -> None:
        """Time has passed while the graph runs."""

    def closing(self) -> None:
        """The run comes to its end; this is the last moment for a note."""
