"""Decides whether and when what failed is restarted: the policy of one operator or process."""

from __future__ import annotations

import sys
from collections.abc import Callable

from dataflow.graph.model import Restart
from dataflow.operator import Operator

MOST_DOUBLINGS = 4
LONGEST_BACKOFF = 30.0
"""Seconds. The time before an attempt doubles with each, so many times and up to here."""


class Restarts:
    """Counts attempts. A failure after `forgive_after` seconds without one begins the count again."""

    def __init__(
        self, policy: Restart, clock: Callable[[], float], *, used: int = 0, forgive_after: float = 60.0
    ) -> None:
        self.policy, self.clock, self.forgive_after = policy, clock, forgive_after
        self.used = used
        self.total = used
        self._last: float | None = None
        self._due = 0.0
        self.pending = False
        """Returns whether an attempt is to be made, now or later."""

    def failed(self) -> bool:
        """Notes a failure; False when the policy allows no further attempt."""
        now = self.clock()
        if self._last is not None and now - self._last > self.forgive_after:
            self.used = 0
        self._last = now
        if self.used >= self.policy.max:
            return False
        pause = min(self.policy.backoff * 1e-9 * 2 ** min(self.used, MOST_DOUBLINGS), LONGEST_BACKOFF)
        self.used += 1
        self.total += 1
        self._due, self.pending = now + pause, True
        return True

    def due_in(self) -> float:
        """Seconds until the attempt that is pending."""
        assert self.pending
        return max(0.0, self._due - self.clock())

    def begun(self) -> None:
        """The attempt is made."""
        self.pending = False


def close_quietly(operator: Operator) -> None:
    """Closes an operator that has failed, or of which only the calls before count; what goes wrong is printed."""
    try:
        operator.close()
    except Exception as error:
        print(f"{type(operator).__name__}.close(): {type(error).__name__}: {error}", file=sys.stderr)
