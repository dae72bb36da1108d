"""The distance between the recorded states of an operator, by event time or by what repeating its calls takes."""

from __future__ import annotations

from typing import Literal

CPU_SPACING = 250_000_000
"""ns of CPU time between two states that are spaced by that: of an operator's calls, and of what repeating them takes
besides."""
REPEATING = 2_000_000
"""ns that repeating a call takes besides, for each operator: reading, decoding, comparing
(`benchmarks/debugging.md`)."""
LARGE = 1 << 16
"""Bytes: smaller states are recorded more often, as many bytes of them."""
MOST_OFTEN = 16
"""Small states that are recorded in place of a large one, at most."""


class StateSpacing:
    """Decides when an operator's state is to be recorded.

    `snapshots`: about every so many ns of event time, then at the same firings in every run; "cpu": whenever repeating
    its calls since the last state would take `CPU_SPACING`. `repeated`: how many operators are repeated for a call, it
    and those in front whose messages are not recorded.
    """

    def __init__(self, snapshots: int | Literal["cpu"], repeated: int = 1) -> None:
        self._by_cpu = snapshots == "cpu"
        self._each = REPEATING * repeated
        self._spacing = CPU_SPACING // MOST_OFTEN if snapshots == "cpu" else snapshots
        self._last: int | None = None

    def is_due(self, stamp: int, cpu_ns: int, firings: int) -> bool:
        """Returns whether a state is to be recorded behind the firing at `stamp` (ns), after `firings` calls that took
        `cpu_ns`."""
        at = cpu_ns + firings * self._each if self._by_cpu else stamp
        if self._last is None:
            self._last = at
        if at - self._last < self._spacing:
            return False
        self._last = at
        return True

    def took(self, nbytes: int) -> None:
        """Notes the size of the state that was recorded."""
        if self._by_cpu:
            self._spacing = CPU_SPACING * min(max(nbytes, LARGE // MOST_OFTEN), LARGE) // LARGE
