"""Makes a recording of many days, and measures how it opens, seeks and verifies its last minute.

python benchmarks/long_recording.py make LONG.mcap --chunks 10000000
python benchmarks/long_recording.py measure LONG.mcap
python benchmarks/long_recording.py verify LONG.mcap

A source of 2 Hz and an operator with a state, flushed after each message: two chunks every half second. The first 100 s
and the
last hour are as a run writes them; in between, one firing record and message are repeated, so that only these verify.
"""

from __future__ import annotations

import argparse
import resource
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from long_recording_operators import EPOCH, PERIOD, numbered
from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from dataflow.execution.snapshots import pack_state
from dataflow.messages import FeatureVector
from dataflow.recording import Recording, RecordingWriter
from dataflow.recording.layout import RESERVED_METADATA, firings_topic
from dataflow.recording.mcap.ending import record_bytes
from dataflow.recording.mcap.seals import sealed
from dataflow.recording.streams.codecs import codec_for
from dataflow.records.firing import Emission, FiringRecord, decode_batch, encode_batch, encode_single
from dataflow.sync import FOREVER, MessageRef
from dataflow.verification.verify import verify

GRAPH = """\
graph: long
namespace: g
operators:
  pulse: {use: "long_recording_operators:Pulse"}
  sum: {use: "long_recording_operators:Sum", inputs: {x: pulse/out}}
record: {snapshots: 10s}
"""
SOURCE, SUM = "g/pulse/out", "g/sum/out"
BLOCK = 20_000
TRUE_HEAD, TRUE_TAIL, SNAPSHOT_EVERY = 200, 7200, 20
"""Messages that are as a run makes them, and between two snapshots there."""


def record_seed(folder: Path, graph: str = GRAPH) -> Path:
    """A run of the graph, for its metadata and the records of `setup()`."""
    (folder / "long.yaml").write_text(graph)
    out = folder / "seed.mcap"
    command = [str(Path(sys.executable).with_name("dataflow")), "run", str(folder / "long.yaml"), "--record", str(out)]
    environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": str(Path(__file__).resolve().parent)}
    subprocess.run(command, check=True, timeout=120, env=environment, stdout=subprocess.DEVNULL)
    return out


class Maker:
    """Writes the run step by step; `records` counts what each operator's log holds."""

    def __init__(self, out: Path, seed: Path) -> None:
        with Recording(seed) as recording:
            metadata = {n: v for n, v in recording.metadata.items() if n not in RESERVED_METADATA}
            setups = dict(reversed(list(recording.firings())))
            extras = {name: recording.streams[name].metadata for name in (SOURCE, SUM)}
        self.writer = RecordingWriter(out, metadata=metadata, namespace="g", overwrite=True)
        for stream in (SOURCE, SUM):
            self.writer.add_stream(
                stream, FeatureVector, extra={key: extras[stream][key] for key in ("operator", "port")}
            )
        self.index = {"pulse": 0, "sum": 0}
        for name, payload in setups.items():
            self.writer.write_firings(name, EPOCH, encode_batch([decode_batch(payload).records[0]]))
            self.index[name] = 1

    def write(self, k: int) -> None:
        """Message `k` and what follows from it, as a run writes them."""
        stamp = EPOCH + k * PERIOD
        for operator, payload in self.records(k, true=True):
            self.writer.write_firings(operator, stamp, payload)
        self.writer.write(SOURCE, numbered(stamp, k % 1000), seq=k)
        self.writer.write(SUM, numbered(stamp, (k + 1) % 1000), seq=k)
        self.writer.flush()

    def fill(self, begin: int, end: int) -> None:
        """Messages `begin` to `end` - 1: the chunks that a run writes, copies of one with other times."""
        file = self.writer._file
        streams = [self.writer._streams[name].channel for name in (SOURCE, SUM)]
        topics = [firings_topic(self.writer._namespace, name) for name in ("pulse", "sum")]
        logs = [self.writer._run[topic][0] for topic in topics]
        body = bytes(codec_for(FeatureVector).encode(numbered(EPOCH, 0))[0][0])
        block = Block(logs, [payload for _, payload in self.records(begin, true=False)], streams, [body, body])
        file._chunks._packed.append(zlib.compress(file._chunks._newest))
        file._chunks._newest.clear()
        for first in range(begin, end, BLOCK):
            numbers = np.arange(first, min(first + BLOCK, end))
            data, indexes = block.at(file.saved_bytes, numbers)
            file._append(data)
            file._chunks._packed.append(zlib.compress(indexes, 1))
            file._chunks.count += 2 * len(numbers)
        for channel in (*streams, *logs):
            file._counts[channel] += end - begin
        for name in (SOURCE, SUM):
            stream = self.writer._streams[name]
            stream.last_seq, stream.last_stamp = end - 1, EPOCH + (end - 1) * PERIOD
        for operator in self.index:
            self.index[operator] += end - begin - 1

    def records(self, k: int, *, true: bool) -> list[tuple[str, bytes]]:
        """The firing records of message `k`."""
        stamp = EPOCH + k * PERIOD
        digests = [numbered(stamp, n % 1000).digest() for n in (k, k + 1)] if true else [bytes(16)] * 2
        records = [
            FiringRecord("pulse", 0, self.index["pulse"], "fire", stamp, outputs=(Emission(k, stamp, digests[0]),)),
            FiringRecord(
                "sum",
                0,
                self.index["sum"],
                "fire",
                stamp,
                inputs={"x": MessageRef(SOURCE, 0, k)},
                outputs=(Emission(k, stamp, digests[1]),),
            ),
        ]
        for record in records:
            self.index[record.operator] += 1
        found = [(record.operator, encode_single(record)) for record in records]
        if true and k % SNAPSHOT_EVERY == 0:
            state = {"state": pack_state({"calls": k + 1})}
            snapshot = FiringRecord("sum", 0, self.index["sum"], "snapshot", stamp, detail=state)
            found.append(("sum", encode_batch([snapshot])))
            self.index["sum"] += 1
        return found


class Block:
    """Pairs of chunks, of which times, numbers, places and checksums are set in a template."""

    STAMP, NUMBER, POSITION = 0x1122334455667788, 0x51525354, 0x0102030405060000

    def __init__(self, logs: list[int], records: list[bytes], streams: list[int], bodies: list[bytes]) -> None:
        first, one = chunk(self.POSITION, logs, records, self.NUMBER, self.STAMP)
        second, two = chunk(self.POSITION + len(first), streams, bodies, self.NUMBER, self.STAMP)
        self._row, self._indexes = first + second, record_bytes(one) + record_bytes(two)
        self._sums = [(49, 49 + one.uncompressed_size, 33)]
        self._sums.append((len(first) + 49, len(first) + 49 + two.uncompressed_size, len(first) + 33))
        for index in (one, two):
            for place in index.message_index_offsets.values():
                at = place - self.POSITION
                self._sums.append((at, at + 35, at + 35))
        starts = [self.POSITION, self.POSITION + len(first)]
        self._places = starts + [p for index in (one, two) for p in index.message_index_offsets.values()]

    def at(self, position: int, numbers: npt.NDArray[np.int64]) -> tuple[bytes, bytes]:
        """The pairs of some numbers as they lie at `position`, and their chunk indexes."""
        size, length = len(numbers), len(self._row)
        rows = np.tile(np.frombuffer(self._row, np.uint8), (size, 1))
        indexes = np.tile(np.frombuffer(self._indexes, np.uint8), (size, 1))
        stamps = EPOCH + numbers * PERIOD
        for template, table in ((self._row, rows), (self._indexes, indexes)):
            put(table, template, struct.pack("<Q", self.STAMP), stamps)
            put(table, template, struct.pack("<I", self.NUMBER), numbers.astype(np.uint32))
        for place in self._places:
            there = position + place - self.POSITION + length * np.arange(size)
            put(indexes, self._indexes, struct.pack("<Q", place), there)
        flat = rows.reshape(-1).data
        for begin, end, at in self._sums:
            sums = [zlib.crc32(flat[row + begin : row + end]) for row in range(0, size * length, length)]
            rows[:, at : at + 4] = np.array(sums, np.uint32).view(np.uint8).reshape(size, 4)
        return rows.tobytes(), indexes.tobytes()


def put(table: npt.NDArray[np.uint8], template: bytes, mark: bytes, values: npt.NDArray[Any]) -> None:
    """Sets one value in each row, wherever the template has `mark`."""
    at = template.find(mark)
    while at >= 0:
        table[:, at : at + len(mark)] = values.view(np.uint8).reshape(len(values), len(mark))
        at = template.find(mark, at + 1)


def chunk(
    position: int, channels: list[int], bodies: list[bytes], sequence: int, stamp: int
) -> tuple[bytes, ChunkIndex]:
    """A chunk of a message on each channel with its message indexes, as it lies at `position`, and its index."""
    content, offsets = b"", []
    for channel, body in zip(channels, bodies, strict=True):
        offsets.append(len(content))
        content += struct.pack("<BQHIQQ", Opcode.MESSAGE, 22 + len(body), channel, sequence, stamp, stamp) + body
    head = struct.pack("<BQQQQI", Opcode.CHUNK, 40 + len(content), stamp, stamp, len(content), zlib.crc32(content))
    data = head + struct.pack("<IQ", 0, len(content)) + content
    length, places = len(data), {}
    for channel, offset in zip(channels, offsets, strict=True):
        places[channel] = position + len(data)
        data += sealed(struct.pack("<BQHIQQ", Opcode.MESSAGE_INDEX, 22, channel, 16, stamp, offset))
    return data, ChunkIndex(
        chunk_length=length,
        chunk_start_offset=position,
        compression="",
        compressed_size=len(content),
        message_end_time=stamp,
        message_index_length=len(data) - length,
        message_index_offsets=places,
        message_start_time=stamp,
        uncompressed_size=len(content),
    )


def make(out: Path, chunks: int) -> None:
    """Writes the recording."""
    messages = chunks // 2
    with tempfile.TemporaryDirectory() as folder:
        maker = Maker(out, record_seed(Path(folder)))
    tail = max(TRUE_HEAD, messages - TRUE_TAIL)
    began = time.monotonic()
    with maker.writer:
        for k in range(TRUE_HEAD):
            maker.write(k)
        maker.fill(TRUE_HEAD, tail)
        for k in range(tail, messages):
            maker.write(k)
        final = EPOCH + messages * PERIOD
        for name in ("pulse", "sum"):
            last = FiringRecord(name, 0, maker.index[name], "finish", FOREVER, outputs=(None,))
            maker.writer.write_firings(name, final, encode_batch([last], last=True))
    size, taken = out.stat().st_size / 1e9, time.monotonic() - began
    print(f"{2 * messages:,} chunks, {messages * PERIOD * 1e-9 / 86400:.1f} days, {size:.2f} GB, made in {taken:.0f} s")


def measure(path: Path) -> None:
    """Prints what opening, seeking and verifying the last minute take."""
    began = time.monotonic()
    with Recording(path) as recording:
        print(f"open            {time.monotonic() - began:6.2f} s, {peak()} MB")
        info = recording.streams[SUM]
        assert info.first is not None
        assert info.last is not None
        for share in (0.5, 0.001, 0.999):
            stamp = info.first + round(share * (info.last - info.first))
            began = time.monotonic()
            found = next(iter(recording.messages([SUM], start=stamp)))
            assert 0 <= found.stamp - stamp <= PERIOD
            print(f"seek to {share:6.1%}  {time.monotonic() - began:6.2f} s, {peak()} MB")


def verify_end(path: Path) -> None:
    """Prints what verifying the last minute takes."""
    began = time.monotonic()
    with Recording(path) as recording:
        info = recording.streams[SUM]
        start = ((info.last or 0) - (info.first or 0)) * 1e-9 - 60
    del recording, info
    report = verify(path, start=start)
    assert report.identical, report
    verified = sum(operator.verified for operator in report.operators)
    print(f"verify last min {time.monotonic() - began:6.2f} s, {verified} firings, {peak()} MB")


def peak() -> int:
    """Peak memory of this process so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["make", "measure", "verify"])
    parser.add_argument("path", type=Path)
    parser.add_argument("--chunks", type=int, default=10_000_000)
    options = parser.parse_args()
    if options.what == "make":
        make(options.path, options.chunks)
    elif options.what == "measure":
        measure(options.path)
    else:
        verify_end(options.path)


if __name__ == "__main__":
    main()
