"""Describes the topics of a bag at a glance: types, counts, rates, what each can be played as."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from dataflow.interop.bag import Bag
from dataflow.interop.conversions import proposed
from dataflow.interop.topics import Reading


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """One topic. `first`, `last`: log times, ns; `rate` in Hz, by log time; `read_as`: message types, best first."""

    topic: str
    type: str
    encoding: str
    count: int
    first: int | None
    last: int | None
    rate: float | None
    latched: bool
    read_as: tuple[str, ...]
    notes: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """JSON values."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Total:
    """All topics together. Times in ns."""

    messages: int
    first: int
    last: int

    @property
    def duration(self) -> int:
        return self.last - self.first

    def as_json(self) -> dict[str, Any]:
        """JSON values."""
        return {"messages": self.messages, "start": self.first, "end": self.last, "duration": self.duration}


def summaries(bag: Bag, readings: Sequence[Reading]) -> list[TopicSummary]:
    """A row for each topic; one pass over the bag where its index lacks the times."""
    unknown = [r.topic.name for r in readings if r.topic.count and r.topic.first is None]
    times: dict[str, tuple[int, int]] = {}
    for stored in bag.messages(unknown) if unknown else ():
        first, _ = times.get(stored.topic, (stored.log_time, 0))
        times[stored.topic] = (first, stored.log_time)
    return [_summary(r, times) for r in readings]


def _summary(reading: Reading, times: dict[str, tuple[int, int]]) -> TopicSummary:
    topic = reading.topic
    first, last = times.get(topic.name, (topic.first, topic.last))
    span = 0 if first is None or last is None else last - first
    read_as = () if reading.read_as is None else tuple(t.SCHEMA for t in proposed(reading.read_as))
    notes = ["latched"] if topic.latched else []
    if not reading.playable and topic.count:
        notes.append(reading.reason.removeprefix(f"{topic.schema.name} "))
    if reading.losses:
        notes.append(f"without {', '.join(reading.losses)}")
    return TopicSummary(
        topic.name,
        topic.schema.name,
        topic.encoding,
        topic.count,
        first,
        last,
        (topic.count - 1) / (span * 1e-9) if topic.count > 1 and span > 0 else None,
        topic.latched,
        read_as if reading.playable or not topic.count else (),
        tuple(notes),
    )


def total(rows: Sequence[TopicSummary]) -> Total:
    """The messages and the span of all topics; a span of 0 where there is no message."""
    first = min((row.first for row in rows if row.first is not None), default=0)
    last = max((row.last for row in rows if row.last is not None), default=0)
    return Total(sum(row.count for row in rows), first, last)
