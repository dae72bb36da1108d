"""The other process of the transport tests: `python bus_peer.py ROLE ENDPOINT ...`; says events as JSON lines."""

from __future__ import annotations

import json
import queue
import sys
from typing import Any

import numpy as np
from transport_envelopes import carrying

from dataflow.messages import DepthImage
from dataflow.transport import (
    Bus,
    Kind,
    NetworkConfig,
    TapClient,
    TapWindow,
    decode,
    encode,
    register,
)

DEPTH = "robot1/camera/depth"
WAIT = 30.0


def depth_image(stamp: int, side: int = 256) -> DepthImage:
    return DepthImage(stamp=stamp, frame="camera", data=np.full((side, side), stamp, np.float32))


def say(**fields: Any) -> None:
    print(json.dumps(fields), flush=True)


def consume(endpoint: str, hold: str = "0") -> None:
    """Reads the stream until its end, keeping every `hold`-th message; reports what it saw."""
    inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
    kept, seen, probed, damaged = [], [], False, 0
    every = int(hold)
    with Bus(NetworkConfig(connect=(endpoint,))) as bus:
        bus.subscribe(DEPTH, inbox.put)
        while True:
            envelope = decode(inbox.get(timeout=WAIT))
            if envelope.kind is Kind.PROBE:
                if not probed:
                    probed = True
                    say(event="probed", number=envelope.seq)
                continue
            seen.append([envelope.kind.name, envelope.seq, envelope.stamp])
            if envelope.message is not None:
                damaged += envelope.message.digest() != depth_image(envelope.stamp, len(envelope.message.data)).digest()
                if every and envelope.seq % every == 0:
                    kept.append(envelope.message)
            if envelope.kind is Kind.END:
                break
        damaged += sum(m.compute_digest() != m.digest() for m in kept)
        say(event="ended", seen=seen, damaged=damaged, kept=len(kept), counters=bus.counters())
        kept.clear()
        sys.stdin.readline()


def hold(endpoint: str) -> None:
    """Keeps every message until killed."""
    inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
    kept, probed = [], False
    with Bus(NetworkConfig(connect=(endpoint,))) as bus:
        bus.subscribe(DEPTH, inbox.put)
        while True:
            envelope = decode(inbox.get(timeout=WAIT))
            if envelope.kind is Kind.PROBE and not probed:
                probed = True
                say(event="probed", number=envelope.seq)
            if envelope.message is not None:
                kept.append(envelope.message)
                say(event="holding", count=len(kept))


def live(endpoint: str) -> None:
    """Declares a static stream, then waits to be killed or told to leave."""
    with Bus(NetworkConfig(listen=(endpoint,))) as bus:
        bus.declare_static("robot1/camera/info", encode(carrying(depth_image(3, 4), "robot1/camera/info", 0)))
        say(event="up")
        sys.stdin.readline()


def produce(endpoint: str, count: str) -> None:
    """Publishes through shared memory as soon as its consumer is known; then waits to be killed or told to leave."""
    with Bus(NetworkConfig(listen=(endpoint,))) as bus:
        publisher = bus.publisher(DEPTH, consumers=1)
        say(event="up")
        sys.stdin.readline()
        while not publisher.shares:
            publisher.probe()
        for i in range(int(count)):
            publisher.put(carrying(depth_image(i), DEPTH, i))
        say(event="sent", counters=bus.counters())
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
    {"consume": consume, "hold": hold, "live": live, "produce": produce, "tap": tap, "registered": registered}[
        sys.argv[1]
    ](*sys.argv[2:])
