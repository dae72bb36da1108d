"""The progress of a worker in memory that it shares with its parent, and that outlives its death.

The worker writes a few integers before and after every step, without a system call; the parent reads them when it likes
to: to show progress, to notice that there is none, and to name the operator and the call at which a worker died.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Sequence

from dataflow.execution.recorded import RecordedRunner, Watcher
from dataflow.supervision.core.report import OperatorCounts

PHASES = ("start", "setup", "fire", "read", "close")
_HEAD = 3
_COUNTS = 6
_WORD = 8


class Board(Watcher):
    """The shared memory of one worker and its parent: either opens it by its descriptor and sees what the other wrote.

    Integers of 64 bits: phase, operator, steps, then of each operator its firings, messages, CPU time (ns), the stamp
    it has done, calls repeated and wall time (ns). A parent that reads while the worker writes may see counts of two
    moments, which is good enough for a display.
    """

    def __init__(self, descriptor: int, operators: Sequence[str]) -> None:
        self.operators = tuple(operators)
        self._size = _WORD * (_HEAD + _COUNTS * len(self.operators))
        if os.fstat(descriptor).st_size < self._size:
            os.ftruncate(descriptor, self._size)
        self._memory = mmap.mmap(descriptor, self._size)
        self._cells = memoryview(self._memory).cast("q")
        self._index = {name: k for k, name in enumerate(self.operators)}
        self._phases = {name: k for k, name in enumerate(PHASES)}

    def begins(self, phase: str, operator: str) -> None:
        """Notes the step that comes next."""
        cells = self._cells
        cells[0] = self._phases[phase]
        cells[1] = self._index.get(operator, -1)
        cells[2] += 1

    def goes_on(self) -> None:
        """Counts a step of what may take long before the first one, such as opening a recording."""
        self._cells[2] += 1

    def stepped(self, runner: RecordedRunner) -> None:
        """Notes what a runner has come to."""
        at = _HEAD + _COUNTS * self._index[runner.node.name]
        self._cells[at] = runner.firings
        self._cells[at + 1] = runner.ports.emitted
        self._cells[at + 2] = runner.work.cpu_ns
        self._cells[at + 3] = runner.done
        self._cells[at + 4] = runner.result.verified
        self._cells[at + 5] = runner.work.wall_ns

    @property
    def steps(self) -> int:
        """The number of steps so far: a worker in which it stands still makes no progress."""
        return self._cells[2]

    def place(self) -> tuple[str, str]:
        """The phase that the worker is at, or was at when it died, and the operator whose turn it is ("" for none)."""
        operator = self._cells[1]
        return PHASES[self._cells[0]], "" if operator < 0 else self.operators[operator]

    def counts(self, operator: str) -> tuple[OperatorCounts, int]:
        """The counts of an operator, and how many of its calls were repeated."""
        at = _HEAD + _COUNTS * self._index[operator]
        firings, emitted, cpu_ns, done, repeated, wall_ns = self._cells[at : at + _COUNTS]
        return OperatorCounts(firings, emitted, 0, cpu_ns, done, wall_ns), repeated

    def close(self) -> None:
        """Lets go of the memory."""
        self._cells.release()
        self._memory.close()
