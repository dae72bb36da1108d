"""A node of a ROS 2 graph over Zenoh: its session, its tokens, and the topics that it takes and gives."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from itertools import count
from typing import Any

import zenoh
import zenoh.ext

from dataflow.operator import SourceError
from dataflow.ros.wire import Attachment, End, Node, Qos, WireError, tokens_of
from dataflow.transport.bus import Bus
from dataflow.transport.network import NetworkConfig, NetworkError
from dataflow.transport.publisher import BusError

ROUTER = "tcp/127.0.0.1:7447"
CONNECT_WITHIN = 5.0
"""Seconds in which a router has to answer."""
HEARTBEAT = 1.0
"""Seconds after which subscribers of a latched topic learn of a message that they have missed."""
LOOK_EVERY = 0.1

TakeSample = Callable[[bytes, bytes], None]
"""(message, attachment); called on a thread of Zenoh's, so it may only hand them over."""
TakeToken = Callable[[str, bool], None]
"""(token, whether it is there); likewise."""


class Publisher:
    """Sends the messages of one topic, numbered."""

    def __init__(self, session: zenoh.Session, end: End) -> None:
        qos = end.qos
        block, drop = zenoh.CongestionControl.BLOCK, zenoh.CongestionControl.DROP
        how: dict[str, Any] = {
            "congestion_control": block if qos.reliable and qos.keep_all else drop,
            "reliability": zenoh.Reliability.RELIABLE if qos.reliable else zenoh.Reliability.BEST_EFFORT,
        }
        self._publisher: Any
        if qos.transient_local:
            how |= {"cache": zenoh.ext.CacheConfig(qos.depth), "publisher_detection": True}
            if qos.reliable:
                beat = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT)
                how["sample_miss_detection"] = beat
            self._publisher = zenoh.ext.declare_advanced_publisher(session, end.key, **how)
        else:
            self._publisher = session.declare_publisher(end.key, **how)
        self._gid, self.sent = end.gid, 0
        self.type = end.type

    def put(self, data: bytes) -> None:
        """Sends a message. Raises `BusError`."""
        self.sent += 1
        attachment = Attachment(self.sent, time.time_ns(), self._gid).encoded()
        try:
            self._publisher.put(data, attachment=attachment)
        except zenoh.ZError as error:
            raise BusError(f"message {self.sent} could not be sent: {error}") from error


class Ros2Node:
    """Takes part as a client of a Zenoh router, so it listens nowhere. Close it (it ends what it has declared)."""

    def __init__(self, name: str, namespace: str, domain: int, router: str, zenoh_settings: Mapping[str, Any]) -> None:
        """Connects; raises `SourceError` where no router answers."""
        settings = {
            "mode": "client",
            "connect/timeout_ms": round(CONNECT_WITHIN * 1e3),
            "connect/exit_on_failure": True,
            "timestamping/enabled": True,  # as rmw_zenoh has it: by stamps, best-effort publishers keep messages
            **zenoh_settings,
        }
        try:
            self._bus = Bus(NetworkConfig(connect=(router,), zenoh=settings))
        except BusError as error:
            raise SourceError(
                f"no Zenoh router answers at {router}: start one (`ros2 run rmw_zenoh_cpp rmw_zenohd`), or name "
                f"another with `router` ({error})"
            ) from error
        except NetworkError as error:
            raise SourceError(str(error)) from error
        self._session = self._bus.session
        self.node = Node(domain, self._bus.id, f"/{namespace.strip('/')}", name)
        self._numbers = count(1)
        self._kept: list[Any] = [self._session.liveliness().declare_token(self.node.token())]

    def end(self, kind: str, topic: str, type_: str, hash_: str, qos: Qos) -> End:
        """Returns a new end of a topic."""
        return End(self.node, str(next(self._numbers)), kind, topic, type_, hash_, qos)

    def advertise(self, topic: str, type_: str, hash_: str, qos: Qos) -> Publisher:
        """Declares a publisher."""
        end = self.end("MP", topic, type_, hash_, qos)
        publisher = Publisher(self._session, end)
        self._kept += [publisher, self._session.liveliness().declare_token(end.token)]
        return publisher

    def subscribe(self, end: End, take: TakeSample) -> None:
        """Declares a subscription; one that is transient local gets what publishers have kept."""

        def sample(given: zenoh.Sample) -> None:
            attached = given.attachment
            take(given.payload.to_bytes(), b"" if attached is None else attached.to_bytes())

        handler = zenoh.handlers.Callback(sample, indirect=False)
        if end.qos.transient_local:
            most = None if end.qos.keep_all else end.qos.depth
            more: dict[str, Any] = {
                "history": zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=most),
                "subscriber_detection": True,
            }
            if end.qos.reliable:
                more["recovery"] = zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None)
            self._kept.append(zenoh.ext.declare_advanced_subscriber(self._session, end.key, handler, **more))
        else:
            self._kept.append(self._session.declare_subscriber(end.key, handler))
        if end.hash != "*":
            self._kept.append(self._session.liveliness().declare_token(end.token))

    def watch(self, topic: str, take: TakeToken) -> None:
        """Passes on the tokens of a topic's publishers, those that are there and those to come."""

        def sample(given: zenoh.Sample) -> None:
            take(str(given.key_expr), given.kind == zenoh.SampleKind.PUT)

        handler = zenoh.handlers.Callback(sample, indirect=False)
        key = tokens_of(self.node.domain, topic)
        self._kept.append(self._session.liveliness().declare_subscriber(key, handler, history=True))

    def publishers(self, topic: str, within: float) -> list[End]:
        """Returns a topic's publishers as soon as there is one; none after `within` seconds."""
        deadline = time.monotonic() + within
        while not (found := list(self._ends(tokens_of(self.node.domain, topic)))):
            if time.monotonic() > deadline:
                return []
            time.sleep(LOOK_EVERY)
        return found

    def topics(self) -> list[str]:
        """Returns the names of all topics that have a publisher."""
        return sorted({end.topic for end in self._ends(tokens_of(self.node.domain))})

    def _ends(self, key: str) -> Iterator[End]:
        for reply in self._session.liveliness().get(key, timeout=2.0):
            if reply.ok is not None:
                try:
                    yield End.decoded(str(reply.ok.key_expr))
                except WireError:
                    continue  # of another version; `watch` reports those of the topic

    def close(self) -> None:
        """Leaves the graph. Idempotent."""
        self._kept.clear()
        self._bus.close()
