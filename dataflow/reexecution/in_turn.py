"""Makes the calls of operators in the order in which the recorded run made them: those of one process may share what
is in no message, the state of a module or the memory of a message."""

from __future__ import annotations

from typing import Any

from dataflow.execution.recorded import RecordedRunner
from dataflow.sync import FOREVER


class Turns:
    """Keeps whose record is next, by the wall time at which its call began."""

    def __init__(self) -> None:
        self._next: dict[RunnerInTurn, int] = {}

    def come(self, runner: RunnerInTurn) -> bool:
        """Notes when the next call of a runner began; returns whether no other call is from before it. One without a
        next call may end."""
        record = None if runner.ended else runner.next_record
        self._next[runner] = FOREVER if record is None else record.wall_start
        return record is None or record.wall_start <= min(self._next.values())

    def wake_next(self) -> None:
        """Wakes the runner whose turn it is."""
        min(self._next, key=self._next.__getitem__).wake()


class RunnerInTurn(RecordedRunner):
    """Repeats an operator's recorded calls, each when its turn has come."""

    def __init__(self, *given: Any, turns: Turns, **options: Any) -> None:
        super().__init__(*given, **options)
        self._turns = turns
        turns.come(self)

    def _make_next(self) -> bool:
        if not self._turns.come(self):
            return False
        self._repeat_changes()
        if not self._turns.come(self):
            self._turns.wake_next()
            return False
        worked = super()._make_next()
        if worked:
            self._turns.come(self)
            self._turns.wake_next()
        return worked
