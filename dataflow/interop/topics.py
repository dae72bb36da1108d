"""Readers of topics: which message type a topic becomes, which times its messages carry, and how one is read."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial
from itertools import islice
from typing import Any, Protocol

from dataflow.interop.access_tracking import TrackedMessage
from dataflow.interop.bag import Bag, Topic
from dataflow.interop.ros import CONVERSIONS, TRANSFORM_SETS, Convert
from dataflow.interop.ros.clouds import point_cloud
from dataflow.interop.ros.poses import transforms
from dataflow.interop.ros.sensors import number
from dataflow.interop.ros.values import time_ns
from dataflow.interop.typestores import RosType, ros_type
from dataflow.messages import Message, MessageError, Transforms
from dataflow.recording.errors import RecordingError
from dataflow.recording.streams.foreign import foreign_decoder, foreign_losses

Data = bytes | memoryview

_CDR_TIME = (struct.Struct("<iI"), struct.Struct(">iI"))
_ROS1_TIME = struct.Struct("<II")
UNIT = "unit"
"""Of a channel's metadata: the unit of its numbers, which ROS has no place for."""
FIRST = 100
"""Messages of which one has to be readable."""
_STAMPED_FIRST = {"rcl_interfaces/msg/Log", "foxglove_msgs/msg/CompressedVideo"}
"""Types that begin with a bare time."""


class TopicReader(Protocol):
    """Reads the messages of one topic. A message may be several here, its parts, which are numbered from 0."""

    def stamps(self, data: Data) -> tuple[int, ...]:
        """The times that a message carries (ns), one for each part; empty where its type carries none."""

    def read(self, data: Data, part: int, stamp: int, losses: list[str] | None = None) -> Message:
        """A part of a message, stamped with `stamp`. Raises `RecordingError` and `MessageError`.

        What it does not carry over is added to `losses`.
        """


class RosReader:
    """Reads messages of a ROS type whose times stand at the beginning, in a header, or nowhere."""

    def __init__(self, kind: RosType, ros1: bool, convert: Convert) -> None:
        self._kind, self._ros1 = kind, ros1
        self._convert = convert
        self._stamped = kind.has_header or kind.name in _STAMPED_FIRST

    def stamps(self, data: Data) -> tuple[int, ...]:
        """The time of its header, without reading more of the message."""
        if not self._stamped:
            return ()
        try:
            if self._ros1:
                seconds, nanoseconds = _ROS1_TIME.unpack_from(data, 4)
            else:
                seconds, nanoseconds = _CDR_TIME[0 if data[1] & 1 else 1].unpack_from(data, 4)
        except (struct.error, IndexError):
            raise RecordingError(f"a {self._kind.name} of {len(data)} bytes is too short") from None
        return (seconds * 10**9 + nanoseconds,)

    def read(self, data: Data, part: int, stamp: int, losses: list[str] | None = None) -> Message:
        """The message."""
        parsed = self._kind.parse(data)
        try:
            if losses is None:
                return self._convert(parsed, stamp)
            seen = TrackedMessage(parsed)
            made = self._convert(seen, stamp)
            losses += seen.unread()
            return made
        except (ValueError, TypeError, AttributeError, IndexError, ArithmeticError) as error:
            if isinstance(error, MessageError):
                raise
            raise RecordingError(f"a {self._kind.name} whose fields contradict each other: {error}") from error


class MarkerArrayReader(RosReader):
    """Reads marker arrays, which are stamped like their first marker."""

    def stamps(self, data: Data) -> tuple[int, ...]:
        """The time of its first marker."""
        markers = self._kind.parse(data).markers
        return (time_ns(markers[0].header.stamp),) if markers else ()


class TransformSetReader:
    """Reads tf messages, whose transforms may have several stamps: each stamp is a part, and so is each further parent
    that a frame has at one."""

    def __init__(self, kind: RosType) -> None:
        self._kind = kind

    def stamps(self, data: Data) -> tuple[int, ...]:
        """The times of its transforms, each once for every parent that a frame has then."""
        return tuple(time for time, _ in _sets(self._kind.parse(data).transforms))

    def read(self, data: Data, part: int, stamp: int, losses: list[str] | None = None) -> Message:
        """The transforms of the part."""
        sets = _sets(self._kind.parse(data).transforms)
        chosen = sets[part][1] if sets else []
        return transforms(chosen if losses is None else [TrackedMessage(row, losses) for row in chosen], stamp)


def _sets(rows: Any) -> list[tuple[int, list[Any]]]:
    """Transforms by time, in its order; those that give a frame another parent than one before are a set apart."""
    found: dict[tuple[int, int], list[Any]] = {}
    parents: dict[tuple[int, str], list[str]] = {}
    for row in rows:
        time = time_ns(row.header.stamp)
        known = parents.setdefault((time, row.child_frame_id), [])
        parent = row.header.frame_id
        if parent not in known and parent != row.child_frame_id:
            known.append(parent)
        found.setdefault((time, known.index(parent) if parent in known else 0), []).append(row)
    return [(time, found[time, number]) for time, number in sorted(found)]


class ForeignReader:
    """Reads what has a decoder among those of recordings: the Foxglove schemas, as protobuf or JSON."""

    def __init__(self, topic: Topic, decode: Callable[[bytes, int], Message]) -> None:
        self._topic, self._decode = topic, decode

    def stamps(self, data: Data) -> tuple[int, ...]:
        """The time that it carries."""
        carried = self._decode(bytes(data), -1).stamp
        return () if carried == -1 else (carried,)

    def read(self, data: Data, part: int, stamp: int, losses: list[str] | None = None) -> Message:
        """The message."""
        made = self._decode(bytes(data), stamp).replace(stamp=stamp)
        if losses is not None:
            losses += foreign_losses(self._topic.encoding, self._topic.schema, bytes(data))
        return made


def reader_of(topic: Topic) -> TopicReader:
    """Returns the reader of a topic; raises `RecordingError` with the reason where there is none."""
    if topic.encoding in ("cdr", "ros1"):
        return _ros_reader(topic)
    decode = foreign_decoder(topic.encoding, topic.schema)
    if decode is None:
        kind = topic.schema.name or "no schema"
        raise RecordingError(f"{topic.encoding or 'unnamed'} messages of {kind} have no counterpart here")
    return ForeignReader(topic, decode)


def _ros_reader(topic: Topic) -> TopicReader:
    name = ros_type(topic.schema.name)
    if name not in CONVERSIONS:
        raise RecordingError(f"{name or 'a message without a schema'} has no counterpart here")
    kind = RosType(name, topic.encoding, topic.schema)
    if name in TRANSFORM_SETS:
        return TransformSetReader(kind)
    convert = CONVERSIONS[name][1]
    if convert is point_cloud and topic.count > 1 and topic.first is not None and topic.last is not None:
        convert = partial(point_cloud, period=(topic.last - topic.first) * 1e-9 / (topic.count - 1))
    elif convert is number and (unit := topic.channel.get(UNIT)):
        convert = partial(number, unit=unit)
    reader = MarkerArrayReader if name == "visualization_msgs/msg/MarkerArray" else RosReader
    return reader(kind, topic.encoding == "ros1", convert)


def is_known(topic: Topic) -> bool:
    """Returns whether a topic's type has a counterpart here."""
    if topic.encoding in ("cdr", "ros1"):
        return ros_type(topic.schema.name) in CONVERSIONS
    return foreign_decoder(topic.encoding, topic.schema) is not None


class Reading:
    """A topic as it can be played: how its messages are read, and the type that the first one becomes.

    `reason`: why it cannot be played; `read_as`: None then, and for a topic without a message that decides it.
    `losses`: what a message of this type does not carry over, as far as the first one that can be read shows.
    """

    def __init__(self, bag: Bag, topic: Topic) -> None:
        self.topic = topic
        self.reader: TopicReader | None = None
        self.read_as: type[Message] | None = None
        self.reason = ""
        self.losses: tuple[str, ...] = ()
        try:
            self.reader = reader_of(topic)
            if not topic.count:
                self.read_as = CONVERSIONS.get(ros_type(topic.schema.name), (None, None))[0]
                self.reason = "it holds no messages"
            else:
                self._look_at(bag)
        except (RecordingError, MessageError) as error:
            self.reader, self.reason = None, str(error)

    @property
    def playable(self) -> bool:
        """Returns whether its messages can stand in for a stream."""
        return not self.reason

    @property
    def merges(self) -> bool:
        """Returns whether messages of one stamp become one."""
        return self.read_as is Transforms

    def _look_at(self, bag: Bag) -> None:
        """Reads messages until one can be read; a topic of which the first 100 cannot is unreadable."""
        assert self.reader is not None
        refused: Exception | None = None
        tried = 0
        for stored in islice(bag.messages([self.topic.name]), FIRST):
            tried += 1
            losses: list[str] = []
            try:
                self.read_as = type(self.reader.read(stored.data, 0, max(stored.log_time, 0), losses))
            except (RecordingError, MessageError) as error:
                refused = refused or error
                continue
            self.losses = tuple(dict.fromkeys(losses))
            return
        if refused is None:
            raise RecordingError(f"{self.topic.count:,} messages are promised, and none is there")
        raise refused if tried == 1 else type(refused)(f"{refused}; none of the first {tried} messages can be read")
