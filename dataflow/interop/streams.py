"""Topics of a bag as recorded streams: stamped by one clock, repaired, merged in the order of stamps."""

from __future__ import annotations

import heapq
import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from dataflow.interop.account import Account
from dataflow.interop.bag import Bag, BagError, DamageReport, Stored, shortfalls
from dataflow.interop.clocks import Choice, Clock, Repair, choose_clock, repair
from dataflow.interop.conversions import NARROWING, convert, in_units, offers
from dataflow.interop.opening import open_bag
from dataflow.interop.ranking import Ranking, TopicEntries, within
from dataflow.interop.topics import Reading
from dataflow.interop.transform_sets import joined, other_parents, places_of
from dataflow.messages import DepthImage, Message, MessageError, Transforms, message_type
from dataflow.messages.depth_units import MILLIMETRES, DepthSpan
from dataflow.recording import Recorded, Recording, RecordingError, StreamInfo
from dataflow.recording.streams.streams import UnreadableMessages

MAX_HELD = 1 << 30
"""Bytes of messages that wait for earlier ones, which the log has later."""


@dataclass(frozen=True, slots=True)
class MappedTopic:
    """A topic that stands in for a stream: as which message type, and whether as one message, valid always.

    `depth_scale`: how many units of 16-bit depth a metre has (REP 118: millimetres).
    """

    topic: str
    type: str
    static: bool = False
    depth_scale: float = MILLIMETRES


class BagStreams:
    """Some topics of a bag as the streams that they stand in for (`PlayableStreams`).

    One pass over the bag, when it is opened, finds the times of all messages; nothing is kept of them but those.
    `watch` is given the number of messages seen. Raises `BagError`, `RecordingError`.
    """

    metadata: Mapping[str, Mapping[str, str]] = {}

    def __init__(
        self,
        path: Path,
        played: Mapping[str, MappedTopic],
        clock: Choice = "auto",
        *,
        watch: Callable[[int], None] | None = None,
        strict: bool = False,
        accounting: bool = False,
    ) -> None:
        """`strict`: a message that cannot be read is an error; else it is passed over and counted in `account`.
        `accounting`: what messages do not carry over is counted there too."""
        self.path, self.played = Path(path), dict(sorted(played.items()))
        self._strict, self._accounting = strict, accounting
        self._bag: Bag = open_bag(self.path, strict=strict)
        self._closed = False
        try:
            self.account = Account(list(self._bag.notes), shortfalls(self._bag))
            self._readings = {p.topic: self._reading(p) for p in self.played.values()}
            self._readers = {topic: r.reader for topic, r in self._readings.items() if r.reader is not None}
            self._unstamped: dict[str, UnreadableMessages] = {}
            self._depths: dict[str, list[npt.NDArray[np.float32]]] = {}
            self._moving = sorted({p.topic for p in self.played.values() if not p.static})
            self._found = self._scan(watch)
            self._unstamped = {topic: UnreadableMessages(u.count, u.reason) for topic, u in self.account.unread.items()}
            times = [found.times(self._bag.topics[t], self._readings[t].merges) for t, found in self._found.items()]
            self.clock: Clock = choose_clock(times, clock)
            self.repairs: Mapping[str, Repair] = {
                t.topic: repair(
                    self.clock.stamps(t),
                    self._found[t.topic].digests_of(distinct=t.shares or self.clock.tells(t)),
                    merge=self._readings[t.topic].merges,
                )
                for t in times
            }
            self.account.repaired = {name: mended.facts() for name, mended in self.repairs.items() if mended.facts()}
            self.account.notes += self.clock.notes
            self.static_notes: dict[str, str] = {}
            self._static = {stream: self._static_message(stream) for stream, p in self.played.items() if p.static}
            self.streams: Mapping[str, StreamInfo] = {stream: self._info(stream) for stream in self.played}
            self.recount()
        except BaseException:
            self.close()
            raise

    @property
    def torn(self) -> bool:
        """Returns False: which of its files has no proper end stands in `notes`."""
        return False

    @property
    def lost(self) -> DamageReport:
        """Messages that damage keeps from being read, as far as they have been read."""
        return self._bag.lost

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of what in the file is damaged or unusual, for people."""
        return (*self.account.notes, *self.account.short)

    def recount(self) -> None:
        """Takes into `account` what damage has kept from being read so far."""
        self.account.short[:] = shortfalls(self._bag)

    def losses(self, topic: str) -> tuple[str, ...]:
        """Names the content of a topic's first message that has no place here."""
        return self._readings[topic].losses

    def look_for_unread(self, topics: Collection[str], start: int | None = None, end: int | None = None) -> None:
        """Reads the messages of topics with start ≤ stamp ≤ end, so that `account` counts those that cannot be read."""
        streams = [stream for stream, played in self.played.items() if played.topic in topics and not played.static]
        for _ in self._merged(streams, start, end) if streams else ():
            pass

    def opening(self) -> Mapping[str, Any] | None:
        """Plain values with which `recorded_streams` gives the same streams in another process."""
        played = {stream: [p.topic, p.type, p.static, p.depth_scale] for stream, p in self.played.items()}
        return {"played": played, "clock": self.clock.kind, "strict": self._strict}

    def facts(self) -> dict[str, str]:
        """Returns the metadata that a recording made of this bag has of it."""
        repairs = {name: found.facts() for name, found in self.repairs.items()}
        return {
            "file": self.path.name,
            "format": self._bag.kind,
            "clock": f"{self.clock.kind}: {self.clock.why}",
            "topics": json.dumps({stream: p.topic for stream, p in self.played.items()}, ensure_ascii=False),
            "repaired": json.dumps({name: found for name, found in repairs.items() if found}, ensure_ascii=False),
            "notes": "\n".join([*self.account.notes, *self.account.short]),
        }

    def messages(
        self, streams: Sequence[str] | None = None, start: int | None = None, end: int | None = None
    ) -> Iterator[Recorded]:
        """Messages with start ≤ stamp ≤ end (ns), merged by (stamp, stream); static streams first and whole."""
        chosen = list(self.played) if streams is None else sorted(set(streams))
        for stream in chosen:
            if self.played[stream].static:
                yield Recorded(stream, self._static[stream], 0, 0)
        moving = [s for s in chosen if not self.played[s].static]
        if moving:
            yield from self._merged(moving, start, end)

    def stamps(self, stream: str, start: int | None = None, end: int | None = None) -> Iterator[int]:
        """The stamps of what `messages()` gives of one stream, in that order."""
        if self.played[stream].static:
            return iter([self._static[stream].stamp])
        stamps = np.unique(self.repairs[self.played[stream].topic].stamps)
        return iter(stamps[within(stamps, start, end)].tolist())

    def close(self) -> None:
        """Closes the bag. Idempotent."""
        if not self._closed:
            self._closed = True
            self._bag.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ------------------------------------------------------------------------------------------------- opening

    def _reading(self, played: MappedTopic) -> Reading:
        topic = self._bag.topics.get(played.topic)
        if topic is None:
            raise BagError(f"{self.path} has no topic {played.topic!r}; it has {', '.join(self._bag.topics) or 'none'}")
        reading = Reading(self._bag, topic)
        if not reading.playable:
            raise BagError(f"{self.path}: topic {topic.name!r} cannot be played: {reading.reason}")
        assert reading.read_as is not None
        possible = [t.SCHEMA for t in offers(reading.read_as)]
        if played.type not in possible:
            raise BagError(
                f"{self.path}: topic {topic.name!r} ({topic.schema.name}) is read as {' or '.join(possible)}, "
                f"not as {played.type}"
            )
        return reading

    def _scan(self, watch: Callable[[int], None] | None) -> dict[str, TopicEntries]:
        found = {topic: TopicEntries() for topic in self._moving}
        for seen, stored in enumerate(self._bag.messages(self._moving), 1):
            try:
                stamps = self._readers[stored.topic].stamps(stored.data)
            except (RecordingError, MessageError) as error:
                self._pass_over(stored, error)
                continue
            found[stored.topic].add(stored, stamps)
            if watch is not None and not seen % 1000:
                watch(seen)
        return found

    def _static_message(self, stream: str) -> Message:
        """The one message of a static stream: the transforms of all, or the first, and whether others differ."""
        played = self.played[stream]
        first: Message | None = None
        differing = count = 0
        given: dict[str, bytes] = {}
        changed: dict[str, int] = {}
        for stored in self._bag.messages([played.topic]):
            count += 1
            for message in self._read(played, stored, max(stored.log_time, 0)):
                if isinstance(message, Transforms):
                    for child, place in places_of(message):
                        if given.setdefault(child, place) != place:
                            changed[child] = changed.get(child, 0) + 1
                            given[child] = place
                if first is None:
                    first = message
                elif isinstance(first, Transforms):
                    assert isinstance(message, Transforms)
                    first = joined(first, message)
                elif message.replace(stamp=first.stamp).digest() != first.digest():
                    differing += 1
        if first is None:
            raise BagError(f"{self.path}: topic {played.topic!r}: none of its {count:,} messages can be read")
        told = f"the first of {count:,}; {differing:,} differ from it" if differing else f"{count:,} messages as one"
        if changed:
            told += f"; differs on the way: {', '.join(sorted(changed))} (the last place holds from the beginning)"
        if count > 1:
            self.static_notes[stream] = told
        if differing or changed:
            self.account.static[played.topic] = told
        return first

    def _info(self, stream: str) -> StreamInfo:
        played = self.played[stream]
        topic = self._bag.topics[played.topic]
        stamps = np.array([self._static[stream].stamp]) if played.static else self.repairs[played.topic].stamps
        return StreamInfo(
            name=stream,
            schema=topic.schema.name,
            encoding=topic.encoding,
            declaration=None,
            known=message_type(played.type),
            count=len(np.unique(stamps)),
            first=int(stamps[0]) if len(stamps) else None,
            last=int(stamps[-1]) if len(stamps) else None,
            static=played.static,
            bytes=0 if played.static else self._found[played.topic].bytes,
            incarnations=1,
            metadata={"topic": played.topic, "message_type": played.type},
        )

    # ------------------------------------------------------------------------------------------------- reading

    def _merged(self, streams: Sequence[str], start: int | None, end: int | None) -> Iterator[Recorded]:
        """Reads the log once; a message waits until all earlier ones have come."""
        plan = Ranking({s: self.played[s].topic for s in streams}, self._found, self.repairs, start, end)
        waiting: list[tuple[int, int, int, Stored]] = []
        held = due = 0
        pending: Recorded | None = None
        self.account.unread = dict(self._unstamped)
        self.account.lost = {topic: lost for topic, lost in self.account.lost.items() if topic not in plan.topics}
        behind: dict[str, int] = {}
        """By stream, messages that were passed over: numbers have no gaps."""
        for stored in self._bag.messages(plan.topics):
            for rank, part in plan.ranks(stored):
                heapq.heappush(waiting, (rank, part, stored.number, stored))
                held += len(stored.data)
            if held > MAX_HELD:
                raise BagError(
                    f"{self.path}: by header stamps, messages are so far from the order of the log that more than "
                    f"{MAX_HELD >> 30} GiB of them wait for earlier ones; play it by log time: --clock log"
                )
            while waiting and waiting[0][0] == due:
                rank, part, _, ready = heapq.heappop(waiting)
                held -= len(ready.data)
                due += 1
                stream, stamp, seq = plan.place(rank)
                found = self._read(self.played[stream], ready, stamp, part)
                if not found:
                    behind[stream] = behind.get(stream, 0) + 1
                    continue
                message = found[0]
                if pending is not None and (pending.stream, pending.stamp) == (stream, stamp):
                    assert isinstance(pending.message, Transforms)
                    assert isinstance(message, Transforms)
                    if self._accounting and (lost := other_parents(pending.message, message)):
                        self.account.lose(self.played[stream].topic, lost)
                    pending = replace(pending, message=joined(pending.message, message))
                    continue
                if pending is not None:
                    yield pending
                pending = Recorded(stream, message, seq - behind.get(stream, 0), 0)
        if pending is not None:
            yield pending
        for topic, depths in self._depths.items():
            if (span := DepthSpan.of(np.concatenate(depths), 1.0)) and (doubt := span.doubt()):
                self.account.doubted[topic] = f"{doubt}: --depth {topic}=UNITS sets the units of a metre"

    def _read(self, played: MappedTopic, stored: Stored, stamp: int, part: int | None = None) -> list[Message]:
        """A part of a message as the type that is played, or all of them; none where it cannot be read."""
        reader, wanted = self._readers[played.topic], message_type(played.type)
        losses: list[str] | None = [] if self._accounting else None
        try:
            parts = range(max(1, len(reader.stamps(stored.data)))) if part is None else (part,)
            read = [reader.read(stored.data, number, stamp, losses) for number in parts]
            made = [in_units(convert(message, wanted), played.depth_scale) for message in read]
        except (RecordingError, MessageError) as error:
            self._pass_over(stored, error)
            return []
        if losses is not None:
            losses += [NARROWING[types] for message in read if (types := (type(message), wanted)) in NARROWING]
            if losses:
                self.account.lose(played.topic, losses)
            if isinstance(made[0], DepthImage) and not stored.number & (stored.number - 1):  # 1, 2, 4, 8 ...
                self._depths.setdefault(played.topic, []).append(made[0].data[::8, ::8].ravel())
        return made

    def _pass_over(self, stored: Stored, error: Exception) -> None:
        """Counts a message that cannot be read; raises `BagError` where that is not allowed."""
        if self._strict:
            raise BagError(
                f"{self.path}: topic {stored.topic!r}, message {stored.number} at {stored.log_time}: {error}"
            ) from error
        self.account.pass_over(stored.topic, f"number {stored.number} at {stored.log_time}: {error}")


def recorded_streams(path: Path, opening: Mapping[str, Any] | None) -> Recording | BagStreams:
    """Opens a recording, or the bag that `opening` (`PlayableStreams.opening`) describes."""
    if opening is None:
        return Recording(path)
    played = {stream: MappedTopic(*values) for stream, values in opening["played"].items()}
    return BagStreams(path, played, opening["clock"], strict=opening["strict"])
