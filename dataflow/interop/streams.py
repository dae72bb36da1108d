"""Topics of a bag as recorded streams: stamped by one clock, repaired, merged in the order of stamps."""

from __future__ import annotations

import heapq
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from dataflow.interop.bag import Bag, BagError, Stored
from dataflow.interop.clocks import Choice, Clock, Repair, choose_clock, repair
from dataflow.interop.conversions import convert, offers
from dataflow.interop.found import Found
from dataflow.interop.opening import open_bag
from dataflow.interop.ranking import Ranking, within
from dataflow.interop.topics import Reading
from dataflow.messages import CameraInfo, Message, MessageError, Transforms, message_type
from dataflow.recording import Recorded, Recording, RecordingError, StreamInfo

MAX_HELD = 1 << 30
"""Bytes of messages that wait for earlier ones, which the log has later."""


@dataclass(frozen=True, slots=True)
class Played:
    """A topic that stands in for a stream: as which message type, and whether as one message, valid always."""

    topic: str
    type: str
    static: bool = False


class BagStreams:
    """Some topics of a bag as the streams that they stand in for (`PlayableStreams`).

    One pass over the bag, when it is opened, finds the times of all messages; nothing is kept of them but those.
    `watch` is told the number of messages seen. Raises `BagError`, `RecordingError`.
    """

    metadata: Mapping[str, Mapping[str, str]] = {}

    def __init__(
        self,
        path: Path,
        played: Mapping[str, Played],
        clock: Choice = "auto",
        *,
        watch: Callable[[int], None] | None = None,
    ) -> None:
        self.path, self.played = Path(path), dict(sorted(played.items()))
        self._bag: Bag = open_bag(self.path)
        self._closed = False
        try:
            self._readings = {p.topic: self._reading(p) for p in self.played.values()}
            self._moving = sorted({p.topic for p in self.played.values() if not p.static})
            self._found = self._scan(watch)
            times = [found.times(self._bag.topics[t], self._readings[t].merges) for t, found in self._found.items()]
            self.clock: Clock = choose_clock(times, clock)
            self.repairs: Mapping[str, Repair] = {
                t.topic: repair(
                    self.clock.stamps(t),
                    np.frombuffer(self._found[t.topic].digests, np.uint64) if len(t.log) else np.empty(0, np.uint64),
                    merge=self._readings[t.topic].merges,
                )
                for t in times
            }
            self.static_notes: dict[str, str] = {}
            self._static = {stream: self._static_message(stream) for stream, p in self.played.items() if p.static}
            self.streams: Mapping[str, StreamInfo] = {stream: self._info(stream) for stream in self.played}
        except BaseException:
            self.close()
            raise

    @property
    def torn(self) -> bool:
        """Tells False: which of its files has no proper end stands in `notes`."""
        return False

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of what in the file is damaged or unusual, for people."""
        return self._bag.notes

    def left_out(self, topic: str) -> tuple[str, ...]:
        """Fields of a topic's messages that have no place here."""
        return self._readings[topic].left_out

    def opening(self) -> Mapping[str, Any] | None:
        """Plain values with which `recorded_streams` gives the same streams in another process."""
        played = {stream: [p.topic, p.type, p.static] for stream, p in self.played.items()}
        return {"played": played, "clock": self.clock.kind}

    def facts(self) -> dict[str, str]:
        """Returns the metadata that a recording made of this bag has of it."""
        repairs = {name: found.facts() for name, found in self.repairs.items()}
        return {
            "file": self.path.name,
            "format": self._bag.kind,
            "clock": f"{self.clock.kind}: {self.clock.why}",
            "topics": json.dumps({stream: p.topic for stream, p in self.played.items()}, ensure_ascii=False),
            "repaired": json.dumps({name: found for name, found in repairs.items() if found}, ensure_ascii=False),
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

    def _reading(self, played: Played) -> Reading:
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

    def _scan(self, watch: Callable[[int], None] | None) -> dict[str, Found]:
        found = {topic: Found() for topic in self._moving}
        for seen, stored in enumerate(self._bag.messages(self._moving), 1):
            reader = self._readings[stored.topic].reader
            assert reader is not None
            try:
                stamps = reader.stamps(stored.data)
            except (RecordingError, MessageError) as error:
                raise self._unreadable(stored, error) from error
            found[stored.topic].add(stored, stamps)
            if watch is not None and not seen % 1000:
                watch(seen)
        return found

    def _static_message(self, stream: str) -> Message:
        """The one message of a static stream: the transforms of all, or the first, and whether others differ."""
        played, reading = self.played[stream], self._readings[self.played[stream].topic]
        assert reading.reader is not None
        first: Message | None = None
        differing = count = 0
        for stored in self._bag.messages([played.topic]):
            count += 1
            try:
                for part in range(max(1, len(reading.reader.stamps(stored.data)))):
                    read = reading.reader.read(stored.data, part, max(stored.log_time, 0))
                    message = convert(read, message_type(played.type))
                    if first is None:
                        first = message
                    elif isinstance(first, Transforms):
                        assert isinstance(message, Transforms)
                        first = joined(first, message)
                    elif message.replace(stamp=first.stamp).digest() != first.digest():
                        differing += 1
            except (RecordingError, MessageError) as error:
                raise self._unreadable(stored, error) from error
        assert first is not None, "a playable topic has messages"
        if isinstance(first, CameraInfo) and differing:
            self.static_notes[stream] = f"the first of {count:,}; {differing:,} differ from it"
        elif count > 1:
            self.static_notes[stream] = (
                f"{count:,} messages as one"
                if not differing
                else (f"the first of {count:,}; {differing:,} differ from it")
            )
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
        pending: _Pending | None = None
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
                message = self._read(stream, ready, part, stamp)
                if pending is not None and (pending.stream, pending.message.stamp) == (stream, stamp):
                    assert isinstance(pending.message, Transforms)
                    assert isinstance(message, Transforms)
                    pending.message = joined(pending.message, message)
                    continue
                if pending is not None:
                    yield pending.done()
                pending = _Pending(stream, message, seq)
        if pending is not None:
            yield pending.done()

    def _read(self, stream: str, stored: Stored, part: int, stamp: int) -> Message:
        played = self.played[stream]
        reader = self._readings[played.topic].reader
        assert reader is not None
        try:
            return convert(reader.read(stored.data, part, stamp), message_type(played.type))
        except (RecordingError, MessageError) as error:
            raise self._unreadable(stored, error) from error

    def _unreadable(self, stored: Stored, error: Exception) -> BagError:
        return BagError(f"{self.path}: topic {stored.topic!r}, message {stored.number} at {stored.log_time}: {error}")


@dataclass(slots=True)
class _Pending:
    stream: str
    message: Message
    seq: int

    def done(self) -> Recorded:
        return Recorded(self.stream, self.message, self.seq, 0)


def recorded_streams(path: Path, opening: Mapping[str, Any] | None) -> Recording | BagStreams:
    """Opens a recording, or the bag that `opening` (`PlayableStreams.opening`) says how to open."""
    if opening is None:
        return Recording(path)
    played = {stream: Played(*values) for stream, values in opening["played"].items()}
    return BagStreams(path, played, opening["clock"])


def joined(a: Transforms, b: Transforms) -> Transforms:
    """The transforms of two sets, stamped like the first; of those that place one frame the later counts."""
    rows = {child: (a, i) for i, child in enumerate(a.child_frames)}
    rows |= {child: (b, i) for i, child in enumerate(b.child_frames)}
    return Transforms(
        stamp=a.stamp,
        frames=tuple(m.frames[i] for m, i in rows.values()),
        child_frames=tuple(rows),
        translations=np.array([m.translations[i] for m, i in rows.values()]).reshape(-1, 3),
        rotations=np.array([m.rotations[i] for m, i in rows.values()]).reshape(-1, 4),
    )
