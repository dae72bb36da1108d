"""Measures how fast recordings are read, against the bare mcap library on the same file.

OMP_NUM_THREADS=1 python benchmarks/reading.py recordings/demo.mcap
"""

from __future__ import annotations

import argparse
import base64
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

import dataflow
from dataflow.recording import Recording

ROUNDS = 7
VECTORS = ("angular_velocity", "linear_acceleration")
Read = Callable[[Path], int]
"""Reads something of a file; returns how many messages that were."""


def bare(path: Path) -> int:
    """Iterates all messages, undecoded, their chunks' checksums checked."""
    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())


def bare_unchecked(path: Path) -> int:
    """Iterates all messages, undecoded; the library's default."""
    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file).iter_messages())


def with_arrays(data: bytes) -> object:
    """A JSON object, with its arrays in base64 as numpy."""
    value = json.loads(data)
    for name, exact in value.get("_exact", {}).items():
        if isinstance(exact, dict) and "base64" in exact:
            flat = np.frombuffer(base64.b64decode(exact["base64"]), exact["dtype"])
            value[name] = flat.reshape(exact["shape"])
    return value


def bare_decoded(path: Path) -> int:
    """Decodes all messages: JSON objects with their arrays as numpy, and protobufs; nothing is checked."""
    count = 0
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoders: dict[int, Callable[[bytes], object] | None] = {}
        for schema, channel, message in reader.iter_messages():
            if channel.id not in decoders:
                made = DecoderFactory().decoder_for(channel.message_encoding, schema)
                decoders[channel.id] = with_arrays if channel.message_encoding == "json" else made
            decode = decoders[channel.id]
            if decode is not None:
                decode(message.data)
            count += 1
    return count


def bare_vectors(path: Path) -> int:
    """Two fields of the IMU's messages as arrays."""
    with path.open("rb") as file:
        read = make_reader(file, validate_crcs=True).iter_messages(topics=["robot1/robot/imu"])
        values = [json.loads(message.data) for _, _, message in read]
    columns = {name: np.array([value[name] for value in values]) for name in VECTORS}
    return len(columns[VECTORS[0]])


def raw(path: Path) -> int:
    """Iterates all messages of streams, undecoded, by timestamp."""
    with Recording(path) as recording:
        return sum(1 for _ in recording.raw())


def messages(path: Path) -> int:
    """Decodes all messages of streams by timestamp: checked, arrays as numpy."""
    with Recording(path) as recording:
        return sum(1 for _ in recording.messages())


def vectors(path: Path) -> int:
    """Two fields of the IMU's messages as arrays."""
    with dataflow.open(path) as recording:
        return len(recording["imu"].columns(*VECTORS)[VECTORS[0]])


def frame(path: Path) -> int:
    """All vectors and scalars of the IMU's messages as a pandas table."""
    with dataflow.open(path) as recording:
        return len(recording["imu"].frame())


def one_image(path: Path) -> int:
    """Opens the file and decodes the image at 15 s."""
    with dataflow.open(path) as recording:
        return int(recording["image_jpeg"].at(15.0) is not None)


CASES: tuple[tuple[str, Read], ...] = (
    ("mcap, undecoded, default (no checksums)", bare_unchecked),
    ("mcap, undecoded, checksums", bare),
    ("`Recording.raw()`", raw),
    ("mcap, JSON with arrays and protobuf decoded", bare_decoded),
    ("`Recording.messages()`", messages),
    ("mcap, two fields of the IMU", bare_vectors),
    ('`recording["imu"].columns(...)`', vectors),
    ('`recording["imu"].frame()`', frame),
    ("`dataflow.open`, one image", one_image),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    options = parser.parse_args()
    counts: dict[str, int] = {}
    times: dict[str, list[tuple[float, float]]] = {name: [] for name, _ in CASES}
    for _ in range(options.rounds + 1):  # the cases take turns, so that other work on the machine meets them alike
        for name, read in CASES:
            clock, cpu = time.perf_counter(), time.process_time()
            counts[name] = read(options.recording)
            times[name].append((time.perf_counter() - clock, time.process_time() - cpu))
    print("| | messages | CPU s | wall s |\n| --- | --- | --- | --- |")
    for name, taken in times.items():
        wall, cpu = (min(column) for column in zip(*taken[1:], strict=True))  # the first round imports and warms up
        print(f"| {name} | {counts[name]:,} | {cpu:.3f} | {wall:.3f} |")


if __name__ == "__main__":
    main()
