"""Sources that take topics of ROS 2 over Zenoh, as `rmw_zenoh` publishes them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import numpy as np

from dataflow.interop.clocks import BACK
from dataflow.interop.conversions import convert, offers
from dataflow.interop.ros import CONVERSIONS as MAPPED
from dataflow.interop.topics import TopicReader
from dataflow.interop.transform_sets import joined, other_parents
from dataflow.messages import Message, MessageError, Number, Transforms
from dataflow.operator import Duration, Out, Param, Source, SourceError
from dataflow.recording.errors import RecordingError
from dataflow.ros.definitions import CLOCK, Distro, clock_time, distros_of, reader_for, type_hash
from dataflow.ros.losses import remember
from dataflow.ros.mailbox import Arrival, Mailbox, TokenChange
from dataflow.ros.message import RosMessage
from dataflow.ros.place import TYPE, Place
from dataflow.ros.reorder import Reorder
from dataflow.ros.wire import End, Qos, WireError, gid_of

SETTLED = 0.3
"""Seconds without a further latched message, after which those of all publishers count as taken."""
OF_TRANSFORMS = 20_000_000
"""Wait for earlier ones (ns) of transforms, which several nodes publish on one topic."""
LATEST = 1 << 62
"""The latest time of publication (ns) that is taken as it is."""
LOST_AGAIN = 20
"""Messages after which the number of lost ones is given again, since flow control may have refused the step with it."""


class Subscriber(Place, Source, abstract=True):
    """Takes one topic. A subclass has one port `message`, whose type is what messages become."""

    real_time = True

    type: str = Param(
        "", pattern=TYPE, doc="its ROS type, such as sensor_msgs/msg/Imu; none takes that of its first publisher"
    )
    within: Duration = Param("10s", ge=0, doc="time to wait for a publisher, or for a latched message, at the start")
    reorder: Duration | None = Param(
        None, ge=0, doc="time that messages wait for earlier ones of other publishers; none takes 20 ms of transforms"
    )
    sim_time: bool = Param(False, doc="stamps messages without a header by /clock")

    def setup(self) -> None:
        """Connects and subscribes. Raises SourceError."""
        self._mail = Mailbox()
        self._counts: Counter[str] = Counter()
        self._first_fault = ""
        self._ends: dict[bytes, End] = {}
        self._warned: dict[str, None] = {}
        self._lost = self._broken_clocks = 0
        self._fallback = (0, 0)
        self._wanted = self.spec.outputs["message"].types[0]
        transforms = self._wanted is Transforms
        wait = self.reorder if self.reorder is not None else OF_TRANSFORMS if transforms else 0
        self._order = Reorder(wait * 1e-9)
        self._name, self._node = self.absolute(self.topic), self.join()
        type_, hash_, distro = self._agreed()
        self._reader = self._reader_of(type_, distro)
        distros_of(type_, hash_)  # reads all definitions, which takes seconds, in which messages would be dropped
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
            reader = reader_for(self._name, type_, distro)
        except RecordingError as error:
            raise SourceError(f"{self._name}: {error}") from error
        if self._wanted not in offers(becomes := MAPPED[type_][0]):
            raise SourceError(
                f"{self._name}: a {type_} becomes a message {becomes.__name__}, not {self._wanted.__name__}: "
                f"use dataflow.ros:{becomes.__name__}"
            )
        return reader

    def _take_clock(self, data: bytes, attachment: bytes) -> None:
        try:
            self._mail.clock = max(0, clock_time(data))
        except RecordingError as error:
            self._broken_clocks += 1
            self._first_fault = self._first_fault or f"/clock: {error}"

    def stream(self) -> Iterator[Mapping[str, Message]]:
        given = since = 0
        while not self._mail.closed:
            for message in self._next():
                step: dict[str, Message] = {"message": message}
                since += 1
                if self._lost != given or (self._lost and since >= LOST_AGAIN):
                    given, since = self._lost, 0
                    step["lost"] = Number(stamp=message.stamp, value=float(given), unit="")
                yield step

    def _next(self) -> Iterator[Message]:
        """Takes what comes next, and gives what need not wait any longer."""
        came = self._mail.get(self._order.due_in(time.monotonic()))
        if isinstance(came, TokenChange):
            self._look_at(came)
        elif came is not None:
            for message in self._read(came):
                self._order.put(message, came.gid, time.monotonic())
        while (ready := self._order.take(time.monotonic())) is not None:
            yield ready

    def _read(self, came: Arrival) -> list[Message]:
        """The messages in one of ROS; none where it cannot be read, which is counted."""
        self._count(came)
        if self.sim_time and not came.clock:
            self._counts["before_clock"] += 1
            return []
        try:
            if self._reader is None:
                data = np.frombuffer(came.data, np.uint8)
                stamp = self._without_header(came)
                return [RosMessage(stamp=stamp, type=self._end.type, hash=self._end.hash, data=data)]
            stamps = list(self._reader.stamps(came.data) or (0,))
            if min(stamps) <= 0:
                stamp = self._without_header(came)
                stamps = [each if each > 0 else stamp for each in stamps]
            read = (self._reader.read(came.data, part, stamp) for part, stamp in enumerate(stamps))
            return [convert(message, self._wanted) for message in read]
        except (RecordingError, MessageError, ArithmeticError) as error:
            self._counts["unreadable"] += 1
            self._first_fault = self._first_fault or str(error)
            self._warn(f"{self._name}: a message of {self._publisher(came.gid)} cannot be read: {error}", "unreadable")
            return []

    def _count(self, came: Arrival) -> None:
        self._counts["received"] += 1
        self._lost = came.lost
        if came.seen is None:
            self._counts["unnumbered"] += 1
        elif came.missing:
            who = self._publisher(came.gid)
            self._warn(
                f"{self._name}: {came.missing} messages of {who} were lost before number {came.seen.number}", who
            )

    def _without_header(self, came: Arrival) -> int:
        """The stamp of a message whose header gives none: the time of /clock, or of publication. Where that stands
        still, each is 1 ns after the one before."""
        time_ = came.clock if self.sim_time else came.time if came.seen is None else min(max(came.seen.time, 1), LATEST)
        before, stamp = self._fallback
        self._fallback = time_, time_ if time_ < before else max(time_, stamp + 1)
        return self._fallback[1]

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
        remember(self._ends, gid_of(change.token), end)
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
            remember(self._warned, once, None)
            self.log.warning("%s", text)

    def summary(self) -> Mapping[str, float | int | str]:
        """Messages received, and lost on the side of ROS (`lost`), here (`overflow`), or by their stamps."""
        if not hasattr(self, "_mail"):
            return {}
        mail, order = self._mail, self._order
        found = {"lost": mail.losses.lost, "overflow": mail.overflow, "late": order.late, **self._counts}
        more = {"repeated": order.repeated, "unnamed": mail.unnamed}
        more["unreadable"] = self._counts["unreadable"] + self._broken_clocks
        return {**found, **{name: n for name, n in more.items() if n}}

    def finding(self) -> str:
        """Returns whose messages were lost, which came late, and the first fault."""
        if not hasattr(self, "_mail"):
            return ""
        return "; ".join(text for text in (self._lacking(), self._late(), self._first_fault) if text)

    def _lacking(self) -> str:
        """Names the publishers whose messages were lost; empty for none."""
        known = list(self._mail.losses.publishers.items())
        lacking = [
            f"{publisher.lost:,} of {publisher.lost + publisher.received:,} messages of {self._publisher(gid)}"
            for gid, publisher in known
            if publisher.lost
        ]
        if (others := self._mail.losses.lost - sum(publisher.lost for _, publisher in known)) > 0:
            lacking.append(f"{others:,} of former publishers")
        return f"{self._name}: lost are {', '.join(lacking)}" if lacking else ""

    def _late(self) -> str:
        """Counts the messages that did not fit in by their stamps, and names what helps; empty for none."""
        order, found = self._order, []
        if order.late:
            helps = "a longer `reorder` keeps them" if order.behind <= BACK else "a publisher's clock is wrong"
            found.append(
                f"{self._name}: {order.late:,} messages came after later ones of other publishers, by up to "
                f"{order.behind * 1e-6:.0f} ms; {helps}"
            )
        if order.repeated:
            found.append(f"{self._name}: {order.repeated:,} messages have the stamp of another, and were left out")
        return "; ".join(found)

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
            for message in self._read(came):
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
    lost: Out[Number] = Out(
        doc="messages lost so far on the side of ROS; with the first message after each gap, and again"
    )


def source_of(message: type[Message], *, latched: bool = False) -> type[Subscriber]:
    """Returns the source of a ROS topic whose messages become those of a type; of a latched one as a static stream."""
    name = message.__name__
    types: Any = Literal[("", *(kind for kind, (becomes, _) in MAPPED.items() if message in offers(becomes)))]
    annotations: dict[str, Any] = {"message": Out[message], "type": types}  # type: ignore[valid-type]
    made: dict[str, Any] = {"__module__": "dataflow.ros", "__annotations__": annotations}
    made["type"] = Param("", doc="its ROS type; none takes that of its first publisher")
    if latched:
        made["__doc__"] = f"The {name} of a latched ROS 2 topic, valid always."
        made["message"] = Out(static=True, doc="what was latched at the start")
        return type(f"Static{name}", (Latched,), made)
    annotations["lost"] = Out[Number]
    made["__doc__"] = f"{name} messages of a ROS 2 topic."
    made["message"] = Out(doc="the messages")
    made["lost"] = Out(doc="messages lost so far on the side of ROS; with the first message after each gap, and again")
    return type(name, (Subscriber,), made)
