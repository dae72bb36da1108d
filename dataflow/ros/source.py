"""Sources that take topics of ROS 2 over Zenoh, as `rmw_zenoh` publishes them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Literal

import numpy as np

from dataflow.interop.conversions import convert
from dataflow.interop.topics import TopicReader
from dataflow.interop.transform_sets import joined, other_parents
from dataflow.messages import Message, MessageError, Number, Transforms
from dataflow.operator import FINDING, Duration, Out, Param, Source, SourceError
from dataflow.recording.errors import RecordingError
from dataflow.ros.definitions import CLOCK, Distro, clock_time, distros_of, reader_for, type_hash
from dataflow.ros.losses import Losses
from dataflow.ros.mailbox import Arrival, Mailbox, TokenChange
from dataflow.ros.message import RosMessage
from dataflow.ros.place import Place
from dataflow.ros.reorder import Reorder
from dataflow.ros.wire import Attachment, End, Qos, WireError, gid_of

SETTLED = 0.3
"""Seconds without a further latched message, after which those of all publishers count as taken."""
OF_TRANSFORMS = 20_000_000
"""Wait for earlier ones (ns) of transforms, which several nodes publish on one topic."""


class Subscriber(Place, Source, abstract=True):
    """Takes one topic. A subclass has one port `message`, whose type is what messages become."""

    real_time = True

    type: str = Param("", doc="its ROS type, such as sensor_msgs/msg/Imu; none takes that of its first publisher")
    within: Duration = Param("10s", ge=0, doc="time to wait for a publisher, or for a latched message, at the start")
    reorder: Duration | None = Param(
        None, ge=0, doc="time that messages wait for earlier ones of other publishers; none takes 20 ms of transforms"
    )
    sim_time: bool = Param(False, doc="stamps messages without a header by /clock")

    def setup(self) -> None:
        """Connects and subscribes. Raises SourceError."""
        self._mail, self._losses = Mailbox(), Losses()
        self._counts: Counter[str] = Counter()
        self._first_fault = ""
        self._ends: dict[bytes, End] = {}
        self._warned: set[str] = set()
        self._clock = self._lost = 0
        self._wanted = self.spec.outputs["message"].types[0]
        transforms = self._wanted is Transforms
        wait = self.reorder if self.reorder is not None else OF_TRANSFORMS if transforms else 0
        self._order = Reorder(wait * 1e-9)
        self._name, self._node = self.absolute(self.topic), self.join()
        type_, hash_, distro = self._agreed()
        self._reader = self._reader_of(type_, distro)
        qos = Qos(self.reliability == "reliable", self.durability == "transient_local", depth=self.depth)
        self._end = self._node.end("MS", self._name, type_, hash_, qos)
        if self.sim_time:
            clock = self._node.end("MS", "/clock", CLOCK, "*", Qos(reliable=False, depth=1))
            self._node.subscribe(clock, self._take_clock)
        self._node.watch(self._name, self._mail.token)
        self._node.subscribe(self._end, self._mail.sample)

    def _agreed(self) -> tuple[str, str, Distro]:
        """The type, its hash and the distribution that defines it: given, or of the topic's publisher."""
        if self.type:
            hash_ = type_hash(self.type, self.distro)
            if hash_ is None:
                raise SourceError(
                    f"ROS 2 {self.distro} has no type {self.type!r} that is known here: leave `type` out, so that its "
                    "hash is taken from its publisher"
                )
            return self.type, hash_, self.distro
        found = self._node.publishers(self._name, self.within * 1e-9)
        if not found:
            there = ", ".join(self._node.topics()) or "none"
            raise SourceError(
                f"no publisher of {self._name} in domain {self.domain} within {self.within * 1e-9:g} s; topics there: "
                f"{there}. Start it, or give `type`"
            )
        first = found[0]
        fit = distros_of(first.type, first.hash)
        if not fit and self._wanted is not RosMessage:
            raise SourceError(
                f"{self._name}: {first.node.full_name} defines {first.type} as no distribution that is known here "
                f"({first.hash}); dataflow.ros:Ros2Source passes its messages on as they are"
            )
        return first.type, first.hash, self.distro if self.distro in fit or not fit else fit[0]

    def _reader_of(self, type_: str, distro: Distro) -> TopicReader | None:
        if self._wanted is RosMessage:
            return None
        try:
            return reader_for(self._name, type_, distro)
        except RecordingError as error:
            raise SourceError(f"{self._name}: {error}") from error

    def _take_clock(self, data: bytes, attachment: bytes) -> None:
        self._clock = max(0, clock_time(data))

    def stream(self) -> Iterator[Mapping[str, Message]]:
        while not self._mail.closed:
            for message in self._next():
                step: dict[str, Message] = {"message": message}
                if self._losses.lost != self._lost:
                    self._lost = self._losses.lost
                    step["lost"] = Number(stamp=message.stamp, value=float(self._lost), unit="")
                yield step

    def _next(self) -> Iterator[Message]:
        """Takes what comes next, and gives what need not wait any longer."""
        came = self._mail.get(self._order.due_in(time.monotonic()))
        if isinstance(came, TokenChange):
            self._look_at(came)
        elif came is not None:
            gid = self._number(came)
            for message in self._read(came, gid):
                self._order.put(message, gid, time.monotonic())
        while (ready := self._order.take(time.monotonic())) is not None:
            yield ready

    def _number(self, came: Arrival) -> bytes:
        """Takes note of a message's number; returns its publisher's gid."""
        self._counts["received"] += 1
        try:
            seen = Attachment.decoded(came.attachment)
        except WireError:
            self._counts["unnumbered"] += 1
            return b""
        if missing := self._losses.take(seen):
            who = self._publisher(seen.gid)
            self._warn(f"{self._name}: {missing} messages of {who} were lost before number {seen.number}", who)
        return seen.gid

    def _read(self, came: Arrival, gid: bytes) -> list[Message]:
        """The messages in one of ROS; none where it cannot be read, which is counted."""
        fallback = self._clock if self.sim_time else self._published(came)
        if self.sim_time and not fallback:
            self._counts["before_clock"] += 1
            return []
        if self._reader is None:
            data = np.frombuffer(came.data, np.uint8)
            return [RosMessage(stamp=fallback, type=self._end.type, hash=self._end.hash, data=data)]
        try:
            stamps = [stamp if stamp > 0 else fallback for stamp in self._reader.stamps(came.data) or (0,)]
            read = (self._reader.read(came.data, part, stamp) for part, stamp in enumerate(stamps))
            return [convert(message, self._wanted) for message in read]
        except (RecordingError, MessageError) as error:
            self._counts["unreadable"] += 1
            self._first_fault = self._first_fault or str(error)
            self._warn(f"{self._name}: a message of {self._publisher(gid)} cannot be read: {error}", "unreadable")
            return []

    @staticmethod
    def _published(came: Arrival) -> int:
        try:
            return max(Attachment.decoded(came.attachment).time, 1)
        except WireError:
            return came.time

    def _publisher(self, gid: bytes) -> str:
        end = self._ends.get(gid)
        return f"publisher {gid.hex()}" if end is None else end.node.full_name

    def _look_at(self, change: TokenChange) -> None:
        """Names a publisher of the topic whose messages do not come here."""
        if not change.alive:
            return
        try:
            end = End.decoded(change.token)
        except WireError as error:
            self._warn(f"{self._name}: {error}", change.token)
            return
        self._ends[gid_of(change.token)] = end
        who = f"{self._name}: {end.node.full_name}"
        if end.type != self._end.type:
            self._mismatch(f"{who} publishes {end.type}, and {self._end.type} is taken: its messages do not come")
        elif end.hash != self._end.hash:
            fit = " or ".join(distros_of(end.type, end.hash)) or "none that is known here"
            self._mismatch(
                f"{who} publishes {end.type} as defined by {fit} ({end.hash}), and {self._end.hash} is taken: its "
                "messages do not come; `distro` chooses"
            )
        elif self._end.qos.transient_local and not end.qos.transient_local:
            self._warn(f"{who} is volatile: messages that it sent before this start do not come", who)

    def _mismatch(self, text: str) -> None:
        self._counts["mismatched"] += text not in self._warned
        self._first_fault = self._first_fault or text
        self._warn(text, text)

    def _warn(self, text: str, once: str) -> None:
        if once not in self._warned:
            self._warned.add(once)
            self.log.warning("%s", text)

    def summary(self) -> Mapping[str, float | int | str]:
        """Messages received, and lost on the side of ROS (`lost`), here (`overflow`), or by their stamps (`late`)."""
        if not hasattr(self, "_mail"):
            return {}
        found = {"lost": self._losses.lost, "overflow": self._mail.overflow, "late": self._order.late, **self._counts}
        told: dict[str, float | int | str] = dict(found)
        lacking = [
            f"{publisher.lost:,} of {publisher.lost + publisher.received:,} messages of {self._publisher(gid)}"
            for gid, publisher in self._losses.publishers.items()
            if publisher.lost
        ]
        findings = [f"{self._name}: lost are {', '.join(lacking)}"] if lacking else []
        if self._order.late:
            findings.append(
                f"{self._name}: {self._order.late:,} messages came after later ones of other publishers, by up to "
                f"{self._order.behind * 1e-6:.0f} ms; a longer `reorder` keeps them"
            )
        if self._first_fault:
            findings.append(self._first_fault)
        return told | ({FINDING: "; ".join(findings)} if findings else {})

    def stop_reading(self) -> None:
        """Lets `stream()` return."""
        self._mail.close()

    def close(self) -> None:
        if hasattr(self, "_node"):
            self._node.close()


class Latched(Subscriber, abstract=True):
    """Takes a topic whose messages publishers keep as one message that is valid always.

    Transforms of all publishers are joined; of others the newest counts. A later change is named, and not taken over.
    """

    durability: Literal["volatile", "transient_local"] = Param("transient_local", doc="as `ros2 topic info -v` has it")
    depth: int = Param(100, ge=1, doc="messages that publishers shall keep (history)")

    def static_outputs(self) -> Mapping[str, Message]:
        """Raises SourceError where nothing is latched."""
        deadline = time.monotonic() + self.within * 1e-9
        self._held: Message | None = None
        while (left := deadline - time.monotonic()) > 0:
            before = self._counts["received"]
            came = self._mail.get(min(left, SETTLED if self._held else left))
            self._take_in(came)
            if came is None and self._held is not None and self._counts["received"] == before:
                break
        if self._held is None:
            there = ", ".join(end.node.full_name for end in self._ends.values()) or "none"
            raise SourceError(
                f"no message of {self._name} ({self._end.type}) came within {self.within * 1e-9:g} s; its publishers: "
                f"{there}" + (f"; {self._first_fault}" if self._first_fault else "")
            )
        return {"message": self._held}

    def _take_in(self, came: Arrival | TokenChange | None) -> None:
        if isinstance(came, TokenChange):
            self._look_at(came)
        elif came is not None:
            for message in self._read(came, self._number(came)):
                self._held = self._with(message)

    def _with(self, message: Message) -> Message:
        if isinstance(message, Transforms) and isinstance(self._held, Transforms):
            for other in other_parents(self._held, message):
                self._warn(f"{self._name}: {other}", other)
            return joined(self._held, message)
        return message

    def stream(self) -> Iterator[Mapping[str, Message]]:
        while not self._mail.closed:
            before = self._held
            self._take_in(self._mail.get(None))
            if before is not None and self._held is not None:
                if self._held.replace(stamp=before.stamp).digest() != before.digest():
                    self._warn(f"{self._name} has changed since the start; the run keeps what it began with", "changed")
                self._held = before
        yield from ()


class Ros2Source(Subscriber):
    """Takes a topic of any type as it is: for types that have no counterpart here."""

    message: Out[RosMessage] = Out(doc="the messages, serialised")
    lost: Out[Number] = Out(doc="messages lost so far on the side of ROS; with the first message after each gap")


def source_of(message: type[Message]) -> type[Subscriber]:
    """Returns the source of a ROS topic whose messages become those of a type."""
    made = {
        "__module__": "dataflow.ros",
        "__doc__": f"{message.__name__} messages of a ROS 2 topic.",
        "__annotations__": {"message": Out[message], "lost": Out[Number]},  # type: ignore[valid-type]
        "message": Out(doc="the messages"),
        "lost": Out(doc="messages lost so far on the side of ROS; with the first message after each gap"),
    }
    return type(message.__name__, (Subscriber,), made)


def latched_source_of(message: type[Message]) -> type[Subscriber]:
    """Returns the source of a latched ROS topic as a static stream of a type."""
    made = {
        "__module__": "dataflow.ros",
        "__doc__": f"The {message.__name__} of a latched ROS 2 topic, valid always.",
        "__annotations__": {"message": Out[message]},  # type: ignore[valid-type]
        "message": Out(static=True, doc="what was latched at the start"),
    }
    return type(f"Static{message.__name__}", (Latched,), made)
