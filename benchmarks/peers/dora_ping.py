"""A dora node: sends, waits for the answer, prints the round trips as JSON.

BYTES and COUNT come from the environment.
"""

from __future__ import annotations

import json
import os
import time
from typing import Any

import numpy as np
import pyarrow as pa
from dora import Node

PAUSE = float(os.environ.get("PAUSE", "0.01"))


def answer(node: Any) -> Any:
    while True:
        event = node.next(timeout=10)
        if event is None or event["type"] == "STOP":
            raise SystemExit("no answer")
        if event["type"] == "INPUT":
            return event["value"]


def main(size: int, count: int) -> list[float]:
    node = Node()
    source = np.zeros(size, np.uint8)
    took = []
    time.sleep(1.0)
    for _ in range(count):
        time.sleep(PAUSE)
        source[:8] = np.frombuffer(np.int64(time.monotonic_ns()).tobytes(), np.uint8)
        node.send_output("ping", pa.array(source))
        sent = int(np.frombuffer(answer(node).to_numpy().tobytes(), np.int64)[0])
        took.append((time.monotonic_ns() - sent) / 1e3)
    return took


if __name__ == "__main__":
    print("TOOK " + json.dumps(main(int(os.environ["BYTES"]), int(os.environ["COUNT"]))), flush=True)
