"""Numbers of recorded messages that are played again."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from dataflow.recording import Recorded


def gapless(messages: Iterable[Recorded]) -> Iterator[Recorded]:
    """Numbers the messages of each stream without the gaps that a recording may have.

    A gap means to a process that messages were lost on their way to it, but messages that a recording lacks were never
    sent. The first message of a stream keeps its number, another incarnation begins with 0.
    """
    due: dict[str, tuple[int, int]] = {}
    for item in messages:
        incarnation, number = due.get(item.stream, (item.incarnation, item.seq))
        if item.incarnation != incarnation:
            number = 0
        due[item.stream] = item.incarnation, number + 1
        yield item if item.seq == number else replace(item, seq=number)
