"""Measurements that show nothing new: told apart from others, counted and said."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import xxhash
from numpy.typing import NDArray

from dataflow.messages import Diagnostics, Message
from dataflow.messages.diagnostics import Level
from operators.status import counted_status

FROZEN = "repeats the last one"


class Watcher:
    """Detects data that repeat the last ones, and counts what was wrong. Two exposures are never equal bit by bit."""

    def __init__(self, operator: str, what: str) -> None:
        self._operator, self._what = operator, what
        self.last = b""
        self.counts: Counter[str] = Counter()
        self._row = 0

    def judge(self, data: NDArray[Any], flaw: str | None) -> str | None:
        """The flaw of data: the given one, else that they repeat the last ones."""
        digest = xxhash.xxh3_128_digest(np.ascontiguousarray(data).data)
        found = flaw if flaw is not None else FROZEN if digest == self.last else None
        self.last = digest
        self.counts["held back" if found else "passed on"] += 1
        self._row = self._row + 1 if found else 0
        return found

    def status(self, stamp: int, flaw: str | None) -> Diagnostics:
        text = f"the {self._what} {flaw}, {self._row} in a row" if flaw else f"the {self._what} is new"
        return counted_status(self._operator, stamp, text, Level.WARN if flaw else Level.OK, self.counts)

    def snapshot(self) -> Mapping[str, Any]:
        return {"last": self.last.hex(), "counts": dict(self.counts), "row": self._row}

    def restore(self, state: Mapping[str, Any]) -> None:
        self.last, self._row = bytes.fromhex(state["last"]), int(state["row"])
        self.counts = Counter({key: int(n) for key, n in state["counts"].items()})


class Watching:
    """Makes an operator pass measurements on at a port `checked` unless they have a flaw or repeat the last ones, and
    say so at a port `status`; `named` is its own name and that of what it watches."""

    named: ClassVar[tuple[str, str]]

    def setup(self) -> None:
        self._watcher = Watcher(*self.named)

    def passed(self, message: Message, data: NDArray[Any], flaw: str | None) -> Mapping[str, Message]:
        """Gives the outputs for a message with these data, whose flaw, if it has one, is the given one."""
        found = self._watcher.judge(data, flaw)
        status = self._watcher.status(message.stamp, found)
        return {"status": status} if found else {"checked": message, "status": status}

    def on_reset(self, input: str) -> None:
        """The clock began anew; the same measurement may come again."""
        self._watcher.last = b""

    def snapshot(self) -> Mapping[str, Any]:
        return self._watcher.snapshot()

    def restore(self, state: Mapping[str, Any]) -> None:
        self._watcher.restore(state)

    def summary(self) -> Mapping[str, int]:
        return dict(self._watcher.counts)
