"""A sink of a live run: it gives way to operators, and is behind by what it has not taken of each source."""

from __future__ import annotations

from dataflow.process.priority import let_others_begin
from dataflow.sinks.sink import SinkProcess


class LiveSinkProcess(SinkProcess):
    """As `SinkProcess`, beside devices that do not wait."""

    def open(self) -> None:
        super().open()
        let_others_begin()

    def _reached(self) -> dict[str, int]:
        """Returns up to where it has taken what follows from each source; streams of operators that drop do not."""
        return dict(self._taken)
