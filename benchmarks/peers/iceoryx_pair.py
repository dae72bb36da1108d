"""Round trip between two processes with iceoryx2: shared memory, woken by its events.

usage: iceoryx_pair.py BYTES COUNT
"""

from __future__ import annotations

import ctypes
import json
import os
import sys
import time
from typing import Any

import iceoryx2 as iox2
import numpy as np

WAIT = iox2.Duration.from_secs(10)


class End:
    """One process's end: publishes on one service, subscribes to the other, waits for its events."""

    def __init__(self, name: str, gives: str, takes: str, size: int) -> None:
        self.node = iox2.NodeBuilder.new().create(iox2.ServiceType.Ipc)
        out = self.service(f"{name}/{gives}").publish_subscribe(iox2.Slice[ctypes.c_uint8]).open_or_create()
        into = self.service(f"{name}/{takes}").publish_subscribe(iox2.Slice[ctypes.c_uint8]).open_or_create()
        self.publisher = out.publisher_builder().initial_max_slice_len(size).create()
        self.subscriber = into.subscriber_builder().create()
        self.notifier = self.service(f"{name}/{gives}/event").event().open_or_create().notifier_builder().create()
        self.listener = self.service(f"{name}/{takes}/event").event().open_or_create().listener_builder().create()

    def service(self, name: str) -> Any:
        return self.node.service_builder(iox2.ServiceName.new(name))

    def give(self, data: np.ndarray) -> None:
        sample = self.publisher.loan_slice_uninit(len(data))
        ctypes.memmove(sample.payload_ptr, data.ctypes.data, len(data))
        sample.assume_init().send()
        self.notifier.notify()

    def take(self) -> np.ndarray:
        """The next payload's first eight bytes."""
        while (sample := self.subscriber.receive()) is None:
            self.listener.timed_wait(WAIT)
        payload = sample.payload()
        first = np.ctypeslib.as_array((ctypes.c_uint8 * 8).from_address(payload.as_ptr())).copy()
        sample.delete()
        return first


PAUSE = float(os.environ.get("PAUSE", "0.01"))


def main(size: int, count: int) -> list[float]:
    name = f"roundtrip/{os.getpid()}"
    pid = os.fork()
    if not pid:
        end = End(name, "pong", "ping", 8)
        for _ in range(count):
            end.give(end.take())
        os._exit(0)
    end = End(name, "ping", "pong", size)
    time.sleep(1.0)
    source = np.zeros(size, np.uint8)
    took = []
    for _ in range(count):
        time.sleep(PAUSE)
        source[:8] = np.frombuffer(np.int64(time.monotonic_ns()).tobytes(), np.uint8)
        end.give(source)
        sent = int(end.take().view(np.int64)[0])
        took.append((time.monotonic_ns() - sent) / 1e3)
    os.waitpid(pid, 0)
    return took


if __name__ == "__main__":
    print(json.dumps(main(int(sys.argv[1]), int(sys.argv[2]))))
