"""A bag: topics of serialised messages in the order in which they were recorded, whatever the file format."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

from dataflow.recording.errors import RecordingError
from dataflow.recording.notices import notice
from dataflow.recording.streams.codecs import SchemaText


class BagError(RecordingError):
    """A bag that cannot be opened or read: names the file, what is wrong, and what would be right."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a bag.

    - `encoding`: of its messages: `cdr`, `ros1`, `protobuf` or `json`.
    - `schema`: its message type as the file defines it; ROS types are named as in ROS 2 (`sensor_msgs/msg/Imu`).
    - `count`, `first`, `last`: messages, and the log times of the first and last one (ns).
    - `latched`: its messages were kept for late subscribers (ROS 1 latching, ROS 2 transient-local durability).
    - `channel`: further facts of it in the file (MCAP channel metadata, QoS profiles).
    """

    name: str
    encoding: str
    schema: SchemaText
    count: int
    first: int | None
    last: int | None
    bytes: int | None
    latched: bool
    channel: Mapping[str, str]


class Stored(NamedTuple):
    """One message of a bag, serialised. `log_time`: when it was recorded (ns); `number`: its place in its topic."""

    topic: str
    number: int
    log_time: int
    data: bytes | memoryview


@dataclass(slots=True)
class DamageReport:
    """Messages that damage keeps from being read.

    - `topics`: by topic, how many, as far as they have been read; `reasons`: by topic, the first reason.
    - `parts`: damage of which it is not known how many messages it took, for people.
    """

    topics: dict[str, int] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    parts: list[str] = field(default_factory=list)

    def take(self, topic: str, number: int, reason: str) -> None:
        """Notes how many messages of a topic are lost; of several passes over a bag the one that found most counts."""
        self.reasons.setdefault(topic, reason)
        self.topics[topic] = max(self.topics.get(topic, 0), number)

    def join(self, other: DamageReport) -> None:
        """Takes in what was found when the same bag was opened another time."""
        for topic, number in other.topics.items():
            self.take(topic, number, other.reasons[topic])
        self.parts[:] = dict.fromkeys([*self.parts, *other.parts])

    def announce(self, path: Path) -> None:
        """Announces the damage of a bag that is closed (`notices`)."""
        notice(path, [*dict.fromkeys(self.reasons.values()), *self.parts])


class Bag(Protocol):
    """A bag opened for reading. Not thread-safe."""

    path: Path
    kind: str
    """Format for people, such as `ROS 2 bag (sqlite3)`."""
    notes: tuple[str, ...]
    """Damage and oddities of the file, for people."""
    promised: Mapping[str, int]
    """Messages by topic according to the file's metadata, statistics or index; empty where none of them counts."""
    lost: DamageReport
    """Messages that damage keeps from being read; complete when all others have been."""

    @property
    def topics(self) -> Mapping[str, Topic]:
        """The topics by name, in alphabetical order."""

    def messages(self, topics: Collection[str]) -> Iterator[Stored]:
        """Every message of some topics, in the order of log times; equal ones as they stand in the file."""

    def close(self) -> None:
        """Closes the files. Idempotent."""


def shortfalls(bag: Bag) -> list[str]:
    """Reports the topics with fewer messages than the metadata promise, and which of them cannot be read."""
    lost = bag.lost
    return [
        *(_promise(*counts) for counts in _counts(bag) if counts[2] < counts[1]),
        *(
            f"topic {name}: {number:,} message{'' if number == 1 else 's'} lost to damage: {lost.reasons[name]}"
            for name, number in sorted(lost.topics.items())
        ),
        *lost.parts,
    ]


def surpluses(bag: Bag) -> list[str]:
    """Reports of which topics a bag holds more messages than its metadata promise."""
    return [_promise(*counts) for counts in _counts(bag) if counts[2] > counts[1]]


def _counts(bag: Bag) -> Iterator[tuple[str, int, int]]:
    """Of each topic that is promised: its name, how many messages are promised, and how many are there."""
    for name, promised in sorted(bag.promised.items()):
        held = sum(t.count for t in bag.topics.values() if t.name == name or t.name.startswith(f"{name} ("))
        yield name, promised, held


def _promise(name: str, promised: int, held: int) -> str:
    return f"topic {name}: {promised:,} messages are promised, {held:,} are there"


def is_static(topic: str) -> bool:
    """Returns whether a topic's transforms are static, which ROS marks by its name."""
    return topic.rpartition("/")[2] == "tf_static"


def is_latched(topic: str, profiles: str = "") -> bool:
    """Returns whether a topic keeps its messages for late subscribers, by its name or the text of its QoS profiles."""
    if is_static(topic):
        return True
    compact = profiles.lower().replace(" ", "").replace('"', "")
    return "durability:transient_local" in compact or "durability:1\n" in compact + "\n"
