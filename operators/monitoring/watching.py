"""Measurements that show nothing new: told apart from others, counted and said."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import xxhash
from numpy.typing import NDArray

from dataflow.messages import Message
from dataflow.messages.diagnostics import Level
from dataflow.operator import Counts
from operators.status import counted_status

FROZEN = "repeats the last one"


@dataclass
class State(Counts):
    """Holds the digest of the last data, and how many were held back in a row. Two exposures never equal each other."""

    last: bytes = b""
    row: int = 0

    def judge(self, data: NDArray[Any], flaw: str | None) -> str | None:
        """Returns the flaw of data: the given one, else that they repeat the last ones."""
        digest = xxhash.xxh3_128_digest(np.ascontiguousarray(data).data)
        found = flaw if flaw is not None else FROZEN if digest == self.last else None
        self.last = digest
        self.counts["held back" if found else "passed on"] += 1
        self.row = self.row + 1 if found else 0
        return found


class MeasurementGate:
    """Makes an operator pass measurements on at a port `checked` unless they have a flaw or repeat the last ones, and
    say so at a port `status`; `named` is its own name and that of what it watches."""

    named: ClassVar[tuple[str, str]]

    state: State

    def passed(self, message: Message, data: NDArray[Any], flaw: str | None) -> Mapping[str, Message]:
        """Gives the outputs for a message with these data, whose flaw, if it has one, is the given one."""
        (operator, what), found = self.named, self.state.judge(data, flaw)
        text = f"the {what} {found}, {self.state.row} in a row" if found else f"the {what} is new"
        level = Level.WARN if found else Level.OK
        status = counted_status(operator, message.stamp, text, level, self.state.counts)
        return {"status": status} if found else {"checked": message, "status": status}
