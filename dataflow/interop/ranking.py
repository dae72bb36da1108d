"""The entries of a bag's log, of which a pass keeps the times alone, and the order in which they are played."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import xxhash

from dataflow.interop.bag import Stored, Topic
from dataflow.interop.clocks import I64, Repair, Times


@dataclass(slots=True)
class TopicEntries:
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


class Ranking:
    """The order of the messages to come: which rank each entry of the log has."""

    def __init__(
        self,
        topics: Mapping[str, str],
        found: Mapping[str, TopicEntries],
        repairs: Mapping[str, Repair],
        start: int | None,
        end: int | None,
    ) -> None:
        """`topics`: that of each stream; `found` and `repairs` by topic."""
        self._streams = sorted(topics)
        self._topics = topics
        self.topics = sorted(set(topics.values()))
        columns: list[list[I64]] = []
        for number, stream in enumerate(self._streams):
            entries, mended = found[topics[stream]], repairs[topics[stream]]
            _, seqs = np.unique(mended.stamps, return_inverse=True)
            keep = within(mended.stamps, start, end)
            order = mended.order[keep]
            size = len(order)
            placed = [mended.stamps[keep], np.full(size, number), seqs[keep].astype(np.int64), np.arange(size)]
            columns.append([*placed, column(entries.messages)[order], column(entries.parts)[order]])
        stamps, numbers, seqs, places, messages, parts = (np.concatenate(c) for c in zip(*columns, strict=True))
        ranked = np.lexsort((places, numbers, stamps))
        self._stamps, self._numbers, self._seqs = stamps[ranked], numbers[ranked], seqs[ranked]
        self._entries = {topic: self._by_message(topic, messages[ranked], parts[ranked]) for topic in self.topics}
        self._next = {topic: next(entries, None) for topic, entries in self._entries.items()}

    def _by_message(self, topic: str, messages: I64, parts: I64) -> Iterator[tuple[int, int, int]]:
        """(message, rank, part) of a topic's entries, in the order of the log."""
        numbers = [i for i, stream in enumerate(self._streams) if self._topics[stream] == topic]
        ranks = np.flatnonzero(np.isin(self._numbers, numbers))
        order = ranks[np.lexsort((ranks, messages[ranks]))]
        return zip(messages[order].tolist(), order.tolist(), parts[order].tolist(), strict=True)

    def ranks(self, stored: Stored) -> Iterator[tuple[int, int]]:
        """(rank, part) of the entries that a message of the log holds."""
        while (entry := self._next[stored.topic]) is not None and entry[0] == stored.number:
            yield entry[1:]
            self._next[stored.topic] = next(self._entries[stored.topic], None)

    def place(self, rank: int) -> tuple[str, int, int]:
        """(stream, stamp, number in the stream) of an entry."""
        return self._streams[int(self._numbers[rank])], int(self._stamps[rank]), int(self._seqs[rank])


def within(stamps: I64, start: int | None, end: int | None) -> npt.NDArray[np.bool_]:
    """Returns which stamps lie in a span; None: it is open there."""
    return (stamps >= (np.iinfo(np.int64).min if start is None else start)) & (
        stamps <= (np.iinfo(np.int64).max if end is None else end)
    )
