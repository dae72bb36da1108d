"""Keeps the last firings of every operator of a process, for requests for latencies or spans while it runs."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from dataflow.records.firing import FiringRecord, consecutive, encode_batch

KEPT = 256
"""Firings of one operator that are kept, at most."""
KEPT_IN_ALL, KEPT_AT_LEAST = 4096, 32
"""Firings of all operators together, and of each one however many there are: what is kept has to stay in the caches of
the CPU, and the garbage collector looks at all of it."""
OVER = 10.0
"""Seconds before a request from which firings are answered."""
LONGEST = 500
"""Characters of an error that are kept."""


class RecentFirings:
    """A firing costs an append to a queue of bounded length; all else is done only on request. Drops and details, which
    may be large, are not kept; of a failure the beginning of its text is."""

    def __init__(self) -> None:
        self._kept: dict[str, deque[tuple[int, FiringRecord]]] = {}
        """By operator, each with its number from 1 on."""
        self._since = time.time_ns()
        """When numbering began: another process begins anew."""

    def add(self, record: FiringRecord) -> None:
        """Takes the record of a call; what is no firing is left out."""
        if record.kind in ("fire", "tick"):
            kept = self._kept.get(record.operator)
            if kept is None:
                kept = self._add(record.operator)
            if record.drops or record.detail:
                error = {} if record.outcome == "ok" else {"error": str(record.detail.get("error", ""))[:LONGEST]}
                record = replace(record, drops=(), detail=error)
            kept.append((kept[-1][0] + 1 if kept else 1, record))

    def _add(self, operator: str) -> deque[tuple[int, FiringRecord]]:
        """Begins to keep firings of one more operator, at the expense of the others where they are many."""
        share = max(KEPT_AT_LEAST, min(KEPT, KEPT_IN_ALL // (len(self._kept) + 1)))
        self._kept = {name: deque(kept, share) for name, kept in self._kept.items()} | {operator: deque(maxlen=share)}
        return self._kept[operator]

    def batches(self, now: int | None = None) -> list[bytes]:
        """Returns the firings of the last seconds that did not fail, in batches; from any thread. `now`: wall time in
        ns."""
        since = (time.time_ns() if now is None else now) - round(OVER * 1e9)
        return [
            encode_batch(part)
            for kept in list(self._kept.values())
            for part in consecutive(r for _, r in kept.copy() if r.wall_start >= since and r.outcome == "ok")
        ]

    def after(self, cursor: Mapping[str, Any]) -> dict[str, Any]:
        """Returns the firings behind those that an earlier answer held; from any thread.

        `cursor`: that of the answer, empty in the first request. The answer has `batches`, the next `cursor`, `missed`,
        how many firings are no longer kept, and `full`, the largest share of what is kept for an operator that was new.
        """
        begun, told = cursor.get("since"), cursor.get("told", {}) if cursor.get("since") == self._since else {}
        batches, numbers, missed, full = list[bytes](), dict[str, int](), 0, 0.0
        for operator, kept in list(self._kept.items()):
            before = told.get(operator, 0)
            new = [(number, record) for number, record in kept.copy() if number > before]
            numbers[operator] = new[-1][0] if new else before
            if new:
                missed += new[0][0] - before - 1 if begun is not None else 0
                full = max(full, len(new) / (kept.maxlen or KEPT))
                batches += map(encode_batch, consecutive(record for _, record in new))
        return {
            "batches": batches, "cursor": {"since": self._since, "told": numbers}, "missed": missed, "full": full,
        }  # fmt: skip
