"""Round trip between two processes with LCM: UDP multicast that does not leave the machine.

usage: lcm_pair.py BYTES COUNT
"""

from __future__ import annotations

import json
import os
import sys
import time

import lcm
import numpy as np

URL = "udpm://239.255.76.67:7667?ttl=0&recv_buf_size=33554432"

PAUSE = float(os.environ.get("PAUSE", "0.01"))


def main(size: int, count: int) -> list[float]:
    pid = os.fork()
    if not pid:
        bus = lcm.LCM(URL)
        bus.subscribe("ping", lambda _, data: bus.publish("pong", np.frombuffer(data, np.uint8)[:8].tobytes()))
        while bus.handle_timeout(5000):
            pass
        os._exit(0)
    bus = lcm.LCM(URL)
    replies: list[bytes] = []
    bus.subscribe("pong", lambda _, data: replies.append(data))
    time.sleep(0.5)
    source = np.zeros(size, np.uint8)
    took = []
    for _ in range(count):
        time.sleep(PAUSE)
        source[:8] = np.frombuffer(np.int64(time.monotonic_ns()).tobytes(), np.uint8)
        bus.publish("ping", source.tobytes())
        while not replies:
            if not bus.handle_timeout(2000):
                raise SystemExit("a message was lost")
        sent = int(np.frombuffer(replies.pop(), np.int64)[0])
        took.append((time.monotonic_ns() - sent) / 1e3)
    os.waitpid(pid, 0)
    return took


if __name__ == "__main__":
    print(json.dumps(main(int(sys.argv[1]), int(sys.argv[2]))))
