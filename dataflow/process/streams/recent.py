"""Keeps the last firings of every operator of a process, for those who ask for latencies while the graph runs."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import replace

from dataflow.records.firing import FiringRecord, consecutive, encode_batch

KEPT = 256
"""Firings of one operator that are kept, at most."""
KEPT_IN_ALL, KEPT_AT_LEAST = 4096, 32
"""Firings of all operators together, and of each one however many there are: what is kept has to stay in the caches of
the CPU, and the garbage collector looks at all of it."""
OVER = 10.0
"""Seconds before a request from which firings are answered."""


class RecentFirings:
    """A firing costs an append to a queue of bounded length; all else is done only on request.

    Drops and details, which may be large, are not kept.
    """

    def __init__(self) -> None:
        self._kept: dict[str, deque[FiringRecord]] = {}

    def add(self, record: FiringRecord) -> None:
        """Takes the record of a call; what is no firing, or has failed, is left out."""
        if record.kind in ("fire", "tick") and record.outcome == "ok":
            kept = self._kept.get(record.operator)
            if kept is None:
                kept = self._add(record.operator)
            bare = replace(record, drops=(), detail={}) if record.drops or record.detail else record
            kept.append(bare)

    def _add(self, operator: str) -> deque[FiringRecord]:
        """Begins to keep firings of one more operator, at the expense of the others where they are many."""
        share = max(KEPT_AT_LEAST, min(KEPT, KEPT_IN_ALL // (len(self._kept) + 1)))
        self._kept = {name: deque(kept, share) for name, kept in self._kept.items()} | {operator: deque(maxlen=share)}
        return self._kept[operator]

    def batches(self, now: int | None = None) -> list[bytes]:
        """Returns the firings of the last seconds, in batches; from any thread.

        `now`: wall time in ns.
        """
        since = (time.time_ns() if now is None else now) - round(OVER * 1e9)
        return [
            encode_batch(part)
            for kept in list(self._kept.values())
            for part in consecutive(record for record in kept.copy() if record.wall_start >= since)
        ]
