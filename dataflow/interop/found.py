"""Finds in a pass over a bag, of each topic: the times of its messages, and nothing of what they hold."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import xxhash

from dataflow.interop.bag import Stored, Topic
from dataflow.interop.clocks import Times

I64 = npt.NDArray[np.int64]


@dataclass(slots=True)
class Found:
    """The entries of one topic in the order of the log: a message, or a part of one."""

    messages: array[int] = field(default_factory=lambda: array("q"))
    parts: array[int] = field(default_factory=lambda: array("q"))
    logs: array[int] = field(default_factory=lambda: array("q"))
    headers: array[int] = field(default_factory=lambda: array("q"))
    digests: array[int] = field(default_factory=lambda: array("Q"))
    stamped: bool = True
    bytes: int = 0

    def add(self, stored: Stored, stamps: tuple[int, ...]) -> None:
        """Takes a message of the log, with the stamps of its parts (none: it carries no time)."""
        self.stamped &= bool(stamps)
        self.bytes += len(stored.data)
        digest = xxhash.xxh3_64_intdigest(stored.data)
        for part, stamp in enumerate(stamps or (0,)):
            self.messages.append(stored.number)
            self.parts.append(part)
            self.logs.append(stored.log_time)
            self.headers.append(stamp)
            self.digests.append(digest ^ part)

    def times(self, topic: Topic, shares: bool) -> Times:
        """The times among which a clock is chosen."""
        header = column(self.headers) if self.stamped else None
        return Times(topic.name, column(self.logs), header, topic.latched, shares)

    def digests_of(self, *, distinct: bool) -> npt.NDArray[np.uint64]:
        """Digests by which entries of one stamp are compared: of their content; where not `distinct`, a number each."""
        count = len(self.digests)
        return np.frombuffer(self.digests, np.uint64) if distinct and count else np.arange(count, dtype=np.uint64)


def column(values: array[int]) -> I64:
    """The numbers of an array, without a copy."""
    return np.frombuffer(values, np.int64) if len(values) else np.empty(0, np.int64)
