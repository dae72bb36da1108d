"""Round trip between two processes with zenoh-python alone: a callback in each, TCP on loopback.

usage: zenoh_pair.py BYTES COUNT
"""

from __future__ import annotations

import json
import os
import queue
import socket
import sys
import time

import numpy as np
import zenoh

PAUSE = float(os.environ.get("PAUSE", "0.01"))


def session(*, listen: str | None = None, connect: str | None = None) -> zenoh.Session:
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", json.dumps([listen] if listen else []))
    config.insert_json5("connect/endpoints", json.dumps([connect] if connect else []))
    return zenoh.open(config)


def echo(endpoint: str) -> None:
    with session(connect=endpoint) as opened:
        reply = opened.declare_publisher("pong", congestion_control=zenoh.CongestionControl.BLOCK)
        over = queue.SimpleQueue[bool]()

        def answer(sample: zenoh.Sample) -> None:
            payload = bytes(sample.payload)
            if payload:
                reply.put(np.frombuffer(payload, np.uint8)[:8].tobytes())
            else:
                over.put(True)

        opened.declare_subscriber("ping", zenoh.handlers.Callback(answer, indirect=False))
        over.get(timeout=120)


def main(size: int, count: int) -> list[float]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    pid = os.fork()
    if not pid:
        time.sleep(0.5)
        echo(endpoint)
        os._exit(0)
    took = []
    with session(listen=endpoint) as opened:
        replies = queue.SimpleQueue[bytes]()

        def take(sample: zenoh.Sample) -> None:
            replies.put(bytes(sample.payload))

        opened.declare_subscriber("pong", zenoh.handlers.Callback(take, indirect=False))
        ping = opened.declare_publisher("ping", congestion_control=zenoh.CongestionControl.BLOCK)
        time.sleep(2.0)
        source = np.zeros(size, np.uint8)
        for _ in range(count):
            time.sleep(PAUSE)
            source[:8] = np.frombuffer(np.int64(time.monotonic_ns()).tobytes(), np.uint8)
            ping.put(source.tobytes())
            sent = int(np.frombuffer(replies.get(timeout=10), np.int64)[0])
            took.append((time.monotonic_ns() - sent) / 1e3)
        ping.put(b"")
        os.waitpid(pid, 0)
    return took


if __name__ == "__main__":
    print(json.dumps(main(int(sys.argv[1]), int(sys.argv[2]))))
