"""A ROS 2 peer made by hand: a router, and a publisher whose tokens and attachments are written out byte by byte."""

from __future__ import annotations

import json
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import xxhash
import zenoh
import zenoh.ext
from rosbags.typesys import Stores, get_typestore

JAZZY = get_typestore(Stores.ROS2_JAZZY)
STRING = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
HUMBLE = "TypeHashNotSupported"


@contextmanager
def router() -> Iterator[str]:
    """A Zenoh router on loopback; gives its endpoint."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    with zenoh.open(_config("router", "listen", endpoint)):
        yield endpoint


def _config(mode: str, what: str, endpoint: str) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5(f"{what}/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("timestamping/enabled", "true")
    return config


class Peer:
    """Publishes and listens as a node of a robot does."""

    def __init__(self, endpoint: str, node: str = "talker") -> None:
        self.session = zenoh.open(_config("client", "connect", endpoint))
        self.endpoint, self.node, self.kept = endpoint, node, []

    def publisher(
        self, topic: str, kind: str, hash_: str, *, latched: int = 0, qos: str = "::,:,:,:,,"
    ) -> PeerPublisher:
        return PeerPublisher(self, topic, kind, hash_, latched, f":1:,{latched}:,:,:,," if latched else qos)

    def heard(self, key: str, **advanced: Any) -> list[zenoh.Sample]:
        """What comes on a key from now on."""
        came: list[zenoh.Sample] = []
        handler = zenoh.handlers.Callback(came.append, indirect=False)
        if advanced:
            self.kept.append(zenoh.ext.declare_advanced_subscriber(self.session, key, handler, **advanced))
        else:
            self.kept.append(self.session.declare_subscriber(key, handler))
        return came

    def tokens(self, key: str) -> list[str]:
        return sorted(str(r.ok.key_expr) for r in self.session.liveliness().get(key) if r.ok is not None)

    def __enter__(self) -> Peer:
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()


class Read:
    """A source that is read on a thread, as in a live run."""

    def __init__(self, source: Any) -> None:
        self.source, self.steps = source, list[Any]()
        source.setup()
        self.thread = threading.Thread(target=self._read)

    def _read(self) -> None:
        for step in self.source.stream():
            self.steps.append(step)

    def __enter__(self) -> Read:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.source.stop_reading()
        self.thread.join(10)
        self.source.close()

    @property
    def texts(self) -> list[str]:
        return [step["message"].text for step in self.steps]


class PeerPublisher:
    """One topic. `number` may be set, to lose messages."""

    made = 0

    def __init__(self, peer: Peer, topic: str, kind: str, hash_: str, latched: int, qos: str) -> None:
        package, name = kind.split("/msg/")
        wire = f"{package}::msg::dds_::{name}_"
        key = f"0/{topic.strip('/')}/{wire}/{hash_}"
        PeerPublisher.made += 1
        self.number, self.kind = 0, kind
        keeps = {"cache": zenoh.ext.CacheConfig(latched), "publisher_detection": True}
        beat = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=1.0)
        self.publisher = (
            zenoh.ext.declare_advanced_publisher(peer.session, key, sample_miss_detection=beat, **keeps)
            if latched
            else peer.session.declare_publisher(key)
        )
        zid, mangled = peer.session.zid(), topic.replace("/", "%")
        token = f"@ros2_lv/0/{zid}/0/{PeerPublisher.made}/MP/%/%/{peer.node}/{mangled}/{wire}/{hash_}/{qos}"
        self.gid = xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")
        self.token = peer.session.liveliness().declare_token(token)

    def send(self, message: Any) -> None:
        """Sends a ROS message, or bytes."""
        data = message if isinstance(message, bytes) else bytes(JAZZY.serialize_cdr(message, self.kind))
        self.number += 1
        attachment = struct.pack("<qqB16s", self.number, time.time_ns(), 16, self.gid)
        self.publisher.put(data, attachment=attachment)


def ros(kind: str, **fields: Any) -> Any:
    """A ROS message by type and fields."""
    return JAZZY.types[kind](**fields)


def string(text: str) -> Any:
    return ros("std_msgs/msg/String", data=text)


def until(true: Any, within: float = 20.0) -> None:
    """Waits for a condition."""
    deadline = time.monotonic() + within
    while not true():
        assert time.monotonic() < deadline, "it did not come in time"
        time.sleep(0.01)
