"""The other process of the transport tests: `python bus_peer.py ROLE ENDPOINT ...`; says events as JSON lines."""

from __future__ import annotations

import json
import queue
import sys
from typing import Any

from transport_envelopes import carrying, depth_image

from dataflow.transport import Bus, Kind, NetworkConfig, TapClient, TapWindow, decode, encode, register

DEPTH = "robot1/camera/depth"
WAIT = 30.0


def say(**fields: Any) -> None:
    print(json.dumps(fields), flush=True)


def consume(endpoint: str) -> None:
    """Subscribes to the stream until its end, as any Zenoh program may; reports what it saw."""
    inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
    seen = []
    with Bus(NetworkConfig(connect=(endpoint,))) as bus:
        bus.session.declare_subscriber(DEPTH, lambda sample: inbox.put(bytes(sample.payload)))
        while True:
            envelope = decode(inbox.get(timeout=WAIT))
            seen.append([envelope.kind.name, envelope.seq, envelope.stamp])
            if envelope.kind is Kind.END:
                break
        say(event="ended", seen=seen)
        sys.stdin.readline()


def live(endpoint: str) -> None:
    """Declares a static stream, then waits to be killed or told to leave."""
    with Bus(NetworkConfig(listen=(endpoint,))) as bus:
        bus.declare_static("robot1/camera/info", encode(carrying(depth_image(3, 4), "robot1/camera/info", 0)))
        say(event="up")
        sys.stdin.readline()


def tap(endpoint: str, messages: str) -> None:
    """Takes everything from a tap and says so."""
    with Bus(NetworkConfig(connect=(endpoint,))) as bus:
        client = TapClient(bus, "robot1", ["robot1/**"], TapWindow(messages=int(messages)))
        say(event="up")
        while True:
            taken = client.take(WAIT)
            if taken is None:
                return
            say(event="took", stream=taken.stream, seq=taken.head().seq, skipped=client.skipped)


def registered(_: str) -> None:
    """Registers a graph and waits."""
    with register("killed", "robot1", ["tcp/127.0.0.1:1"]):
        say(event="up")
        sys.stdin.readline()


if __name__ == "__main__":
    {"consume": consume, "live": live, "tap": tap, "registered": registered}[sys.argv[1]](*sys.argv[2:])
