"""The order in which the entries of a bag's log are played."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import numpy.typing as npt

from dataflow.interop.bag import Stored
from dataflow.interop.clocks import Repair
from dataflow.interop.found import I64, Found, column


class Ranking:
    """The order of the messages to come: which rank each entry of the log has."""

    def __init__(
        self,
        topics: Mapping[str, str],
        found: Mapping[str, Found],
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
            columns.append(
                [
                    mended.stamps[keep],
                    np.full(size, number),
                    seqs[keep].astype(np.int64),
                    np.arange(size),
                    column(entries.messages)[order],
                    column(entries.parts)[order],
                ]
            )
        stamps, numbers, seqs, places, messages, parts = (np.concatenate(c) for c in zip(*columns, strict=True))
        ranked = np.lexsort((places, numbers, stamps))
        self._stamps, self._numbers, self._seqs = stamps[ranked], numbers[ranked], seqs[ranked]
        self._of_topic = {topic: self._by_message(topic, messages[ranked], parts[ranked]) for topic in self.topics}

    def _by_message(self, topic: str, messages: I64, parts: I64) -> Iterator[tuple[int, int, int]]:
        """(message, rank, part) of a topic's entries, in the order of the log."""
        numbers = [i for i, stream in enumerate(self._streams) if self._topics[stream] == topic]
        ranks = np.flatnonzero(np.isin(self._numbers, numbers))
        order = ranks[np.lexsort((ranks, messages[ranks]))]
        return _Ahead(zip(messages[order].tolist(), order.tolist(), parts[order].tolist(), strict=True))

    def ranks(self, stored: Stored) -> Iterator[tuple[int, int]]:
        """(rank, part) of the entries that a message of the log holds."""
        rows = self._of_topic[stored.topic]
        assert isinstance(rows, _Ahead)
        while rows.next is not None and rows.next[0] == stored.number:
            yield rows.next[1], rows.next[2]
            next(rows)

    def place(self, rank: int) -> tuple[str, int, int]:
        """(stream, stamp, number in the stream) of an entry."""
        return self._streams[int(self._numbers[rank])], int(self._stamps[rank]), int(self._seqs[rank])


class _Ahead(Iterator[tuple[int, int, int]]):
    """An iterator whose next item can be looked at."""

    def __init__(self, rows: Iterator[tuple[int, int, int]]) -> None:
        self._rows = rows
        self.next = next(rows, None)

    def __next__(self) -> tuple[int, int, int]:
        if self.next is None:
            raise StopIteration
        item, self.next = self.next, next(self._rows, None)
        return item


def within(stamps: I64, start: int | None, end: int | None) -> npt.NDArray[np.bool_]:
    """Returns which stamps lie in a span; None: it is open there."""
    return (stamps >= (np.iinfo(np.int64).min if start is None else start)) & (
        stamps <= (np.iinfo(np.int64).max if end is None else end)
    )
