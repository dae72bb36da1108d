"""Measures Zenoh between two processes, as programs outside a run get its streams: latency, throughput by size.

Run `python benchmarks/transport.py`; the last table is in `benchmarks/transport.md`. `--stall` stops the consumer for
some seconds in mid-stream and counts what it gets.
"""

from __future__ import annotations

import argparse
import os
import platform
import queue
import signal
import statistics
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dataflow.messages import Image
from dataflow.transport import Bus, Envelope, Kind, NetworkConfig, Reservation, decode, encode

STREAM, ECHO = "bench/source/image", "bench/@/echo"
SIZES = {"1 KB": (16, 21), "100 KB": (160, 208), "900 KB": (480, 640), "4 MB": (1080, 1296)}
WINDOW = 16
IMAGES = 8
ACK = struct.Struct("<QQ")

MODES: dict[str, Mapping[str, Any]] = {
    "network": {},
    "zenoh-defaults": {
        "zenoh": {
            "transport/link/tx/lease": 10_000,
            "transport/link/tx/keep_alive": 4,
            "transport/link/tx/queue/congestion_control/block/wait_before_close": 5_000_000,
            "transport/link/tx/queue/size/data": 2,
            "transport/link/rx/buffer_size": 65_535,
        },
    },
    "zenoh-shm": {
        "zenoh": {
            "transport/shared_memory/enabled": True,
            "transport/shared_memory/mode": "init",
            "transport/shared_memory/transport_optimization/pool_size": 64 << 20,
        },
    },
}


def consume(mode: str, endpoint: str) -> None:
    """The other process: decodes everything, reads one value of each array, and answers with (count, monotonic ns)."""
    inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
    with Bus(NetworkConfig(connect=(endpoint,), **MODES[mode])) as bus:
        echo = bus.publisher(ECHO)
        bus.session.declare_subscriber(STREAM, lambda sample: inbox.put(bytes(sample.payload)))
        count = 0
        while True:
            envelope = decode(inbox.get(timeout=60))
            if envelope.kind is Kind.END:
                return
            if envelope.message is not None:
                assert isinstance(envelope.message, Image)
                assert envelope.message.data[-1, -1, 0] == envelope.seq % IMAGES
                count += 1
            echo.put(ACK.pack(count, time.monotonic_ns()))


def make_images(shape: tuple[int, int]) -> list[Image]:
    """Images that differ in their last pixel."""
    images = []
    for i in range(IMAGES):
        data = np.zeros((*shape, 3), np.uint8)
        data[-1, -1, 0] = i
        images.append(Image(stamp=i, frame="camera", data=data))
    return images


class Producer:
    """Sends images and waits for the consumer's answers."""

    def __init__(self, bus: Bus) -> None:
        self.publisher = bus.publisher(STREAM)
        self.bus = bus
        self.seq = 0
        self.acks: queue.SimpleQueue[tuple[int, int]] = queue.SimpleQueue()
        self.answered = 0
        bus.session.declare_subscriber(ECHO, lambda sample: self.acks.put(ACK.unpack(bytes(sample.payload))))

    def connect(self) -> None:
        """Probes until the consumer answers."""
        end = time.monotonic() + 20
        while time.monotonic() < end:
            self.publisher.put(encode(Envelope(Kind.PROBE, STREAM, 0, 0, 0)))
            try:
                self.acks.get(timeout=0.05)
            except queue.Empty:
                continue
            break
        time.sleep(0.2)
        while not self.acks.empty():
            self.acks.get()

    def send(self, images: list[Image]) -> int:
        """Publishes the next image; when that began (monotonic ns)."""
        image = images[self.seq % IMAGES]
        start = time.monotonic_ns()
        self.publisher.put(encode(Envelope(Kind.MESSAGE, STREAM, 0, self.seq, image.stamp, image)))
        self.seq += 1
        return start

    def wait_until(self, outstanding: int, timeout: float = 30.0) -> int:
        """Waits until at most `outstanding` messages are unanswered; when the last answer was given (monotonic ns)."""
        at = 0
        while self.seq - self.answered > outstanding:
            self.answered, at = self.acks.get(timeout=timeout)
        return at


def measure(producer: Producer, shape: tuple[int, int], rounds: int) -> tuple[float, float, float, float]:
    """(median, p90 latency one way in µs, send in µs, throughput in MB/s)."""
    images = make_images(shape)
    nbytes = images[0].nbytes()
    latencies, sends = [], []
    for _ in range(rounds):
        start = producer.send(images)
        sends.append((time.monotonic_ns() - start) / 1e3)
        latencies.append((producer.wait_until(0) - start) / 1e3)
    count = max(100, min(4000, 600_000_000 // nbytes))
    began = time.monotonic()
    for _ in range(count):
        producer.send(images)
        producer.wait_until(WINDOW - 1)
    producer.wait_until(0)
    rate = count * nbytes / (time.monotonic() - began) / 1e6
    return statistics.median(latencies), statistics.quantiles(latencies, n=10)[8], statistics.median(sends), rate


def stall(producer: Producer, consumer: int, seconds: float) -> tuple[int, int]:
    """Stops the consumer while 60 images go out, then sends 20 more; (messages sent, messages it got)."""
    images = make_images((480, 640))
    os.kill(consumer, signal.SIGSTOP)
    resume = threading.Timer(seconds, os.kill, (consumer, signal.SIGCONT))
    resume.start()
    for _ in range(60):
        producer.send(images)
        time.sleep(0.02)
    resume.join()
    for _ in range(20):
        producer.send(images)
    try:
        producer.wait_until(0, timeout=3.0)
    except (queue.Empty, ValueError):
        return producer.seq, producer.answered
    return producer.seq, producer.answered


def run(mode: str, rounds: int, stalled: float) -> list[str]:
    rows = []
    with Reservation(1) as reserved, Bus(NetworkConfig(listen=reserved.endpoints, **MODES[mode])) as bus:
        child = subprocess.Popen([sys.executable, __file__, "--consume", mode, "--endpoint", reserved.endpoints[0]])
        try:
            producer = Producer(bus)
            producer.connect()
            if stalled:
                sent, got = stall(producer, child.pid, stalled)
                rows.append(f"| {mode} | {sent} | {got} |")
            else:
                for name, shape in SIZES.items():
                    median, p90, send, rate = measure(producer, shape, rounds)
                    rows.append(f"| {name} | {mode} | {median:.0f} | {p90:.0f} | {send:.0f} | {rate:.0f} |")
                print(f"{mode}: {bus.counters()}", file=sys.stderr)
            producer.publisher.put(encode(Envelope(Kind.END, STREAM, 0, producer.seq, producer.seq, reason="done")))
            child.wait(20)
        finally:
            child.kill()
            child.wait()
    left = sorted(os.listdir("/dev/shm")) if Path("/dev/shm").is_dir() else []
    print(f"{mode}: left in /dev/shm: {left}", file=sys.stderr)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--modes", nargs="+", default=list(MODES), choices=MODES)
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--stall", type=float, default=0.0, metavar="SECONDS")
    parser.add_argument("--consume", choices=MODES, help=argparse.SUPPRESS)
    parser.add_argument("--endpoint", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.consume:
        consume(options.consume, options.endpoint)
        return
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}\n")
    if options.stall:
        print("| mode | sent | received |\n| --- | --- | --- |")
    else:
        print("| size | mode | latency p50, µs | p90, µs | send, µs | throughput, MB/s |")
        print("| --- | --- | --- | --- | --- | --- |")
    for mode in options.modes:
        print("\n".join(run(mode, options.rounds, options.stall)), flush=True)


if __name__ == "__main__":
    main()
